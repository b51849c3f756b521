"""Terminal tables of a log: the findings of a review, the result of a replay."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from math import log2
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from aeroloop.service.report.rows import grave
from aeroloop.service.review.report import FaultInterval, Findings, Mark, Spread, TheoremFindings
from aeroloop.service.terminal.display import LABELS, figures_table, labelled

if TYPE_CHECKING:
    from aeroloop.protocol.messages.trace import End
    from aeroloop.service.lab.demo import DemoFigures
    from aeroloop.service.logs.replay import EndReplay, Replay

MARKS_SHOWN: Final = 12
"""Events that do not matter."""
BEFORE: Final = "before"
"""In place of its time, of what happened before the session."""
BEFORE_SHOWN: Final = 4
DISAGREEMENTS_SHOWN: Final = 5
SESSIONS_SHOWN: Final = 9
DAMAGES_SHOWN: Final = 20
UNSEEN_SHOWN: Final = 3
_TIMINGS: Final = {
    "period": "period",
    "latency": "latency",
    "measurement_delay": "plant to controller",
    "command_delay": "controller to plant",
}
_BARS: Final = "▁▂▃▄▅▆▇█"


def review_account(findings: Findings) -> None:
    """Print the events that matter, figures of merit, timing, other events, and whether the limits hold."""
    console = Console()
    marks = timed(findings.marks)
    timed_faults = ("fault begins", "fault ends") if findings.faults else ()  # stand in a table of their own
    before = [entry for entry in marks if entry[0] == BEFORE]
    since = marks[len(before) :]
    matter = [entry for entry in since if grave(entry[1]) and not entry[1].text.startswith(timed_faults)]
    none = "no trip, failure, loss or refusal"
    console.print(_grave_table(matter) if matter else f"{none} since the session began" if before else none)
    if findings.faults:
        console.print(_faults_table(findings.faults))
    console.print()
    figures_table(findings.model_copy(update={"trips": [], "damages": _some(findings.damages)}))
    console.print()
    if findings.timing:
        console.print(_timing_table(findings, drawn=console.width >= 80))
        console.print()
    table = labelled()
    for label, text in _rows(findings):
        table.add_row(label, text)
    console.print(table)
    if findings.theorem is not None:
        console.print()
        console.print(theorem_table(findings, findings.theorem))
    others = [entry for entry in since if not grave(entry[1])]
    if before or others:
        console.print()
        console.print(_marks_table(before, others))
    if findings.checks:
        console.print()
        checks = Table(show_header=False, box=None, pad_edge=False)
        for check in findings.checks:
            style = "green" if check.holds else "bold red"
            checks.add_row(f"[{style}]{'✓' if check.holds else '✗'}[/]", check.text, check.found)
        console.print(checks)


def demo_account(figures: DemoFigures) -> None:
    """Print the faults that acted, and figures of merit."""
    if figures.faults:
        Console().print(_faults_table(figures.faults))
    figures_table(figures)


def _timing_table(findings: Findings, *, drawn: bool) -> Table:
    labels, unit, bars = (
        Column(style="bold", no_wrap=True, min_width=LABELS),
        Column(no_wrap=True),
        Column(no_wrap=True),
    )
    values = (Column(name, justify="right", no_wrap=True) for name in ("p50", "p99", "p99.9", "max"))
    table = Table(labels, *values, unit, bars, box=None, pad_edge=False, header_style="")
    for name, spread in findings.timing.items():
        percentiles = (spread.p50, spread.p99, spread.p999, spread.max)
        table.add_row(_TIMINGS[name], *(f"{us:.0f}" for us in percentiles), "µs", sparkline(spread) if drawn else "")
    if (age := findings.age_us) is not None:
        table.add_row("age when used", f"{age['p50']:.0f}", f"{age['p99']:.0f}", "", f"{age['max']:.0f}", "µs", "")
    return table


def sparkline(spread: Spread, width: int = 22) -> str:
    """The distribution as a row of bars: logarithm of the count over logarithm of the duration.

    Why logarithms: a single late tick in a million stays visible.
    """
    first, last = log2(spread.bins[0][0]), log2(spread.bins[-1][0])
    counts = [0] * width
    for edge, count in spread.bins:
        counts[min(width - 1, int((log2(edge) - first) / max(last - first, 1e-9) * width))] += count
    top = log2(1 + max(counts))
    bars = (_BARS[round(log2(1 + count) / top * (len(_BARS) - 1))] if count else " " for count in counts)
    return "".join(bars).rstrip()


def _rows(findings: Findings) -> Iterator[tuple[str, str]]:
    if findings.gap_count:
        longest = max(findings.gaps, key=lambda gap: gap.ticks)
        ticks = "1 tick" if longest.ticks == 1 else f"{longest.ticks} ticks"
        yield "gaps", f"{findings.gap_count}, the longest {ticks} at {longest.time_s:.3f} s"
    else:
        yield "gaps", "none"
    shares = (f"{name} {100 * share:.2f} %" for name, share in findings.saturated.items())
    yield "at the outermost level", ", ".join(shares)
    for name, count in findings.invalid.items():
        if count:
            yield f"invalid {name}s", str(count)
    lost = ", ".join(f"{count} {name}" for name, count in findings.losses.items())
    yield "messages lost", lost or "none reported"
    for gap in findings.missing:
        yield "not recorded", str(gap)
    for unknown in findings.unknown:
        yield "not known", str(unknown)
    if findings.lapses:
        yield "irregular ticks", ", ".join(f"{count} {name}" for name, count in findings.lapses.items())
    if findings.clock_offset_us is not None:
        first, last = findings.clock_offset_us
        yield "controller's clock ahead", f"{first:,.0f} µs at the first tick, {last:,.0f} µs at the last"
    for differs in findings.disagreements[:DISAGREEMENTS_SHOWN]:
        yield "ends disagree", f"{differs.key}: controller {differs.controller}, plant {differs.plant}"
    if (more := len(findings.disagreements) - DISAGREEMENTS_SHOWN) > 0:
        yield "", f"… and {more} more keys; --json has them all"
    if (part := findings.reasons.get("duration_s")) is not None:
        yield "part", part
    yield "session", f"{findings.session} of {findings.vehicle}, {_utc(findings.started)}"
    vehicles = dict.fromkeys(one.vehicle for one in findings.recorded)
    if len(vehicles) > 1:
        yield "vehicles", f"{', '.join(vehicles)}; shown is {findings.vehicle}, --vehicle shows another"
    its = [one for one in findings.recorded if one.vehicle == findings.vehicle]
    if len(its) > 1:
        for i, one in enumerate(its, 1):
            shown = ", shown" if one.session == findings.session else ""
            if shown or i <= SESSIONS_SHOWN:
                yield "sessions" if i == 1 else "", f"{i}  {one.session}, {one.duration_s:.1f} s{shown}"
        yield "", f"--session N shows another of {len(its)}"


def _utc(started: str) -> str:
    return started.replace("T", " ").replace("+00:00", " UTC")


def theorem_table(findings: Findings, found: TheoremFindings) -> Table:
    """The theorem's bounds beside the run's values."""
    table, nothing = labelled(), found.verdict.rstrip(".")

    def row(label: str, name: str, form: Callable[[float], str]) -> None:
        value = getattr(found, name)
        reason = findings.reasons.get(f"theorem.{name}", "not available")
        if value is None and reason == nothing:
            return  # the certificate's row says so
        table.add_row(label, Text(f"— ({reason})" if value is None else form(value)))

    table.add_row("certificate", Text(found.verdict, style="" if found.holds else "bold red"))
    if findings.reasons.get("theorem.held") != nothing:
        table.add_row("this run", Text(*_held(findings, found)))
    row("mean square", "mean_square_share", lambda share: _mean_square(found, share))
    row("every instant", "pointwise_share", lambda share: _pointwise(found, share))
    if findings.reasons.get("theorem.broken") != nothing:
        table.add_row("Lemma 1", Text(_lemma(findings, found), style="bold red" if found.broken else ""))
    since = f"since {found.since_s + found.transient_s:.3g} s"
    row(f"largest ‖z‖ {since}", "z_norm", "{:.4f}".format)
    row(f"largest error {since}", "error_deg", "{:.2f}°".format)
    if found.true_z_norm is not None and found.true_error_deg is not None:
        table.add_row("of the true state", f"‖z‖ {found.true_z_norm:.4f}, error {found.true_error_deg:.2f}°")
    if found.since_s:
        table.add_row("judged from", f"{found.since_s:g} s, when the reference had been reached")
    if found.until_s is not None:
        table.add_row("judged until", f"{found.until_s:g} s, where gains or reference changed")
    return table


def _held(findings: Findings, found: TheoremFindings) -> tuple[str, str]:
    """Whether the run kept to all that could be judged, in words and in a style."""
    if found.held is None:
        return f"— ({findings.reasons.get('theorem.held', 'not available')})", ""
    counts = (
        ("Lemma 1", found.judged),
        ("the mean square", found.mean_square_judged),
        ("the bound at every instant", found.pointwise_judged),
    )
    by = ", ".join(name for name, count in counts if count)
    return (f"✓ kept to {by}", "green") if found.held else (f"✗ does not keep to all of {by}", "bold red")


def _mean_square(found: TheoremFindings, share: float) -> str:
    by = f"{found.mean_square_judged} true states up to {found.spacing_s:g} s apart"
    return f"∫k‖z‖² is at most {_percent(share)} of V(t₀) + ∫δ_Q, at {found.mean_square_at_s:g} s; {by}"


def _pointwise(found: TheoremFindings, share: float) -> str:
    return (
        f"‖z‖ is at most {_percent(share)} of its bound, at {found.pointwise_at_s:g} s; the bound judges from "
        f"{found.pointwise_since_s:g} s and falls to {found.pointwise_bound:.4g}"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _lemma(findings: Findings, found: TheoremFindings) -> str:
    """Lemma 1 in one line: the closest or the broken inequalities, and the number of states checked."""
    if found.broken is None:
        return f"— ({findings.reasons.get('theorem.broken', 'not available')})"
    by = f"the {found.judged} of {found.samples} true states that satisfy its premises"
    if found.broken:
        which = ", ".join(f"({check.equation}) {check.broken}×" for check in found.lemma if check.broken)
        return f"broken: {which}, of {by}"
    closest = max(found.lemma, key=lambda check: check.closest or 0.0)
    return f"holds at {by}; closest is ({closest.equation}), {100 * (closest.closest or 0.0):.0f} % of its bound"


def _faults_table(faults: Sequence[FaultInterval]) -> Table:
    """Faults at the plant, a line each: from when to when, what it changed, and where it came from."""
    table = labelled()
    for i, fault in enumerate(faults):
        until = "to the end" if fault.end_s is None else f"to {fault.end_s:.3f} s"
        text = f"{fault.fault} from {fault.begin_s:.3f} s {until}, {fault.changed} {fault.effect} ({fault.source})"
        table.add_row("" if i else "with faults", Text(text, style="bold red"))
    return table


def timed(marks: Sequence[Mark]) -> list[tuple[str, Mark]]:
    """Events in order, each with its time on the law's clock, or `before` or `after` the session."""
    within = [i for i, mark in enumerate(marks) if mark.time_s is not None] or [len(marks)]

    def when(i: int, time_s: float | None) -> str:
        outside = BEFORE if i < within[0] else "after"
        return outside if time_s is None else f"{round(time_s, 3) + 0.0:.3f} s"

    return [(when(i, mark.time_s), mark) for i, mark in enumerate(marks)]


