"""Rows and sentences of a review: figures of merit, durations, what is missing, and what the theorem comes to.

The page and the terminal show the same, so that a figure reads the same in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from json import dumps
from typing import Any, Final, Literal, NamedTuple

from aeroloop.service.review.report import Findings, Mark, Spread, TheoremFindings
from aeroloop.service.review.requirements import value_of


class Value(NamedTuple):
    """A figure of one run: its digits, or a dash and the reason why there are none; and the number."""

    text: str
    why: str | None = None
    number: float | None = None


class Delta(NamedTuple):
    """Difference of a figure of one run to that of the first; `word` is None where neither is better."""

    text: str
    word: Literal["better", "worse", "same"] | None


class Figure(NamedTuple):
    """Form of a figure of merit.

    `path` leads to it in the findings, `what` says in a few words what it is, `main` figures are always shown, and
    those that add up over time (`sums_up`) are comparable only between runs of the same duration.
    """

    path: str
    name: str
    unit: str
    text: Callable[[float], str]
    main: bool = False
    what: str = ""
    less_is_better: bool = True
    sums_up: bool = False

    @property
    def key(self) -> str:
        """Its name in `--json`."""
        return self.path if self.path.startswith(THEOREM) else self.path.partition(".")[0]


class Row(NamedTuple):
    """A figure of several runs: a value per run, and whether less is better, run by run."""

    figure: Figure
    values: list[Value]
    comparable: list[bool]

    def delta(self, run: int) -> Delta | None:
        """Difference of a run to the first; None where either is unknown."""
        first, value = self.values[0].number, self.values[run].number
        if first is None or value is None:
            return None
        if self.values[0].text == self.values[run].text:
            return Delta("0", "same")
        apart = value - first
        sign = "+" if apart > 0 else "−"
        share = f" ({sign}{percent(abs(apart / first))} %)" if first else ""
        word: Literal["better", "worse"] = "better" if apart < 0 else "worse"
        return Delta(f"{sign}{self.figure.text(abs(apart))}{share}", word if self.comparable[run] else None)


def micros(value: float) -> str:
    """A duration with its unit: `622 µs`, `1.42 ms`, `2.1 s`."""
    for scale, unit in ((1e6, "s"), (1e3, "ms")):
        if abs(value) >= scale:
            return f"{value / scale:.3g} {unit}" if abs(value) < 1e3 * scale else f"{value / scale:,.0f} {unit}"
    return f"{value:.3g} µs" if value < 100 else f"{value:.0f} µs"


def seconds(value: float) -> str:
    """A time on the law's clock or a duration, to the millisecond: `12.346`."""
    return f"{round(value, 3) + 0.0:,.3f}".replace("-", "−")  # + 0.0: no minus before a zero


def percent(share: float) -> str:
    """A share 0…1 in percent: two significant digits under 1 %, and `0` only for exactly 0."""
    value = 100 * share
    return "0" if not value else f"{value:.2g}" if value < 1 else f"{value:.1f}"


_whole, _tenth, _hundredth = "{:,.0f}".format, "{:,.1f}".format, "{:,.2f}".format
_fourth = "{:.4f}".format

THEOREM: Final = "theorem."
"""Prefix of the theorem's keys."""

SPREADS: Final = {
    "latency": ("latency", "Latency: from a measurement to the command that answers it"),
    "measurement_delay": ("plant to controller", "From the plant to the controller"),
    "command_delay": ("controller to plant", "From the controller to the plant"),
    "period": ("period", "Period between measurements"),
}
"""Labels and titles of distributions, in the order of drawing."""

PERCENTILES: Final = {"p50": "p50", "p90": "p90", "p99": "p99", "p999": "p99.9", "max": "longest"}
"""Percentiles of a duration that are shown, and their names."""

UNMET: Final = {
    "C.28": "the sensors of attitude err by more than the quantizer, against (C.28)",
    "C.29": "the sensors of the rate err by more than the quantizer, against (C.29)",
    "C.30": "the command is saturated or missing, against (C.30)",
    "Assumption 3": "the attitude error is larger than the certificate assumes",
}
"""Premises of Lemma 1 that a true state may not satisfy, and what that means."""

