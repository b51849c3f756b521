"""Messages of a loop as a viewer's decoder gets them, and a decoder that knows the plant."""

from __future__ import annotations

import json
from math import radians
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Loss, Percentiles, Status, Telemetry, Timing, Truth
from aeroloop.protocol.messages.operator import Setpoint
from aeroloop.protocol.messages.trace import ControllerRow, End, Outcome, PlantRow, Sent, TraceWriter
from aeroloop.protocol.messages.trace import Received as ReceivedAs
from aeroloop.protocol.wire.attitude import Quaternion
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import Quantizer
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import load
from aeroloop.service.viewers.channels import Decoder
from aeroloop.service.viewers.schemas import Decoded
from tests.support.made_log import description

NOW = 1_800_000_000_000_000_000
SETTINGS = load()
WIRE = SETTINGS.wire
ROLL, PITCH, YAW = 0.1, -0.5, 0.9


def quaternion_of(turn: Rotation) -> Quaternion:
    return tuple(turn.as_quat(scalar_first=True).tolist())


def about(axis: int, by: float) -> Rotation:
    return Rotation.from_rotvec(by * np.eye(3)[axis - 1])


BODY = about(3, YAW) * about(2, PITCH) * about(1, ROLL)
ATTITUDE = quaternion_of(BODY)


def address(name: str, role: str = "plant") -> topics.Address:
    found = topics.read_key(topics.key(name, "aero", session="s1", role=role))
    assert found is not None
    return found


def configured(rate_hz: float | None = None) -> Decoder:
    """A decoder that knows the plant; at most so many messages of a topic a second."""
    decoder = Decoder(rate_hz)
    decoder.configure(description(SETTINGS, "plant"))
    return decoder


def frame(form: FrameFormat, quantizers: list[Quantizer], values: list[float | None]) -> bytes:
    return form.pack(3, [q.invalid if v is None else q.encode(v) for q, v in zip(quantizers, values, strict=True)])


def measurement(*values: float | None) -> bytes:
    quantizers = [WIRE.attitude.quantizer()] * 3 + [WIRE.rate.quantizer()] * 3
    return frame(WIRE.measurement, quantizers, list(values))


def batch(end: End, rows: list[tuple[int, Sent, bytes]], wire: WireSpec = WIRE) -> bytes:
    """A batch with rows of times [ns since 1970], what was sent, and the frame that was; the other frame is zero."""
    writer = TraceWriter(end, wire, 1)
    writer.session = "s1"
    ahead_ns = NOW - 10**12  # of the wall clock to the monotonic clock
    for tick, (at_ns, sent_as, frame) in enumerate(rows):
        sent_ns = at_ns - ahead_ns
        if end == "plant":
            echo = bytes(wire.command.size)
            volts = [0.0] * wire.actuators
            writer.row(PlantRow(tick, tick, sent_as, Sent.NONE, Outcome.NONE, 0, -1, sent_ns, 0, frame, echo, volts))
        else:
            taken = bytes(wire.measurement.size)
            writer.row(ControllerRow(tick, ReceivedAs.FRAME, sent_as, sent_ns - 200_000, sent_ns, taken, frame))
    return writer.take(NOW - ahead_ns, NOW)


def by_topic(decoded: list[Decoded]) -> dict[str, Decoded]:
    found = {message.topic: message for message in decoded}
    assert len(found) == len(decoded)
    return found


def said(decoded: Decoded) -> dict[str, Any]:
    tree: dict[str, Any] = json.loads(decoded.data)
    return tree


def telemetry(error: Quaternion, sign: int = 1) -> Telemetry:
    return Telemetry(
        session="s1", tick=250, counter=3, attitude_error=error[1:], rate_error=(0.0, radians(2.0), radians(-3.0)),
        desired=ATTITUDE, state={"damping_estimate": (0.0, 0.007, 0.0095), "sign": (sign,)}, voltages=(1.0, 2.0),
    )  # fmt: skip


TIMES = Percentiles(count=5000, p50=310.0, p99=620.0, p999=900.0, max=1000.0)
STATUS = Status(
    role="plant", state="driven", uptime_s=12.0, ticks=6000, rate_hz=500.0, skipped=2, recent_latency_us=TIMES,
    timing=Timing(
        wake=None, busy=None, period=None, recent_wake=TIMES, recent_busy=None, recent_period=None,
    ),
)  # fmt: skip
RAW = {
    "measurement": measurement(0, 0, 0, 0, 0, 0),
    "command": frame(WIRE.command, [WIRE.voltage.quantizer()] * 2, [1.0, None]),
    "telemetry": telemetry(quaternion_of(about(1, 0.1))).encode(),
    "truth": Truth(tick=1, attitude=ATTITUDE, rate=(0.0, 0.0, 0.0), voltages=(1.0, 2.0)).encode(),
    "reference": Setpoint(attitude=(0.0, 0.0, 0.0)).encode(),
    "status": STATUS.encode(),
    "event": Event(role="plant", kind="started", text="x").encode(),
    "loss": Loss(key="k", count=1, reason="cache").encode(),
    "trace": batch("plant", [(NOW, Sent.FRAME, measurement(0, 0, 0, 0, 0, 0))]),
}  # a message of every topic that is decoded
