"""What every command shares: options, the configuration, errors in one line, figures as text or JSON."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, NoReturn, TypeVar

import typer

if TYPE_CHECKING:
    from threading import Event

    from aeroloop.protocol.runtime.role import Role
    from aeroloop.service.config import Settings
    from aeroloop.service.figures import Figures

# Heavy modules (casadi, zenoh) are imported where they are used: `--help` must not wait for them.

_PR_SET_PDEATHSIG: Final = 1
PAPER_DURATION_S: Final = 50.0

T = TypeVar("T")

state = {"debug": False}

Config = Annotated[
    Path | None, typer.Option("--config", "-c", help="TOML file with the configuration.", show_default=False)
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override section.key; may be repeated.", show_default=False),
]
Duration = Annotated[float, typer.Option("--duration", min=0.01, help="Length of the experiment, in s.")]
BitsOut = Annotated[
    str | None, typer.Option(metavar="R|cont", help="Bits of ε and ω, 2…16, or cont.", show_default=False)
]
BitsIn = Annotated[str | None, typer.Option(metavar="R|cont", help="Bits of u, 2…16, or cont.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say only warnings and errors on stderr.")]
LogFormat = Annotated[Literal["text", "json"], typer.Option("--log-format", help="What lines on stderr look like.")]
WithParent = Annotated[int, typer.Option("--with-parent", metavar="PID", help="End with this process.", hidden=True)]


def fail(message: str, code: int) -> NoReturn:
    """End the command with one line on stderr."""
    typer.echo(f"aeroloop: {message}", err=True)
    raise typer.Exit(code)


def settings_of(config: Path | None, overrides: list[str] | None) -> Settings:
    """The effective configuration; what is wrong with it ends the command."""
    from aeroloop.service.config import ConfigError, load

    try:
        return load(config, overrides or [])
    except ConfigError as error:
        if state["debug"]:
            raise
        fail(str(error), 2)


def reloadable(config: Path | None, overrides: list[str]) -> tuple[Settings, Callable[[], Settings]]:
    """The effective configuration, and what reads it again."""

    def load() -> Settings:
        from aeroloop.service import config as configuration

        return configuration.load(config, overrides)

    return settings_of(config, overrides), load


def with_bits_of(settings: Settings, bits_out: str | None, bits_in: str | None) -> Settings:
    """The settings with the bits given on the command line."""
    from aeroloop.service.config import ConfigError, with_bits

    try:
        return with_bits(settings, bits_out, bits_in)
    except ConfigError as error:
        if state["debug"]:
            raise
        fail(str(error), 2)


def guarded(run: Callable[[], T]) -> T:
    """Run, and turn what can go wrong into one line and an exit code."""
    from aeroloop.protocol.errors import AeroloopError

    try:
        return run()
    except (AeroloopError, ValueError) as error:
        if state["debug"]:
            raise
        fail(str(error).splitlines()[0], 1)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def checked(make: Callable[[], T]) -> T:
    """Make something of what the user gave; what is wrong with it is his to put right."""
    from pydantic import ValidationError

    from aeroloop.protocol.errors import AeroloopError

    try:
        return make()
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        fail(f"{where}: {first['msg'].removeprefix('Value error, ')}, not {first['input']!r}", 2)
    except AeroloopError as error:
        fail(str(error), 2)


def run_role(
    kind: str, settings: Settings, run: Callable[[Role], None], *, quiet: bool, log_format: str, with_parent: int
) -> None:
    """Join the network as a role and run until a signal says stop."""
    _prepare(quiet=quiet, log_format=log_format, with_parent=with_parent)

    def live() -> None:
        from aeroloop.protocol.runtime.role import Role
        from aeroloop.service.daemon.claim import controller_name

        name = controller_name() if kind == "controller" else None
        with Role(kind, settings.vehicle, settings.network, settings.description(), name) as role:
            role.stop_on_signals()
            run(role)

    guarded(live)


def run_alone(run: Callable[[Event], None], *, quiet: bool, log_format: str, with_parent: int) -> None:
    """Run a process that is on no Zenoh network until a signal says stop."""
    from threading import Event

    _prepare(quiet=quiet, log_format=log_format, with_parent=with_parent)
    stop = Event()
    for which in (signal.SIGTERM, signal.SIGINT):
        signal.signal(which, lambda *_: stop.set())
    guarded(lambda: run(stop))


def _prepare(*, quiet: bool, log_format: str, with_parent: int) -> None:
    from aeroloop.service.terminal.log_lines import set_up_logging

    set_up_logging(logging.WARNING if quiet else logging.INFO, as_json=log_format == "json")
    if with_parent:
        import ctypes
        import os

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != with_parent:  # it died before the kernel was asked to watch it
            raise typer.Exit(0)


def print_figures(figures: Figures, json: bool) -> None:
    """Print figures of merit, for a program or for a person."""
    if json:
        typer.echo(figures.model_dump_json(indent=2))
    else:
        from aeroloop.service.terminal.display import figures_table

        figures_table(figures)
