"""`aeroloop lab`: experiments, tables, calibration and certificates, in lockstep and without a network."""

from __future__ import annotations

import typer

from aeroloop.service.cli.lab_certificate import certify
from aeroloop.service.cli.lab_experiments import burden, calibrate, experiment, sweep, tables
from aeroloop.service.cli.lab_laws import laws, tune

group = typer.Typer()
for verb in (experiment, tables, calibrate, certify, burden, laws, sweep, tune):
    group.command()(verb)
