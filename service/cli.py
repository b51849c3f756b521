"""The command `aeroloop`: parse, call one function, print.

What is printed is for a person; `--json` is for a program. Errors are one line on stderr: exit code 2 for usage and
configuration, 1 for a run that failed, 130 for ^C.
"""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, NoReturn, TypeVar

import typer
from typer.exceptions import TyperException

if TYPE_CHECKING:
    from protocol.role import Role
    from service.calibrate import Calibration
    from service.config import Settings
    from service.doctor import Diagnosis
    from service.figures import Figures
    from service.operate import Statuses
    from service.tables import Tables

# Heavy modules (casadi, zenoh) are imported where they are used: `--help` must not wait for them.

_PR_SET_PDEATHSIG: Final = 1
PAPER_DURATION_S: Final = 50.0

T = TypeVar("T")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Adaptive attitude control over Zenoh, in frames whose every bit is a quantizer's bit.",
)
lab = typer.Typer(no_args_is_help=True, help="The theory and the bench, in lockstep.")
log_group = typer.Typer(no_args_is_help=True, help="What happened: reads logs.")
op = typer.Typer(no_args_is_help=True, help="An operator's verbs, over the network.")
host = typer.Typer(no_args_is_help=True, help="This machine.")
show = typer.Typer(no_args_is_help=True, help="What would be used.")
app.add_typer(lab, name="lab")
app.add_typer(log_group, name="log")
app.add_typer(op, name="op")
app.add_typer(host, name="host")
app.add_typer(show, name="show")

_state = {"debug": False}

Config = Annotated[
    Path | None, typer.Option("--config", "-c", help="TOML file with the configuration.", show_default=False)
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override section.key; may be repeated.", show_default=False),
]
Duration = Annotated[float, typer.Option("--duration", min=0.01, help="Length of the experiment [s].")]
BitsOut = Annotated[
    str | None, typer.Option(metavar="R|cont", help="Bits of ε and ω, 2…16, or cont.", show_default=False)
]
BitsIn = Annotated[str | None, typer.Option(metavar="R|cont", help="Bits of u, 2…16, or cont.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say only warnings and errors on stderr.")]
LogFormat = Annotated[Literal["text", "json"], typer.Option("--log-format", help="What lines on stderr look like.")]
WithParent = Annotated[bool, typer.Option("--with-parent", hidden=True)]


def main() -> None:
    """Entry point of the command."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code. Whatever goes wrong is one line on stderr."""
    _state["debug"] = False
    try:
        return app(list(arguments), prog_name="aeroloop", standalone_mode=False) or 0
    except TyperException as error:
        if message := error.format_message():  # empty where help was printed because nothing was asked
            command = " ".join(["aeroloop", *arguments[:1]])
            typer.echo(f"aeroloop: {message} (`{command} --help` tells more)", err=True)
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        return 130
    except Exception as error:
        if _state["debug"]:
            raise
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        typer.echo(f"aeroloop: unexpected {text}; `aeroloop --debug …` shows where", err=True)
        return 1


@app.callback()
def options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Options of every command."""
    _state["debug"] = debug


@app.command()
def demo(
    duration: Duration = PAPER_DURATION_S,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="Deterministic, as fast as the machine allows.")] = False,
    bits_out: BitsOut = None,
    bits_in: BitsIn = None,
    log: Annotated[Path | None, typer.Option("--log", help="Where the log goes.", show_default=False)] = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the paper's experiment over Zenoh in three processes, and judge its log."""
    settings = _settings(config, [*(overrides or []), *(["loop.lockstep=true"] if lockstep else [])])
    settings = _with_bits(settings, bits_out, bits_in)

    def run() -> tuple[Figures, bool]:
        from service.demo import run_demo
        from service.display import live_demo

        if json or not sys.stderr.isatty():
            how = "in lockstep" if settings.loop.lockstep else "in real time"
            typer.echo(f"aeroloop: {duration:g} s of the experiment {how}, three processes", err=True)
            return run_demo(settings, duration, log)
        with live_demo(duration) as update:
            return run_demo(settings, duration, log, update)

    figures, complete = _guard(run)
    _print_figures(figures, json)
    if not complete:
        raise typer.Exit(130)


