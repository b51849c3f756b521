"""`aeroloop lab`: experiments, tables, grids, searches and certificates, in lockstep and without a network."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from aeroloop.service.cli.common import (
    PAPER_DURATION_S,
    BitsOption,
    Config,
    Duration,
    EngineOption,
    Force,
    Json,
    Markdown,
    Overrides,
    check_engine,
    check_figure,
    checked,
    loop_of,
    new_file,
    show,
    with_bits_of,
    working,
)
from aeroloop.service.cli.entry import INTERRUPTED

# Modules of the lab are imported where they are used, as `--help` must not wait for them.

_Bits = Annotated[
    list[str] | None,
    typer.Option(
        "--bits",
        metavar="OUT/IN",
        help="Bits of ε and ω, and of u, such as 8/6 or cont/cont; may be repeated; six pairs if left out, for laws "
        "8/6 and cont/cont.",
    ),
]
_Sensors = Annotated[
    list[str] | None,
    typer.Option(
        "--sensors",
        metavar="NAME",
        help="perfect, encoders, gyro (2 mrad/s of noise) or shaken-gyro (20 mrad/s); may be repeated; all four if "
        "left out, for laws encoders. A free body has no encoders: perfect.",
    ),
]
_Seeds = Annotated[
    int, typer.Option("--seeds", min=1, help="Runs of each combination, with seeds of wind and sensors from 0 up.")
]
_Figure = Annotated[Path | None, typer.Option("--figure", help="Draw the result: a .png, .svg or .pdf file.")]
_ROWS = "Table of all experiments. Rows are kept in FILE.jsonl as they come: the same command goes on there."
_TABLE = "FILE.parquet|FILE.csv"


def experiment(
    duration: Duration = PAPER_DURATION_S,
    bits: BitsOption = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the closed loop in this process, without a network."""
    settings = with_bits_of(loop_of(config, overrides), bits)
    from aeroloop.service.lab.experiment import run_experiment
    from aeroloop.service.terminal.log_sheets import figure_sheets

    with working("experiment", json, duration) as update:
        figures = run_experiment(settings, duration, update)
    show(figures, json, figure_sheets)


