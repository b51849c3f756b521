"""Shared parts of the commands: options, configuration, one-line errors, printing of results."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NoReturn, TypeVar

import typer

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.printable import printable

if TYPE_CHECKING:
    from pydantic import BaseModel

    from aeroloop.service.config import Settings
    from aeroloop.service.terminal.show import Sheets

# Heavy modules (casadi, zenoh) are imported where they are used: `--help` must not wait for them.

PAPER_DURATION_S: Final = 50.0

Result = TypeVar("Result")

state = {"debug": False}

Config = Annotated[Path | None, typer.Option("--config", "-c", help="TOML file with the configuration.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override section.key; may be repeated.")
]
Duration = Annotated[float, typer.Option("--duration", metavar="S", min=0.01, help="Length of the experiment, in s.")]
BitsOption = Annotated[
    str | None,
    typer.Option(
        "--bits",
        metavar="ε/ω/u|OUT/IN",
        help="Bits of attitude, rate and voltage, such as 10/6/6; out and in, such as 8/6; or cont.",
    ),
]


def _checked_engine(engine: str) -> str:
    from aeroloop.service.lab.engine import check_engine

    with checked():
        check_engine(engine)
    return engine


EngineOption = Annotated[
    str,
    typer.Option(
        "--engine",
        metavar="processes|dask:ADDRESS",
        callback=_checked_engine,
        help="Run on every core, or on the workers of a Dask cluster, which trusts its network: TLS, or a private one.",
    ),
]
Port = Annotated[int, typer.Option("--port", min=0, max=65535, help="TCP port; 0 is any free one.")]
Address = Annotated[str, typer.Option("--address", help="Address to listen on; 0.0.0.0 is all.")]
Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files; never a log.")]
Markdown = Annotated[bool, typer.Option("--markdown", help="Print Markdown.")]
NewLog = Annotated[Path | None, typer.Option("--log", help="New log, or its folder.")]


def fail(message: str, code: int) -> NoReturn:
    """End the command with one line on stderr."""
    report(message)
    raise typer.Exit(code)


def report(message: str) -> None:
    """Print one line on stderr."""
    typer.echo(f"aeroloop: {printable(message)}", err=True)


def say(message: str) -> None:
    """Print one line, as a role answered it."""
    typer.echo(printable(message))


def load_settings(config: Path | None, overrides: Sequence[str] | None, *more: str) -> Settings:
    """The effective configuration, with more overrides."""
    from aeroloop.service.config import load

    return load(config, [*(overrides or ()), *more])


def load_for_loop(
    config: Path | None, overrides: Sequence[str] | None, *more: str, bits: str | None = None
) -> Settings:
    """As `load_settings`, for what runs the law: its class is found and has checked its settings."""
    from aeroloop.service.config import bits_overrides, load

    return load(config, [*(overrides or ()), *more, *bits_overrides(bits)], runs_law=True)


@contextmanager
def checked(*models: type[BaseModel]) -> Iterator[None]:
    """Build values of these models from user input; invalid input ends the command with exit code 2."""
    from pydantic import ValidationError

    from aeroloop.protocol.wording import problem

    try:
        yield
    except (ValueError, AeroloopError) as error:
        if state["debug"]:
            raise
        fail(problem(error, *models) if isinstance(error, ValidationError) else str(error), 2)


def _escaped(character: str) -> str:
    return character if character.isprintable() else dumps(character)[1:-1]


def working(title: str, hidden: bool, total: float | None = None) -> AbstractContextManager[Callable[..., None]]:
    """A progress bar: `update(done, total)`; hidden where JSON is printed."""
    from aeroloop.service.terminal.show import progress_bar

    return progress_bar(title, total, hidden=hidden)


def show(result: Result, json: bool, sheets: Callable[[Result], Sheets], markdown: bool = False, keys: int = 1) -> None:
    """Print a result: all of it as JSON, or the tables that a function makes of it."""
    from pydantic_core import to_json

    from aeroloop.service.terminal import show as printer

    if json:
        text = to_json(result, indent=2, inf_nan_mode="null").decode()
        # JSON escapes control characters of ASCII; the others of Unicode are escaped here, and mean the same.
        typer.echo(re.sub(r"[^\n -~]", lambda found: _escaped(found[0]), text))
    elif markdown:
        typer.echo(printer.markdown(sheets(result)))
    else:
        printer.show_all(sheets(result), keys)
