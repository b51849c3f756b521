"""`aeroloop op`: an operator's verbs, sent to running roles over the network."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aeroloop.service.cli.common import Config, Json, Overrides, checked, fail, guarded, settings_of

if TYPE_CHECKING:
    from aeroloop.protocol.messages.operator import Reference
    from aeroloop.service.host.operator import Statuses

Within = Annotated[float, typer.Option("--in", metavar="S", help="Duration of the move, in s.")]

group = typer.Typer(no_args_is_help=True, help="Operate running roles over the network.")


@group.command()
def status(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Print the status of every role of every vehicle on the network."""
    settings = settings_of(config, overrides)

    def run() -> Statuses:
        from aeroloop.service.host.operator import gather

        return gather(settings.network)

    found = guarded(run)
    if json:
        from json import dumps

        tree = {
            vehicle: {role: status.model_dump(mode="json") for role, status in roles.items()}
            for vehicle, roles in found.items()
        }
        typer.echo(dumps(tree, indent=2))
    else:
        from aeroloop.service.terminal.display import status_table

        status_table(found)


@group.command()
def top(config: Config = None, overrides: Overrides = None) -> None:
    """Show every vehicle and role on the network, live, until ^C."""
    settings = settings_of(config, overrides)

    def run() -> None:
        import threading

        from aeroloop.service.terminal.display import live_screen
        from aeroloop.service.terminal.monitor import watch

        stop = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: stop.set())
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        with live_screen() as show:
            watch(settings.network, show, stop)

    guarded(run)


@group.command()
def arm(config: Config = None, overrides: Overrides = None) -> None:
    """Arm the plant for the next claim, and let controllers that hold or are faulted claim again."""
    from aeroloop.service.host import operator as operate

    settings = settings_of(config, overrides)
    typer.echo(guarded(lambda: operate.arm(settings.network, settings.vehicle)))


@group.command()
def stop(config: Config = None, overrides: Overrides = None) -> None:
    """Stop the plant at once: 0 V, and no controller drives it until it is armed again."""
    from aeroloop.service.host import operator as operate

    settings = settings_of(config, overrides)
    typer.echo(guarded(lambda: operate.stop(settings.network, settings.vehicle)))


@group.command()
def release(config: Config = None, overrides: Overrides = None) -> None:
    """Make the controller release the vehicle and hold until `op arm`, so that another can claim it."""
    from aeroloop.service.host import operator as operate

    settings = settings_of(config, overrides)
    typer.echo(guarded(lambda: operate.release(settings.network, settings.vehicle)))


@group.command("set-gains")
def set_gains(
    c1: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--C1", help="For the attitude error (1/s).", show_default=False),
    ] = None,
    c2: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--C2", help="For the rate error (N·m·s/rad).", show_default=False),
    ] = None,
    gamma: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--Gamma", help="For the adaptation (N·m·s²/rad² per s).", show_default=False),
    ] = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Change the law's gains between two ticks; gains left out stay as they are."""
    from aeroloop.protocol.messages.operator import Gains
    from aeroloop.service.host import operator as operate

    settings = settings_of(config, overrides)
    if c1 is c2 is gamma is None:
        fail("give --C1, --C2 or --Gamma, three numbers each", 2)
    gains = checked(lambda: Gains(C1=c1, C2=c2, Gamma=gamma))
    typer.echo(guarded(lambda: operate.set_gains(settings.network, settings.vehicle, gains)))


@group.command(context_settings={"ignore_unknown_options": True})  # a negative angle is no option
def goto(
    roll: Annotated[float, typer.Argument(help="Roll, in deg.")],
    pitch: Annotated[float, typer.Argument(help="Pitch, in deg.")],
    yaw: Annotated[float, typer.Argument(help="Yaw, in deg; not wrapped: from 0 to 350 is almost a full turn.")],
    within_s: Within,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Turn smoothly to an attitude and hold it; a turn that would be too fast is refused."""
    from aeroloop.protocol.messages.operator import Hold, Track
    from aeroloop.service.host import operator as operate

    settings = settings_of(config, overrides)
    track = checked(lambda: Track(reference=Hold(attitude=(roll, pitch, yaw)), within_s=within_s))
    typer.echo(guarded(lambda: operate.track(settings.network, settings.vehicle, track)))


@group.command()
def track(
    what: Annotated[
        str, typer.Argument(help="sinusoid, hold, stream, or a CSV file of time (s), roll, pitch, yaw (deg).")
    ],
    within_s: Within = 2.0,
    amplitude: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="sinusoid: of roll, pitch, yaw (deg); the paper's if left out.", show_default=False),
    ] = None,
    frequency: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="sinusoid: of roll, pitch, yaw (rad/s); the paper's if left out.", show_default=False),
    ] = None,
    timeout_s: Annotated[
        float | None, typer.Option("--timeout", help="stream: hold after this long without a set-point, in s.")
    ] = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Follow another reference: a sinusoid, the current attitude, a file, or set-points published on `reference`."""
    from aeroloop.protocol.messages.operator import Hold, Sinusoid, Stream, Track
    from aeroloop.service.host import operator as operate

    settings = settings_of(config, overrides)
    given = {"amplitude": amplitude, "frequency": frequency, "timeout_s": timeout_s}
    options = {name: value for name, value in given.items() if value is not None}
    misplaced = set(options) - {"sinusoid": {"amplitude", "frequency"}, "stream": {"timeout_s"}}.get(what, set())
    if misplaced:
        fail(f"{what} takes no --{misplaced.pop().removesuffix('_s')}", 2)

    def reference() -> Reference:
        match what:
            case "sinusoid":
                return Sinusoid.model_validate(options)
            case "hold":
                return Hold()
            case "stream":
                return Stream.model_validate(options)
            case _:
                return operate.read_points(Path(what))

    message = checked(lambda: Track(reference=reference(), within_s=within_s))
    typer.echo(guarded(lambda: operate.track(settings.network, settings.vehicle, message)))
