"""`aeroloop op`: what an operator asks and tells, over the network."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

import typer

from service.commands.common import (
    Config,
    Json,
    Overrides,
    guarded,
    settings_of,
)

if TYPE_CHECKING:
    from service.operate import Statuses

group = typer.Typer(no_args_is_help=True, help="An operator's verbs, over the network.")


@group.command()
def status(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Say how every role of every vehicle on the network is doing."""
    settings = settings_of(config, overrides)

    def run() -> Statuses:
        from service.operate import gather

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
        from service.display import status_table

        status_table(found)


@group.command()
def top(config: Config = None, overrides: Overrides = None) -> None:
    """Show every vehicle and role on the network, live, until ^C."""
    settings = settings_of(config, overrides)

    def run() -> None:
        import threading

        from service.display import live_screen
        from service.top import watch

        stop = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: stop.set())
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        with live_screen() as show:
            watch(settings.network, show, stop)

    guarded(run)


@group.command()
def arm(config: Config = None, overrides: Overrides = None) -> None:
    """Arm the plant, so that the next controller to claim it may drive it."""
    settings = settings_of(config, overrides)

    def run() -> None:
        from service.operate import arm

        arm(settings.network, settings.vehicle)

    guarded(run)
    typer.echo(f"{settings.vehicle} is armed")


@group.command()
def stop(config: Config = None, overrides: Overrides = None) -> None:
    """Stop the plant at once: 0 V, and nobody drives it until it is armed again."""
    settings = settings_of(config, overrides)

    def run() -> None:
        from service.operate import stop

        stop(settings.network, settings.vehicle)

    guarded(run)
    typer.echo(f"{settings.vehicle} is stopped at 0 V; `aeroloop op arm` lets it be driven again")
