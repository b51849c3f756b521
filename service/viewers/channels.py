"""Decoder of published messages into topics that Foxglove and Lichtblick show without any configuration.

Sans-I/O; the one converter for `log live`, the recorder's decoded channels and `log export --to mcap`. Topics are under
`/<vehicle>/`; poses, transforms, the scene and the log are Foxglove's messages, the rest are the views of schemas.py,
rounded far below a quantizer's step. The plant's trace rows give measurements, the controller's rows give commands, at
the times of sending on their own wall clocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees, sqrt
from typing import Any, Final

from foxglove import messages as foxglove
from pydantic import ValidationError
from pydantic_core import to_json

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Description, Event, Loss, Status, Telemetry, Truth
from aeroloop.protocol.messages.operator import Setpoint
from aeroloop.protocol.messages.trace import Sent, read_batch
from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.spec import MAX_ACTUATORS, LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.viewers import schemas
from aeroloop.service.viewers.schemas import Decoded, protobuf_shape

WORLD: Final = "world"
ROLES: Final = ("plant", "controller", "recorder")
"""Roles with a status topic from the start; statuses of other roles are decoded, too."""

_POSE: Final = protobuf_shape(foxglove.PoseInFrame.get_schema())
_TRANSFORM: Final = protobuf_shape(foxglove.FrameTransform.get_schema())
SHAPES: Final = {
    "pose": _POSE,
    "tf": _TRANSFORM,
    "measurement": schemas.ATTITUDE,
    "command": schemas.VOLTAGES,
    "tracking": schemas.TRACKING,
    "desired_pose": _POSE,
    "desired_tf": _TRANSFORM,
    "truth": schemas.ATTITUDE,
    "setpoint": schemas.SETPOINT,
    "scene": protobuf_shape(foxglove.SceneUpdate.get_schema()),
    "log": protobuf_shape(foxglove.Log.get_schema()),
    **{f"status/{role}": schemas.STATUS for role in ROLES},
}
"""Topics below `/<vehicle>/`."""

_ERROR, _WARNING = foxglove.LogLevel.Error, foxglove.LogLevel.Warning
_LEVELS: Final = {"tripped": _ERROR, "fault": _ERROR, "lost": _WARNING, "refused": _WARNING}
"""Log level by kind of event; Info for all others."""

_Values = tuple[str | float | None, ...]
_Shown = tuple[str, _Values | foxglove.PoseInFrame | foxglove.FrameTransform | foxglove.SceneUpdate | foxglove.Log]
"""A topic's name, and the values of its view or a message of Foxglove's."""


def topic_of(vehicle: str, name: str) -> str:
    """A topic of a vehicle, such as `/aero/pose`; for names see SHAPES."""
    return f"/{vehicle}/{name}"


class _Wire:
    """Frame formats of a vehicle by its description. Raises ValidationError, KeyError or TypeError."""

    def __init__(self, description: Description) -> None:
        spec = WireSpec.model_validate(description.config["wire"])
        self.role = description.role
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
        self._wires: dict[str, _Wire] = {}

    def configure(self, description: Description) -> None:
        """Decode a vehicle's frames by this description from now on; before the first, frames and rows are dropped.

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
        """Decode a message, a frame or a batch of a trace, published at a time [ns since 1970].

        Nothing if it is not due, malformed, or not shown, or if a frame says that nothing has changed.
        """
        vehicle, topic, wire = address.vehicle, address.topic, self._wires.get(address.vehicle)
        try:
            if topic.kind == "trace":
                return self._rows(vehicle, wire, payload)
            if topic.kind == "frame":
                if wire is None or (payload == UNCHANGED and topic.name in wire.on_change):
                    return []
                return self._frame(vehicle, wire, topic.name, payload, published_ns)
            if topic.model is None or topic.name not in _CONVERTERS:
                return []
            if topic.decoded == "limited" and not self._due(topic.name, vehicle, published_ns):
                return []
            message = topic.model.model_validate_json(payload)
            return _encoded(vehicle, _CONVERTERS[topic.name](message, address, wire, published_ns), published_ns)
        except (ValueError, OverflowError):  # a stranger may publish anything, such as 1e999
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
        unpacked = wire.formats[name].unpack(payload)
        if unpacked is None:
            self.malformed += 1
            return []
        _, codes = unpacked
        if name == "command":
            return _encoded(vehicle, [(name, _voltages(wire, codes))], at_ns)
        x, y, z = map(wire.attitude.level, codes[:3])
        known = x + y + z == x + y + z  # not NaN: a valid value
        measured = attitude.received_quaternion(x, y, z, attitude.IDENTITY) if known else None
        rate: attitude.Vector = tuple(map(wire.rate.level, codes[3:]))  # type: ignore[assignment]  # three of them
        shown: list[_Shown] = [(name, _attitude(measured, rate))]
        if measured:
            shown += _posed("", vehicle, measured, at_ns)
        return _encoded(vehicle, shown, at_ns)


