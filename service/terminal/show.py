"""Printer of results: rows of text as a table for a terminal of any width, or as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal, TypeAlias

import typer
from rich.cells import cell_len
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

Row: TypeAlias = dict[str, str]
Format: TypeAlias = Literal["terminal", "markdown"]

Sheets: TypeAlias = Iterable[tuple[str, Sequence[Row]]]
"""Tables, each with its title, and paragraphs, which are titles without rows."""

STYLES: Final = {
    **dict.fromkeys(("✓", "running", "driven", "recording", "routing"), "green"),
    **dict.fromkeys(("✗", "tripped", "faulted", "fault", "not recording", "silent"), "bold red"),
    **dict.fromkeys(("missing", "lost", "refused"), "yellow"),
}
"""In a terminal, of cells with these texts."""
_PIPE_WIDTH: Final = 160
_GAP: Final = 2


def show(rows: Sequence[Row], title: str = "", form: Format = "terminal", keys: int = 1) -> None:
    """Print rows, all with the same columns, and a title; without rows the title is a paragraph.

    Args:
        rows: From column to text.
        title: Above the table, in a terminal and in Markdown.
        form: For a person or for a document.
        keys: So many first columns name a row: each block has them where a terminal is too narrow for all columns.
    """
    if form == "markdown":
        typer.echo("\n".join(_markdown(rows, title)))
    else:
        console = Console()
        if not console.is_terminal:
            console.width = max(console.width, _PIPE_WIDTH)  # folded lines cannot be unfolded in a file
        console.print(drawn(rows, title, console.width, keys), soft_wrap=not console.is_terminal and not rows)


def show_all(sheets: Sheets, form: Format = "terminal", keys: int = 1) -> None:
    """Print tables and paragraphs, with a line between them."""
    for i, (title, rows) in enumerate(sheets):
        if i:
            typer.echo("")
        show(rows, title, form, keys)


def drawn(rows: Sequence[Row], title: str, width: int, keys: int = 1) -> Group:
    """Rows as a table that is at most so wide: blocks of columns below each other where not all fit side by side."""
    heading = [Text(title, style="bold" if rows else "")] if title else []
    return Group(*heading, *(_blocks(rows, width, keys) if rows else ()))


def _markdown(rows: Sequence[Row], title: str) -> list[str]:
    if not rows:
        return [title]
    heading = [f"**{title}**", ""] if title else []
    rule = "".join("|--:" if right else "|---" for right in _right(rows))
    return [*heading, *(f"| {' | '.join(cells)} |" for cells in (rows[0],)), f"{rule}|",
            *(f"| {' | '.join(row.values())} |" for row in rows)]  # fmt: skip


def _right(rows: Sequence[Row]) -> list[bool]:
    """Which columns hold numbers, and no longer words, and so stand to the right: never the first."""

    def numbers(column: str) -> bool:
        cells = [row[column] for row in rows if row[column] not in ("–", "", "none")]
        return all(re.search(r"\d", cell) and not re.search(r"[^\W\d_]{4}", cell) for cell in cells)

    return [i > 0 and numbers(column) for i, column in enumerate(rows[0])]


def _blocks(rows: Sequence[Row], width: int, keys: int) -> list[Table]:
    least = {name: _least(rows, name, width) for name in rows[0]}
    right = dict(zip(rows[0], _right(rows), strict=True))
    tables = []
    for columns in _split(least, width, keys):
        drawn = Table(box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
        whole = {name: max(cell_len(name), *(cell_len(row[name]) for row in rows)) for name in columns}
        folds = sum(whole.values()) + _GAP * (len(columns) - 1) > width
        for name in columns:
            is_long = max(cell_len(row[name]) for row in rows) > least[name]
            fixed = least[name] if folds and not is_long else None
            drawn.add_column(name, justify="right" if right[name] else "left", width=fixed, min_width=least[name])
        for row in rows:
            drawn.add_row(*(Text(row[name], style=STYLES.get(row[name], "")) for name in columns))
        tables.append(drawn)
    return tables


def _least(rows: Sequence[Row], name: str, available: int) -> int:
    """Least width of a column: its title and texts over a third of a line fold between words, others do not."""
    cells = [row[name] for row in rows]
    folding = [text for text in cells if cell_len(text) > available / 3]
    whole = [] if folding else cells
    return max(map(cell_len, (*whole, *(word for text in (name, *folding) for word in text.split()), "")))


def _split(least: Mapping[str, int], available: int, keys: int) -> list[list[str]]:
    """Columns of each block: all in one where they fit beside each other."""
    first, *others = [*least][:keys], *[*least][keys:]
    blocks = [[*first]]
    for name in others:
        width = sum(least[each] for each in blocks[-1]) + _GAP * len(blocks[-1]) + least[name]
        if len(blocks[-1]) > keys and width > available:
            blocks.append([*first])
        blocks[-1].append(name)
    return blocks
