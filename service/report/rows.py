"""Rows and sentences of a review that page and terminal share, so that a figure reads the same in both."""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from typing import Any, Final, NamedTuple

from aeroloop.service.figures import Figures
from aeroloop.service.review.report import Findings, Mark
from aeroloop.service.review.requirements import FIGURES, Figure, percent, value_of


class Value(NamedTuple):
    """A figure of one run: its digits, or a dash and the reason why there are none; and the number."""

    text: str
    why: str | None = None
    number: float | None = None


class Row(NamedTuple):
    """A figure of several runs: a value and its difference to the first one, run by run; empty where unknown."""

    figure: Figure
    values: list[Value]
    deltas: list[str]


class Duration(NamedTuple):
    """A duration of a run: PERCENTILES as texts, and of how many ticks."""

    run: int
    label: str
    percentiles: list[str]
    ticks: int


DURATIONS: Final = {
    "latency": "latency", "measurement_delay": "plant to controller", "command_delay": "controller to plant",
    "period": "period",
}  # fmt: skip
PERCENTILES: Final = {"p50": "p50", "p90": "p90", "p99": "p99", "p999": "p99.9", "max": "longest"}


def figure_rows(runs: Sequence[Figures]) -> list[Row]:
    """Main figures, and every other that at least one run has or has a reason for lacking."""
    rows = []
    for figure in FIGURES:
        numbers = [value_of(run, figure.path) for run in runs]
        values = [
            Value("–", run.reasons.get(figure.key)) if number is None else Value(figure.text(number), None, number)
            for run, number in zip(runs, numbers, strict=True)
        ]
        if figure.main or any(value.text != "–" or value.why for value in values):
            rows.append(Row(figure, values, [_delta(figure, numbers[0], number) for number in numbers]))
    return rows


def _delta(figure: Figure, first: float | None, value: float | None) -> str:
    if first is None or value is None:
        return ""
    if figure.text(first) == figure.text(value):
        return "0"
    sign = "+" if value > first else "−"
    share = f" ({sign}{percent(abs(value / first - 1))} %)" if first else ""
    return f"{sign}{figure.text(abs(value - first))}{share}"


def durations(runs: Sequence[Findings]) -> list[Duration]:
    """Every duration that a run has, those of one kind together."""
    return [
        Duration(i, label, [micros(getattr(run.timing[name], each)) for each in PERCENTILES], run.timing[name].count)
        for name, label in DURATIONS.items()
        for i, run in enumerate(runs)
        if name in run.timing
    ]


def missing(run: Findings) -> list[str]:
    """What of the log is damaged, was not recorded, is unknown, or was lost by the recorder, or its law's."""
    lacks = [f"not recorded: {gap}" for gap in run.missing]
    lost = [f"the recorder lost {count(n, 'message')} of {topic}" for topic, n in run.losses.items()]
    of_law = [] if run.law_unknown is None else [f"without its law: {run.law_unknown}"]
    return [*run.damages, *lacks, *map(str, run.unknown), *lost, *of_law]


def theorem_sentences(run: Findings) -> list[tuple[bool | None, str]]:
    """What is proven of a run and what of it held, with whether that is good; nothing if it was not checked."""
    if (found := run.theorem) is None:
        return []
    sentences: list[tuple[bool | None, str]] = [(found.holds, found.verdict)]  # None: no theorem
    if found.holds and found.held is None:
        sentences.append((None, f"Whether it held could not be judged: {run.reasons['theorem.held']}."))
    if found.held is None or found.pointwise_share is None:
        return sentences
    span = f"from {found.since_s:g} s" if found.since_s else "from the beginning"
    until = "" if found.until_s is None else f" until {found.until_s:g} s, where gains or reference changed"
    share = f"‖z‖ is at most {percent(found.pointwise_share)} % of its bound, at {found.pointwise_at_s:g} s"
    return [
        *sentences,
        (found.held, f"The run {'kept to' if found.held else 'broke'} the bound."),
        (None, f"Judged {span}{until}, by {found.pointwise_judged:,} of {found.samples:,} true states; {share}, where "
               f"the bound falls to {found.pointwise_bound:.4g}."),
    ]  # fmt: skip


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


def micros(value: float) -> str:
    """A duration with its unit: `622 µs`, `1.42 ms`, `2.1 s`."""
    for scale, unit in ((1e6, "s"), (1e3, "ms")):
        if abs(value) >= scale:
            return f"{value / scale:.3g} {unit}" if abs(value) < 1e3 * scale else f"{value / scale:,.0f} {unit}"
    return f"{value:.3g} µs" if value < 100 else f"{value:.0f} µs"