def _encoded(vehicle: str, shown: list[_Shown], at_ns: int) -> list[Decoded]:
    found = []
    for name, content in shown:
        shape = SHAPES.get(name, schemas.STATUS)  # any role may publish a status
        if isinstance(content, tuple):
            data = to_json(dict(zip(shape.fields, content, strict=True)), inf_nan_mode="null")
        else:
            data = content.encode()
        found.append(Decoded(topic_of(vehicle, name), shape, data, at_ns))
    return found


# ── from message to topics ──


def _telemetry(message: Telemetry, address: topics.Address, wire: _Wire | None, at_ns: int) -> list[_Shown]:
    x, y, z = message.attitude_error
    scalar = sqrt(max(0.0, 1.0 - x * x - y * y - z * z))
    (sign,) = message.state.get("sign", (None,))[:1]
    damping = [*message.state.get("damping_estimate", ()), None, None, None][:3]
    measured = _product(message.desired, (-scalar if sign == -1 else scalar, x, y, z))  # q = q_d ⊗ e of (C.16)
    tracking = (
        None if wire is None else round(message.tick * wire.period, 6),
        _degree(attitude.angle(x, y, z)),
        *map(_degree, attitude.to_euler(measured)),
        *map(_degree, attitude.to_euler(message.desired)),
        *map(_degree, message.rate_error),
        *(theta if theta is None else round(theta, 6) for theta in damping),
        sign if sign is None else int(sign),
    )
    return [("tracking", tracking), *_posed("desired_", f"{address.vehicle}_desired", message.desired, at_ns)]


def _truth(message: Truth, *_: object) -> list[_Shown]:
    return [("truth", _attitude(message.attitude, message.rate))]


def _reference(message: Setpoint, *_: object) -> list[_Shown]:
    return [("setpoint", message.attitude)]


def _status(message: Status, address: topics.Address, wire: _Wire | None, at_ns: int) -> list[_Shown]:
    found: dict[str, Any] = message.model_dump(include=set(schemas.STATUS.fields))
    wake = message.timing.recent_wake if message.timing else None
    for name, durations in {"latency": message.recent_latency_us, "age": message.age_us, "wake": wake}.items():
        found[f"{name}_p50_us"] = durations.p50 if durations else None
        found[f"{name}_p99_us"] = durations.p99 if durations else None
    found |= {"rate_hz": round(message.rate_hz, 3), "uptime_s": round(message.uptime_s, 1)}
    values = tuple(found[field] for field in schemas.STATUS.fields)
    shown: list[_Shown] = [(f"status/{address.role}", values)]
    if address.role == "plant" and wire is not None:  # with every status, for a viewer that connects late
        shown.append(("scene", _scene(address.vehicle, wire.kind, at_ns)))
    return shown


def _event(message: Event, address: topics.Address, _: object, at_ns: int) -> list[_Shown]:
    level = _LEVELS.get(message.kind, foxglove.LogLevel.Info)
    return _logged(level, str(address.role), f"{message.kind}: {message.text}", at_ns)


def _loss(message: Loss, _: object, __: object, at_ns: int) -> list[_Shown]:
    text = f"{message.count} messages of {message.key} are not in the log: {LOSS_REASONS[message.reason]}"
    return _logged(_WARNING, "recorder", text, at_ns)


_CONVERTERS: Final[dict[str, Callable[[Any, topics.Address, _Wire | None, int], list[_Shown]]]] = {
    "telemetry": _telemetry,
    "truth": _truth,
    "reference": _reference,
    "status": _status,
    "event": _event,
    "loss": _loss,
}
"""What is shown of a topic's message, by the topic's name."""


# ── values ──


def _degree(radians: float) -> float:
    return round(degrees(radians), 4) + 0.0  # never −0


def _attitude(q: attitude.Quaternion | None, rate: attitude.Vector) -> _Values:
    """Angles, null if they are not known, and rates in the body frame from [rad/s], null where they are NaN."""
    angles = map(_degree, attitude.to_euler(q)) if q else (None, None, None)
    return *angles, *(_degree(part) if part == part else None for part in rate)


def _voltages(wire: _Wire, codes: Sequence[float]) -> _Values:
    """Levels [V] of motors 1 to 8, and whether each is the quantizer's outermost; null for those there are not."""
    levels = dict(zip(wire.motors, map(wire.voltage.level, codes), strict=True))
    every = [levels.get(number, float("nan")) for number in range(1, MAX_ACTUATORS + 1)]
    volts = [round(u, 4) if u == u else None for u in every]
    return *volts, *(abs(u) >= wire.voltage.outermost if u == u else None for u in every)


