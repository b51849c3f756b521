"""Table of a host's certificates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from aeroloop.protocol.transport.certificate import SOON_DAYS
from aeroloop.service.terminal.roles import BAD, WAITING

if TYPE_CHECKING:
    from aeroloop.service.host.keys import KeyFile


def keys_table(folder: Path, rows: Sequence[KeyFile]) -> None:
    """Print the certificates of a folder, and a line for each that cannot be used."""
    file, role, until, left = (
        Column(title, no_wrap=True, justify="right" if title == "days left" else "left")
        for title in ("file", "role", "valid until", "days left")
    )
    vehicle, name = Column("vehicle", overflow="fold"), Column("name", overflow="fold")
    table = Table(file, role, vehicle, name, until, left, box=None, pad_edge=False)
    for row in rows:
        days = row.days_left
        style = BAD if row.problem else WAITING if days is not None and days < SOON_DAYS else ""
        table.add_row(
            row.file,
            row.role or "–",
            row.vehicle or ("every" if row.role and row.role != "authority" else "–"),
            row.name or "–",
            f"{row.valid_until:%Y-%m-%d}" if row.valid_until else "–",
            f"{days:.{0 if abs(days) >= 1 else 1}f}" if days is not None else "–",
            style=style,
        )
    console = Console()
    console.print(Text(str(folder)), table, sep="\n", soft_wrap=False)
    for row in rows:
        if row.problem:
            console.print(Text(row.problem, style=BAD), soft_wrap=True)
