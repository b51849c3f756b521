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
    checked,
    load_for_loop,
    report,
    show,
    working,
)
from aeroloop.service.cli.entry import INTERRUPTED

# Modules of the lab are imported where they are used, as `--help` must not wait for them.

_Seeds = Annotated[
    int, typer.Option("--seeds", min=1, help="Runs of each combination, with seeds of wind and sensors from 0 up.")
]
_ROWS = (
    "Table of all experiments. Rows are kept in FILE.jsonl as they come: the same command goes on there, and with "
    "--force a finished table gets more values or seeds."
)


def experiment(
    duration: Duration = PAPER_DURATION_S,
    bits: BitsOption = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the closed loop in this process, without a network."""
    settings = load_for_loop(config, overrides, bits=bits)
    from aeroloop.service.lab.experiment import run_experiment
    from aeroloop.service.terminal.log_sheets import figure_sheets

    with working("experiment", json, duration) as update:
        figures = run_experiment(settings, duration, update)
    show(figures, json, figure_sheets)


def tables(
    engine: EngineOption = "processes",
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Predict the paper's Tables C.2 to C.4. Beside the published values."""
    settings = load_for_loop(config, overrides)
    from aeroloop.service.lab.tables import predict, sheets

    with working("cells", json) as update:
        result = predict(settings, update, engine)
    show(result, json, sheets, markdown)


def certify(
    disturbance: Annotated[
        float | None,
        typer.Option(min=0, help="Largest torque beyond the plant's settings, in N·m; a machine needs it."),
    ] = None,
    bits: BitsOption = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print every term, with its equation.")] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print what is proven, and what that assumes. Exits with 1 unless all of it holds."""
    settings = load_for_loop(config, overrides, bits=bits)
    from aeroloop.service.terminal.sheets import certificate_sheets
    from aeroloop.service.theorem.certificate import certify

    result = certify(settings, disturbance=disturbance)
    show(result, json, partial(certificate_sheets, verbose=verbose))
    raise typer.Exit(0 if result.holds else 1)


def burden(
    bits: Annotated[
        list[str] | None, typer.Option(metavar="OUT/IN", help="Such as 8/6; may be repeated; six pairs if left out.")
    ] = None,
    quantizer: Annotated[
        list[str] | None,
        typer.Option(
            help="uniform, hysteresis-uniform, logarithmic-uniform, or hysteresis-rate (hysteresis for ω, uniform for "
            "the rest); may be repeated; all four if left out."
        ),
    ] = None,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    figure: Annotated[Path | None, typer.Option(help="Draw the result: a .png, .svg or .pdf file.")] = None,
    force: Force = False,
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Measure error against bits, for every quantizer and sensor. Sent on change and at every tick."""
    settings = load_for_loop(config, overrides)
    from aeroloop.service.lab.burden import draw_burden, grid, measure_burden, sheets
    from aeroloop.service.logs.outputs import check_output, writing

    with checked():
        if figure is not None:
            from aeroloop.service.report.plots import check_path

            check_path(figure)
        check_output(figure, [config], force=force)
        cells = grid(settings, bits or (), quantizer or ())
    with working("experiments", json) as update:
        result = measure_burden(settings, cells, duration, update, engine)
    show(result, json, sheets, markdown, keys=2)
    if figure is not None:  # after the table: a full disk must not cost it
        with writing(figure, [config], force=force) as part:
            draw_burden(result, part)


def laws(
    law: Annotated[
        list[str] | None,
        typer.Option(help="A law.kind; may be repeated; ours if left out. One that adapts is shown without that, too."),
    ] = None,
    seeds: _Seeds = 5,
    duration: Duration = PAPER_DURATION_S,
    bits: BitsOption = None,
    engine: EngineOption = "processes",
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Compare control laws, tuned alike. Proven bound, error, effort, chatter, bits, delay and loss survived.

    Exits with 1 if a run has no figures, such as one that tripped.
    """
    settings = load_for_loop(config, overrides, bits=bits)
    from aeroloop.service.lab.laws import compare, compared_laws, laws_in_python, sheets

    compared = compared_laws(settings, law or ())
    in_python = laws_in_python(settings, compared)
    if in_python:
        report(
            f"plain Python: {', '.join(in_python)}; its runs and searches go tick by tick, a hundred times slower than "
            "those of expressions; --duration 5 --seeds 1 is a first look"
        )
    with working("experiments and searches", json) as update:
        result = compare(settings, compared, seeds=seeds, duration_s=duration, engine=engine, progress=update)
    show(result, json, sheets, markdown)
    if any(row["reason"] is not None for row in result.rows):
        raise typer.Exit(1)


def sweep(
    out: Annotated[Path, typer.Option(metavar="FILE.parquet|FILE.csv", help=_ROWS)],
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="section.key=a,b,c, or a..b*n, n values evenly from a to b; section.key*=VALUES has factors of what "
            "is configured: law.C2*=0.5,1,2. May be repeated, for every combination.",
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
    """Run an experiment for every combination of values and seeds. Writes a table of their figures.

    Exits with 1 if a row has a reason instead of figures, such as a trip.
    """
    settings = load_for_loop(config, overrides, bits=bits)
    from aeroloop.service.lab.axes import configurations, parse_axes
    from aeroloop.service.lab.sweep import SweepPlan, check_table, rows_file, run_sweep, sheets

    axes = parse_axes(vary or ())
    planned = SweepPlan(settings, axes, configurations(settings, axes, seeds, duration), seeds, duration)
    with checked():
        check_table(out, [config], force=force)
    with working("experiments", json) as update:
        try:
            result = run_sweep(planned, out, engine=engine, progress=update)
        except KeyboardInterrupt:
            report(f"interrupted; what has run is in {rows_file(out)}, and the same command goes on from there")
            raise
    show(result, json, sheets)
    if result.failed:
        raise typer.Exit(1)


def tune(
    gain: Annotated[
        list[str] | None,
        typer.Option(help="Gain, or other number of [law]; may be repeated; all of the law's gains if left out."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Training seeds, each calm and in wind.")] = 2,
    held_out: Annotated[int, typer.Option(min=1, max=100, help="Runs with seeds and winds not searched.")] = 4,
    budget: Annotated[int, typer.Option(min=1, help="Experiments of the search, at most.")] = 1000,
    duration: Annotated[float, typer.Option(metavar="S", min=0.01, help="Length of an experiment, in s.")] = 10.0,
    out: Annotated[Path | None, typer.Option(help="Write the gains to this file, as TOML to paste.")] = None,
    engine: EngineOption = "processes",
    force: Force = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Search a law's gains for the least error and effort. Exits with 1 if they are worse in runs not searched.

    What is minimised is the mean of z_track + 1e-7·u_total, by one factor for each gain, up to 10 either way. Gains
    with which a run trips, or a voltage changes over 1.25 times as often as with the configured ones, do not count.
    """
    settings = load_for_loop(config, overrides)
    from aeroloop.service.lab.engine import open_workers
    from aeroloop.service.lab.tune import TuneOptions, sheets, toml_of, tune
    from aeroloop.service.logs.outputs import check_output, writing

    with checked():
        check_output(out, [config], force=force)
    options = TuneOptions(gain or (), seeds, held_out, budget, duration)
    with working("experiments", json) as update, open_workers(engine) as workers:
        found = tune(settings, options, workers, update)
    show(found, json, sheets)
    if out is not None:
        with writing(out, [config], force=force) as part:
            part.write_text(toml_of(found), encoding="utf-8")
    raise typer.Exit(INTERRUPTED if found.interrupted else int(found.worse))


group = typer.Typer()
for verb in (experiment, tables, certify, burden, laws, sweep, tune):
    group.command()(verb)
