"""Report of a run as data: what `log review --json` prints (`Findings`) and what its page draws.

review.py fills it; it does not depend on how it is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

from pydantic import BaseModel, Field

from aeroloop.service.figures import Figures
from aeroloop.service.logs.session import Array, Missing, Unknown


class Spread(BaseModel, frozen=True):
    """Distribution of a duration: percentiles [µs]."""

    count: int
    p50: float
    p90: float
    p99: float
    p999: float
    max: float


class Gap(BaseModel, frozen=True):
    """Ticks in a row that no command answered: when the first was [s], its number, how many."""

    time_s: float
    tick: int
    ticks: int


class Mark(BaseModel, frozen=True):
    """An event on the time axis: an event message, a change of gains or reference, a loss."""

    time_s: float | None = Field(description="on the law's clock [s]; null if outside of what was read")
    kind: str = Field(description="`tripped`, `fault`, `change`, `lost`… as in the log's events")
    role: str
    text: str


class FaultInterval(BaseModel, frozen=True):
    """A fault of the emulated plant that acted in the session."""

    fault: str = Field(description="signal:kind[=value][@start[..end]], as it was configured or injected")
    source: Literal["configured", "injected"]
    begin_s: float = Field(description="when it began, on the law's clock; 0 if before the session [s]")
    end_s: float | None = Field(description="when it ended [s]; null if not within the session")
    changed: int = Field(description="frames, samples or voltages that it changed, at the plant")
    effect: str = Field(description="what it changed, and how: `commands dropped`")


class Recorded(BaseModel, frozen=True):
    """A session in the log, and the time from its controller's first to its last row [s]."""

    vehicle: str
    session: str
    duration_s: float


class Disagreement(BaseModel, frozen=True):
    """A dotted key of the configuration that the two ends have different values of; each acts by its own."""

    key: str
    controller: Any
    plant: Any


class Check(BaseModel, frozen=True):
    """A limit such as `z_track ≤ 0.005 s`, whether it holds, and what was found, with its unit."""

    text: str
    holds: bool
    found: str


class TheoremFindings(BaseModel, frozen=True):
    """What is proven of a session, and whether the session kept to it. Times are on the law's clock [s]."""

    verdict: str = Field(description="what the theorem promises, in a sentence, or why it promises nothing")
    holds: bool | None = Field(default=None, description="null where nothing can be promised")
    held: bool | None = Field(description="whether the run kept to it, as far as that could be judged")
    pointwise_radius: float | None = Field(default=None, description="bound of ‖z‖ in the end [1, rad/s], if certified")
    pointwise_deg: float | None = Field(default=None, description="the attitude error within that bound [deg]")
    pointwise_share: float | None = Field(
        default=None, description="largest true ‖z‖ as a share of the bound that holds once it was so small; at most 1"
    )
    pointwise_at_s: float | None = Field(default=None, description="when that was")
    pointwise_judged: int = Field(default=0, description="true states that judged it")
    pointwise_since_s: float | None = Field(default=None, description="from when on")
    pointwise_bound: float | None = Field(default=None, description="the least bound that judged [1, rad/s]")
    since_s: float = Field(description="judged from when the reference was reached")
    until_s: float | None = Field(description="judged until gains or reference changed; null: to the end")
    samples: int = Field(description="true states that belong to a tick that is judged")


