"""Rows of logs for `show`: findings of a review, runs side by side, figures of one run, the result of a replay."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from aeroloop.service.figures import Figures
from aeroloop.service.report import rows
from aeroloop.service.report.rows import count, grave, missing
from aeroloop.service.review.report import FaultInterval, Findings, Mark, Report, differences
from aeroloop.service.review.requirements import FIGURES, value_of
from aeroloop.service.terminal.show import Row, Sheets, paragraph

if TYPE_CHECKING:
    from aeroloop.protocol.messages.trace import End
    from aeroloop.service.lab.check import LogCheck
    from aeroloop.service.lab.demo import DemoFigures
    from aeroloop.service.lab.fork import Fork
    from aeroloop.service.logs.copies import Exported
    from aeroloop.service.logs.replay import EndReplay, Replay
    from aeroloop.service.review.instant import Instant

BEFORE: Final = "before"
"""In place of its time, of what happened before the session."""
BEFORE_SHOWN: Final = 4
"""Events of no matter from before the session."""
SHOWN: Final = 12
"""Lines of one kind; `--json` has them all."""


VECTORS: Final = {
    "roll, pitch, yaw [°]": "(roll|pitch|yaw)_deg",
    "desired [°]": "desired_(roll|pitch|yaw)_deg",
    "attitude error ε̃ [1]": "attitude_error_[xyz]",
    "attitude error [°]": "attitude_error_deg",
    "rate ω [rad/s]": "rate_[xyz]_rad_s",
    "rate error ω_e [rad/s]": "rate_error_[xyz]_rad_s",
}
"""Columns of a table that an instant shows in a row."""
TRUTHS: Final = {
    f"{name}_{axis}": f"truth_{truth.format(i=i, axis=axis)}"
    for name, truth in (("attitude", "q{i}"), ("rate", "rate_{axis}_rad_s"))
    for i, axis in enumerate("xyz", 1)
}
"""The column of the true value of a signal of a measurement."""


def figure_sheets(figures: Figures) -> Sheets:
    """Main figures of merit of one run, each that is missing with its reason; its trips, damages and log."""
    yield "", _one_run(figures)
    lines = [f"tripped: {trip}" for trip in figures.trips] + [f"not read: {line}" for line in figures.damages]
    lines += [f"log: {figures.log}"] if figures.log else []
    if lines:
        yield paragraph(lines), []


def demo_sheets(figures: DemoFigures) -> Sheets:
    """The faults that acted, and the figures of merit."""
    if figures.faults:
        yield "with faults", [_fault(fault) for fault in figures.faults]
    yield from figure_sheets(figures)


def review_sheets(findings: Findings) -> Sheets:
    """The events that matter, figures of merit, timing, other events, and whether the limits hold."""
    marks = timed(findings.marks)
    timed_faults = ("fault begins", "fault ends") if findings.faults else ()  # stand in a table of their own
    before = [entry for entry in marks if entry[0] == BEFORE]
    since = marks[len(before) :]
    matter = [entry for entry in since if grave(entry[1]) and not entry[1].text.startswith(timed_faults)]
    none = "no trip, failure, loss or refusal" + (" since the session began" if before else "")
    yield ("", _grave_events(matter)) if matter else (none, [])
    if findings.faults:
        yield "with faults", [_fault(fault) for fault in findings.faults]
    yield "", _one_run(findings)
    if durations := rows.durations([findings]):
        names = rows.PERCENTILES.values()
        yield "", [{"": each.label, **dict(zip(names, each.percentiles, strict=True))} for each in durations]
    yield "", [{"of the log": label, "found": text} for label, text in _details(findings)]
    if findings.theorem is not None:
        signs = {True: "✓", False: "✗", None: "–"}
        yield "", [{"": signs[good], "theorem": text} for good, text in rows.theorem_sentences(findings)]
    others = [*before[-BEFORE_SHOWN:], *(entry for entry in since if not grave(entry[1]))]
    if others:
        shown = [each for i, each in enumerate(others) if i < SHOWN or each[1].kind == "marked"]
        more = max(0, len(before) - BEFORE_SHOWN) + len(others) - len(shown)
        yield "", [_event(*each) for each in shown]
        if more:
            yield f"… and {more} more such events; --json has them all", []
    if findings.checks:
        checks = findings.checks
        yield "", [{"": "✓" if each.holds else "✗", "required": each.text, "found": each.found} for each in checks]


def comparison_sheets(reports: Sequence[Report]) -> Sheets:
    """The figures of several runs and the differences between their configurations."""
    names = [report.name for report in reports]
    yield "", _figure_rows(names, [report.findings for report in reports])
    differing: list[Row] = [
        {"": key, **dict(zip(names, map(rows.shown, values), strict=True))} for key, values in differences(reports)
    ]
    yield (f"{'differs in' if differing else 'no difference between'} the configurations", differing)
    lines: list[str] = []
    for report in reports:
        trips = [f"{when} {mark.text}" for when, mark in timed(report.findings.marks) if mark.kind == "tripped"]
        lines += [f"{report.name}: {line}" for line in (*trips, *_some(missing(report.findings)))]
    if lines:
        yield paragraph(lines), []


def _figure_rows(names: Sequence[str], runs: Sequence[Figures]) -> list[Row]:
    """A row a figure, with a column a run."""
    return [
        {"": figure.name, **{name: value.text for name, value in zip(names, values, strict=True)}, " ": figure.unit}
        for figure, values, _ in rows.figure_rows(runs)
    ]


def _one_run(run: Figures) -> list[Row]:
    found: list[Row] = []
    for figure, (value,), _ in rows.figure_rows([run]):
        if figure.main or (value.number is not None and figure.key in ("duration_s", "latency_us")):
            row = {"figure": figure.name, "value": value.text, "unit": figure.unit}
            found.append(row | {"why not": value.why or ""})
    known = not any(row["why not"] for row in found)
    return [{name: row[name] for name in row if not (known and name == "why not")} for row in found]


def _details(findings: Findings) -> Iterator[tuple[str, str]]:
    for line in _some(missing(findings)):
        yield "missing", line
    gaps = "none"
    if findings.gap_count:
        longest = max(findings.gaps, key=lambda gap: gap.ticks)
        gaps = f"{findings.gap_count}, the longest {count(longest.ticks, 'tick')} at {longest.time_s:.3f} s"
    yield "gaps", gaps
    shares = (f"{name} {100 * share:.2f} %" for name, share in findings.saturated.items())
    yield "at the outermost level", ", ".join(shares)
    yield from ((f"invalid {name}s", str(n)) for name, n in findings.invalid.items() if n)
    if findings.lapses:
        yield "frames and ticks", ", ".join(f"{name}: {n:,}" for name, n in findings.lapses.items())
    differing = [f"{each.key}: controller {each.controller}, plant {each.plant}" for each in findings.disagreements]
    yield from (("ends disagree", line) for line in _some(differing))
    if findings.log:
        yield "path", findings.log
    if (part := findings.reasons.get("duration_s")) is not None:
        yield "part", part
    started = findings.started.replace("T", " ").replace("+00:00", " UTC")
    yield "session", f"{findings.session} of {findings.vehicle}, {started}"
    vehicles = dict.fromkeys(one.vehicle for one in findings.recorded)
    if len(vehicles) > 1:
        yield "vehicles", f"{', '.join(vehicles)}; shown is {findings.vehicle}, --vehicle shows another"
    its = [one for one in findings.recorded if one.vehicle == findings.vehicle]
    if len(its) > 1:
        listed = [f"{i} is {one.session}, {one.duration_s:.1f} s" for i, one in enumerate(its, 1)]
        yield "sessions", f"{'; '.join(_some(listed))}; --session N shows another"


def _fault(fault: FaultInterval) -> Row:
    """A fault at the plant: from when to when, what it changed, and where it came from."""
    until = "the end" if fault.end_s is None else f"{fault.end_s:.3f} s"
    row = {"fault": fault.fault, "from": f"{fault.begin_s:.3f} s", "to": until}
    return row | {"effect": f"{fault.changed} {fault.effect}", "source": fault.source}


def timed(marks: Sequence[Mark]) -> list[tuple[str, Mark]]:
    """Events in order, each with its time on the law's clock, or `before` or `after` the session."""
    found, outside = list[tuple[str, Mark]](), BEFORE
    for mark in marks:
        if mark.time_s is None:
            found.append((outside, mark))
        else:
            found.append((f"{round(mark.time_s, 3) + 0.0:.3f} s", mark))
            outside = "after"
    return found


