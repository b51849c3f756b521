"""Raw messages, decoded: what Foxglove and Lichtblick show of a vehicle without any configuration.

Sans-I/O. Topics stand under `/<vehicle>/`; poses, transforms, the scene and the log are in Foxglove's schemas, the rest
are the models of views.py. Of traces, the plant's rows give the measurements that it sent and the controller's the
commands that it sent, at the times of sending on their own wall clocks. The wire spec in a description decodes them,
so they give nothing before it. Time is cut into slots, and the first row or message in a slot passes; at a bounded rate
no other is looked at. What happens once always passes, and so do statuses, which come once a second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from foxglove.messages import FrameTransform, Log, LogLevel, Pose, PoseInFrame, Quaternion, SceneUpdate, Vector3
from pydantic import ValidationError

from aeroloop.protocol.messages import operator as verbs
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, Loss, Status, Telemetry, Truth
from aeroloop.protocol.messages.trace import Batch, Sent, read_batch
from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import SILENCE
from aeroloop.service.viewers import views
from aeroloop.service.viewers.body import WORLD, desired_frame_of, frame_of, scene, timestamp
from aeroloop.service.viewers.schemas import Shape as Shape
from aeroloop.service.viewers.schemas import json_shape, protobuf_shape

LIMITED: Final = frozenset({"telemetry", "truth", "reference"})
"""Messages that stream, and so are held to the rate; as the rows of traces are."""

_FRAME: Final = Sent.FRAME.value

UNLIMITED: Final = frozenset({"status", "event", "loss"})
"""Messages that always pass."""

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
    "setpoint": json_shape("aeroloop.Setpoint", views.SetpointView),
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
    """How a vehicle's frames are read, as its description says. Raises as pydantic does, KeyError or TypeError."""

    def __init__(self, description: Description) -> None:
        spec = WireSpec.model_validate(description.config["wire"])
        voltage = spec.voltage.quantizer()
        self.silent = {name for name in ("measurement", "command") if getattr(spec.transmit, name) == "on_change"}
        self.role = description.role
        self.kind = str(description.config["plant"]["kind"])
        self.period = LoopSettings.model_validate(description.config["loop"]).period
        self.measurement, self.command = spec.measurement.unpack, spec.command.unpack
        self.attitude: Callable[[float], float] = spec.attitude.quantizer().level
        self.rate: Callable[[float], float] = spec.rate.quantizer().level
        self.voltage: Callable[[float], float] = voltage.level
        self.outermost = voltage.outermost


