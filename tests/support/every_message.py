"""One message of every kind, and several of some."""

from __future__ import annotations

from aeroloop.protocol.messages import models, operator
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import PlantChange, Tail
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

LATENCY = models.Percentiles(count=3, p50=230.5, p99=700.25, p999=800.0, max=812.0)
COUNTS = models.LatencyCounts(counts=[0, 0, 1, 1, 1, 2, *[3] * 10], sum_us=1743.25)
FAULT = models.FaultStatus(
    fault="command:drop=0.1@2", source="injected", begin_tick=1001, end_tick=None, changed=7, effect="commands dropped"
)
RECORD = models.SessionRecord(
    controller="c1", session="5f0b", gains=operator.Gains(C1=(0.3, 0.3, 0.3), C2=(0.15, 0.15, 0.15)),
    gains_from="operator", reference=operator.Hold(attitude=(0.0, -10.0, 90.0)), reference_from="resumed", within_s=5.0,
    since_tick=12, ended=TripCause.HOLDER_GONE, ended_tick=700,
)  # fmt: skip

MESSAGES: list[operator.Message] = [
    models.Claim(
        controller="c1", session="5f0c", period_ns=1, lockstep=True,
        wire=WireSpec(attitude=SignalSpec(bits=None, limit=1.0), rate=SignalSpec(bits=10, limit=2.0, deadzone=0.1)),
    ),
    RECORD,
    models.Grant(session="5f0c"),
    models.Grant(session="5f0c", last=RECORD),
    models.Refusal(reason="held by c2 since 3 s", holder="c2", differences=["rate.bits: 8, not 10"]),
    models.Release(session="5f0c"),
    models.Description(
        protocol=models.PROTOCOL_VERSION, role="plant", vehicle="aero", host="bench", versions={"python": "3.11"},
        config={"loop": {"rate_hz": 500.0}, "list": [1, "a", None, True]},
    ),
    LATENCY,
    models.Status(
        role="plant", state="driven", session="5f0c", uptime_s=1e6, ticks=2**40, rate_hz=499.9, skipped=1, received=2,
        sent=3, refused=4, saturated=5, latency_us=LATENCY, latency_counts=COUNTS, trips={TripCause.OPERATOR: 2},
        notes=["SCHED_FIFO: Operation not permitted"], faults=[FAULT],
    ),
    COUNTS,
    FAULT,
    models.Telemetry(
        session="5f0c", tick=7, counter=15, attitude_error=(0.1, -0.2, 1e-17), rate_error=(0.0, 1 / 3, -2.0),
        desired=(1.0, 0.0, 0.0, 0.0), state={"damping_estimate": (0.0, 0.0071, 0.022), "sign": (-1.0,)},
        voltages=(12.5, -24.0),
    ),
    models.Truth(
        tick=0, attitude=(1.0, 0.0, 0.0, 0.0), rate=(0.0, -0.5, 0.1), voltages=(24.0,),
        signals={"battery_V": 24.1, "T_deg": None},
    ),
    models.Timing(wake=LATENCY, busy=None, period=LATENCY, recent_wake=None, recent_busy=None, recent_period=None),
    models.Event(role="plant", kind="tripped", text="no fresh command for 100 ms, η ≥ 0", session="5f0c", tick=1207),
    models.Loss(key="aeroloop/aero/5f0c/command", count=3, reason="gone"),
    operator.Sinusoid(),
    operator.Hold(attitude=(0.0, -10.5, 1 / 3)),
    operator.Points(times=[0.0, 1.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, -0.1)]),
    operator.Stream(timeout_s=0.3),
    operator.Setpoint(attitude=(0.0, 1.0, 2.0)),
    operator.Gains(C1=(0.3, 0.3, 0.3), Gamma=(0.02, 0.01, 1e-3)),
    operator.Change(session="5f0c", tick=1234, gains=operator.Gains(), reference=operator.Hold(), within_s=0.1),
    operator.Request(),
    operator.Track(reference=operator.Points(times=[0.0, 1.0], attitudes=[(0.0, 0.0, 0.0)] * 2), within_s=2.5),
    operator.Mark(text="a bump"),
    operator.Inject(faults=["rate:off@2", "command:drop=0.1"], clear=True),
    operator.Advance(seconds=0.5),
    operator.Answer(done=True, text="armed"),
    PlantChange(tick=-1, kind="inject", name="rate:off@2"),
    Tail(
        state={"uptime": 3}, changes=[operator.Change(session="5f0c", tick=0)],
        operations=[PlantChange(tick=7, kind="release", name="5f0c")],
    ),
]  # fmt: skip
