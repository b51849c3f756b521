"""Rows and sentences of a review: figures of merit, durations, what is missing, and what the theorem comes to.

The page and the terminal show the same, so that a figure reads the same in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from typing import Any, Final, Literal, NamedTuple

from aeroloop.service.review.report import Findings, Mark, Spread
from aeroloop.service.review.requirements import FIGURES, Figure, percent, value_of


class Value(NamedTuple):
    """A figure of one run: its digits, or a dash and the reason why there are none; and the number."""

    text: str
    why: str | None = None
    number: float | None = None


class Delta(NamedTuple):
    """Difference of a figure of one run to that of the first; `word` is None where neither is better."""

    text: str
    word: Literal["better", "worse", "same"] | None


class Row(NamedTuple):
    """A figure of several runs: a value and its difference to the first one, run by run."""

    figure: Figure
    values: list[Value]
    deltas: list[Delta | None]


def micros(value: float) -> str:
    """A duration with its unit: `622 µs`, `1.42 ms`, `2.1 s`."""
    for scale, unit in ((1e6, "s"), (1e3, "ms")):
        if abs(value) >= scale:
            return f"{value / scale:.3g} {unit}" if abs(value) < 1e3 * scale else f"{value / scale:,.0f} {unit}"
    return f"{value:.3g} µs" if value < 100 else f"{value:.0f} µs"


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


def figure_rows(runs: Sequence[Findings]) -> list[Row]:
    """Main figures, and every other that at least one run has or has a reason for lacking.

    Of the theorem's, `theorem_sentences` has the reasons.
    """
    rows = []
    differ = [abs(run.duration_s - runs[0].duration_s) > 0.01 * runs[0].duration_s for run in runs]
    for figure in FIGURES:
        numbers = [value_of(run, figure.path) for run in runs]
        values = [
            Value("–", run.reasons.get(figure.key)) if number is None else Value(figure.text(number), None, number)
            for run, number in zip(runs, numbers, strict=True)
        ]
        if figure.main or any(value.text != "–" or value.why for value in values):
            comparable = [figure.less_is_better and not (figure.sums_up and apart) for apart in differ]
            deltas = [_delta(figure, values[0], value, may) for value, may in zip(values, comparable, strict=True)]
            rows.append(Row(figure, values, deltas))
    return rows


def _delta(figure: Figure, first: Value, value: Value, comparable: bool) -> Delta | None:
    """Difference of a run's value to the first run's; None where either is unknown."""
    if first.number is None or value.number is None:
        return None
    if first.text == value.text:
        return Delta("0", "same")
    apart = value.number - first.number
    sign = "+" if apart > 0 else "−"
    share = f" ({sign}{percent(abs(apart / first.number))} %)" if first.number else ""
    word: Literal["better", "worse"] = "better" if apart < 0 else "worse"
    return Delta(f"{sign}{figure.text(abs(apart))}{share}", word if comparable else None)


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
    counts = {"Lemma 1": found.judged, "the bound at every instant": found.pointwise_judged}
    by = " and ".join(name for name, n in counts.items() if n)
    held = {True: f"The run kept to {by}.", False: f"The run did not keep to all of {by}."}
    judged = []
    if found.since_s:
        judged.append(f"Judged from {found.since_s:g} s, when the reference had been reached.")
    if found.until_s is not None:
        judged.append(f"Judged until {found.until_s:g} s, where gains or reference changed.")
    if found.samples:
        unmet = [f"At {n:,} {UNMET.get(name, name)}." for name, n in found.outside.items() if n]
        judged += [f"{found.samples:,} true states belong to a tick.", *unmet]
        if found.judged:
            judged.append(f"Lemma 1 is judged by {f'the other {found.judged:,}' if unmet else 'all of them'}.")
    if found.broken:
        which = ", ".join(f"({check.equation}) {check.broken:,}×" for check in found.lemma if check.broken)
        judged.append(f"It is broken: {which}.")
    elif found.lemma:
        closest = max(found.lemma, key=lambda check: check.closest)
        judged.append(f"Closest is ({closest.equation}), {percent(closest.closest)} % of its bound.")
    if found.pointwise_share is not None:
        text = f"‖z‖ is at most {percent(found.pointwise_share)} % of its bound, at {found.pointwise_at_s:g} s"
        since = f"the bound judges from {found.pointwise_since_s:g} s and falls to {found.pointwise_bound:.4g}"
        judged.append(f"{text}; {since}.")
    unjudged: dict[str, list[str]] = {}
    for (name, n), key in zip(counts.items(), ("broken", "pointwise_share"), strict=True):
        why = run.reasons.get(f"theorem.{key}")
        if why and not n and why != found.verdict.rstrip("."):  # which is said already
            unjudged.setdefault(why, []).append(name)
    reasons = "; ".join(f"{' and '.join(names)}, since {why}" for why, names in unjudged.items())
    texts = " ".join(judged), f"Not judged: {reasons}." if reasons else ""
    return [
        (bool(found.holds), found.verdict),
        (found.held, "Nothing could be judged." if found.held is None else held[found.held]),
        *((None, text) for text in texts if text),
    ]


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
