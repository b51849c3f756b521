"""What is printed: rows of text as a table for a terminal of any width, or as Markdown; one progress bar on stderr."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from math import degrees, inf
from typing import TYPE_CHECKING, Final, TypeAlias

import typer
from rich.cells import cell_len
from rich.console import Console, Group
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from aeroloop.protocol.printable import printable
from aeroloop.protocol.wire.attitude import angle

if TYPE_CHECKING:
    from aeroloop.service.config import Settings
    from aeroloop.service.testing.process_group import ProcessGroup

Row: TypeAlias = dict[str, str]

Sheets: TypeAlias = Iterable[tuple[str, Sequence[Row]]]
"""Tables, each with its title, and paragraphs, which are titles without rows; a title may have several lines."""

STYLES: Final = {
    **dict.fromkeys(("✓", "running", "driven", "recording", "routing"), "green"),
    **dict.fromkeys(("✗", "tripped", "faulted", "fault", "not recording", "silent"), "bold red"),
    **dict.fromkeys(("missing", "lost", "refused"), "yellow"),
}
"""In a terminal, of cells with these texts."""
_PIPE_WIDTH: Final = 160
_GAP: Final = 2
_LINE_S: Final = 10.0


def paragraph(lines: Iterable[str]) -> str:
    """Lines as a paragraph. What of the network or a log is in one cannot look like another line."""
    return "\n".join(map(printable, lines))


def show(rows: Sequence[Row], title: str = "", keys: int = 1) -> None:
    """Print rows, all with the same columns, below a title; without rows the title is a paragraph.

    So many first columns (`keys`) name a row: each block has them where a terminal is too narrow for all columns.
    """
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, _PIPE_WIDTH)  # folded lines cannot be unfolded in a file
    console.print(drawn(rows, title, console.width, keys), soft_wrap=not console.is_terminal and not rows)


def show_all(sheets: Sheets, keys: int = 1) -> None:
    """Print tables and paragraphs, with a line between them."""
    for i, (title, rows) in enumerate(sheets):
        if i:
            typer.echo("")
        show(rows, title, keys)


def markdown(sheets: Sheets) -> str:
    """Tables and paragraphs in Markdown."""
    return "\n\n".join("\n".join(_markdown(rows, title)) for title, rows in sheets)


def drawn(rows: Sequence[Row], title: str, width: int, keys: int = 1) -> Group:
    """Rows as a table that is at most so wide: blocks of columns below each other where not all fit side by side."""
    title, rows = _printable_sheet(title, rows)
    heading = [Text(title, style="bold" if rows else "")] if title else []
    return Group(*heading, *(_blocks(rows, width, keys) if rows else ()))


def _printable_sheet(title: str, rows: Sequence[Row]) -> tuple[str, Sequence[Row]]:
    """A title, of one line or several, and rows without any character that acts on a terminal."""
    printable_rows = [{name: printable(cell) for name, cell in row.items()} for row in rows]
    return paragraph(title.split("\n")), printable_rows


def _markdown(rows: Sequence[Row], title: str) -> list[str]:
    title, rows = _printable_sheet(title, rows)
    if not rows:
        return [title]
    heading = [f"**{title}**", ""] if title else []
    rule = "".join("|--:" if _right(rows, name) else "|---" for name in rows[0])
    head, *lines = (f"| {' | '.join(cells)} |" for cells in (rows[0], *(row.values() for row in rows)))
    return [*heading, head, f"{rule}|", *lines]


def _right(rows: Sequence[Row], column: str) -> bool:
    """Whether a column holds numbers, and no longer words, and so stands to the right: never the first."""
    cells = [row[column] for row in rows if row[column] not in ("–", "", "none")]
    numbers = all(re.search(r"\d", cell) and not re.search(r"[^\W\d_]{4}", cell) for cell in cells)
    return numbers and column != next(iter(rows[0]))


def _blocks(rows: Sequence[Row], width: int, keys: int) -> Iterator[Table]:
    least = {name: _least(rows, name, width) for name in rows[0]}
    longest = {name: max(cell_len(row[name]) for row in rows) for name in rows[0]}
    first = [*least][:keys]
    blocks = [[*first]]
    for name in [*least][keys:]:
        used = sum(least[each] + _GAP for each in blocks[-1])
        if len(blocks[-1]) > keys and used + least[name] > width:
            blocks.append([*first])
        blocks[-1].append(name)
    for columns in blocks:
        table = Table(box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
        folds = sum(max(cell_len(name), longest[name]) + _GAP for name in columns) - _GAP > width
        for name in columns:  # where not all fits, only titles and long texts fold
            fixed = least[name] if folds and longest[name] <= least[name] else None
            right = _right(rows, name)
            table.add_column(name, justify="right" if right else "left", width=fixed, min_width=least[name])
        for row in rows:
            table.add_row(*(Text(row[name], style=STYLES.get(row[name], "")) for name in columns))
        yield table


def _least(rows: Sequence[Row], name: str, available: int) -> int:
    """Least width of a column: its title and texts over a third of a line fold between words, others do not."""
    cells = [row[name] for row in rows]
    folding = [text for text in cells if cell_len(text) > available / 3]
    whole = [] if folding else cells
    return max(map(cell_len, (*whole, *(word for text in (name, *folding) for word in text.split()), "")))


# ── progress ──


@contextmanager
def progress_bar(title: str, total: float | None = None, *, hidden: bool = False) -> Iterator[Callable[..., None]]:
    """A bar, updated by the yielded `update(done, total, title)`; what is None stays.

    Where stderr is no terminal, a share (`total` is 1) is a line every 10 s instead.
    """
    console = Console(stderr=True)
    line_due = inf if hidden or total != 1 or console.is_terminal else time.monotonic() + _LINE_S
    columns = TextColumn("{task.description}", markup=False), BarColumn(20), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=hidden or not console.is_terminal) as progress:
        task = progress.add_task(title, total=total)

        def update(done: float | None = None, total: float | None = None, title: str | None = None) -> None:
            nonlocal line_due
            progress.update(task, completed=done, total=total, description=title)
            if time.monotonic() >= line_due:
                line_due = time.monotonic() + _LINE_S
                now = progress.tasks[0]
                sys.stderr.write(f"aeroloop: {now.description}, {now.percentage:.0f} %\n")

        yield update


def demo_progress(settings: Settings, update: Callable[..., None]) -> Callable[[str, ProcessGroup], None]:
    """Update a bar with what the demo waits for, and from the first command on with time and error."""

    def show(waiting_for: str, now: ProcessGroup) -> None:
        if waiting_for or now.telemetry is None:
            update(title=f"waiting for {waiting_for}")
        else:
            error = degrees(angle(*now.telemetry.attitude_error))
            update(now.telemetry.tick * settings.loop.period, title=f"error {error:5.2f}°")

    return show
