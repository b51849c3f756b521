"""JSON messages: everything on the network that is neither a frame nor a trace.

Units stand in the fields' descriptions, so that the JSON schema in a log explains the log.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, AwareDatetime, Field, FiniteFloat, PlainSerializer, StringConstraints

from aeroloop.protocol.messages.operator import REFERENCE_VALUES, Angles, Change, Gains, Message, Reference, Stream
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.wire.spec import WireSpec

PROTOCOL_VERSION: Final = 2

STATUS_VALUES: Final = 2048  # values of a status with 128 faults, twice

EventKind = Literal[
    "armed", "changed", "claimed", "refused", "released", "tripped", "lost", "started", "stopped", "fault", "marked"
]
Source = Literal["configured", "operator", "resumed", "held"]
"""Where gains or a reference come from: the configuration, an operator, the session before, or the attitude found."""


def _no_other_topics_key(session: str) -> str:
    from aeroloop.protocol.messages.topics import TOPICS  # whose rows name the models

    if any(session == topic.key.partition("/")[0] for topic in TOPICS.values()):
        raise ValueError(f"{session!r} is the key of a topic and cannot name a session")
    return session


SessionName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9-]{1,64}$"), AfterValidator(_no_other_topics_key)]
"""One chunk of a key, and not the first chunk of a topic's key."""
TokenName = Annotated[str, StringConstraints(pattern=r"^[^/*$#?]{1,64}$")]
"""One chunk of a liveliness token's key, without wildcards."""
MAX_SIGNALS: Final = 16  # so many fit into the 2 KiB of a true state
Signals = Annotated[
    dict[Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")], FiniteFloat | None],
    Field(max_length=MAX_SIGNALS),
]
"""Further quantities of a plant by name."""


class Claim(Message):
    """A controller's request for the exclusive control of a plant."""

    protocol: int = Field(default=PROTOCOL_VERSION, description="version of SPEC.md that the controller implements")
    controller: TokenName = Field(description="name of the controller and of its liveliness token")
    session: SessionName = Field(description="name of the session, in the keys of its frames; new for every claim")
    period_ns: int = Field(gt=0, description="period of the controller's law [ns]")
    lockstep: bool = Field(description="the plant waits for each command before it steps")
    auto_arm: bool = Field(default=False, description="arm the plant by this claim, unless an operator stopped it")
    wire: Annotated[WireSpec, PlainSerializer(WireSpec.agreed)]


class SessionRecord(Message):
    """Gains and reference of a session. The plant keeps the last one for the next controller, with how it ended."""

    max_values = REFERENCE_VALUES
    controller: str
    session: str | None = Field(description="null: none runs, and the next one begins so")
    gains: Gains = Field(description="all of the law")
    gains_from: Source
    reference: Reference = Field(description="a hold without attitude: the attitude that the session finds")
    reference_from: Source
    within_s: float = Field(ge=0, description="time in which the reference was to be reached [s]")
    since_tick: int = Field(ge=0, description="the session's tick from which the reference applies")
    gains_since_tick: int = Field(default=0, ge=0, description="the session's tick from which the gains apply")
    start: Angles | None = Field(default=None, description="as in the change that set the reference")
    brake_s: Angles | None = Field(default=None, description="likewise")
    run_up_s: Angles | None = Field(default=None, description="likewise")
    here: tuple[Angles, Angles, Angles] | None = Field(default=None, description="likewise")
    ended: TripCause | Literal["released"] | None = Field(
        default=None, description="how the session ended; an operator's stop since then replaces it"
    )
    ended_tick: int | None = Field(default=None, description="the session's last tick")

    @property
    def in_force(self) -> list[Change]:
        """The changes in force, as `operator.in_force` gives; none without a session, or of a stream."""
        if self.session is None or isinstance(self.reference, Stream):
            return []
        gains = Change(session=self.session, tick=self.gains_since_tick, gains=self.gains)
        times = {name: getattr(self, name) for name in ("within_s", "start", "brake_s", "run_up_s", "here")}
        reference = Change(session=self.session, tick=self.since_tick, reference=self.reference, **times)
        return sorted((gains, reference), key=lambda change: change.tick)


class Grant(Message):
    """The plant's answer to a claim it accepts. The first measurement follows at once."""

    max_values = REFERENCE_VALUES
    granted: Literal[True] = True
    session: str
    last: SessionRecord | None = Field(default=None, description="the last session's record; null if there is none")


class Refusal(Message):
    """The plant's answer to a claim it refuses, with the reason."""

    granted: Literal[False] = False
    reason: str = Field(description="for a person")
    holder: str | None = Field(default=None, description="controller that has the vehicle, if any")
    differences: list[str] = Field(default_factory=list, description="fields of the claim that do not fit the plant")


class Release(Message):
    """A controller ends its session; the plant goes to 0 V."""

    session: str


class Description(Message):
    """Identity and configuration of a role: all that a log reader needs to read the log."""

    max_values = REFERENCE_VALUES
    protocol: int = Field(description="version of SPEC.md that the role implements")
    role: str
    vehicle: str
    host: str
    versions: dict[str, str]
    facts: dict[str, str] = Field(
        default_factory=dict,
        description="the host, and its properties that affect timing; `process` as in the status of the same process",
    )
    config: dict[str, Any] = Field(description="the effective configuration; sections as in the TOML file")
    certificate: dict[str, Any] | None = Field(
        default=None, description="controller: of its configuration, as `aeroloop lab certify --json` prints it"
    )


class Percentiles(Message):
    """Percentiles of a duration in µs, from a histogram with bins 4.4 % wide."""

    count: int
    p50: float
    p99: float
    p999: float = Field(description="99.9th percentile")
    max: float


LATENCY_BOUNDS_US: Final = 100, 200, 300, 400, 500, 700, 1000, 1500, 2000, 3000, 5000, 10_000, 20_000, 50_000, 100_000


class LatencyCounts(Message):
    """Latencies since the plant's start, counted at fixed bounds: a difference of two statuses counts those between."""

    counts: list[Annotated[int, Field(ge=0)]] = Field(
        min_length=len(LATENCY_BOUNDS_US) + 1,
        max_length=len(LATENCY_BOUNDS_US) + 1,
        description=f"how many were at most {', '.join(map(str, LATENCY_BOUNDS_US))} µs long; last, of any length",
    )
    sum_us: float = Field(ge=0, description="their sum [µs]")


class Timing(Message):
    """Timing of a loop, since its start-up and over the last ten seconds."""

    wake: Percentiles | None = Field(description="from a tick's deadline to its start [µs]")
    busy: Percentiles | None = Field(description="from a tick's start to its end [µs]")
    period: Percentiles | None = Field(description="from one tick's start to the next one's [µs]")
    recent_wake: Percentiles | None = Field(description="`wake`, last 10 s")
    recent_busy: Percentiles | None = Field(description="`busy`, last 10 s")
    recent_period: Percentiles | None = Field(description="`period`, last 10 s")


class FaultStatus(Message):
    """A fault of an emulated plant. Ticks are the plant's since its start, as in the trace's rows."""

    fault: str = Field(description="as it was configured or injected: signal:kind[=value][@start[..end]]")
    source: Literal["configured", "injected"]
    begin_tick: int | None = Field(description="first tick of its action; null before the first claim")
    end_tick: int | None = Field(description="first tick after it; null if none is known")
    changed: int = Field(description="frames, samples or voltages that it has changed since the plant's start")
    effect: str = Field(description="what it changes, and how: `commands dropped`")


class Status(Message):
    """State and counters of a role; the last one before it ends has the final counts."""

    max_values = STATUS_VALUES
    role: str
    state: str
    session: str | None = None
    cause: str | None = Field(
        default=None, description="why a plant is not armed, a controller claims no vehicle, a recorder writes nothing"
    )
    process: str = Field(default="", description="host and process id of the role")
    since: AwareDatetime | None = Field(default=None, description="plant: when the cause arose, UTC")
    unkept: str | None = Field(
        default=None, description="plant: why its next process will not know of a trip or a stop; null if it will"
    )
    datagrams: str = Field(default="", description="plant: where it takes frames as datagrams; empty for nowhere")
    certificate_until: AwareDatetime | None = Field(
        default=None, description="when the role's certificate expires, UTC; null where no link needs one"
    )
    uptime_s: float
    ticks: int = Field(description="ticks since start")
    rate_hz: float = Field(description="ticks a second since the last status")
    age_s: float = Field(default=0.0, description="in an answer to a query: since the status was taken [s]")
    skipped: int = Field(description="ticks of the session's grid that were missed")
    recent_skipped: int = Field(default=0, description="`skipped`, last 10 s")
    received: int = Field(default=0, description="frames (recorder: messages) received since start")
    sent: int = Field(default=0, description="frames sent since start")
    refused: int = Field(default=0, description="malformed frames since start")
    stale: int = Field(default=0, description="stale frames since start, too late to be acted upon")
    saturated: int = Field(default=0, description="values beyond a quantizer's range since start")
    lost: int = Field(default=0, description="recorder: messages missing in its log since start")
    lacks_recorder: Literal["gone", "required"] | None = Field(
        default=None,
        description="gone: it disappeared without a last status `stopped`; required: the controller waits for one",
    )
    latency_us: Percentiles | None = Field(
        default=None, description="plant: from a measurement sent to its answer, plant's clock"
    )
    recent_latency_us: Percentiles | None = Field(default=None, description="`latency_us`, last 10 s")
    latency_counts: LatencyCounts | None = Field(default=None, description="plant: `latency_us`, as a histogram")
    trips: dict[TripCause, Annotated[int, Field(ge=0)]] = Field(
        default={}, description="plant: trips since start by cause; causes without any are left out"
    )
    age_us: Percentiles | None = Field(
        default=None, description="controller: from a measurement received to its answer sent, last 10 s [µs]"
    )
    timing: Timing | None = Field(default=None, description="timing of the loop; null in lockstep")
    notes: list[str] = Field(default_factory=list, description="settings that the host refused")
    faults: list[FaultStatus] = Field(default_factory=list, description="emulated plant: past, acting and to come")
    gains: Gains | None = Field(default=None, description="controller: its gains, of the next session if none runs")
    gains_from: Source | None = None
    reference: str | None = Field(default=None, description="controller: its reference, in words; likewise")
    reference_from: Source | None = None


class Telemetry(Message):
    """What the controller computed at one tick."""

    session: str
    tick: int = Field(description="tick k of the law; its time is k·period")
    counter: int = Field(description="counter of the measurement it used")
    attitude_error: tuple[float, float, float] = Field(description="ε̃ of the quantized attitude [1]")
    rate_error: tuple[float, float, float] = Field(description="ω_e of the quantized rates, body frame [rad/s]")
    desired: tuple[float, float, float, float] = Field(description="q_d [1]")
    state: dict[str, tuple[float, ...]] = Field(
        description="the law's named state after the tick; of the paper's: damping_estimate, θ̂ [N·m·s/rad], and sign, "
        "of the equilibrium approached, z₁₊ or z₁₋"
    )
    voltages: tuple[float, ...] = Field(description="u before quantization [V]")


class Truth(Message):
    """The emulator's unquantized state. Never fed to the controller."""

    tick: int = Field(description="plant tick since start; its time is tick·period")
    attitude: tuple[float, float, float, float] = Field(description="q, body relative to inertial [1]")
    rate: tuple[float, float, float] = Field(description="ω, body frame [rad/s]")
    voltages: tuple[float, ...] = Field(description="voltages at the motors [V]")
    signals: Signals = Field(
        default={},
        exclude_if=lambda signals: not signals,
        description="up to 16 further quantities of the plant by name, `[A-Za-z][A-Za-z0-9_]{0,39}`, which ends in the "
        "unit; null where not known",
    )
    session: str | None = Field(default=None, description="session whose measurement was taken of this state, if any")
    session_tick: int | None = Field(default=None, description="that measurement's tick since the session's first")


class Event(Message):
    """One event at a role."""

    role: str
    kind: EventKind
    text: str = Field(
        description="one line for a person: what, why, since when, and which operator asked for it, if available"
    )
    session: str | None = None
    tick: int | None = Field(default=None, description="the session's tick at which it happened, if any")


LossReason = Literal["cache", "gone", "end"]
LOSS_REASONS: Final[dict[LossReason, str]] = {
    "cache": "not received, and no longer in their publisher's cache",
    "gone": "not received, and their publisher does not answer",
    "end": "not received, and still in their publisher's cache when recording ended",
}
"""Why messages are not in a log."""


class Loss(Message):
    """Messages of one key that the recorder found missing in the log."""

    key: str
    count: int = Field(ge=1, description="how many are missing")
    reason: LossReason = Field(description="; ".join(f"{name}: {words}" for name, words in LOSS_REASONS.items()))
