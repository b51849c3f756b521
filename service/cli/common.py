"""Shared parts of the commands: options, configuration, one-line errors, printing of results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NoReturn, TypeVar

import typer

from aeroloop.protocol.errors import AeroloopError

if TYPE_CHECKING:
    from pydantic import BaseModel

    from aeroloop.service.config import Settings
    from aeroloop.service.config_sources import Target
    from aeroloop.service.terminal.show import Sheets

# Heavy modules (casadi, zenoh) are imported where they are used: `--help` must not wait for them.

PAPER_DURATION_S: Final = 50.0

Result = TypeVar("Result", bound="BaseModel")

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
Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files; never a log.")]
Markdown = Annotated[bool, typer.Option("--markdown", help="Print Markdown.")]
NewLog = Annotated[Path | None, typer.Option("--log", help="New log, or its folder.")]
Require = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="FIGURE=LIMIT",
        help="Exit with 1 unless a figure (of every run) is at most this, such as z_track=50e-4, skipped_ticks=0 or "
        "latency_us.p99=2000; theorem.held=1: unless the run kept to all that is proven.",
    ),
]


def fail(message: str, code: int) -> NoReturn:
    """End the command with one line on stderr."""
    report(message)
    raise typer.Exit(code)


def report(message: str) -> None:
    """Print an error as one line on stderr."""
    typer.echo(f"aeroloop: {message}", err=True)


def settings_of(config: Path | None, overrides: Sequence[str] | None, *more: str) -> Settings:
    """The effective configuration, with more overrides; a configuration error ends the command."""
    from aeroloop.service.config import load

    with checked():
        return load(config, [*(overrides or ()), *more])


def loop_of(config: Path | None, overrides: Sequence[str] | None, *more: str) -> Settings:
    """As `settings_of`, for what runs the law: its class is found and has checked its settings."""
    from aeroloop.service.config import with_law_settings

    with checked():
        return with_law_settings(settings_of(config, overrides, *more))


def target_of(config: Path | None, overrides: Sequence[str] | None) -> Target:
    """Vehicle and network of the effective configuration; a configuration error ends the command."""
    from aeroloop.service.config_sources import load_target

    with checked():
        return load_target(config, overrides or ())


def with_bits_of(settings: Settings, bits: str | None) -> Settings:
    """The settings with the bits given on the command line."""
    from aeroloop.service.config import with_bits

    with checked():
        return with_bits(settings, bits)


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


@contextmanager
def working(title: str, json: bool, total: float | None = None) -> Iterator[Callable[..., None]]:
    """A progress bar: `update(done, total)`. No bar where JSON is printed."""
    from aeroloop.service.terminal.display import progress_bar

    with progress_bar(title, total, hidden=json) as update:
        yield update


def show(result: Result, json: bool, sheets: Callable[[Result], Sheets], markdown: bool = False, keys: int = 1) -> None:
    """Print a result: all of it as JSON, or the tables that a function makes of it."""
    if json:
        typer.echo(result.model_dump_json(indent=2))
    else:
        from aeroloop.service.terminal.show import show_all

        show_all(sheets(result), "markdown" if markdown else "terminal", keys)


def check_figure(figure: Path | None, config: Path | None, force: bool) -> None:
    """Check where a figure is to be drawn, if one is. Raises as `check_path` and `check_output` do."""
    if figure is not None:
        from aeroloop.service.logs.outputs import check_output
        from aeroloop.service.report.plots import check_path

        check_path(figure)
        check_output(figure, [config], force=force)


@contextmanager
def new_file(path: Path, config: Path | None, force: bool) -> Iterator[Path]:
    """A path to write to, once the table is printed: a full disk must not cost the table."""
    from aeroloop.service.logs.outputs import writing

    with writing(path, [config], force=force) as part:
        yield part