def _grave_table(marks: Sequence[tuple[str, Mark]]) -> Table:
    """Every event that matters; of faults that differ in numbers only, the first, with count and time of the last."""
    alike: dict[tuple[str, str, str], list[tuple[str, Mark]]] = {}
    for i, (when, mark) in enumerate(marks):
        text = str(i) if mark.kind == "tripped" else re.sub(r"\d+([.,]\d+)?", "#", mark.text)
        alike.setdefault((mark.role, mark.kind, text), []).append((when, mark))
    table = _marks()
    for (when, first), *more in alike.values():
        again = f" (and {len(more)} more like it, the last: {more[-1][0]})" if more else ""
        style = "bold red" if first.kind in ("tripped", "fault") else ""
        table.add_row(when, first.role, first.kind, Text(first.text + again), style=style)
    return table


def _marks_table(before: Sequence[tuple[str, Mark]], marks: Sequence[tuple[str, Mark]]) -> Table:
    """Events that do not matter, after the last few from before the session; earlier ones are counted in one line."""
    table = _marks()
    if earlier := Counter(mark.kind for _, mark in before[:-BEFORE_SHOWN]):
        counts = ", ".join(f"{count} {kind}" for kind, count in earlier.items())
        table.add_row(BEFORE, "", "", f"{earlier.total()} events: {counts}; --json has them all")
    for when, mark in [*before[-BEFORE_SHOWN:], *marks[:MARKS_SHOWN]]:
        table.add_row(when, mark.role, mark.kind, Text(mark.text))
    if (more := len(marks) - MARKS_SHOWN) > 0:
        table.add_row("", "", "", f"… and {more} more such events; --json has them all")
    return table


