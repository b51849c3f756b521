"""`aeroloop op`: an operator's verbs, sent to running roles over the network.

They address the configured vehicle. Where none is configured, `stop`, `status` and `top` are about every vehicle on the
network, and the others about the only one: where there are several, they refuse.
"""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aeroloop.service.cli.common import Config, Json, Overrides, checked, fail, target_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aeroloop.protocol.messages.operator import Gains, Message, Reference
    from aeroloop.service.config_sources import Target

Three = tuple[float, float, float]
Within = Annotated[
    float | None,
    typer.Option("--in", metavar="S", help="Time to get there, in s; the shortest within the limits if left out."),
]

group = typer.Typer()


@group.command()
def status(
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Print only what is wrong, and exit with 1 if anything is: a plant tripped or a controller faulted; a "
            "role silent for 3 s; a loop late (over 1 % of the last 10 s' ticks skipped, or commands that take over a "
            "period at the 99th percentile); a controller or plant missing, or a recorder that was there or is "
            "required; messages that a recorder lost; a plant that cannot keep a stop on disk.",
        ),
    ] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print the status of the vehicle's roles, of all if none is set. Exits with 1 if no role answers."""
    target = target_of(config, overrides)
    from aeroloop.service.host.health import troubles
    from aeroloop.service.host.operator import gather

    found = gather(target.network)
    if "vehicle" in target.model_fields_set:
        if target.vehicle not in found.statuses:
            fail(f"no role of {target.vehicle} answers, only of {', '.join(sorted(found.statuses))}", 1)
        found = found._replace(statuses={target.vehicle: found.statuses[target.vehicle]})
    well = not check or not troubles(found)
    if json:
        from json import dumps

        tree: dict[str, object] = {
            vehicle: {role: status.model_dump(mode="json") for role, status in roles.items()}
            for vehicle, roles in found.statuses.items()
        }
        if check:
            tree = {"well": well, "troubles": [trouble._asdict() for trouble in troubles(found)], "vehicles": tree}
        typer.echo(dumps(tree, indent=2))
    else:
        from aeroloop.service.terminal.roles import status_sheets, trouble_sheets
        from aeroloop.service.terminal.show import show_all

        show_all(trouble_sheets(found) if check else status_sheets(found))
    for line in [] if check else found.silent:
        typer.echo(f"aeroloop: {line}", err=True)
    if not well:
        raise typer.Exit(1)


@group.command()
def top(config: Config = None, overrides: Overrides = None) -> None:
    """Show every vehicle and role on the network, live; ^C quits."""
    target = target_of(config, overrides)
    from aeroloop.service.terminal.monitor import watch

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # which restores the terminal, as ^C does
    watch(target.network)


@group.command()
def arm(config: Config = None, overrides: Overrides = None) -> None:
    """Arm the plant for the next claim. Controllers that hold or are faulted claim again."""
    _send(target_of(config, overrides), "arm")


