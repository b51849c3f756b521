"""`aeroloop lab`: experiments, tables, calibration and certificates, in lockstep and without a network."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from aeroloop.service.cli.common import (
    BitsIn,
    BitsOut,
    Config,
    Json,
    Overrides,
    guarded,
    loop_of,
    with_bits_of,
)
from aeroloop.service.cli.lab_experiments import burden, calibrate, experiment, sweep, tables
from aeroloop.service.cli.lab_laws import laws, tune


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
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print what is proven of the configuration, what that assumes, and what fails; exit 1 unless all of it holds."""
    settings = with_bits_of(loop_of(config, overrides), bits_out, bits_in)
    from aeroloop.service.terminal.sheets import certificate_sheets
    from aeroloop.service.terminal.show import show_result
    from aeroloop.service.theorem.any_law import certify_any

    with guarded():
        result = certify_any(settings, disturbance=disturbance, attitude_error_deg=attitude_error, late_s=late)
    show_result(result, partial(certificate_sheets, verbose=verbose), json=json)
    raise typer.Exit(0 if result.holds else 1)


group = typer.Typer()
for verb in (experiment, tables, calibrate, certify, burden, laws, sweep, tune):
    group.command()(verb)