def _marks() -> Table:
    times, texts = Column(justify="right", no_wrap=True), Column(overflow="fold")
    roles, kinds = Column(no_wrap=True), Column(no_wrap=True)
    return Table(times, roles, kinds, texts, show_header=False, box=None, pad_edge=False)


def _some(lines: Sequence[str], shown: int = DAMAGES_SHOWN) -> list[str]:
    more = len(lines) - shown
    return [*lines[:shown], *([f"… and {more} more; --json has them all"] if more > 0 else [])]


def replay_table(replay: Replay) -> None:
    """Print the result of a replay."""
    console = Console()
    table = Table("session", "from tick", "ticks", "differ", "rms", "largest", "u_total", box=None)
    for session in replay.sessions:
        first_tick = "–" if session.first_tick is None else str(session.first_tick)
        rms = "–" if session.rms_v is None else f"{session.rms_v:.3f} V"
        largest = "–" if session.max_v is None else f"{session.max_v:.2f} V"
        efforts = f"{session.u_total_logged:.1f} → {session.u_total_computed:.1f} V²·s"
        counts = str(session.ticks), str(session.differ)
        table.add_row(f"{session.vehicle}/{session.session}", first_tick, *counts, rms, largest, efforts)
    console.print(table)
    for session in replay.sessions:
        if (first := session.first_difference) is not None:
            console.print(
                f"{session.session}: first differs at tick {first.tick} ({first.time_s:g} s): "
                f"{first.logged} logged, {first.computed} computed"
            )
    for plant in replay.plants:
        if (other := plant.first_difference) is not None:
            console.print(
                f"plant: first differs at tick {other.session_tick} of {other.session}: {other.field} {other.logged} "
                f"logged, {other.computed} computed"
            )
    for end_name, lines in replay.details.items():
        for line in lines:
            console.print(f"{end_name}: {line}", markup=False, soft_wrap=True)
    ends: dict[End, EndReplay | None] = {"controller": replay.controller, "plant": replay.plant}
    for name, end in ends.items():
        if end is None:
            reason, unseen = replay.reasons[name], replay.unseen.get(name, [])
            more = _some([line for line in unseen if reason not in line], UNSEEN_SHOWN)
            not_compared = f"; not compared: {'; '.join(more)}" if more else ""
            console.print(f"{name}: not replayed: {reason}{not_compared}", markup=False, soft_wrap=True)
        else:
            console.print(f"{name}: {_replayed(replay, name, end)}", markup=False, soft_wrap=True)
    named = {line for lines in replay.unseen.values() for line in lines}
    for line in _some([line for line in replay.damages if line not in named]):
        console.print(f"not read: {line}", markup=False, soft_wrap=True)


def _replayed(replay: Replay, name: End, end: EndReplay) -> str:
    """What a replay found of an end, and in the same line what it did not compare."""
    unseen = replay.unseen.get(name, [])
    if end.differ:
        found = f"{end.ticks} ticks, {end.differ} differ"
    elif unseen:
        found = f"the same, byte for byte, at {end.ticks} ticks"
    else:
        found = f"{end.ticks} ticks, every tick is the same, byte for byte"
    if unseen:
        found += f"; not compared: {'; '.join(_some(unseen, UNSEEN_SHOWN))}"
    elif name in replay.reasons:
        found += f"; {replay.reasons[name]}"
    open_ended = [gap for gap in replay.missing if gap.end == name and not gap.rows]
    return found + "".join(f"; not in the log: {gap}" for gap in open_ended[:UNSEEN_SHOWN])
