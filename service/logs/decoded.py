"""Raw messages, decoded: what Foxglove and Lichtblick show of a vehicle without being told anything.

Sans-I/O. Topics stand under `/<vehicle>/`; poses, transforms, the scene and the log are in Foxglove's schemas, the rest
are the models of views.py. Frames are read by the wire spec in a contract, so they give nothing before it came. At a
bounded rate a message that is not due is turned away before anything of it is looked at: time is cut into slots, and
the first message in a slot passes. What happens once always passes, and so do statuses, which come once a second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from foxglove.messages import FrameTransform, Log, LogLevel, Pose, PoseInFrame, Quaternion, SceneUpdate, Vector3
from pydantic import ValidationError

from protocol import attitude, topics, verbs
from protocol.clock import LoopSettings
from protocol.messages import Contract, Event, Loss, Status, Telemetry, Truth
from protocol.transmit import SILENCE
from protocol.wire import WireSpec
from service.logs import views
from service.logs.body import WORLD, desired_frame_of, frame_of, scene, timestamp
from service.logs.schemas import Shape as Shape
from service.logs.schemas import json_shape, protobuf_shape

LIMITED: Final = frozenset({"measurement", "command", "telemetry", "truth", "reference"})
"""Topics of the network that stream, and so are held to the rate."""

UNLIMITED: Final = frozenset({"status", "event", "change", "loss"})
"""Topics that always pass."""

ROLES: Final = ("plant", "controller", "recorder")
"""Whose statuses are known beforehand; those of others are decoded just the same."""

_POSE: Final = protobuf_shape(PoseInFrame.get_schema())
_TRANSFORM: Final = protobuf_shape(FrameTransform.get_schema())
_STATUS: Final = json_shape("aeroloop.RoleStatus", views.RoleStatus)
_ATTITUDE: Final = json_shape("aeroloop.Attitude", views.Attitude)
_HERE: Final = Vector3()

_LEVELS: Final = {
    "tripped": LogLevel.Error,
    "fault": LogLevel.Error,
    "lost": LogLevel.Warning,
    "refused": LogLevel.Warning,
}
"""Of an event, by its kind; Info for all others."""

SHAPES: Final = {
    "pose": _POSE,
    "tf": _TRANSFORM,
    "measurement": _ATTITUDE,
    "command": json_shape("aeroloop.Voltages", views.Voltages),
    "tracking": json_shape("aeroloop.Tracking", views.Tracking),
    "desired_pose": _POSE,
    "desired_tf": _TRANSFORM,
    "truth": _ATTITUDE,
    "setpoint": json_shape("aeroloop.Setpoint", views.Setpoint),
    "scene": protobuf_shape(SceneUpdate.get_schema()),
    "log": protobuf_shape(Log.get_schema()),
    **{f"status/{role}": _STATUS for role in ROLES},
}
"""Topics below `/<vehicle>/`."""


def topic_of(vehicle: str, name: str) -> str:
    """A topic of a vehicle, such as `/aero/pose`; for names see SHAPES."""
    return f"/{vehicle}/{name}"


class Decoded(NamedTuple):
    """A message to show.

    Attributes:
        topic: Such as `/aero/pose`.
        shape: How it is to be read; the same for every message of a topic.
        data: The message itself.
        at_ns: When that which it was made from was published, ns since 1970.
    """

    topic: str
    shape: Shape
    data: bytes
    at_ns: int


class _Wire:
    """How a vehicle's frames are read, as its contract says. Raises as pydantic does, KeyError or TypeError."""

    def __init__(self, contract: Contract) -> None:
        spec = WireSpec.model_validate(contract.config["wire"])
        voltage = spec.voltage.quantizer()
        self.silent = {name for name in ("measurement", "command") if getattr(spec.transmit, name) == "on_change"}
        self.role = contract.role
        self.kind = str(contract.config["plant"]["kind"])
        self.period = LoopSettings.model_validate(contract.config["loop"]).period
        self.measurement, self.command = spec.measurement.unpack, spec.command.unpack
        self.attitude: Callable[[float], float] = spec.attitude.quantizer().level
        self.rate: Callable[[float], float] = spec.rate.quantizer().level
        self.voltage: Callable[[float], float] = voltage.level
        self.outermost = voltage.outermost


