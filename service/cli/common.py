"""Shared parts of the commands: options, configuration, one-line errors, figures as text or JSON."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, NoReturn, TypeVar, get_type_hints

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
Quiet = Annotated[bool, typer.Option("--quiet", help="Log only warnings and errors.")]
LogFormat = Annotated[Literal["text", "json"], typer.Option("--log-format", help="Format of the log lines on stderr.")]
WithParent = Annotated[int, typer.Option("--with-parent", metavar="PID", help="End with this process.", hidden=True)]


class DaemonOptions(NamedTuple):
    """Options that the command of every daemon has."""

    config: Config = None
    overrides: Overrides = None
    quiet: Quiet = False
    log_format: LogFormat = "text"
    with_parent: WithParent = 0


def daemon(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of every daemon to a command, which takes them as its first argument."""
    own = list(signature(command).parameters.values())[1:]
    shared = [Parameter(name, Parameter.KEYWORD_ONLY, default=value) for name, value in _DEFAULTS.items()]
    hints = get_type_hints(command, include_extras=True) | get_type_hints(DaemonOptions, include_extras=True)

    @wraps(command)
    def with_options(**arguments: Any) -> None:
        command(DaemonOptions(**{name: arguments.pop(name) for name in _DEFAULTS}), **arguments)

    parameters = [each.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[each.name]) for each in (*own, *shared)]
    with_options.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    with_options.__annotations__ = {each.name: hints[each.name] for each in parameters}
    return with_options


_DEFAULTS: Final = DaemonOptions()._asdict()


def fail(message: str, code: int) -> NoReturn:
    """End the command with one line on stderr."""
    typer.echo(f"aeroloop: {message}", err=True)
    raise typer.Exit(code)


def settings_of(config: Path | None, overrides: list[str] | None) -> Settings:
    """The effective configuration; a configuration error ends the command."""
    from aeroloop.service.config import load

    return _configured(lambda: load(config, overrides or []))


def reloadable(config: Path | None, overrides: list[str]) -> tuple[Settings, Callable[[], Settings]]:
    """The effective configuration, and a function that loads it again."""

    def load() -> Settings:
        from aeroloop.service import config as configuration

        return configuration.load(config, overrides)

    return settings_of(config, overrides), load


def with_bits_of(settings: Settings, bits_out: str | None, bits_in: str | None) -> Settings:
    """The settings with the bits given on the command line."""
    from aeroloop.service.config import with_bits

    return _configured(lambda: with_bits(settings, bits_out, bits_in))


def _configured(make: Callable[[], Settings]) -> Settings:
    from aeroloop.service.config import ConfigError

    try:
        return make()
    except ConfigError as error:
        if state["debug"]:
            raise
        fail(str(error), 2)


def guarded(run: Callable[[], T]) -> T:
    """Run, and turn expected errors into one line and an exit code."""
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
    """Build a value from user input; invalid input ends the command with exit code 2."""
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


def run_role(kind: str, settings: Settings, run: Callable[[Role], None], options: DaemonOptions) -> None:
    """Join the network as a role and run until SIGTERM or SIGINT."""
    _prepare(options)

    def join_and_run() -> None:
        from aeroloop.protocol.runtime.role import Role
        from aeroloop.service.daemon.claim import controller_name

        name = controller_name() if kind == "controller" else None
        with Role(kind, settings.vehicle, settings.network, settings.description(), name) as role:
            role.stop_on_signals()
            run(role)

    guarded(join_and_run)


def run_alone(run: Callable[[Event], None], options: DaemonOptions) -> None:
    """Run a process that is no role on the network until SIGTERM or SIGINT."""
    from threading import Event

    _prepare(options)
    stop = Event()
    for which in (signal.SIGTERM, signal.SIGINT):
        signal.signal(which, lambda *_: stop.set())
    guarded(lambda: run(stop))


def _prepare(options: DaemonOptions) -> None:
    from aeroloop.service.terminal.log_lines import set_up_logging

    set_up_logging(logging.WARNING if options.quiet else logging.INFO, as_json=options.log_format == "json")
    if options.with_parent:
        import ctypes
        import os

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != options.with_parent:  # the parent ended before prctl took effect
            raise typer.Exit(0)


def print_figures(figures: Figures, json: bool) -> None:
    """Print figures of merit, as JSON or as a table."""
    if json:
        typer.echo(figures.model_dump_json(indent=2))
    else:
        from aeroloop.service.terminal.display import figures_table

        figures_table(figures)