@app.command()
def controller(
    duration: Annotated[
        float | None, typer.Option("--duration", min=0.01, help="End after this long [s].", show_default=False)
    ] = None,
    auto_arm: Annotated[
        bool, typer.Option("--auto-arm", help="Arm the plant with every claim, unless an operator stopped it.")
    ] = False,
    config: Config = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
    log_format: LogFormat = "text",
    with_parent: WithParent = False,
) -> None:
    """Run the controller daemon until SIGTERM."""
    options = [f"controller.duration_s={duration}"] if duration is not None else []
    options += ["controller.auto_arm=true"] if auto_arm else []
    settings = _settings(config, [*(overrides or []), *options])

    def run(role: Role) -> None:
        from service.daemon import Daemon

        Daemon(role, settings.loop, settings.wire, settings.law, settings.reference, settings.controller).run()

    _run_role("controller", settings, run, quiet=quiet, log_format=log_format, with_parent=with_parent)


@app.command()
def emulator(
    config: Config = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
    log_format: LogFormat = "text",
    with_parent: WithParent = False,
) -> None:
    """Run the emulated plant until SIGTERM."""
    settings = _settings(config, overrides)

    def run(role: Role) -> None:
        from plant_emulator.emulator import Emulator

        Emulator(role, settings.loop, settings.wire, settings.plant).run()

    _run_role("plant", settings, run, quiet=quiet, log_format=log_format, with_parent=with_parent)


@app.command()
def recorder(
    log: Annotated[Path | None, typer.Option("--log", help="Where the log goes.", show_default=False)] = None,
    config: Config = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
    log_format: LogFormat = "text",
    with_parent: WithParent = False,
) -> None:
    """Record everything on the network into an MCAP log until SIGTERM."""
    settings = _settings(config, overrides)
    if log is not None:
        settings.recorder.path = log

    def run(role: Role) -> None:
        from service.recorder import Recorder

        Recorder(role, settings.recorder).run()

    _run_role("recorder", settings, run, quiet=quiet, log_format=log_format, with_parent=with_parent)