class Decoder:
    """Decodes what crosses the network.

    Args:
        rate_hz: At most so many messages a second of each topic that streams, by time of publication; None: all.

    Attributes:
        malformed: Messages and contracts so far that could not be read.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self.malformed = 0
        self._slot_ns = 0 if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._slots: dict[tuple[str, str], int] = {}
        self._wires: dict[str, _Wire] = {}
        self._readers: dict[str, Callable[[topics.Address, bytes, int], list[Decoded]]] = {
            "measurement": self._measurement,
            "command": self._command,
            "telemetry": self._telemetry,
            "truth": self._truth,
            "reference": self._reference,
            "status": self._status,
            "event": self._event,
            "change": self._change,
            "loss": self._loss,
        }

    def configure(self, contract: Contract) -> None:
        """Read a vehicle's frames by this contract from now on.

        A controller's counts while there is none of a plant: the plant decides whose frames it takes. Other roles' do
        not: what a recorder was configured with need not be what is on the wire.
        """
        known = self._wires.get(contract.vehicle)
        if contract.role == "plant" or (contract.role == "controller" and (known is None or known.role != "plant")):
            try:
                self._wires[contract.vehicle] = _Wire(contract)
            except (ValidationError, KeyError, TypeError):
                self.malformed += 1

    def take(self, address: topics.Address, payload: bytes, published_ns: int) -> list[Decoded]:
        """What a message gives: nothing if it is not due, malformed, or of no interest to a person.

        Args:
            address: What its key says.
            payload: Its bytes.
            published_ns: When it was published, ns since 1970.
        """
        topic, vehicle, _, _ = address
        name = topic.name
        if payload == SILENCE and (wire := self._wires.get(vehicle)) and name in wire.silent:
            return []
        if self._slot_ns and name in LIMITED:
            source, slot = (name, vehicle), published_ns // self._slot_ns
            if self._slots.get(source) == slot:
                return []
            self._slots[source] = slot
        read = self._readers.get(name)
        if read is None:
            return []
        try:
            return read(address, payload, published_ns)
        except (ValidationError, _MalformedError):
            self.malformed += 1
            return []

    def _measurement(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        vehicle, wire = address.vehicle, self._wires.get(address.vehicle)
        if wire is None:
            return []
        _, codes = _read(wire.measurement(payload))
        x, y, z = (wire.attitude(code) for code in codes[:3])
        p, q, r = (wire.rate(code) for code in codes[3:])
        known = x + y + z == x + y + z  # not NaN: a valid value
        measured = attitude.received_quaternion(x, y, z, attitude.IDENTITY) if known else None
        shown = _shown(vehicle, "measurement", views.Attitude.of(measured, (p, q, r)), at_ns)
        return [shown, *_posed(vehicle, "", frame_of(vehicle), measured, at_ns)] if measured else [shown]

    def _command(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        wire = self._wires.get(address.vehicle)
        if wire is None:
            return []
        _, codes = _read(wire.command(payload))
        return [_shown(address.vehicle, "command", views.Voltages.of(codes, wire.voltage, wire.outermost), at_ns)]

    def _telemetry(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Telemetry.model_validate_json(payload)
        vehicle, wire = address.vehicle, self._wires.get(address.vehicle)
        tracking = views.Tracking.of(told, wire.period if wire else None)
        return [
            _shown(vehicle, "tracking", tracking, at_ns),
            *_posed(vehicle, "desired_", desired_frame_of(vehicle), told.desired, at_ns),
        ]

    def _truth(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Truth.model_validate_json(payload)
        return [_shown(address.vehicle, "truth", views.Attitude.of(told.attitude, told.rate), at_ns)]

    def _reference(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = verbs.Setpoint.model_validate_json(payload)
        return [_shown(address.vehicle, "setpoint", views.Setpoint.of(told.attitude), at_ns)]

    def _status(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Status.model_validate_json(payload)
        vehicle, wire = address.vehicle, self._wires.get(address.vehicle)
        status = Decoded(
            topic_of(vehicle, f"status/{address.role}"), _STATUS, views.RoleStatus.of(told).encode(), at_ns
        )
        if address.role != "plant" or wire is None:
            return [status]
        body = scene(vehicle, wire.kind, at_ns)  # again with every status, for whoever comes late
        return [status, Decoded(topic_of(vehicle, "scene"), SHAPES["scene"], body, at_ns)]

    def _event(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Event.model_validate_json(payload)
        level = _LEVELS.get(told.kind, LogLevel.Info)
        return [_logged(address.vehicle, level, told.role, f"{told.kind}: {told.text}", at_ns)]

    def _change(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = verbs.Change.model_validate_json(payload)
        what = told.model_dump_json(include={"gains", "reference", "within_s"}, exclude_none=True)
        return [_logged(address.vehicle, LogLevel.Debug, "controller", f"from tick {told.tick} on: {what}", at_ns)]

    def _loss(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Loss.model_validate_json(payload)
        text = f"{told.count} messages of {told.key} are not in the log ({told.reason})"
        return [_logged(address.vehicle, LogLevel.Warning, "recorder", text, at_ns)]


class _MalformedError(Exception):
    """A frame cannot be read."""


def _read(frame: tuple[int, tuple[float, ...]] | None) -> tuple[int, tuple[float, ...]]:
    if frame is None:
        raise _MalformedError
    return frame


def _shown(vehicle: str, name: str, view: views.View, at_ns: int) -> Decoded:
    return Decoded(topic_of(vehicle, name), SHAPES[name], view.encode(), at_ns)


def _logged(vehicle: str, level: LogLevel, name: str, text: str, at_ns: int) -> Decoded:
    line = Log(timestamp=timestamp(at_ns), level=level, message=text, name=name)
    return Decoded(topic_of(vehicle, "log"), SHAPES["log"], line.encode(), at_ns)


def _posed(vehicle: str, prefix: str, frame: str, q: attitude.Quaternion, at_ns: int) -> list[Decoded]:
    """An attitude as a pose in the world, and as the transform from the world to a frame."""
    at, turned = timestamp(at_ns), Quaternion(w=q[0], x=q[1], y=q[2], z=q[3])
    pose = PoseInFrame(timestamp=at, frame_id=WORLD, pose=Pose(position=_HERE, orientation=turned))
    transform = FrameTransform(
        timestamp=at, parent_frame_id=WORLD, child_frame_id=frame, translation=_HERE, rotation=turned
    )
    return [
        Decoded(topic_of(vehicle, f"{prefix}pose"), _POSE, pose.encode(), at_ns),
        Decoded(topic_of(vehicle, f"{prefix}tf"), _TRANSFORM, transform.encode(), at_ns),
    ]