def tables(
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Runs of each cell, for a mean and a spread.")] = 1,
    engine: EngineOption = "processes",
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Predict the paper's Tables C.2 to C.4. Beside the published values."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab.tables import predict, sheets

    with working("cells", json) as update:
        result = predict(settings, seeds, update, engine)
    show(result, json, sheets, markdown)


def calibrate(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Fit the plant to two of the paper's cells, calm and windy."""
    settings = loop_of(config, overrides)
    from aeroloop.service.lab.tables import calibrate, calibration_sheets

    with working("experiments", json) as update:
        result = calibrate(settings, update)
    show(result, json, calibration_sheets)


def certify(
    disturbance: Annotated[
        float | None,
        typer.Option(min=0, help="Largest torque beyond what the plant's settings say, in N·m; a machine needs it."),
    ] = None,
    late: Annotated[float, typer.Option(min=0, help="Further delay of commands, in s.")] = 0.0,
    attitude_error: Annotated[
        float | None,
        typer.Option(
            metavar="DEG",
            min=0,
            max=180,
            help="Assumed bound of the attitude error, in degrees; 20 if left out; 180 assumes nothing.",
        ),
    ] = None,
    bits: BitsOption = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print every term, with its equation.")] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print what is proven, and what that assumes. Exits with 1 unless all of it holds."""
    settings = with_bits_of(loop_of(config, overrides), bits)
    from aeroloop.service.terminal.sheets import certificate_sheets
    from aeroloop.service.theorem.certificate import certificate_of

    result = certificate_of(settings, disturbance=disturbance, attitude_error_deg=attitude_error, late_s=late)
    show(result, json, partial(certificate_sheets, verbose=verbose))
    raise typer.Exit(0 if result.holds else 1)


def burden(
    bits: _Bits = None,
    quantizer: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="uniform, hysteresis-uniform, logarithmic-uniform, or hysteresis-rate (hysteresis for ω, uniform for "
            "the rest); may be repeated; all four if left out.",
        ),
    ] = None,
    sensors: _Sensors = None,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    figure: _Figure = None,
    force: Force = False,
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Measure error against bits, for every quantizer and sensor. Beside each transmit policy and float64."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab.burden import draw_burden, grid, measure_burden, sheets

    with checked():
        check_figure(figure, config, force)
        cells = grid(settings, bits or (), quantizer or (), sensors or ())
    with working("experiments", json) as update:
        result = measure_burden(settings, cells, duration, update, engine)
    show(result, json, sheets, markdown, keys=2)
    if figure is not None:
        with new_file(figure, config, force) as part:
            draw_burden(result, part)


def laws(
    law: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="A kind of law: ours, an entry point, or package.module:Class; may be repeated; ours if left out. "
            "One that adapts is shown without adaptation, too.",
        ),
    ] = None,
    bits: _Bits = None,
    sensors: _Sensors = None,
    wind: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="calm or wind; may be repeated; both if left out.")
    ] = None,
    plant: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="aero, rigid_body (a free body like it, with three motors), or a plant of your own, as plant.kind "
            "takes it; may be repeated; the first two if left out.",
        ),
    ] = None,
    within: Annotated[
        float,
        typer.Option(
            metavar="DEG", min=0.1, max=180, help="Error up to which delay and lost frames count as survived."
        ),
    ] = 10.0,
    seeds: _Seeds = 5,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    out: Annotated[Path | None, typer.Option(metavar=_TABLE, help=_ROWS)] = None,
    figure: _Figure = None,
    force: Force = False,
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Compare control laws, tuned alike. Proven bound, error, effort, chatter, bits, delay and loss survived."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab.laws import compare, draw_laws, run_comparison, sheets
    from aeroloop.service.lab.sweep import check_table

    axes = {"laws": law, "bits": bits, "sensors": sensors, "winds": wind, "plants": plant}
    given = {name: values or () for name, values in axes.items()}
    with checked():
        check_figure(figure, config, force)
        comparison = compare(settings, **given, seeds=seeds, duration_s=duration, within_deg=within)
        if out is not None:
            check_table(out, comparison.plan, [config], force=force, within_deg=within)
    with working("experiments and searches", json) as update:
        result = run_comparison(comparison, out, engine, update)
    show(result, json, sheets, markdown)
    if figure is not None:
        with new_file(figure, config, force) as part:
            draw_laws(result, part)


