"""The processes: the demo, and each of its parts by itself."""

from __future__ import annotations

import sys
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.common import (
    PAPER_DURATION_S,
    BitsIn,
    BitsOut,
    Config,
    Duration,
    Json,
    LogFormat,
    Overrides,
    Quiet,
    WithParent,
    guarded,
    print_figures,
    reloadable,
    run_role,
    settings_of,
    with_bits_of,
)

if TYPE_CHECKING:
    from protocol.role import Role
    from service.figures import Figures

group = typer.Typer()


@group.command()
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
    settings = settings_of(config, [*(overrides or []), *(["loop.lockstep=true"] if lockstep else [])])
    settings = with_bits_of(settings, bits_out, bits_in)

    def run() -> tuple[Figures, bool]:
        from service.demo import run_demo
        from service.display import live_demo

        if json or not sys.stderr.isatty():
            how = "in lockstep" if settings.loop.lockstep else "in real time"
            typer.echo(f"aeroloop: {duration:g} s of the experiment {how}, three processes", err=True)
            return run_demo(settings, duration, log)
        with live_demo(duration) as update:
            return run_demo(settings, duration, log, update)

    figures, complete = guarded(run)
    print_figures(figures, json)
    if not complete:
        raise typer.Exit(130)


@group.command()
def controller(
    duration: Annotated[
        float | None, typer.Option("--duration", min=0.01, help="End after this long, in s.", show_default=False)
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
    settings, load = reloadable(config, [*(overrides or []), *options])

    def run(role: Role) -> None:
        from service.daemon import Daemon
        from service.reload import reload_on_hangup

        daemon = Daemon(role, settings.loop, settings.wire, settings.law, settings.reference, settings.controller)
        reload_on_hangup(role, settings, load, lambda new: daemon.reconfigure(new.law, new.reference, new.controller))
        daemon.run()

    run_role("controller", settings, run, quiet=quiet, log_format=log_format, with_parent=with_parent)


@group.command()
def emulator(
    faults: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="SIGNAL:KIND@T",
            help="What shall go wrong, such as rate:off@5 or command:drop=0.05; may be repeated.",
            show_default=False,
        ),
    ] = None,
    config: Config = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
    log_format: LogFormat = "text",
    with_parent: WithParent = False,
) -> None:
    """Run the emulated plant until SIGTERM."""
    options = [f"plant.faults={dumps(faults)}"] if faults else []
    settings, load = reloadable(config, [*(overrides or []), *options])

    def run(role: Role) -> None:
        from plant_emulator.emulator import EmulatorOnZenoh
        from service.reload import reload_on_hangup

        emulator = EmulatorOnZenoh(role, settings.loop, settings.wire, settings.plant)
        reload_on_hangup(role, settings, load, lambda new: emulator.reconfigure(new.plant))
        emulator.run()

    run_role("plant", settings, run, quiet=quiet, log_format=log_format, with_parent=with_parent)


@group.command()
def recorder(
    log: Annotated[Path | None, typer.Option("--log", help="Where the log goes.", show_default=False)] = None,
    config: Config = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
    log_format: LogFormat = "text",
    with_parent: WithParent = False,
) -> None:
    """Record everything on the network into an MCAP log until SIGTERM."""
    options = [f"recorder.path={dumps(str(log))}"] if log is not None else []
    settings, load = reloadable(config, [*(overrides or []), *options])

    def run(role: Role) -> None:
        from service.recorder import Recorder
        from service.reload import reload_on_hangup

        recorder = Recorder(role, settings.recorder)
        reload_on_hangup(role, settings, load, lambda new: recorder.reconfigure(new.recorder))
        recorder.run()

    run_role("recorder", settings, run, quiet=quiet, log_format=log_format, with_parent=with_parent)
