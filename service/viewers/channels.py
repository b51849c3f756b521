"""Decoder of published messages into topics that Foxglove and Lichtblick show without any configuration.

Sans-I/O; the one converter for `log live` and the recorder's decoded channels. Topics are under `/<vehicle>/`;
transforms, scene and log are Foxglove's messages, statuses and set-points the network's, the rest are the views of
schemas.py, rounded far below a quantizer's step. The plant's trace rows give measurements, the controller's rows give
commands, at the times of sending on their own wall clocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, nan, sqrt
from typing import Any, Final, NamedTuple

from foxglove import messages as foxglove
from pydantic import BaseModel, ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Description, Event, Loss, Status, Telemetry, Truth
from aeroloop.protocol.messages.operator import Message, MessageError, Setpoint
from aeroloop.protocol.messages.trace import ENDS, Sent, read_batch
from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.viewers.schemas import Attitude, Decoded, Tracking, Voltages, json_shape, protobuf_shape

WORLD: Final = "world"
ROLES: Final = ("plant", "controller", "recorder")
"""Roles with a status topic."""

_ATTITUDE, _STATUS = json_shape(Attitude), json_shape(Status)
_TRANSFORM: Final = protobuf_shape(foxglove.FrameTransform.get_schema())
SHAPES: Final = {
    "tf": _TRANSFORM,
    "measurement": _ATTITUDE,
    "command": json_shape(Voltages),
    "tracking": json_shape(Tracking),
    "desired_tf": _TRANSFORM,
    "truth": _ATTITUDE,
    "setpoint": json_shape(Setpoint),
    "scene": protobuf_shape(foxglove.SceneUpdate.get_schema()),
    "log": protobuf_shape(foxglove.Log.get_schema()),
    **{f"status/{role}": _STATUS for role in ROLES},
}
"""Topics below `/<vehicle>/`."""

_ERROR, _WARNING = foxglove.LogLevel.Error, foxglove.LogLevel.Warning
_LEVELS: Final = {"tripped": _ERROR, "fault": _ERROR, "lost": _WARNING, "refused": _WARNING}
"""Log level by kind of event; Info for all others."""

_Shown = dict[str, Any]
"""What is shown, by names of topics: models, or messages of Foxglove's."""


class _Wire:
    """Frame formats of a vehicle by its description. Raises ValidationError, KeyError or TypeError."""

    def __init__(self, description: Description, published_ns: int) -> None:
        spec = WireSpec.model_validate(description.config["wire"])
        self.published_ns = published_ns
        self.kind = str(description.config["plant"]["kind"])
        self.period = LoopSettings.model_validate(description.config["loop"]).period
        self.formats = {"measurement": spec.measurement, "command": spec.command}
        self.on_change = {name for name in self.formats if getattr(spec.transmit, name) == "on_change"}
        self.attitude, self.rate = spec.attitude.quantizer(), spec.rate.quantizer()
        self.motors, self.voltage = spec.motors, spec.voltage.quantizer()


