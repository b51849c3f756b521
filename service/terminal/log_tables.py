"""Terminal tables of logs: the findings of a review, several runs side by side, the result of a replay."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from math import log2
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table
from rich.text import Text

from aeroloop.service.report import rows
from aeroloop.service.report.rows import count, grave, missing
from aeroloop.service.review.report import FaultInterval, Findings, Mark, Report, Spread, differences
from aeroloop.service.terminal.display import figures_table, labelled

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
    figures_table(findings.model_copy(update={"trips": [], "damages": []}))
    console.print()
    if findings.timing:
        table = Table("", *rows.PERCENTILES.values(), "", box=None, pad_edge=False, header_style="")
        for row in rows.durations([findings]):
            table.add_row(
                row.label, *row.percentiles, sparkline(row.spread) if row.spread and console.width >= 80 else ""
            )
        console.print(table)
        console.print()
    table = labelled()
    for label, text in _rows(findings):
        table.add_row(label, text)
    console.print(table)
    if findings.theorem is not None:
        console.print()
        for good, text in rows.theorem_sentences(findings):
            console.print(Text(text, style="" if good is None else "green" if good else "bold red"))
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


def comparison_tables(reports: Sequence[Report]) -> None:
    """Print the figures of several runs and the differences between their configurations."""
    console = Console()
    figures = Table("", box=None)
    differing = Table("differs in the configurations", box=None)
    for report in reports:
        figures.add_column(escape(report.name), justify="right")
        differing.add_column(escape(report.name), overflow="fold")
    figures.add_column("")
    for row in rows.figure_rows([report.findings for report in reports]):
        figures.add_row(row.figure.name, *(value.text for value in row.values), row.figure.unit)
    for key, values in differences(reports):
        differing.add_row(key, *(escape(rows.shown(value)) for value in values))
    console.print(figures)
    console.print()
    console.print(differing if differing.row_count else "the configurations are the same")
    for report in reports:
        trips = [f"{when} {mark.text}" for when, mark in timed(report.findings.marks) if mark.kind == "tripped"]
        for line in [*trips, *_some(missing(report.findings))]:
            console.print(f"{report.name}: {line}", markup=False)


def demo_account(figures: DemoFigures) -> None:
    """Print the faults that acted, and figures of merit."""
    if figures.faults:
        Console().print(_faults_table(figures.faults))
    figures_table(figures)


def sparkline(spread: Spread, width: int = 22) -> str:
    """The distribution as a row of bars: logarithm of the count over logarithm of the duration.

    Why logarithms: a single late tick in a million stays visible.
    """
    first, last = log2(spread.bins[0][0]), log2(spread.bins[-1][0])
    counts = [0] * width
    for edge, n in spread.bins:
        counts[min(width - 1, int((log2(edge) - first) / max(last - first, 1e-9) * width))] += n
    top = log2(1 + max(counts))
    bars = (_BARS[round(log2(1 + n) / top * (len(_BARS) - 1))] if n else " " for n in counts)
    return "".join(bars).rstrip()


def _rows(findings: Findings) -> Iterator[tuple[str, str]]:
    for line in _some(missing(findings)):
        yield "missing", line
    if findings.gap_count:
        longest = max(findings.gaps, key=lambda gap: gap.ticks)
        yield "gaps", f"{findings.gap_count}, the longest {count(longest.ticks, 'tick')} at {longest.time_s:.3f} s"
    else:
        yield "gaps", "none"
    shares = (f"{name} {100 * share:.2f} %" for name, share in findings.saturated.items())
    yield "at the outermost level", ", ".join(shares)
    for name, n in findings.invalid.items():
        if n:
            yield f"invalid {name}s", str(n)
    if findings.lapses:
        yield "irregular ticks", ", ".join(f"{n} {name}" for name, n in findings.lapses.items())
    if findings.clock_offset_us is not None:
        first, last = findings.clock_offset_us
        yield "controller's clock ahead", f"{first:,.0f} µs at the first tick, {last:,.0f} µs at the last"
    for differs in findings.disagreements[:DISAGREEMENTS_SHOWN]:
        yield "ends disagree", f"{differs.key}: controller {differs.controller}, plant {differs.plant}"
    if (more := len(findings.disagreements) - DISAGREEMENTS_SHOWN) > 0:
        yield "", f"… and {more} more keys; --json has them all"
    if (part := findings.reasons.get("duration_s")) is not None:
        yield "part", part
    started = findings.started.replace("T", " ").replace("+00:00", " UTC")
    yield "session", f"{findings.session} of {findings.vehicle}, {started}"
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
        counts = ", ".join(f"{n} {kind}" for kind, n in earlier.items())
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
    lines = [
        f"{session.session}: first differs at tick {first.tick} ({first.time_s:g} s): {first.logged} logged, "
        f"{first.computed} computed"
        for session in replay.sessions
        if (first := session.first_difference) is not None
    ]
    lines += [
        f"plant: first differs at tick {other.session_tick} of {other.session}: {other.field} {other.logged} logged, "
        f"{other.computed} computed"
        for plant in replay.plants
        if (other := plant.first_difference) is not None
    ]
    lines += [f"{end}: {line}" for end, details in replay.details.items() for line in details]
    lines += [f"controller: {_replayed(replay, 'controller')}", f"plant: {_replayed(replay, 'plant')}"]
    named = {line for unseen in replay.unseen.values() for line in unseen}
    lines += [f"not read: {line}" for line in _some([line for line in replay.damages if line not in named])]
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _replayed(replay: Replay, name: End) -> str:
    """What a replay found of an end, and in the same line what it did not compare."""
    end: EndReplay | None = getattr(replay, name)
    unseen, reason = replay.unseen.get(name, []), replay.reasons.get(name, "")
    if end is None:
        unseen, found = [line for line in unseen if reason not in line], f"not replayed: {reason}"
    elif end.differ:
        found = f"{end.ticks} ticks, {end.differ} differ"
    elif unseen:
        found = f"the same, byte for byte, at {end.ticks} ticks"
    else:
        found = f"{end.ticks} ticks, every tick is the same, byte for byte"
    if unseen:
        found += f"; not compared: {'; '.join(_some(unseen, UNSEEN_SHOWN))}"
    if end is None:
        return found
    if reason and not unseen:
        found += f"; {reason}"
    open_ended = [gap for gap in replay.missing if gap.end == name and not gap.rows]
    return found + "".join(f"; not in the log: {gap}" for gap in open_ended[:UNSEEN_SHOWN])
