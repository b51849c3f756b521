"""Verbs of `aeroloop lab` that run experiments and print figures of merit: one, tables, grids."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aeroloop.service.cli.common import (
    PAPER_DURATION_S,
    BitsIn,
    BitsOut,
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
    guarded,
    loop_of,
    new_file,
    show,
    with_bits_of,
)


def experiment(
    duration: Duration = PAPER_DURATION_S,
    bits_out: BitsOut = None,
    bits_in: BitsIn = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the closed loop in this process, in lockstep, without a network."""
    settings = with_bits_of(loop_of(config, overrides), bits_out, bits_in)
    from aeroloop.service.lab.experiment import run_experiment
    from aeroloop.service.terminal.display import figures_table, progress_bar

    with guarded(), progress_bar("experiment", duration, hidden=json) as update:
        figures = run_experiment(settings, duration, update)
    show(figures, json, figures_table)


def tables(
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Runs of each cell, for a mean and a spread.")] = 1,
    engine: EngineOption = "processes",
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Predict every cell of the paper's Tables C.2 to C.4 and print it beside the published value."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab.tables import predict, sheets
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.show import show_result

    with guarded(), count_bar("cells", hidden=json) as update:
        result = predict(settings, seeds, update, engine)
    show_result(result, sheets, json=json, markdown=markdown)


def calibrate(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Fit the plant to two of the paper's cells, calm and windy, and print the fitted values."""
    settings = loop_of(config, overrides)
    from aeroloop.service.lab.calibrate import calibrate, sheets
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.show import show_result

    with guarded(), count_bar("experiments", hidden=json) as update:
        result = calibrate(settings, lambda runs: update(runs, None))
    show_result(result, sheets, json=json)


def burden(
    bits: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OUT/IN",
            help="Bits of ε and ω, and of u, such as 8/6; may be repeated; six pairs if left out.",
            show_default=False,
        ),
    ] = None,
    quantizer: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="uniform, hysteresis-uniform, logarithmic-uniform, or hysteresis-rate (hysteresis for ω, uniform for "
            "the rest); may be repeated; all four if left out.",
            show_default=False,
        ),
    ] = None,
    sensors: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="perfect, encoders, gyro (2 mrad/s of noise) or shaken-gyro (20 mrad/s); may be repeated; all four "
            "if left out.",
            show_default=False,
        ),
    ] = None,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    figure: Annotated[
        Path | None, typer.Option(help="Draw error against bits/s: a .png, .svg or .pdf file.", show_default=False)
    ] = None,
    force: Force = False,
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Measure error against bits for a grid of bits, quantizers, transmit policies and sensors, beside float64."""
    settings = loop_of(config, overrides)
    from aeroloop.service.lab.burden import grid, measure_burden, sheets
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.show import show_result

    check_engine(engine)
    with checked():
        check_figure(figure, config, force)
        cells = grid(settings, bits or (), quantizer or (), sensors or ())
    with guarded(), count_bar("experiments", hidden=json) as update:
        result = measure_burden(settings, cells, duration, update, engine)
    show_result(result, sheets, json=json, markdown=markdown, keys=2)
    if figure is not None:
        from aeroloop.service.lab.burden_figure import draw_burden

        with new_file(figure, config, force) as part:
            draw_burden(result, part)


def sweep(
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE.parquet|FILE.csv",
            help="Table of all experiments. Rows are kept in FILE.jsonl as they come: the same command goes on there.",
            show_default=False,
        ),
    ],
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="section.key=a,b,c or section.key=a..b*n, n values evenly from a to b; may be repeated, for every "
            "combination.",
            show_default=False,
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=1, help="Runs of each combination, with seeds of wind and sensors from 0 up.")
    ] = 1,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    force: Force = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run an experiment for every combination of values and seeds, and write a table of their figures."""
    settings = loop_of(config, overrides)
    check_engine(engine)
    from aeroloop.service.lab.axes import configurations, parse_axes
    from aeroloop.service.lab.sweep import SweepPlan, check_table, run_sweep, sheets
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.show import show_result

    with checked():
        axes = parse_axes(vary or ())
        planned = SweepPlan(settings, axes, configurations(settings, axes, seeds, duration), seeds, duration)
        check_table(out, planned, [config], force=force)
    with guarded(), count_bar("experiments", hidden=json) as update:
        result = run_sweep(planned, out, engine=engine, progress=update)
    show_result(result, sheets, json=json)