def _event(when: str, mark: Mark, again: str = "") -> Row:
    return {"time": when, "role": mark.role, "event": mark.kind, "what": mark.text + again}


def _grave_events(marks: Sequence[tuple[str, Mark]]) -> list[Row]:
    """Every event that matters; of faults that differ in numbers only, the first, with count and time of the last."""
    alike: dict[tuple[str, str, str], list[tuple[str, Mark]]] = {}
    for i, (when, mark) in enumerate(marks):
        text = str(i) if mark.kind == "tripped" else re.sub(r"\d+([.,]\d+)?", "#", mark.text)
        alike.setdefault((mark.role, mark.kind, text), []).append((when, mark))
    found = []
    for (when, first), *more in alike.values():
        last = more[-1][0].replace("after", "after the session") if more else ""
        again = f" ({count(1 + len(more), 'such event')} in all, the last: {last})" if more else ""
        found.append(_event(when, first, again))
    return found


def _some(lines: Sequence[str]) -> list[str]:
    more = len(lines) - SHOWN
    return [*lines[:SHOWN], *([f"… and {more} more; --json has them all"] if more > 0 else [])]


def export_sheets(exported: Exported) -> Sheets:
    """What was exported, and what of the log was not."""
    if exported.sessions is None:
        found = f"{exported.rows} messages on {len(exported.columns)} channels"
    else:
        found = f"{exported.rows} ticks of {', '.join(exported.sessions)}"
    lines = [f"not read, {line}" for line in exported.damages] + [str(one) for one in exported.unknown]
    if exported.law_unknown is not None:
        lines.append(f"without its law: {exported.law_unknown}")
    if around := exported.around:
        lines.append(f"around: {around[0]}" + (f" ({len(around) - 1} more such events)" if len(around) > 1 else ""))
    if others := exported.left_out:
        names = ", ".join(_some(others))
        lines.append(f"not exported of this log: {names}; choose by --vehicle and --session")
    yield paragraph([f"{exported.out}: {found}", *lines]), []