FIGURES: Final = (
    Figure("z_track", "tracking error z_track", "×10⁻⁴ s", lambda z: _hundredth(z * 1e4), True,
            "∫ ε̃ᵀε̃ dt, ε̃ the attitude error as measured", sums_up=True),
    Figure("u_total", "control effort u_total", "V²·s", _tenth, True,
            "∫ uᵀu dt, u the voltages as sent", sums_up=True),
    Figure("max_error_deg", "largest attitude error", "°", _hundredth, True,
            "angle from measured to desired attitude"),
    Figure("final_error_deg", "final attitude error", "°", _hundredth, True, "at the last tick"),
    Figure("skipped_ticks", "skipped ticks", "", _whole, True, "ticks without a command", sums_up=True),
    Figure("latency_us.p50", "loop latency p50", "µs", _whole, True, "measurement sent to command received, median"),
    Figure("latency_us.p99", "loop latency p99", "µs", _whole),
    Figure("latency_us.max", "loop latency, longest", "µs", _whole),
    Figure("age_us.p50", "age of measurements at the controller, p50", "µs", _whole),
    Figure("age_us.p99", "age of measurements at the controller, p99", "µs", _whole),
    Figure("measurement.frames_per_s", "measurements", "frames/s", _tenth, less_is_better=False),
    Figure("measurement.bits_per_s", "measurements", "bit/s", _whole, True, "payload from plant to controller", False),
    Figure("command.frames_per_s", "commands", "frames/s", _tenth, less_is_better=False),
    Figure("command.bits_per_s", "commands", "bit/s", _whole, True, "payload from controller to plant", False),
    Figure("gap_count", "gaps", "", _whole, sums_up=True),
    Figure("saturated.attitude", "attitude at the quantizer's limit", "%", percent),
    Figure("saturated.rate", "rate at the quantizer's limit", "%", percent),
    Figure("saturated.voltage", "voltage at the quantizer's limit", "%", percent),
    Figure("invalid", "frames without a valid value", "", _whole, sums_up=True),
    Figure("missing_ticks", "ticks that were not recorded", "", _whole, sums_up=True),
    Figure("lapses", "late, missed, malformed, stale, refused", "", _whole, sums_up=True),
    Figure("losses", "messages the recorder lost", "", _whole, sums_up=True),
    Figure("trips", "trips", "", _whole, sums_up=True),
    Figure("theorem.held", "kept to all that could be judged: 1, or 0", "", _whole, less_is_better=False),
    Figure("theorem.mean_square_share", "∫k‖z‖² of its bound V(t₀) + ∫δ_Q, at most", "%", percent),
    Figure("theorem.pointwise_share", "true ‖z‖ of its bound at every instant, at most", "%", percent),
    Figure("theorem.radius", "bound of ‖z‖ in the long run, root mean square", "", _fourth, less_is_better=False),
    Figure("theorem.pointwise_radius", "bound of ‖z‖ at every instant, in the end", "", _fourth, less_is_better=False),
    Figure("theorem.pointwise_deg", "attitude error within that bound", "°", _hundredth, less_is_better=False),
    Figure("theorem.z_norm", "largest ‖z‖ after the transient", "", _fourth),
    Figure("theorem.true_z_norm", "largest true ‖z‖ after the transient", "", _fourth),
    Figure("theorem.error_deg", "largest attitude error after the transient", "°", _hundredth),
    Figure("theorem.true_error_deg", "largest true attitude error after the transient", "°", _hundredth),
    Figure("theorem.broken", "inequalities of Lemma 1 broken", "", _whole, sums_up=True),
    Figure("duration_s", "duration", "s", seconds, less_is_better=False),
)  # fmt: skip


def figure_rows(runs: Sequence[Findings]) -> list[Row]:
    """Main figures, and every other that at least one run has or has a reason for lacking."""
    rows = []
    apart = [abs(run.duration_s - runs[0].duration_s) > 0.01 * runs[0].duration_s for run in runs]
    for figure in FIGURES:
        found = [(run, value_of(run, figure.path)) for run in runs]
        values = [
            Value("–", run.reasons.get(figure.key)) if number is None else Value(figure.text(number), None, number)
            for run, number in found
        ]
        if figure.main or any(value.text != "–" or value.why for value in values):
            comparable = [figure.less_is_better and not (figure.sums_up and differ) for differ in apart]
            rows.append(Row(figure, values, comparable))
    return rows


class Duration(NamedTuple):
    """A duration of a run: PERCENTILES as texts, and the distribution if there is one."""

    run: int
    label: str
    percentiles: list[str]
    spread: Spread | None