class Decoder:
    """Decodes what is published.

    Args:
        rate_hz: At most so many messages a second of each topic that streams, by time of publication; None: all.

    Attributes:
        malformed: Messages, rows and descriptions so far that could not be read.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self.malformed = 0
        self._slot_ns = 0 if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._slots: dict[tuple[str, str], int] = {}
        self._wires: dict[str, _Wire] = {}
        self._readers: dict[str, Callable[[topics.Address, bytes, int], list[Decoded]]] = {
            "trace": self._trace,
            "telemetry": self._telemetry,
            "truth": self._truth,
            "reference": self._reference,
            "status": self._status,
            "event": self._event,
            "loss": self._loss,
        }
        self._frames: dict[str, Callable[[str, _Wire, bytes, int], list[Decoded]]] = {
            "measurement": self._measurement,
            "command": self._command,
        }

    def configure(self, description: Description) -> None:
        """Read a vehicle's frames by this description from now on.

        A controller's counts while there is none of a plant: the plant decides whose frames it takes. Other roles' do
        not: what a recorder was configured with need not be what is on the wire.
        """
        known = self._wires.get(description.vehicle)
        if description.role == "plant" or (
            description.role == "controller" and (known is None or known.role != "plant")
        ):
            try:
                self._wires[description.vehicle] = _Wire(description)
            except (ValidationError, KeyError, TypeError):
                self.malformed += 1

    def take(self, address: topics.Address, payload: bytes, published_ns: int) -> list[Decoded]:
        """What a message or a batch of a trace gives: nothing if it is not due, malformed, or of no interest.

        Args:
            address: What its key says; a frame's gives nothing, as the traces have it.
            payload: Its bytes.
            published_ns: When it was published, ns since 1970.
        """
        read = self._readers.get(address.topic.name)
        if read is None:
            return []
        if address.topic.name in LIMITED and not self._due(address.topic.name, address.vehicle, published_ns):
            return []
        try:
            return read(address, payload, published_ns)
        except (ValidationError, _MalformedError):
            self.malformed += 1
            return []

    def frame(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        """What a frame from the network gives, at whatever rate; silence in lockstep gives nothing."""
        wire, show = self._wires.get(address.vehicle), self._frames.get(address.topic.name)
        if wire is None or show is None or (payload == SILENCE and address.topic.name in wire.silent):
            return []
        try:
            return show(address.vehicle, wire, payload, at_ns)
        except _MalformedError:
            self.malformed += 1
            return []

    def rows(self, vehicle: str, batch: Batch) -> list[Decoded]:
        """What the rows of a trace give: the plant's its measurements, the controller's its commands."""
        wire, columns, base_ns = self._wires.get(vehicle), batch.columns, batch.header.wall_ns
        if wire is None:
            return []
        name = "measurement" if batch.header.end == "plant" else "command"
        show, frames, found = self._frames[name], columns[name], []
        slot_ns, last = self._slot_ns, self._slots.get((name, vehicle), -1)
        for row, (sent_as, sent) in enumerate(zip(columns["sent_as"].tolist(), columns["sent"].tolist(), strict=True)):
            at_ns = base_ns + sent * 1000
            if sent_as != _FRAME or at_ns < 0 or (slot_ns and at_ns // slot_ns == last):
                continue
            last = at_ns // slot_ns if slot_ns else -1
            try:
                found += show(vehicle, wire, frames[row].tobytes(), at_ns)
            except _MalformedError:
                self.malformed += 1
        self._slots[name, vehicle] = last
        return found

    def _due(self, name: str, vehicle: str, at_ns: int) -> bool:
        """Whether it is the first of its source in its slot of time."""
        if not self._slot_ns:
            return True
        source, slot = (name, vehicle), at_ns // self._slot_ns
        if self._slots.get(source) == slot:
            return False
        self._slots[source] = slot
        return True

    def _trace(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        del at_ns  # its rows have their own times
        batch = read_batch(payload)
        if batch is None:
            raise _MalformedError
        return self.rows(address.vehicle, batch)

    def _measurement(self, vehicle: str, wire: _Wire, payload: bytes, at_ns: int) -> list[Decoded]:
        _, codes = _read(wire.measurement(payload))
        x, y, z = (wire.attitude(code) for code in codes[:3])
        p, q, r = (wire.rate(code) for code in codes[3:])
        known = x + y + z == x + y + z  # not NaN: a valid value
        measured = attitude.received_quaternion(x, y, z, attitude.IDENTITY) if known else None
        shown = _shown(vehicle, "measurement", views.Attitude.of(measured, (p, q, r)), at_ns)
        return [shown, *_posed(vehicle, "", frame_of(vehicle), measured, at_ns)] if measured else [shown]

    def _command(self, vehicle: str, wire: _Wire, payload: bytes, at_ns: int) -> list[Decoded]:
        _, codes = _read(wire.command(payload))
        return [_shown(vehicle, "command", views.Voltages.of(codes, wire.voltage, wire.outermost), at_ns)]

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
        return [_shown(address.vehicle, "setpoint", views.SetpointView.of(told.attitude), at_ns)]

    def _status(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Status.model_validate_json(payload)
        vehicle, wire = address.vehicle, self._wires.get(address.vehicle)
        status = Decoded(
            topic_of(vehicle, f"status/{address.role}"), _STATUS, views.RoleStatus.of(told).encode(), at_ns
        )
        if address.role != "plant" or wire is None:
            return [status]
        body = scene(vehicle, wire.kind, at_ns)  # again with every status, for a viewer that connects late
        return [status, Decoded(topic_of(vehicle, "scene"), SHAPES["scene"], body, at_ns)]

    def _event(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        told = Event.model_validate_json(payload)
        level = _LEVELS.get(told.kind, LogLevel.Info)
        return [_logged(address.vehicle, level, told.role, f"{told.kind}: {told.text}", at_ns)]

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