def sweep(
    out: Annotated[Path, typer.Option(metavar=_TABLE, help=_ROWS)],
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="section.key=a,b,c or section.key=a..b*n, n values evenly from a to b; may be repeated, for every "
            "combination.",
        ),
    ] = None,
    seeds: _Seeds = 1,
    duration: Duration = PAPER_DURATION_S,
    bits: BitsOption = None,
    engine: EngineOption = "processes",
    force: Force = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run an experiment for every combination of values and seeds. Writes a table of their figures."""
    settings = with_bits_of(loop_of(config, overrides), bits)
    check_engine(engine)
    from aeroloop.service.lab.axes import configurations, parse_axes
    from aeroloop.service.lab.sweep import SweepPlan, check_table, run_sweep, sheets

    with checked():
        axes = parse_axes(vary or ())
        planned = SweepPlan(settings, axes, configurations(settings, axes, seeds, duration), seeds, duration)
        check_table(out, planned, [config], force=force)
    with working("experiments", json) as update:
        result = run_sweep(planned, out, engine=engine, progress=update)
    show(result, json, sheets)


def tune(
    gain: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Gain, or other number of the law's settings; may be repeated; all of the law's gains if left out.",
        ),
    ] = None,
    scale: Annotated[
        bool, typer.Option("--scale", help="Keep the ratio between a gain's axes: fewer dimensions.")
    ] = False,
    weight: Annotated[float, typer.Option(min=0, help="Of u_total beside z_track in the cost, in 1/V².")] = 1e-7,
    max_saturated: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Largest part of the ticks with a voltage at its limit; 1.25 × the configured gains' if left out.",
        ),
    ] = None,
    max_chatter: Annotated[
        float | None,
        typer.Option(min=0, help="Most changes of a voltage a second; 1.25 × the configured gains' if left out."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Training seeds of wind and sensors.")] = 2,
    winds: Annotated[
        str, typer.Option(metavar="A,B", help="Training winds, as parts of plant.wind.torque; 0 is calm.")
    ] = "0,1",
    held_out: Annotated[
        int, typer.Option(min=1, max=100, help="Runs with other seeds and winds, which the search does not see.")
    ] = 4,
    budget: Annotated[int, typer.Option(min=1, help="Experiments of the search, at most.")] = 1000,
    duration: Annotated[float, typer.Option(metavar="S", min=0.01, help="Length of an experiment, in s.")] = 10.0,
    reach: Annotated[float, typer.Option(min=1.01, help="Largest factor of a gain, up or down.")] = 10.0,
    within: Annotated[
        float, typer.Option(metavar="DEG", min=0, help="Bound of the attitude error with delay or lost frames.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed finds the same.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Write the gains to this file, as TOML to paste.")] = None,
    engine: EngineOption = "processes",
    force: Force = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Search a law's gains for the least error and effort. Exits with 1 if they are worse in runs not searched."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab.sweep import open_workers
    from aeroloop.service.lab.tune import TuneOptions, parse_winds, sheets, toml_of, tune
    from aeroloop.service.logs.outputs import check_output

    with checked():
        if out is not None:
            check_output(out, [config], force=force)
        options = TuneOptions(
            gain or (), scale, weight, max_saturated, max_chatter, seeds, parse_winds(winds), held_out, budget,
            duration, reach, seed, within,
        )  # fmt: skip
    with working("experiments", json) as update, open_workers(engine) as workers:
        found = tune(settings, options, workers, update)
    show(found, json, sheets)
    if out is not None:
        with new_file(out, config, force) as part:
            part.write_text(toml_of(found), encoding="utf-8")
    raise typer.Exit(INTERRUPTED if found.interrupted else 1 if found.worse else 0)


def design(
    error: Annotated[float, typer.Option(min=0, metavar="DEG", help="Attitude error to be proven, in degrees.")],
    kbit: Annotated[
        float | None,
        typer.Option(min=0, metavar="KBIT", help="Largest payload of both frames, in kbit/s."),
    ] = None,
    rates: Annotated[
        list[float] | None,
        typer.Option("--rate", metavar="HZ", help="Rate; may be repeated; as configured if left out."),
    ] = None,
    gains: Annotated[bool, typer.Option("--gains", help="Search the law's gains, too.")] = False,
    plant: Annotated[bool, typer.Option("--plant", help="Of the configured plant, not of the paper's body.")] = False,
    delay: Annotated[float, typer.Option(min=0, metavar="S", help="Further delay of every command, in s.")] = 0.0,
    loss: Annotated[int, typer.Option(min=0, metavar="N", help="Most frames lost in a row.")] = 0,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Search bits, rate and gains for the least payload. Its attitude error is proven."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab import design as lab

    with working("designs", json) as update:
        found = lab.design(
            settings, error_deg=error, kbit=kbit, rates=rates or (), gains=gains, plant=plant, delay_s=delay, lost=loss,
            duration_s=duration, progress=update, engine=engine,
        )  # fmt: skip
    show(found, json, lab.sheets, markdown)


group = typer.Typer()
for verb in (experiment, tables, calibrate, certify, burden, laws, sweep, tune, design):
    group.command()(verb)
