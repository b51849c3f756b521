"""Table of the bench, for the terminal or as Markdown; with an earlier run, its ratios beside those of this one."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from aeroloop.protocol.runtime.host_facts import host_facts, versions
from aeroloop.service.bench.results import Change, NotMeasured, Results
from aeroloop.service.lab.tables import markdown_table
from aeroloop.service.terminal.console import Console

_STYLES = {"met": "green", "not met": "yellow", "worse": "bold red"}


def bench_table(results: Results, changes: Sequence[Change] = ()) -> None:
    """Print ours, floor, ratio and aim of each item, and its earlier ratio where there is one."""
    header, *rows = _rows(results, changes)
    table = Table(box=None, pad_edge=False)
    for name in header:
        table.add_column(name, justify="left" if name in ("item", "aim is") else "right", overflow="fold")
    for row in rows:
        verdict = Text(row[-1], style=_STYLES.get(row[-1], ""))
        table.add_row(*map(Text, row[:-1]), verdict)
    console = Console()
    console.print(table)
    for line in _notes(changes):
        console.print(line, soft_wrap=True)


def bench_markdown(results: Results, changes: Sequence[Change] = ()) -> str:
    """The same as Markdown."""
    return "\n\n".join([markdown_table(_rows(results, changes)), *_notes(changes)])


def _rows(results: Results, changes: Sequence[Change]) -> list[list[str]]:
    by_name = {change.name: change for change in changes}
    earlier = ["before", "at most"] if changes else []
    rows = [["item", "ours", "floor", "ratio", *earlier, "aim", "aim is"]]
    for name, line in results.root.items():
        change = by_name.get(name)
        beside = [_two(change.before), _two(change.limit)] if change else []
        if isinstance(line, NotMeasured):
            rows.append([name, "–", "–", "–", *beside, f"{line.aim:g}", f"not measured: {line.reason}"])
        else:
            figures = [f"{line.ours:g} {line.unit}", f"{line.floor:g} {line.unit}", _two(line.ratio)]
            verdict = "worse" if change and change.worse else "met" if line.ratio <= line.aim else "not met"
            rows.append([name, *figures, *beside, f"{line.aim:g}", verdict])
    return rows


def _two(ratio: float | None) -> str:
    return "–" if ratio is None else f"{ratio:.2f}"


def _notes(changes: Sequence[Change]) -> list[str]:
    """What one of the runs lacks, and the machine."""
    facts, found = host_facts(), versions()
    host = [f"{facts.get('cpus', '?')} CPUs", facts.get("cpu", ""), facts["kernel"], f"Python {found['python']}"]
    lacking = {
        "not measured now": [change.name for change in changes if change.now is None],
        "not measured before": [change.name for change in changes if change.before is None],
    }
    notes = [f"{what}: {', '.join(names)}" for what, names in lacking.items() if names]
    return [*notes, ", ".join([*filter(None, host), f"aeroloop {found.get('revision', found['aeroloop'])}"])]