def replay_sheets(replay: Replay) -> Sheets:
    """A row for each session, where each end first differs, and the verdict on each end."""
    sessions: list[Row] = []
    for one in replay.sessions:
        row = {"session": f"{one.vehicle}/{one.session}"}
        row |= {"from tick": "–" if one.first_tick is None else str(one.first_tick), "ticks": str(one.ticks)}
        sessions.append(row | {"differ": str(one.differ)})
    if sessions:
        yield "", sessions
    lines = [f"first differs {line}" for line in replay.first_differences]
    lines += [f"controller: {_replayed(replay, 'controller')}", f"plant: {_replayed(replay, 'plant')}"]
    named = {line for unseen in replay.unseen.values() for line in unseen}
    lines += [f"not read: {line}" for line in _some([line for line in replay.damages if line not in named])]
    lines += [f"not judged: {line}" for line in _some(replay.others)]
    yield paragraph(lines), []


def instant_sheets(its: Instant) -> Sheets:
    """All that is known of a tick, on one screen."""
    values = its.values
    when = its.measured.replace("T", " ").replace("+00:00", " UTC")
    yield f"tick {its.tick}, {its.time_s:g} s  {when}  session {its.session} of {its.vehicle}", []
    age_s = values.get("truth_age_s")
    true = "true" if age_s is None else f"true, {1e3 * age_s:g} ms before"
    for what, frame in (("measurement", its.measurement), ("command", its.command)):
        counter = "" if frame.counter is None else f", counter {frame.counter}"
        received = f"sent as {frame.sent_as}, {frame.received_as.replace('_', ' ')}"
        shown: list[Row] = []
        for one in frame.signals:
            row = {"": one.name, "bits": one.bits, "code": f"{one.code:g}", "level": _digits(one.level)}
            if what == "command":
                row["unquantized"] = _digits(values.get(f"unquantized_{one.name}_V"))
            truth = _digits(values.get(TRUTHS.get(one.name, f"truth_{one.name}_V")))
            shown.append(row | {true: truth, "unit": one.unit})
        yield f"{what} {frame.octets or '–'}: {received}{counter}", shown
    vectors = {
        what: [value for name, value in values.items() if re.fullmatch(pattern, name)]
        for what, pattern in VECTORS.items()
    }
    after = {f"{name} after": numbers for name, numbers in its.state_after.items()}
    gains = {f"gain {name}": gain for name, gain in its.gains.items()}
    used = {name: [v for key, v in values.items() if re.match(f"{name}(_|$)", key)] for name in its.state_after}
    if values:
        every = vectors | used | after | its.coordinates | gains
        columns = [str(i + 1) for i in range(max(map(len, every.values())))]
        cells = {name: zip_longest(columns, map(_digits, numbers), fillvalue="") for name, numbers in every.items()}
        yield "", [{"": name, **dict(row)} for name, row in cells.items()]
    delays = {"measurement": "measurement_delay_us", "command": "command_delay_us", "round trip": "latency_us"}
    known = [f"{name} {rows.micros(us)}" for name, key in delays.items() if (us := values.get(key)) is not None]
    clocks = [f"{name} at {'–' if at_s is None else f'{at_s:.6f} s'}" for name, at_s in its.clocks_s.items()]
    lines = [f"delays: {', '.join(known)}"] * bool(known) + clocks * any(its.clocks_s.values()) + its.notes
    if lines:
        yield paragraph(lines), []
    if its.events:
        yield "within a second", [_event(*each) for each in timed(its.events)[:SHOWN]]


