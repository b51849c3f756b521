"""Table of the bench, for the terminal or as Markdown; with an earlier run, its ratios beside those of this one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table
from rich.text import Text

from aeroloop.protocol.runtime.host_facts import host_facts, versions
from aeroloop.service.bench.results import Change, Measured, NotMeasured, Results
from aeroloop.service.lab.tables import markdown_table
from aeroloop.service.terminal.console import Console

_STYLES = {"met": "green", "missed": "yellow", "worse": "bold red"}


def bench_table(results: Results, changes: Sequence[Change] = ()) -> None:
    """Print ours, floor, ratio and aim of each item, and its earlier ratio where there is one."""
    header, *rows = _rows(results, changes)
    table = Table(box=None, pad_edge=False)
    for name in header:
        table.add_column(name, justify="left" if name in ("item", "") else "right", no_wrap=name == "item")
    for *figures, verdict in rows:
        table.add_row(*map(Text, figures), Text(verdict, style=_STYLES.get(verdict, "")))
    console = Console()
    console.print(table)
    for line in _notes(results, changes):
        console.print(Text(line), soft_wrap=not console.is_terminal)


def bench_markdown(results: Results, changes: Sequence[Change] = ()) -> str:
    """The same as Markdown."""
    return "\n\n".join([markdown_table(_rows(results, changes)), *_notes(results, changes)])


def _rows(results: Results, changes: Sequence[Change]) -> list[list[str]]:
    """What was measured, a header first; the last column says whether the aim is met, or whether the ratio is worse."""
    by_name = {change.name: change for change in changes}
    rows = [["item", "ours", "floor", "ratio", *(["before", "at most"] if changes else []), "aim", ""]]
    for name, line in results.root.items():
        if isinstance(line, Measured):
            change = by_name.get(name)
            beside = [_two(change.before), _two(change.limit)] if change else []
            verdict = "worse" if change and change.worse else _verdict(line.ratio, line.aim)
            figures = [f"{line.ours:g} {line.unit}".strip(), f"{line.floor:g} {line.unit}".strip(), _two(line.ratio)]
            rows.append([name, *figures, *beside, "–" if line.aim is None else f"{line.aim:g}", verdict])
    return rows


def _two(ratio: float | None) -> str:
    return "–" if ratio is None else f"{ratio:.2f}"


def _notes(results: Results, changes: Sequence[Change]) -> Iterator[str]:
    """Notes of items, what was not measured and why, what the earlier run lacks, and the machine."""
    lacking: dict[str, list[str]] = {}
    for name, line in results.root.items():
        if isinstance(line, NotMeasured):
            lacking.setdefault(f"not measured ({line.reason})", []).append(name)
        elif line.note:
            yield f"{name}: {line.note}"
    lacking["not measured before"] = [change.name for change in changes if change.now and change.before is None]
    for what, names in lacking.items():
        if names:
            yield f"{what}: {', '.join(names)}"
    facts, found = host_facts(), versions()
    host = [f"{facts.get('cpus', '?')} CPUs", facts.get("cpu", ""), facts["kernel"], f"Python {found['python']}"]
    yield ", ".join([*filter(None, host), f"aeroloop {found.get('revision', found['aeroloop'])}"])


def _verdict(ratio: float, aim: float | None) -> str:
    return "" if aim is None else "met" if ratio <= aim else "missed"