def durations(runs: Sequence[Findings]) -> list[Duration]:
    """Every duration that a run has, those of one kind together, the age of measurements last."""
    found = [
        Duration(i, label, [micros(getattr(run.timing[name], each)) for each in PERCENTILES], run.timing[name])
        for name, (label, _) in SPREADS.items()
        for i, run in enumerate(runs)
        if name in run.timing
    ]
    ages = [(i, run.age_us) for i, run in enumerate(runs) if run.age_us]
    return found + [
        Duration(i, "age when used", [micros(age[each]) if each in age else "–" for each in PERCENTILES], None)
        for i, age in ages
    ]


def missing(run: Findings) -> list[str]:
    """What of the log is damaged, was not recorded, is unknown, or was lost by the recorder."""
    lacks = [f"not recorded: {gap}" for gap in run.missing]
    lost = [f"the recorder lost {count(n, 'message')} of {topic}" for topic, n in run.losses.items()]
    return [*run.damages, *lacks, *map(str, run.unknown), *lost]


def theorem_sentences(run: Findings) -> list[tuple[bool | None, str]]:
    """What is proven of a run and what of it held, with whether that is good; nothing if it was not checked."""
    if (found := run.theorem) is None:
        return []
    counts = {
        "Lemma 1": found.judged,
        "the mean square": found.mean_square_judged,
        "the bound at every instant": found.pointwise_judged,
    }
    by = ", ".join(name for name, n in counts.items() if n)
    held = {True: f"The run kept to {by}.", False: f"The run did not keep to all of {by}."}
    told: list[tuple[bool | None, str]] = [
        (bool(found.holds), found.verdict),
        (found.held, "Nothing could be judged." if found.held is None else held[found.held]),
        (None, _judged(found)),
    ]
    if found.mean_square_share is not None and found.spacing_s is not None:
        text = (
            f"∫k‖z‖² is at most {percent(found.mean_square_share)} % of V(t₀) + ∫δ_Q, at {found.mean_square_at_s:g} s"
        )
        told.append((None, f"{text}; {found.mean_square_judged:,} true states up to {found.spacing_s:g} s apart."))
    if found.pointwise_share is not None:
        text = f"‖z‖ is at most {percent(found.pointwise_share)} % of its bound, at {found.pointwise_at_s:g} s"
        since = f"the bound judges from {found.pointwise_since_s:g} s and falls to {found.pointwise_bound:.4g}"
        told.append((None, f"{text}; {since}."))
    names: dict[str, list[str]] = {}
    for row in figure_rows([run]):
        why = row.values[0].why
        if row.figure.key.startswith(THEOREM) and why and why != found.verdict.rstrip("."):  # which is said already
            names.setdefault(why, []).append(row.figure.name)
    return told + [(None, f"Not judged, since {why}: {'; '.join(of)}.") for why, of in names.items()]


def _judged(found: TheoremFindings) -> str:
    """From when until when a run is judged, and by how many true states."""
    parts = [f"The transient is taken to last {found.transient_s:.3g} s, three times the law's slower time constant."]
    if found.since_s:
        parts.append(f"Judged from {found.since_s:g} s, when the reference had been reached.")
    if found.until_s is not None:
        parts.append(f"Judged until {found.until_s:g} s, where gains or reference changed.")
    if found.samples:
        unmet = [f"At {n:,} {UNMET.get(name, name)}." for name, n in found.outside.items() if n]
        by = f"the other {found.judged:,}" if unmet else "all of them"
        parts += [f"{found.samples:,} true states belong to a tick.", *unmet, f"Lemma 1 is judged by {by}."]
    if found.broken:
        which = ", ".join(f"({check.equation}) {check.broken:,}×" for check in found.lemma if check.broken)
        parts.append(f"It is broken: {which}.")
    elif closest := max((check.closest or 0.0, check.equation) for check in found.lemma) if found.judged else None:
        parts.append(f"Closest is ({closest[1]}), {percent(closest[0])} % of its bound.")
    return " ".join(parts)


def grave(mark: Mark) -> bool:
    """Whether an event is highlighted."""
    return mark.kind in {"tripped", "fault", "lost", "refused"}


def shown(value: Any) -> str:
    """A value as the configuration writes it: `true`, `[1, 2]`, a text without quotes; None is a dash."""
    if value is None:
        return "–"
    return value if isinstance(value, str) else dumps(value, ensure_ascii=False, default=str)


def count(n: int, what: str) -> str:
    """A number of things: `1 tick`, `2,000 ticks`."""
    return f"{n:,} {what}" + ("" if n == 1 else "s")