class Decoder:
    """Decodes published messages; counts messages, rows and descriptions that are malformed.

    `rate_hz` is the most messages per second of each streaming topic; None: all. Time of publication is divided into
    slots, and the first row or message of a slot passes; the others are not decoded. Frames from the network, events,
    losses and statuses, which are published once a second, always pass.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self.malformed = 0
        self._slot_ns = 0 if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._slots: dict[tuple[str, str], int] = {}
        self._wires: dict[tuple[str, str], _Wire] = {}  # by vehicle and role

    def configure(self, description: Description, published_ns: int = 0) -> None:
        """Decode a vehicle's frames by this description, unless it is older than the last of its role.

        Before the first, frames and rows are dropped. The plant's counts, as the plant decides which frames it
        accepts; the controller's counts until there is one.
        """
        which = description.vehicle, description.role
        known = self._wires.get(which)
        if description.role in ENDS and (known is None or known.published_ns <= published_ns):
            try:
                self._wires[which] = _Wire(description, published_ns)
            except (ValidationError, KeyError, TypeError):
                self.malformed += 1

    def take(self, address: topics.Address, payload: bytes, published_ns: int) -> list[Decoded]:
        """Decode a message, a frame or a batch of a trace, published at a time [ns since 1970].

        Nothing if it is not due, malformed, or not shown, or if a frame says that nothing has changed. A description
        configures the decoder.
        """
        vehicle, topic = address.vehicle, address.topic
        wire = self._wires.get((vehicle, "plant")) or self._wires.get((vehicle, "controller"))
        try:
            if topic.name == "description":
                self.configure(Description.decode(payload), published_ns)
            elif topic.kind == "trace":
                return self._rows(vehicle, wire, payload)
            elif topic.kind == "frame":
                if wire is not None and not (payload == UNCHANGED and topic.name in wire.on_change):
                    return self._frame(vehicle, wire, topic.name, payload, published_ns)
            elif topic.decoded == "always" or (
                topic.decoded == "limited" and self._due(topic.name, vehicle, published_ns)
            ):
                assert topic.model is not None
                message = topic.model.model_validate_json(payload)
                return _encoded(vehicle, _converted(message, address, wire, published_ns), published_ns)
        except (ValueError, OverflowError, MessageError):  # untrusted publishers may send anything, such as 1e999
            self.malformed += 1
        return []

    def _due(self, name: str, vehicle: str, at_ns: int) -> bool:
        """Whether it is the first of its topic and vehicle in its slot of time."""
        if not self._slot_ns:
            return True
        slot, before = at_ns // self._slot_ns, self._slots.get((name, vehicle))
        self._slots[name, vehicle] = slot
        return slot != before

    def _rows(self, vehicle: str, wire: _Wire | None, payload: bytes) -> list[Decoded]:
        """Decode the frames that an end sent: measurements from the plant's rows, commands from the controller's."""
        batch = read_batch(payload)
        if batch is None:
            raise ValueError("malformed batch")
        if wire is None:
            return []
        name = "measurement" if batch.header.end == "plant" else "command"
        columns, found = batch.columns, list[Decoded]()
        for row, (sent_as, sent_us) in enumerate(zip(columns["sent_as"], columns["sent"].tolist(), strict=True)):
            at_ns = batch.header.wall_ns + sent_us * 1000
            if sent_as == Sent.FRAME and at_ns >= 0 and self._due(name, vehicle, at_ns):
                found += self._frame(vehicle, wire, name, columns[name][row].tobytes(), at_ns)
        return found

    def _frame(self, vehicle: str, wire: _Wire, name: str, payload: bytes, at_ns: int) -> list[Decoded]:
        if (unpacked := wire.formats[name].unpack(payload)) is None:
            raise ValueError("malformed frame")
        _, codes = unpacked
        if name == "command":
            return _encoded(vehicle, {name: _voltages(wire, codes)}, at_ns)
        x, y, z = map(wire.attitude.level, codes[:3])
        known = x + y + z == x + y + z  # not NaN: a valid value
        measured = attitude.received_quaternion(x, y, z, attitude.IDENTITY) if known else None
        p, q, r = map(wire.rate.level, codes[3:])
        shown: _Shown = {name: _attitude(measured, (p, q, r))}
        if measured:
            shown["tf"] = _turned(vehicle, measured, at_ns)
        return _encoded(vehicle, shown, at_ns)


def _encoded(vehicle: str, shown: _Shown, at_ns: int) -> list[Decoded]:
    found = []
    for name, content in shown.items():
        data = content.model_dump_json().encode() if isinstance(content, BaseModel) else content.encode()
        found.append(Decoded(f"/{vehicle}/{name}", SHAPES[name], data, at_ns))
    return found


# ── from message to topics ──


def _converted(message: Message, address: topics.Address, wire: _Wire | None, at_ns: int) -> _Shown:
    match message:
        case Telemetry():
            desired = _turned(f"{address.vehicle}_desired", message.desired, at_ns)
            return {"tracking": _tracking(message, wire), "desired_tf": desired}
        case Truth():
            return {"truth": _attitude(message.attitude, message.rate)}
        case Setpoint():
            return {"setpoint": message}
        case Status() if address.role in ROLES:
            shown: _Shown = {f"status/{address.role}": message}
            if address.role == "plant" and wire is not None:  # with every status, for a viewer that connects late
                shown["scene"] = _scene(address.vehicle, wire.kind, at_ns)
            return shown
        case Event():
            level = _LEVELS.get(message.kind, foxglove.LogLevel.Info)
            return _logged(level, str(address.role), f"{message.kind}: {message.text}", at_ns)
        case Loss():
            text = f"{message.count} messages of {message.key} are not in the log: {LOSS_REASONS[message.reason]}"
            return _logged(_WARNING, "recorder", text, at_ns)
        case _:
            return {}


def _tracking(message: Telemetry, wire: _Wire | None) -> BaseModel:
    x, y, z = message.attitude_error
    (sign,) = message.state.get("sign", (None,))[:1]
    damping = [*message.state.get("damping_estimate", ()), nan, nan, nan][:3]
    values = (
        None if wire is None else round(message.tick * wire.period, 6),
        _degree(attitude.angle(x, y, z)),
        *map(_degree, attitude.to_euler(message.desired)),
        *map(_degree, message.rate_error),
        *(round(theta, 6) for theta in damping),
        None if sign is None else int(sign),
    )
    return Tracking.model_validate(dict(zip(Tracking.model_fields, values, strict=True)))


def _degree(radians: float) -> float:
    return round(degrees(radians), 4) + 0.0  # never −0


def _attitude(q: attitude.Quaternion | None, rate: attitude.Vector) -> BaseModel:
    """Angles, null if they are not known, and rates in the body frame from [rad/s], null where they are NaN."""
    angles = attitude.to_euler(q) if q else (nan, nan, nan)
    return Attitude(**dict(zip(Attitude.model_fields, map(_degree, (*angles, *rate)), strict=True)))


def _voltages(wire: _Wire, codes: Sequence[float]) -> BaseModel:
    """Levels [V] of the motors, and whether each is the quantizer's outermost; null where it is no valid value."""
    levels = {i: u for i, u in zip(wire.motors, map(wire.voltage.level, codes), strict=True) if u == u}
    volts = {f"voltage_{i}_v": round(u, 4) for i, u in levels.items()}
    return Voltages(**volts, **{f"saturated_{i}": abs(u) >= wire.voltage.outermost for i, u in levels.items()})


