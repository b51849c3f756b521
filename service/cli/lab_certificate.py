"""Verbs of `aeroloop lab` about the certificate: what is proven, and the search for a run that breaks it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aeroloop.service.cli.common import (
    BitsIn,
    BitsOut,
    Config,
    EngineOption,
    Force,
    Json,
    Overrides,
    check_engine,
    check_figure,
    checked,
    fail,
    guarded,
    loop_of,
    new_file,
    show,
    with_bits_of,
)

if TYPE_CHECKING:
    from aeroloop.service.config import Settings
    from aeroloop.service.lab.attack import Attack
    from aeroloop.service.lab.margins import Bits, Margins


def certify(
    disturbance: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Largest torque beyond what the plant's settings say, in N·m; a machine needs it.",
            show_default=False,
        ),
    ] = None,
    late: Annotated[float, typer.Option(min=0, help="Further delay of commands, in s.")] = 0.0,
    attitude_error: Annotated[
        float | None,
        typer.Option(
            metavar="DEG",
            min=0,
            max=180,
            help="Assumed bound of the attitude error, in degrees; controller.start_within_deg if left out; 180 "
            "assumes nothing.",
            show_default=False,
        ),
    ] = None,
    bits_out: BitsOut = None,
    bits_in: BitsIn = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print every term, with its equation.")] = False,
    runs: Annotated[
        int,
        typer.Option(
            "--attack",
            metavar="RUNS",
            min=0,
            help="Print beside the bound the largest ‖z‖ that a search over so many experiments finds.",
            show_default=False,
        ),
    ] = 0,
    margins: Annotated[
        bool,
        typer.Option(
            "--margins",
            help="Print the delay and the lost frames that it survives, over bits and rates, beside those at which "
            "simulation diverges; minutes.",
        ),
    ] = False,
    figure: Annotated[
        Path | None,
        typer.Option(help="With --margins: draw them into a .png, .svg or .pdf file.", show_default=False),
    ] = None,
    force: Force = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print what is proven of the configuration, what that assumes, and what fails; exit 1 unless all of it holds."""
    settings = with_bits_of(loop_of(config, overrides), bits_out, bits_in)
    if margins:
        if late:
            fail("--margins finds the largest --late: leave one of them out", 2)
        with checked():
            check_figure(figure, config, force)
        pair = (settings.wire.attitude.bits, settings.wire.voltage.bits) if bits_out or bits_in else None
        found = _margins(settings, pair, disturbance or 0.0, json)
        if figure is not None:
            from aeroloop.service.lab.margins_figure import draw_margins

            with new_file(figure, config, force) as part:
                draw_margins(found, part)
        return
    from aeroloop.service.lab.attack import largest_norm
    from aeroloop.service.terminal.certificate_table import certificate_table, own_certificate
    from aeroloop.service.theorem.any_law import OwnCertificate, certify_any

    with guarded():
        result = certify_any(settings, disturbance=disturbance, attitude_error_deg=attitude_error, late_s=late)
    if isinstance(result, OwnCertificate):
        if runs:
            fail("--attack searches for runs against the paper's theorem, not against a certificate of your own", 2)
        show(result, json, own_certificate)
        raise typer.Exit(0 if result.holds else 1)
    if runs:
        largest = largest_norm(_attacked(settings, runs, disturbance=disturbance or 0.0, json=json))
        result = result.model_copy(update={"largest_found": largest})
    show(result, json, lambda found: certificate_table(found, verbose=verbose))
    raise typer.Exit(0 if result.holds else 1)


def _attacked(settings: Settings, runs: int, *, json: bool, engine: str = "processes", **options: Any) -> Attack:
    from aeroloop.service.lab.attack import attack
    from aeroloop.service.lab.workers import Workers
    from aeroloop.service.terminal.display import count_bar

    with guarded(), count_bar("experiments", hidden=json) as update, Workers(engine) as workers:
        return attack(settings, runs, workers=workers, progress=update, **options)


def _margins(settings: Settings, pair: Bits | None, disturbance: float, json: bool) -> Margins:
    from aeroloop.service.lab.margins import BITS, measure_margins
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.margins_table import margins_table

    with guarded(), count_bar("margins", hidden=json) as update:
        found = measure_margins(settings, [pair] if pair else BITS, disturbance=disturbance, progress=update)
    show(found, json, margins_table)
    return found


def attack(
    runs: Annotated[
        int, typer.Option(min=1, help="Experiments, at least; the search goes on in rounds of 256.")
    ] = 2048,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="End after the round in which this time is over.", show_default=False)
    ] = None,
    duration: Annotated[float, typer.Option(metavar="S", min=0.01, help="Length of an experiment, in s.")] = 8.0,
    disturbance: Annotated[float, typer.Option(min=0, help="Largest torque of the disturbance, in N·m.")] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed finds the same.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Append each round to this file of JSON lines; the next time, go on.", show_default=False),
    ] = None,
    engine: EngineOption = "processes",
    bits_out: BitsOut = None,
    bits_in: BitsIn = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print every statement.")] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Search, as an adversary, for a run of the paper's body that breaks the certificate; exit 1 if one is found."""
    settings = with_bits_of(loop_of(config, overrides), bits_out, bits_in)
    check_engine(engine)
    from aeroloop.service.terminal.attack_table import attack_table

    options: dict[str, Any] = {"engine": engine, "seed": seed, "duration_s": duration, "seconds": seconds, "out": out}
    result = _attacked(settings, runs, disturbance=disturbance, json=json, **options)
    show(result, json, lambda found: attack_table(found, verbose=verbose))
    raise typer.Exit(1 if result.beaten else 0)