class Findings(Figures):
    """Figures of merit and all other findings. What is unavailable is null, with the reason in `reasons`."""

    vehicle: str
    session: str
    sessions: int = Field(description="the vehicle's sessions in the log; the longest is judged if none is named")
    recorded: list[Recorded] = Field(default_factory=list, description="every session, in the order of recording")
    disagreements: list[Disagreement] = Field(default_factory=list, description="of loop, wire and plant")
    started: str = Field(description="when the session's first measurement was sent, UTC")
    timing: dict[str, Spread] = Field(
        description="`period`: between measurements, and `latency`: from a measurement to the command that answers it, "
        "on the plant's clock; `measurement_delay`, `command_delay`: one way, if both are equally fast at the median"
    )
    clock_offset_us: list[float] | None = Field(
        default=None, description="the controller's monotonic clock less the plant's, at the first and the last tick"
    )
    gaps: list[Gap] = Field(description="the longest hundred, in order of time")
    gap_count: int
    saturated: dict[str, float] = Field(description="share of values at the outermost level, 0…1, by signal")
    invalid: dict[str, int] = Field(description="frames with a component that has no valid value, by frame")
    losses: dict[str, int] = Field(description="messages that the recorder lost, by topic")
    missing_ticks: dict[str, int] = Field(description="rows never recorded, in all of the vehicle's sessions, by end")
    missing: list[Missing] = Field(description="where they are, and sessions of whose last batch there is none")
    unknown: list[Unknown] = Field(
        default=[],
        description="ticks that no figure counts: the log does not hold the gains, the reference and the law's state",
    )
    law_unknown: str | None = Field(
        default=None,
        description="why the law's own columns are missing (its state, gains, voltages before quantization); null if "
        "they are not",
    )
    unseen: dict[str, list[str]] = Field(
        default_factory=dict, description="what of the session no figure sees, by the figure whose limit permits it"
    )
    lapses: dict[str, int] = Field(
        description="deviations from one frame each way per tick. At the controller: measurements received "
        "`late`, ticks `missed`, `malformed` measurements; at the plant: commands `stale`, `repeated`, `refused` "
        "(malformed, or without a valid value), `withheld` by a fault"
    )
    marks: list[Mark]
    faults: list[FaultInterval] = Field(default_factory=list, description="that acted at the plant, in order of time")
    theorem: TheoremFindings | None = None
    checks: list[Check] = Field(default_factory=list)


class Line(NamedTuple):
    """One line of a panel: its values at the report's times, and whether they are desired ones. Shape (n,)."""

    label: str
    values: Array
    desired: bool = False

    @property
    def held(self) -> bool:
        """Whether it holds its value from one tick to the next; desired and true values do not."""
        return not self.desired and not self.label.startswith("true")


class Panel(NamedTuple):
    """Lines that share an axis; panels of a group stand together. The unit is `1` if there is none."""

    group: str
    title: str
    label: str
    unit: str
    lines: Sequence[Line]


@dataclass(frozen=True)
class Report:
    """A run."""

    name: str
    findings: Findings
    time: Array  # of every line, on the law's clock [s]. Shape (n,)
    panels: Sequence[Panel]  # in the order of the paper's figures
    thinned: int  # ticks per two points of a line, the least and the largest value; 1 or 2 if nothing was thinned out
    settings: dict[str, Any]  # effective, as nested tables; each section is of the role that owns it
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)  # about software and host, by role
    part: tuple[float, float] | None = None  # span of the law's clock that was read, if not the whole session [s]

    @property
    def period_s(self) -> float | None:
        """The loop's period [s], as configured; None if the log does not have it."""
        rate = self.settings.get("loop", {}).get("rate_hz")
        return 1 / rate if rate else None


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, with dotted keys: `{"law": {"C2": 1}}` is `{"law.C2": 1}`."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found


ADDRESSES: Final = (
    "network.", "recorder.path", "can.channel", "can.node", "can.options.",
    "plant.quanser.card_identifier", "plant.state_directory",
)  # fmt: skip
"""Keys that only say where something is."""


def differences(reports: Sequence[Report]) -> list[tuple[str, list[Any]]]:
    """Dotted keys that differ in the configurations of several runs, but addresses and paths; and each run's value."""
    tables = [flat(report.settings) for report in reports]
    keys = sorted(key for key in set().union(*tables) if not key.startswith(ADDRESSES))
    rows = [(key, [table.get(key) for table in tables]) for key in keys]
    return [(key, values) for key, values in rows if any(value != values[0] for value in values)]