@lab.command()
def experiment(
    duration: Duration = PAPER_DURATION_S,
    bits_out: BitsOut = None,
    bits_in: BitsIn = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the closed loop in this process, in lockstep and through real frames, without a network."""
    settings = _with_bits(_settings(config, overrides), bits_out, bits_in)

    def run() -> Figures:
        from service.experiment import run_experiment

        if json:
            return run_experiment(settings, duration)
        from service.display import progress_bar

        with progress_bar("experiment", duration) as update:
            return run_experiment(settings, duration, update)

    _print_figures(_guard(run), json)


@lab.command()
def tables(
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Runs of each cell, for a mean and a spread.")] = 1,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown.")] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Predict every cell of the paper's Tables C.2 to C.4, beside what was published."""
    settings = _settings(config, overrides)

    def run() -> Tables:
        from service.display import count_bar
        from service.tables import predict

        with count_bar("cells", hidden=json) as update:
            return predict(settings, seeds, update)

    result = _guard(run)
    if json:
        typer.echo(result.model_dump_json(indent=2))
    elif markdown:
        from service.tables import markdown as as_markdown

        typer.echo(as_markdown(result))
    else:
        from service.display import paper_tables

        paper_tables(result)


@lab.command()
def calibrate(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Fit the bench to two of the paper's cells, calm and windy, and print the fitted values."""
    settings = _settings(config, overrides)

    def run() -> Calibration:
        from service.calibrate import calibrate
        from service.display import count_bar

        with count_bar("experiments", hidden=json) as update:
            return calibrate(settings, lambda runs: update(runs, None))

    result = _guard(run)
    if json:
        typer.echo(result.model_dump_json(indent=2))
    else:
        from service.display import calibration_table

        calibration_table(result)


@log_group.command()
def review(
    log: Annotated[Path, typer.Argument(help="An MCAP log.", show_default=False)],
    figures: Annotated[
        Path | None, typer.Option("--figures", help="Draw the paper's figures into this folder.", show_default=False)
    ] = None,
    json: Json = False,
) -> None:
    """Compute every figure of merit from a log alone, and draw the paper's figures if asked."""

    def run() -> Figures:
        from service.review import read

        judged = read(log, keep=figures is not None)
        if figures is not None:
            from service.plots import draw_figures

            for path in draw_figures(judged.session, figures):
                typer.echo(f"aeroloop: drew {path}", err=True)
        return judged.figures

    _print_figures(_guard(run), json)


@op.command()
def status(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Say how every role of every vehicle on the network is doing."""
    settings = _settings(config, overrides)

    def run() -> Statuses:
        from service.operate import gather

        return gather(settings.network)

    found = _guard(run)
    if json:
        from json import dumps

        tree = {
            vehicle: {role: status.model_dump(mode="json") for role, status in roles.items()}
            for vehicle, roles in found.items()
        }
        typer.echo(dumps(tree, indent=2))
    else:
        from service.display import status_table

        status_table(found)


@op.command()
def top(config: Config = None, overrides: Overrides = None) -> None:
    """Show every vehicle and role on the network, live, until ^C."""
    settings = _settings(config, overrides)

    def run() -> None:
        import threading

        from service.display import live_screen
        from service.top import watch

        stop = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: stop.set())
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        with live_screen() as show:
            watch(settings.network, show, stop)

    _guard(run)


@op.command()
def arm(config: Config = None, overrides: Overrides = None) -> None:
    """Arm the plant, so that the next controller to claim it may drive it."""
    settings = _settings(config, overrides)

    def run() -> None:
        from service.operate import arm

        arm(settings.network, settings.vehicle)

    _guard(run)
    typer.echo(f"{settings.vehicle} is armed")


@op.command()
def stop(config: Config = None, overrides: Overrides = None) -> None:
    """Stop the plant at once: 0 V, and nobody drives it until it is armed again."""
    settings = _settings(config, overrides)

    def run() -> None:
        from service.operate import stop

        stop(settings.network, settings.vehicle)

    _guard(run)
    typer.echo(f"{settings.vehicle} is stopped at 0 V; `aeroloop op arm` lets it be driven again")


@host.command()
def doctor(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Say whether this machine will hold the configured rate, and what to change if not."""
    settings = _settings(config, overrides)

    def run() -> Diagnosis:
        from service.display import progress_bar
        from service.doctor import TRIAL_S, diagnose

        with progress_bar("trial", TRIAL_S, hidden=json) as update:
            return diagnose(settings.loop, update)

    diagnosis = _guard(run)
    if json:
        typer.echo(diagnosis.model_dump_json(indent=2))
    else:
        from service.display import diagnosis_table

        diagnosis_table(diagnosis)
    if not diagnosis.holds:
        raise typer.Exit(1)


@host.command()
def units(
    install: Annotated[
        Path | None, typer.Option("--install", help="Write them into this folder instead.", show_default=False)
    ] = None,
) -> None:
    """Print systemd units for the daemons, or install them."""
    from shutil import which

    from service.units import UNITS, unit
    from service.units import install as install_units

    executable = which("aeroloop") or str(Path(sys.argv[0]).absolute())
    if install is None:
        for name in UNITS:
            typer.echo(f"# aeroloop-{name}.service\n{unit(name, executable)}")
        return
    try:
        for path in install_units(install, executable):
            typer.echo(path)
    except OSError as error:
        _fail(f"cannot write into {install}: {error.strerror}", 1)


@show.command("config")
def show_config(config: Config = None, overrides: Overrides = None) -> None:
    """Print the effective configuration as TOML."""
    typer.echo(_settings(config, overrides).toml(), nl=False)


@show.command()
def spec(config: Config = None, overrides: Overrides = None) -> None:
    """Print the wire as configured: frames, widths, steps."""
    from service.display import wire_table

    wire_table(_settings(config, overrides).wire)


# ── what every command shares ──


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"aeroloop: {message}", err=True)
    raise typer.Exit(code)


def _settings(config: Path | None, overrides: list[str] | None) -> Settings:
    from service.config import ConfigError, load

    try:
        return load(config, overrides or [])
    except ConfigError as error:
        if _state["debug"]:
            raise
        _fail(str(error), 2)


def _with_bits(settings: Settings, bits_out: str | None, bits_in: str | None) -> Settings:
    """The settings with the bits given on the command line."""
    from service.config import ConfigError, with_bits

    try:
        return with_bits(settings, bits_out, bits_in)
    except ConfigError as error:
        if _state["debug"]:
            raise
        _fail(str(error), 2)


def _guard(run: Callable[[], T]) -> T:
    """Run, and turn what can go wrong into one line and an exit code."""
    from protocol.errors import AeroloopError

    try:
        return run()
    except (AeroloopError, ValueError) as error:
        if _state["debug"]:
            raise
        _fail(str(error).splitlines()[0], 1)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def _run_role(
    kind: str, settings: Settings, run: Callable[[Role], None], *, quiet: bool, log_format: str, with_parent: bool
) -> None:
    """Join the network as a role and run until a signal says stop."""
    from service.logs import set_up_logging

    set_up_logging(logging.WARNING if quiet else logging.INFO, as_json=log_format == "json")
    if with_parent:
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    def live() -> None:
        from protocol.role import Role
        from service.daemon import controller_name

        name = controller_name() if kind == "controller" else None
        with Role(kind, settings.vehicle, settings.network, settings.contract(), name) as role:
            role.stop_on_signals()
            run(role)

    _guard(live)


def _print_figures(figures: Figures, json: bool) -> None:
    if json:
        typer.echo(figures.model_dump_json(indent=2))
    else:
        from service.display import figures_table

        figures_table(figures)


if __name__ == "__main__":
    main()
