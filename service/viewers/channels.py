"""Decoder of raw messages into topics that Foxglove and Lichtblick show without any configuration.

Sans-I/O. Topics are under `/<vehicle>/`; poses, transforms, the scene and the log have Foxglove's schemas, the rest
are the models of views.py. The plant's trace rows give measurements, the controller's rows give commands, at the times
of sending on their own wall clocks. The wire spec in a description decodes them; rows before it are dropped. Time is
divided into slots, and the first row or message of a slot passes; the others are not decoded. Events, losses and
statuses, which are published once a second, always pass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from foxglove.messages import FrameTransform, Log, LogLevel, Pose, PoseInFrame, Quaternion, SceneUpdate, Vector3
from pydantic import ValidationError

from aeroloop.protocol.messages import operator as verbs
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Description, Event, Loss, Status, Telemetry, Truth
from aeroloop.protocol.messages.trace import Batch, Sent, read_batch
from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.viewers import views
from aeroloop.service.viewers.body import WORLD, desired_frame_of, frame_of, scene, timestamp
from aeroloop.service.viewers.schemas import Decoded, json_shape, protobuf_shape

LIMITED: Final = frozenset(topic.name for topic in topics.TOPICS.values() if topic.decoded == "limited")
"""Streaming messages, which are limited to the rate, like the rows of traces."""

_FRAME: Final = Sent.FRAME.value

UNLIMITED: Final = frozenset(topic.name for topic in topics.TOPICS.values() if topic.decoded == "always")
"""Messages that always pass."""

ROLES: Final = ("plant", "controller", "recorder")
"""Roles with a status topic from the start; statuses of other roles are decoded, too."""

_POSE: Final = protobuf_shape(PoseInFrame.get_schema())
_TRANSFORM: Final = protobuf_shape(FrameTransform.get_schema())
_STATUS: Final = json_shape("aeroloop.RoleStatus", views.RoleStatus)
_ATTITUDE: Final = json_shape("aeroloop.Attitude", views.Attitude)
_HERE: Final = Vector3()

_ERROR, _WARNING = LogLevel.Error, LogLevel.Warning
_LEVELS: Final = {"tripped": _ERROR, "fault": _ERROR, "lost": _WARNING, "refused": _WARNING}
"""Log level by kind of event; Info for all others."""

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


class _Wire:
    """Frame formats of a vehicle by its description. Raises ValidationError, KeyError or TypeError."""

    def __init__(self, description: Description) -> None:
        spec = WireSpec.model_validate(description.config["wire"])
        voltage = spec.voltage.quantizer()
        self.silent = {name for name in ("measurement", "command") if getattr(spec.transmit, name) == "on_change"}
        self.role = description.role
        self.kind = str(description.config["plant"]["kind"])
        self.period = LoopSettings.model_validate(description.config["loop"]).period
        self.unpack = {"measurement": spec.measurement.unpack, "command": spec.command.unpack}
        self.attitude: Callable[[float], float] = spec.attitude.quantizer().level
        self.rate: Callable[[float], float] = spec.rate.quantizer().level
        self.motors = spec.motors
        self.voltage: Callable[[float], float] = voltage.level
        self.outermost = voltage.outermost


class Decoder:
    """Decodes published messages; counts messages, rows and descriptions that are malformed.

    `rate_hz` is the most messages per second of each streaming topic, by time of publication; None: all.
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

    def configure(self, description: Description) -> None:
        """Decode a vehicle's frames by this description from now on.

        A controller's is used until there is a plant's: the plant decides which frames it accepts. Other roles' are
        ignored: a recorder's configuration need not match the wire.
        """
        known = self._wires.get(description.vehicle)
        of_plant = known is not None and known.role == "plant"
        if description.role == "plant" or (description.role == "controller" and not of_plant):
            try:
                self._wires[description.vehicle] = _Wire(description)
            except (ValidationError, KeyError, TypeError):
                self.malformed += 1

    def take(self, address: topics.Address, payload: bytes, published_ns: int) -> list[Decoded]:
        """Decode a message or a batch of a trace, published at a time [ns since 1970].

        Nothing if it is not due, malformed, or not shown; nor of a frame, as the traces have it.
        """
        read = self._readers.get(address.topic.name)
        if read is None:
            return []
        if address.topic.name in LIMITED and not self._due(address.topic.name, address.vehicle, published_ns):
            return []
        try:
            return read(address, payload, published_ns)
        except (ValueError, OverflowError):  # a stranger may publish anything, such as 1e999
            self.malformed += 1
            return []

    def frame(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        """Decode a frame from the network, without a limit of rate; silence in lockstep gives nothing."""
        wire, name = self._wires.get(address.vehicle), address.topic.name
        if wire is None or (payload == UNCHANGED and name in wire.silent):
            return []
        return self._framed(address.vehicle, name, wire, payload, at_ns)

    def rows(self, vehicle: str, batch: Batch) -> list[Decoded]:
        """Decode the rows of a trace: measurements from the plant's, commands from the controller's."""
        wire, columns, base_ns = self._wires.get(vehicle), batch.columns, batch.header.wall_ns
        if wire is None:
            return []
        name = "measurement" if batch.header.end == "plant" else "command"
        frames, found = columns[name], []
        slot_ns, last = self._slot_ns, self._slots.get((name, vehicle), -1)
        for row, (sent_as, sent) in enumerate(zip(columns["sent_as"].tolist(), columns["sent"].tolist(), strict=True)):
            at_ns = base_ns + sent * 1000
            if sent_as != _FRAME or at_ns < 0 or (slot_ns and at_ns // slot_ns == last):
                continue
            last = at_ns // slot_ns if slot_ns else -1
            found += self._framed(vehicle, name, wire, frames[row].tobytes(), at_ns)
        self._slots[name, vehicle] = last
        return found

    def _due(self, name: str, vehicle: str, at_ns: int) -> bool:
        """Whether it is the first of its topic and vehicle in its slot of time."""
        if not self._slot_ns:
            return True
        slot, before = at_ns // self._slot_ns, self._slots.get((name, vehicle))
        self._slots[name, vehicle] = slot
        return slot != before

    def _trace(self, address: topics.Address, payload: bytes, _: int) -> list[Decoded]:
        batch = read_batch(payload)  # its rows have their own times
        if batch is None:
            self.malformed += 1
            return []
        return self.rows(address.vehicle, batch)

    def _framed(self, vehicle: str, name: str, wire: _Wire, payload: bytes, at_ns: int) -> list[Decoded]:
        unpacked = wire.unpack[name](payload)
        if unpacked is None:
            self.malformed += 1
            return []
        _, codes = unpacked
        if name == "command":
            return [_shown(vehicle, name, views.Voltages.of(codes, wire.motors, wire.voltage, wire.outermost), at_ns)]
        x, y, z = (wire.attitude(code) for code in codes[:3])
        p, q, r = (wire.rate(code) for code in codes[3:])
        known = x + y + z == x + y + z  # not NaN: a valid value
        measured = attitude.received_quaternion(x, y, z, attitude.IDENTITY) if known else None
        shown = _shown(vehicle, name, views.Attitude.of(measured, (p, q, r)), at_ns)
        return [shown, *_posed(vehicle, "", frame_of(vehicle), measured, at_ns)] if measured else [shown]

    def _telemetry(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        telemetry = Telemetry.model_validate_json(payload)
        vehicle, wire = address.vehicle, self._wires.get(address.vehicle)
        tracking = views.Tracking.of(telemetry, wire.period if wire else None)
        return [
            _shown(vehicle, "tracking", tracking, at_ns),
            *_posed(vehicle, "desired_", desired_frame_of(vehicle), telemetry.desired, at_ns),
        ]

    def _truth(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        truth = Truth.model_validate_json(payload)
        return [_shown(address.vehicle, "truth", views.Attitude.of(truth.attitude, truth.rate), at_ns)]

    def _reference(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        setpoint = verbs.Setpoint.model_validate_json(payload)
        return [_shown(address.vehicle, "setpoint", views.SetpointView.of(setpoint.attitude), at_ns)]

    def _status(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        status = Status.model_validate_json(payload)
        vehicle, wire = address.vehicle, self._wires.get(address.vehicle)
        shown = _shown(vehicle, f"status/{address.role}", views.RoleStatus.of(status), at_ns)
        if address.role != "plant" or wire is None:
            return [shown]
        # The scene comes with every status, for a viewer that connects late.
        return [shown, _shown(vehicle, "scene", scene(vehicle, wire.kind, at_ns), at_ns)]

    def _event(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        event = Event.model_validate_json(payload)
        level = _LEVELS.get(event.kind, LogLevel.Info)
        return [_logged(address.vehicle, level, f"{address.role}", f"{event.kind}: {event.text}", at_ns)]

    def _loss(self, address: topics.Address, payload: bytes, at_ns: int) -> list[Decoded]:
        loss = Loss.model_validate_json(payload)
        text = f"{loss.count} messages of {loss.key} are not in the log: {LOSS_REASONS[loss.reason]}"
        return [_logged(address.vehicle, LogLevel.Warning, "recorder", text, at_ns)]


def _shown(
    vehicle: str, name: str, view: views.View | Log | PoseInFrame | FrameTransform | SceneUpdate, at_ns: int
) -> Decoded:
    shape = _STATUS if name.startswith("status/") else SHAPES[name]  # any role may publish a status
    return Decoded(topic_of(vehicle, name), shape, view.encode(), at_ns)


def _logged(vehicle: str, level: LogLevel, name: str, text: str, at_ns: int) -> Decoded:
    return _shown(vehicle, "log", Log(timestamp=timestamp(at_ns), level=level, message=text, name=name), at_ns)


def _posed(vehicle: str, prefix: str, frame: str, q: attitude.Quaternion, at_ns: int) -> list[Decoded]:
    """An attitude as a pose in the world, and as the transform from the world to a frame."""
    at, turned = timestamp(at_ns), Quaternion(w=q[0], x=q[1], y=q[2], z=q[3])
    pose = PoseInFrame(timestamp=at, frame_id=WORLD, pose=Pose(position=_HERE, orientation=turned))
    transform = FrameTransform(
        timestamp=at, parent_frame_id=WORLD, child_frame_id=frame, translation=_HERE, rotation=turned
    )
    return [_shown(vehicle, f"{prefix}pose", pose, at_ns), _shown(vehicle, f"{prefix}tf", transform, at_ns)]
