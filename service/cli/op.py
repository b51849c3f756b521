"""`aeroloop op`: an operator's verbs, sent to running roles over the network.

They address the configured vehicle. Where none is configured, `stop`, `status`, `console` and `metrics` are about every
vehicle on the network, and the others about the only one: where there are several, they refuse.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from aeroloop.service.cli.common import Address, Config, Json, Overrides, Port, checked, fail, report, say, show
from aeroloop.service.cli.entry import run_alone

if TYPE_CHECKING:
    from collections.abc import Sequence
    from threading import Event

    from aeroloop.protocol.messages.operator import Gains, Message, Reference
    from aeroloop.service.config_sources import Target

Three = tuple[float, float, float]
Within = Annotated[
    float | None,
    typer.Option("--in", metavar="S", help="Time to get there, in s; the shortest within the limits if left out."),
]

REFERENCES: Final = ("configured", "sinusoid", "hold", "stream")
"""What `op track` takes beside a file."""

group = typer.Typer()


def _target(config: Path | None, overrides: Sequence[str] | None) -> tuple[Target, str | None]:
    """Network of the configuration, and the vehicle if one is configured."""
    from aeroloop.service.config_sources import load_target

    target = load_target(config, overrides or (), report)
    return target, target.vehicle if "vehicle" in target.model_fields_set else None


@group.command()
def status(
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Print only what is wrong, and exit with 1 if anything is: tripped, faulted, silent for 3 s, missing, "
            "late (1 % of ticks skipped, or commands over a period at p99), messages lost, a stop not kept on disk.",
        ),
    ] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print the status of the vehicle's roles, of all if none is set. Exits with 1 if no role answers."""
    target, vehicle = _target(config, overrides)
    from aeroloop.service.host.health import troubles
    from aeroloop.service.host.operator import gather
    from aeroloop.service.terminal.roles import status_sheets, trouble_sheets

    found = gather(target.network)
    if vehicle is not None:
        if vehicle not in found.statuses:
            fail(f"no role of {vehicle} answers, only of {', '.join(sorted(found.statuses))}", 1)
        found = found._replace(statuses={vehicle: found.statuses[vehicle]})
    if not check:
        show(found.statuses, json, lambda _: status_sheets(found))
        for line in found.silent:
            report(line)
        return
    wrong = troubles(found)
    tree = {"well": not wrong, "troubles": [trouble._asdict() for trouble in wrong], "vehicles": found.statuses}
    show(tree, json, lambda _: trouble_sheets(found, wrong))
    if wrong:
        raise typer.Exit(1)


@group.command()
def console(
    port: Port = 8766,
    address: Address = "127.0.0.1",
    tls: Annotated[
        tuple[Path, Path] | None,
        typer.Option("--tls", metavar="CERT KEY", help="PEM files of TLS, without which only this host is served."),
    ] = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Serve a page that shows and operates a running loop. Until ^C; its address has a token."""
    target, vehicle = _target(config, overrides)

    def run(stop: Event) -> None:
        from aeroloop.service.console.server import Console

        served = Console(target.network, address, port, tls, vehicle)
        typer.echo(f"{'a page that only reads' if served.reads_only else 'the console'} is at {served.url}, until ^C")
        served.run(stop)

    run_alone(run)


@group.command()
def metrics(
    port: Port = 9464,
    address: Address = "127.0.0.1",
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Serve metrics of every vehicle to Prometheus until ^C. `show alerts` prints rules for them."""
    target, _ = _target(config, overrides)

    def run(stop: Event) -> None:
        from aeroloop.service.host.metrics import serve

        serve(target.network, stop, address, port, lambda url: typer.echo(f"metrics at {url} until ^C"))

    run_alone(run)


@group.command()
def arm(config: Config = None, overrides: Overrides = None) -> None:
    """Arm the plant for the next claim. Controllers that hold or are faulted claim again."""
    _send(config, overrides, "arm")


@group.command()
def stop(
    every: Annotated[bool, typer.Option("--all", help="Stop every vehicle's plant on the network.")] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Stop the vehicle's plant at once: 0 V until `op arm`. All plants if no vehicle is configured."""
    target, vehicle = _target(config, overrides)
    from aeroloop.service.host.operator import stop as stop_plants

    _, failures = stop_plants(target.network, None if every else vehicle, on_answer=say)
    if failures:
        fail("; ".join(failures), 1)


@group.command()
def mark(
    text: Annotated[str, typer.Argument(help="A line to find the instant by.")],
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Put a line into the log, which `log review` lists."""
    from aeroloop.protocol.messages.operator import Mark

    with checked(Mark):
        message = Mark(text=text)
    _send(config, overrides, "mark", message)


@group.command()
def release(config: Config = None, overrides: Overrides = None) -> None:
    """Make the controller release the vehicle, for another one. It holds until `op arm`."""
    _send(config, overrides, "stand_down")


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

    if not (faults or clear):
        fail("name a fault, such as rate:off@1..2, or give --clear", 2)
    with checked():
        message = Inject(faults=[str(Fault.parse(text)) for text in faults or ()], clear=clear)
    _send(config, overrides, "inject", message)


@group.command("set-gains", context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def set_gains(context: typer.Context, config: Config = None, overrides: Overrides = None) -> None:
    """Change gains of the law between two ticks. Each is --NAME and its numbers: --C2 0.2 0.2 0.2; others stay."""
    _send(config, overrides, "set_gains", _gains(context.args))


def _gains(words: Sequence[str]) -> Gains:
    from aeroloop.protocol.messages.operator import Gains

    given: dict[str, list[float]] = {}
    name = ""
    try:
        for word in words:
            if word.startswith("--"):
                name, equals, value = word[2:].partition("=")
                given[name] = [float(value)] if equals else []
            else:
                given[name].append(float(word))
    except (KeyError, ValueError):
        given = {}
    if not given or not all(given.values()):
        fail("give each gain as --NAME and its numbers, such as --C2 0.2 0.2 0.2", 2)
    with checked(Gains):
        return Gains.model_validate(given)


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

    with checked(Track, Hold):
        track = Track(reference=Hold(attitude=(roll, pitch, yaw)), within_s=within_s)
    _send(config, overrides, "track", track)


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
    from aeroloop.protocol.wording import closest
    from aeroloop.service.settings import read_points

    options = {name: each for name, each in (("amplitude", amplitude), ("frequency", frequency)) if each is not None}
    if options and what != "sinusoid":
        fail(f"{what} takes no option but --in", 2)
    with checked(Sinusoid, Track):
        reference: Reference | None
        match what:
            case "configured":
                reference = None
            case "sinusoid":
                reference = Sinusoid.model_validate(options)
            case "hold":
                reference = Hold()
            case "stream":
                reference = Stream()
            case _:
                near = closest(what, REFERENCES)
                if near is not None and not Path(what).exists():
                    fail(f"{what} is neither a reference nor a file: did you mean {near}?", 2)
                reference = read_points(Path(what))
        message = Track(reference=reference, within_s=within_s)
    _send(config, overrides, "track", message)


def _send(config: Path | None, overrides: Sequence[str] | None, topic: str, message: Message | None = None) -> None:
    """Send a request to the configured vehicle, else to the only one on the network; print the answer."""
    target, vehicle = _target(config, overrides)
    from aeroloop.protocol.messages.operator import Request
    from aeroloop.service.host.operator import only_vehicle, send

    vehicle = vehicle or only_vehicle(target.network) or target.vehicle
    say(send(target.network, vehicle, topic, message or Request()))