def _timestamp(at_ns: int) -> foxglove.Timestamp:
    """A time since 1970 [ns] in Foxglove's type, which has 32 bits of seconds."""
    seconds, rest = divmod(at_ns, 1_000_000_000)
    return foxglove.Timestamp(min(max(seconds, 0), 0xFFFFFFFF), rest)


def _logged(level: foxglove.LogLevel, name: str, text: str, at_ns: int) -> _Shown:
    return {"log": foxglove.Log(timestamp=_timestamp(at_ns), level=level, message=text, name=name)}


def _turned(frame: str, q: attitude.Quaternion, at_ns: int) -> foxglove.FrameTransform:
    """An attitude as the transform from the world to a frame."""
    turn, here = foxglove.Quaternion(w=q[0], x=q[1], y=q[2], z=q[3]), foxglove.Vector3()
    return foxglove.FrameTransform(
        timestamp=_timestamp(at_ns), parent_frame_id=WORLD, child_frame_id=frame, translation=here, rotation=turn
    )


# ── the 3-D scene: two rotors on a beam over a stand for the Aero, a box with a nose otherwise ──


class _Part(NamedTuple):
    x: float  # place along the frame's axes [m]
    z: float
    size: tuple[float, float, float]  # [m]
    color: tuple[float, float, float]  # red, green and blue
    disc: bool = False
    axis: foxglove.Quaternion = foxglove.Quaternion(w=1.0)


_BEAM, _NOSE, _TAIL = (0.35, 0.38, 0.42), (0.85, 0.2, 0.15), (0.15, 0.4, 0.75)  # red points forward
_AERO: Final = (
    _Part(0.0, 0.0, (0.36, 0.03, 0.03), _BEAM),
    _Part(0.18, 0.0, (0.14, 0.14, 0.02), _NOSE, disc=True),
    _Part(-0.18, 0.0, (0.14, 0.14, 0.02), _TAIL, disc=True, axis=foxglove.Quaternion(x=sqrt(0.5), w=sqrt(0.5))),
)
_STAND: Final = (
    _Part(0.0, -0.17, (0.04, 0.04, 0.3), _BEAM, disc=True),
    _Part(0.0, -0.33, (0.3, 0.3, 0.02), _BEAM, disc=True),
)
_BODY: Final = (_Part(0.0, 0.0, (0.3, 0.2, 0.1), _BEAM), _Part(0.17, 0.0, (0.04, 0.1, 0.05), _NOSE))


def _scene(vehicle: str, kind: str, at_ns: int) -> foxglove.SceneUpdate:
    """The body, a transparent copy at the desired attitude, and the Aero's stand, each fixed to its frame."""
    body, desired = _AERO if kind == "aero" else _BODY, f"{vehicle}_desired"
    entities = [(vehicle, f"{vehicle} body", body, 1.0), (desired, f"{desired} desired", body, 0.25)]
    if kind == "aero":
        entities.append((WORLD, f"{vehicle} stand", _STAND, 1.0))
    return foxglove.SceneUpdate(entities=[_entity(*entity, at_ns) for entity in entities])


def _entity(frame: str, name: str, parts: Sequence[_Part], alpha: float, at_ns: int) -> foxglove.SceneEntity:
    def placed(part: _Part) -> dict[str, Any]:
        (length, width, height), (red, green, blue) = part.size, part.color
        return {
            "pose": foxglove.Pose(position=foxglove.Vector3(x=part.x, z=part.z), orientation=part.axis),
            "size": foxglove.Vector3(x=length, y=width, z=height),
            "color": foxglove.Color(r=red, g=green, b=blue, a=alpha),
        }

    return foxglove.SceneEntity(
        timestamp=_timestamp(at_ns),
        frame_id=frame,
        id=name,
        frame_locked=True,
        cubes=[foxglove.CubePrimitive(**placed(part)) for part in parts if not part.disc],
        cylinders=[
            foxglove.CylinderPrimitive(bottom_scale=1.0, top_scale=1.0, **placed(part)) for part in parts if part.disc
        ],
    )