@group.command()
def stop(
    every: Annotated[bool, typer.Option("--all", help="Stop every vehicle's plant on the network.")] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Stop the vehicle's plant at once: 0 V until `op arm`. All plants if no vehicle is configured."""
    target = target_of(config, overrides)
    from aeroloop.service.host.operator import stop as stop_plants

    configured = "vehicle" in target.model_fields_set
    answers, failures = stop_plants(target.network, target.vehicle if configured and not every else None)
    for line in answers:
        typer.echo(line)
    if failures:
        fail("; ".join(failures), 1)


@group.command()
def mark(
    text: Annotated[str, typer.Argument(help="A line to find the instant by.")],
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Put a mark into the log, which `log review` lists and `log export --around` finds."""
    from aeroloop.protocol.messages.operator import Mark

    target = target_of(config, overrides)
    with checked(Mark):
        message = Mark(text=text)
    _send(target, "mark", message)


@group.command()
def release(config: Config = None, overrides: Overrides = None) -> None:
    """Make the controller release the vehicle, for another one. It holds until `op arm`."""
    _send(target_of(config, overrides), "stand_down")


@group.command()
def inject(
    faults: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FAULT",
            help="As rate:off, rate:off@1..2 (in s from now) or command:drop=0.1; plant_emulator/faults has all.",
        ),
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="First remove all faults, configured ones too.")] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Inject faults into the running emulator, between two ticks. If one is refused, none is injected."""
    from aeroloop.plant_emulator.faults.language import Fault
    from aeroloop.protocol.messages.operator import Inject

    target = target_of(config, overrides)
    if not (faults or clear):
        fail("name a fault, such as rate:off@1..2, or give --clear", 2)
    with checked():
        message = Inject(faults=[str(Fault.parse(text)) for text in faults or ()], clear=clear)
    _send(target, "inject", message)


@group.command("set-gains", context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def set_gains(context: typer.Context, config: Config = None, overrides: Overrides = None) -> None:
    """Change gains of the law between two ticks. Each is --NAME and its numbers: --C2 0.2 0.2 0.2; others stay."""
    target = target_of(config, overrides)
    _send(target, "set_gains", gains_from(context.args))


def gains_from(words: Sequence[str]) -> Gains:
    """Gains given as --NAME and numbers; anything else ends the command."""
    from aeroloop.protocol.messages.operator import Gains

    how = "give each gain as --NAME and its numbers, such as --C2 0.2 0.2 0.2"
    given: dict[str, list[str]] = {}
    numbers: list[str] | None = None
    for word in words:
        if word.startswith("--"):
            name, equals, value = word[2:].partition("=")
            numbers = given[name] = [value] if equals else []
        elif numbers is None:
            fail(f"{how}, not {word!r}", 2)
        else:
            numbers.append(word)
    if not all(given.values()) or not given:
        fail(how, 2)
    try:
        floats = {name: [float(number) for number in numbers] for name, numbers in given.items()}
    except ValueError:
        fail(how, 2)
    with checked(Gains):
        return Gains.model_validate(floats)


@group.command(context_settings={"ignore_unknown_options": True})  # a negative angle is no option
def goto(
    roll: Annotated[float, typer.Argument(help="Roll, in deg.")],
    pitch: Annotated[float, typer.Argument(help="Pitch, in deg.")],
    yaw: Annotated[float, typer.Argument(help="Yaw, in deg; not wrapped: from 0 to 350 is almost a full turn.")],
    within_s: Within = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Brake, turn to an attitude and hold it."""
    from aeroloop.protocol.messages.operator import Hold, Track

    target = target_of(config, overrides)
    with checked(Track, Hold):
        track = Track(reference=Hold(attitude=(roll, pitch, yaw)), within_s=within_s)
    _send(target, "track", track)


@group.command()
def track(
    what: Annotated[
        str,
        typer.Argument(help="configured, sinusoid, hold, stream, or a CSV file of time (s), roll, pitch, yaw (deg)."),
    ],
    within_s: Within = None,
    amplitude: Annotated[
        Three | None, typer.Option(help="sinusoid: of roll, pitch, yaw (deg); the paper's if left out.")
    ] = None,
    frequency: Annotated[
        Three | None, typer.Option(help="sinusoid: of roll, pitch, yaw (rad/s); the paper's if left out.")
    ] = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Follow another reference: a sinusoid, a file, set-points. `hold` and `stream` brake at once."""
    from aeroloop.protocol.messages.operator import Hold, Sinusoid, Stream, Track
    from aeroloop.service.settings import read_points

    target = target_of(config, overrides)
    options = {name: each for name, each in (("amplitude", amplitude), ("frequency", frequency)) if each is not None}
    if options and what != "sinusoid":
        fail(f"{what} takes no option but --in", 2)
    with checked(Sinusoid, Track):
        reference: Reference | None
        match what:
            case "sinusoid":
                reference = Sinusoid.model_validate(options)
            case "hold" | "stream":
                reference = Hold() if what == "hold" else Stream()
            case "configured":
                reference = None
            case _:
                reference = read_points(Path(what))
        message = Track(reference=reference, within_s=within_s)
    _send(target, "track", message)


def _send(target: Target, topic: str, message: Message | None = None) -> None:
    from aeroloop.protocol.messages.operator import Request
    from aeroloop.service.host.operator import send

    typer.echo(send(target.network, _vehicle(target), topic, message or Request()))


def _vehicle(target: Target) -> str:
    """The configured vehicle, else the only one on the network; OperatorError if there are several."""
    from aeroloop.service.host.operator import only_vehicle

    return target.vehicle if "vehicle" in target.model_fields_set else only_vehicle(target.network) or target.vehicle