def _product(p: attitude.Quaternion, q: attitude.Quaternion) -> attitude.Quaternion:
    """Hamilton product p ⊗ q."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def _timestamp(at_ns: int) -> foxglove.Timestamp:
    """A time since 1970 [ns] in Foxglove's type, which has 32 bits of seconds."""
    seconds, rest = divmod(at_ns, 1_000_000_000)
    return foxglove.Timestamp(min(max(seconds, 0), 0xFFFFFFFF), rest)


def _logged(level: foxglove.LogLevel, name: str, text: str, at_ns: int) -> list[_Shown]:
    return [("log", foxglove.Log(timestamp=_timestamp(at_ns), level=level, message=text, name=name))]


def _posed(prefix: str, frame: str, q: attitude.Quaternion, at_ns: int) -> list[_Shown]:
    """An attitude as a pose in the world, and as the transform from the world to a frame."""
    at, turned, here = _timestamp(at_ns), foxglove.Quaternion(w=q[0], x=q[1], y=q[2], z=q[3]), foxglove.Vector3()
    pose = foxglove.PoseInFrame(timestamp=at, frame_id=WORLD, pose=foxglove.Pose(position=here, orientation=turned))
    transform = foxglove.FrameTransform(
        timestamp=at, parent_frame_id=WORLD, child_frame_id=frame, translation=here, rotation=turned
    )
    return [(f"{prefix}pose", pose), (f"{prefix}tf", transform)]


# ── the 3-D scene: two rotors on a beam over a stand for the Aero, a box with a nose otherwise ──

_BEAM, _NOSE, _TAIL = (0.35, 0.38, 0.42), (0.85, 0.2, 0.15), (0.15, 0.4, 0.75)
"""Red, green and blue, 0…1; red points forward."""
_UPRIGHT, _SIDEWAYS = foxglove.Quaternion(w=1.0), foxglove.Quaternion(x=sqrt(0.5), w=sqrt(0.5))
_Triple = tuple[float, float, float]


def _scene(vehicle: str, kind: str, at_ns: int) -> foxglove.SceneUpdate:
    """The body, a transparent copy at the desired attitude, and the stand, each fixed to its frame.

    `kind` is `plant.kind`. Lengths are in metres, about those of the bench.
    """
    desired = f"{vehicle}_desired"
    parts = [(vehicle, f"{vehicle} body", *_body(kind, 1.0)), (desired, f"{desired} desired", *_body(kind, 0.25))]
    if kind == "aero":
        column, foot = _cylinder(0.0, -0.17, (0.04, 0.04, 0.3)), _cylinder(0.0, -0.33, (0.3, 0.3, 0.02))
        parts.append((WORLD, f"{vehicle} stand", [], [column, foot]))
    at = _timestamp(at_ns)
    return foxglove.SceneUpdate(
        entities=[
            foxglove.SceneEntity(
                timestamp=at, frame_id=frame, id=name, frame_locked=True, cubes=cubes, cylinders=cylinders
            )
            for frame, name, cubes, cylinders in parts
        ]
    )


def _body(kind: str, alpha: float) -> tuple[list[foxglove.CubePrimitive], list[foxglove.CylinderPrimitive]]:
    if kind != "aero":
        return [_box(0.0, (0.3, 0.2, 0.1), _BEAM, alpha), _box(0.17, (0.04, 0.1, 0.05), _NOSE, alpha)], []
    return [_box(0.0, (0.36, 0.03, 0.03), _BEAM, alpha)], [
        _cylinder(0.18, 0.0, (0.14, 0.14, 0.02), _NOSE, alpha),
        _cylinder(-0.18, 0.0, (0.14, 0.14, 0.02), _TAIL, alpha, _SIDEWAYS),
    ]


def _box(x: float, size: _Triple, rgb: _Triple, alpha: float) -> foxglove.CubePrimitive:
    return foxglove.CubePrimitive(**_placed(x, 0.0, size, rgb, alpha))


def _cylinder(
    x: float, z: float, size: _Triple, rgb: _Triple = _BEAM, alpha: float = 1.0, turned: foxglove.Quaternion = _UPRIGHT
) -> foxglove.CylinderPrimitive:
    return foxglove.CylinderPrimitive(bottom_scale=1.0, top_scale=1.0, **_placed(x, z, size, rgb, alpha, turned))


def _placed(
    x: float, z: float, size: _Triple, rgb: _Triple, alpha: float, turned: foxglove.Quaternion = _UPRIGHT
) -> dict[str, Any]:
    """What boxes and cylinders have: a place (x, 0, z), a size and a color."""
    return {
        "pose": foxglove.Pose(position=foxglove.Vector3(x=x, z=z), orientation=turned),
        "size": foxglove.Vector3(x=size[0], y=size[1], z=size[2]),
        "color": foxglove.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha),
    }
