"""One message of every kind, and several of some."""

from __future__ import annotations

from aeroloop.protocol.messages.models import (
    PROTOCOL_VERSION,
    Claim,
    Description,
    Event,
    FaultStatus,
    Grant,
    Loss,
    Percentiles,
    Refusal,
    Release,
    SessionRecord,
    Status,
    Telemetry,
    Timing,
    Truth,
)
from aeroloop.protocol.messages.operator import (
    Advance,
    Answer,
    Change,
    Gains,
    Hold,
    Inject,
    Mark,
    Message,
    Points,
    Request,
    Setpoint,
    Sinusoid,
    Stream,
    Track,
)
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import PlantChange, Tail
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

LATENCY = Percentiles(count=3, p50=230.5, p99=700.25, p999=800.0, max=812.0)
FAULT = FaultStatus(
    fault="command:drop=0.1@2", source="injected", begin_tick=1001, end_tick=None, changed=7, effect="commands dropped"
)
RECORD = SessionRecord(
    controller="c1", session="5f0b", gains=Gains(C1=(0.3, 0.3, 0.3), C2=(0.15, 0.15, 0.15), Gamma=(0.03, 0.03, 0.03)),
    gains_from="operator", reference=Hold(attitude=(0.0, -10.0, 90.0)), reference_from="resumed", within_s=5.0,
    since_tick=12, ended=TripCause.HOLDER_GONE, ended_tick=700,
)  # fmt: skip

MESSAGES: list[Message] = [
    Claim(
        controller="c1", session="5f0c", period_ns=1, lockstep=True,
        wire=WireSpec(attitude=SignalSpec(bits=None, limit=1.0), rate=SignalSpec(bits=10, limit=2.0, deadzone=0.1)),
    ),
    RECORD,
    Grant(session="5f0c"),
    Grant(session="5f0c", last=RECORD),
    Refusal(reason="held by c2 since 3 s", holder="c2", differences=["rate.bits: 8, not 10"]),
    Release(session="5f0c"),
    Description(
        protocol=PROTOCOL_VERSION, role="plant", vehicle="aero", host="bench", versions={"python": "3.11"},
        config={"loop": {"rate_hz": 500.0}, "list": [1, "a", None, True]},
    ),
    LATENCY,
    Status(
        role="plant", state="driven", session="5f0c", uptime_s=1e6, ticks=2**40, rate_hz=499.9, skipped=1, received=2,
        sent=3, refused=4, saturated=5, latency_us=LATENCY, notes=["SCHED_FIFO: Operation not permitted"],
        faults=[FAULT],
    ),
    FAULT,
    Telemetry(
        session="5f0c", tick=7, counter=15, attitude_error=(0.1, -0.2, 1e-17), rate_error=(0.0, 1 / 3, -2.0),
        desired=(1.0, 0.0, 0.0, 0.0), state={"damping_estimate": (0.0, 0.0071, 0.022), "sign": (-1.0,)},
        voltages=(12.5, -24.0),
    ),
    Truth(
        tick=0, attitude=(1.0, 0.0, 0.0, 0.0), rate=(0.0, -0.5, 0.1), voltages=(24.0,),
        signals={"battery_V": 24.1, "T_deg": None},
    ),
    Timing(wake=LATENCY, busy=LATENCY, period=LATENCY, recent_wake=LATENCY, recent_busy=None, recent_period=None),
    Event(role="plant", kind="tripped", text="no fresh command for 100 ms, η ≥ 0", session="5f0c", tick=1207),
    Loss(key="aeroloop/aero/5f0c/command", count=3, reason="gone"),
    Sinusoid(),
    Hold(attitude=(0.0, -10.5, 1 / 3)),
    Points(times=[0.0, 1.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, -0.1)]),
    Stream(timeout_s=0.3),
    Setpoint(attitude=(0.0, 1.0, 2.0)),
    Gains(C1=(0.3, 0.3, 0.3), Gamma=(0.02, 0.01, 1e-3)),
    Change(session="5f0c", tick=1234, gains=Gains(), reference=Hold(), within_s=0.1),
    Request(),
    Track(reference=Points(times=[0.0, 1.0], attitudes=[(0.0, 0.0, 0.0)] * 2), within_s=2.5),
    Mark(text="a bump"),
    Inject(faults=["rate:off@2", "command:drop=0.1"], clear=True),
    Advance(seconds=0.5),
    Answer(done=True, text="armed"),
    PlantChange(tick=-1, kind="inject", name="rate:off@2"),
    Tail(
        state={"uptime": 3}, changes=[Change(session="5f0c", tick=0)],
        operations=[PlantChange(tick=7, kind="release", name="5f0c")],
    ),
]  # fmt: skip