def _digits(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}"


def fork_tree(fork: Fork, reports: Sequence[Report]) -> dict[str, Any]:
    """A fork as `--json` prints it."""
    names = ("tick", "at_s", "changed", "parts", "compared", "network", "ended", "differed", "log")
    runs = {one.name: one.findings for one in reports}
    return {**{name: getattr(fork, name) for name in names}, "runs": runs}


def fork_sheets(fork: Fork, reports: Sequence[Report]) -> Sheets:
    """Figures of the fork beside those recorded, where they part, and why the fork ended."""
    changed = "; ".join(fork.changed) or "nothing is changed"
    yield f"from tick {fork.tick} ({fork.at_s:g} s): {changed}", []
    yield "", _figure_rows(["recorded", "forked"], [report.findings for report in reports])
    lines = [f"the fork ended: {fork.ended}"] if fork.ended else []
    lines += [fork.differed] if fork.differed else []
    if fork.parts is not None:
        found = fork.parts
        sent = "; ".join(found.signals) or f"{found.logged} recorded, {found.computed} forked"
        what = "measured" if found.end == "plant" else "commanded"
        lines.append(f"they part at tick {found.tick} ({found.time_s:g} s), where the {found.end} {what}: {sent}")
        if fork.network is not None and fork.network <= found.tick:
            lines.append(f"a frame was late or lost before, first at tick {fork.network}")
    elif fork.compared:
        lines.append(f"{fork.compared} ticks, every one the same, byte for byte")
    yield paragraph(lines + ([f"log: {fork.log}"] if fork.log else [])), []


def check_sheets(checked: Sequence[LogCheck]) -> Sheets:
    """A row a log, then what could not be compared."""
    shown = list[Row]()
    for one in checked:
        verdict = one.error or (f"{one.differ} of {one.commands} differ" if one.differ else f"{one.commands} equal")
        verdict = (verdict if one.commands or one.error else "–") + ", accepted" * one.accepted
        plant = f"{one.plant_differ} of {one.plant_ticks} differ" if one.plant_differ else f"{one.plant_ticks} equal"
        row = {"": "✓" if one.same else "✗", "log": Path(one.log).name, "commands": verdict}
        row |= {"plant": plant if one.plant_ticks else "–", "first difference": "; ".join(one.first) or "–"}
        both = [before_after for before_after in (one.before, one.after) if before_after is not None]
        for figure in FIGURES:
            if figure.key in ("z_track", "u_total", "max_error_deg"):
                values = [value_of(each, figure.path) for each in both]
                texts = ["–" if value is None else figure.text(value) for value in values]
                row[f"{figure.key} {figure.unit}"] = " → ".join(texts) if len(both) == 2 else "–"
        shown.append(row)
    yield "", shown
    lines = list[str]()
    for one in checked:
        unseen = [f"not compared: {line}" for line in one.unseen]
        lines += [f"{Path(one.log).name}: {line}" for line in (*_some(unseen), *_some(one.notes))]
    if lines:
        yield paragraph(lines), []


def _replayed(replay: Replay, name: End) -> str:
    """What a replay found of an end, and in the same line what it did not compare."""
    end: EndReplay | None = getattr(replay, name)
    unseen, reason = replay.unseen.get(name, []), replay.reasons.get(name, "")
    if end is None:
        others = [line for line in unseen if reason not in line]
        return f"not replayed: {reason}" + (f"; not compared: {'; '.join(_some(others))}" if others else "")
    found = f"{end.ticks} ticks, {end.differ} differ"
    if not end.differ:
        same = "the same, byte for byte"
        found = f"{same}, at {end.ticks} ticks" if unseen else f"{end.ticks} ticks, every tick is {same}"
    if unseen:
        found += f"; not compared: {'; '.join(_some(unseen))}"
    elif reason:
        found += f"; {reason}"
    open_ended = [gap for gap in replay.missing if gap.end == name and not gap.rows]
    return found + "".join(f"; not in the log: {gap}" for gap in open_ended[:SHOWN])
