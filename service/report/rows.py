"""Rows and sentences of a review that page and terminal share, so that a figure reads the same in both."""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from typing import Any, Final, NamedTuple

from aeroloop.service.figures import Figures
from aeroloop.service.review.report import Findings, Mark, Spread
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
    """A duration of a run: PERCENTILES as texts, and the distribution if there is one."""

    run: int
    label: str
    percentiles: list[str]
    spread: Spread | None = None


DURATIONS: Final = {
    "latency": "latency", "measurement_delay": "plant to controller", "command_delay": "controller to plant",
    "period": "period",
}  # fmt: skip
PERCENTILES: Final = {"p50": "p50", "p90": "p90", "p99": "p99", "p999": "p99.9", "max": "longest"}

UNMET: Final = {
    "C.28": "the sensors of attitude err by more than the quantizer, against (C.28)",
    "C.29": "the sensors of the rate err by more than the quantizer, against (C.29)",
    "C.30": "the command is saturated or missing, against (C.30)",
    "Assumption 3": "the attitude error is larger than the certificate assumes",
}  # premises of Lemma 1 that a true state may not satisfy, and what that means


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
    """Every duration that a run has, those of one kind together, the age of measurements last."""
    found = [
        Duration(i, label, [micros(getattr(run.timing[name], each)) for each in PERCENTILES], run.timing[name])
        for name, label in DURATIONS.items()
        for i, run in enumerate(runs)
        if name in run.timing
    ]
    ages = [(i, run.age_us) for i, run in enumerate(runs) if run.age_us]
    texts = [(i, [micros(age[each]) if each in age else "–" for each in PERCENTILES]) for i, age in ages]
    return found + [Duration(i, "age when used", percentiles) for i, percentiles in texts]


def missing(run: Findings) -> list[str]:
    """What of the log is damaged, was not recorded, is unknown, or was lost by the recorder."""
    lacks = [f"not recorded: {gap}" for gap in run.missing]
    lost = [f"the recorder lost {count(n, 'message')} of {topic}" for topic, n in run.losses.items()]
    return [*run.damages, *lacks, *map(str, run.unknown), *lost]


def theorem_sentences(run: Findings) -> list[tuple[bool | None, str]]:
    """What is proven of a run and what of it held, with whether that is good; nothing if it was not checked."""
    if (found := run.theorem) is None:
        return []
    sentences: list[tuple[bool | None, str]] = [(bool(found.holds), found.verdict)]
    judged = [("Lemma 1", found.broken, 0), ("the bound at every instant", found.pointwise_share, 1)]
    kept = " and ".join(what for what, worst, _ in judged if worst is not None)
    broke = " and ".join(what for what, worst, most in judged if worst is not None and worst > most)
    if found.held is not None:
        sentences.append((found.held, f"The run kept to {kept}." if found.held else f"The run broke {broke}."))
    elif found.holds is not None:
        sentences.append((None, f"Nothing of it could be judged: {run.reasons.get('theorem.held', 'no true states')}."))
    if found.held is None:
        return sentences
    span = f"from {found.since_s:g} s" if found.since_s else "from the beginning"
    until = "" if found.until_s is None else f" until {found.until_s:g} s, where gains or reference changed"
    unmet = [f"at {n:,} {UNMET.get(name, name)}" for name, n in found.outside.items() if n]
    details = [f"Judged {span}{until}, by {found.samples:,} true states", *unmet]
    if found.lemma:
        closest = max(found.lemma, key=lambda check: check.closest)
        nearest = f"of Lemma 1 ({closest.equation}) is nearest to its bound, {percent(closest.closest)} % of it"
        details.append(f"{nearest}, by the {found.judged:,} states that satisfy its premises")
    if found.pointwise_share is not None:
        share = f"‖z‖ is at most {percent(found.pointwise_share)} % of its bound, at {found.pointwise_at_s:g} s"
        details.append(f"{share}, where the bound falls to {found.pointwise_bound:.4g}")
    return [*sentences, (None, "; ".join(details) + ".")]


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
