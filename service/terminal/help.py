"""Help of a command: its usage, what it does, and panels of its arguments, options and verbs.

Typer's own looks alike, but first imports Markdown, syntax highlighting and tracebacks, which takes 60 ms.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, ClassVar, Final

from rich.console import Console
from rich.highlighter import RegexHighlighter
from rich.padding import Padding
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from rich.theme import Theme
from typer.core import TyperGroup

if TYPE_CHECKING:
    from typer import Context
    from typer.core import TyperCommand


class _Highlighter(RegexHighlighter):
    highlights: ClassVar = [
        r"^(?P<usage>Usage:)",
        r"(?<![\w-])(?P<name>--?[a-zA-Z][\w-]*)",
        r"(?P<note>\[[^\[]+\])$",  # default, range
        r"(?P<must>required)\]$",
    ]


_THEME: Final = Theme(
    {"usage": "not bold yellow", "name": "bold cyan", "value": "bold yellow", "note": "dim", "must": "not dim red"}
)


def print_help(command: TyperCommand | TyperGroup, ctx: Context) -> None:
    """Print the help of a command, or of a group and its verbs, on stdout."""
    console = Console(theme=_THEME, highlighter=_Highlighter(), markup=False, emoji=False)
    console.print(Padding(command.get_usage(ctx), 1), style="bold")
    console.print(Padding(_unwrapped(command.help), (0, 1, 1, 1)))
    rows: dict[str, list[tuple[str, str | None]]] = {"argument": [], "option": [], "command": []}
    for parameter in command.get_params(ctx):
        if record := parameter.get_help_record(ctx):
            rows[parameter.param_type_name].append(record)
    if isinstance(command, TyperGroup):
        for name in command.list_commands(ctx):
            if verb := command.get_command(ctx, name):
                rows["command"].append((name, verb.help))
    for kind, records in rows.items():
        if records:
            table = Table.grid(padding=(0, 2, 0, 0), expand=True)
            table.add_column()
            table.add_column(ratio=1, highlight=True)
            for names, about in records:
                name, *value = re.split("(?<!,) ", names, maxsplit=1)
                table.add_row(
                    Text.assemble((name, "name"), *((f" {text}", "value") for text in value)), _unwrapped(about)
                )
            console.print(Panel(table, title=f"{kind.capitalize()}s", title_align="left", border_style="dim"))


def _unwrapped(text: str | None) -> str:
    """The text without the line breaks inside its paragraphs."""
    return re.sub(r"(?<!\n)\n(?!\n)", " ", text or "")
