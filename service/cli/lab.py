"""`aeroloop lab`: experiments, tables, calibration and certificates, in lockstep and without a network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    checked,
    fail,
    guarded,
    loop_of,
    show,
    with_bits_of,
)
from aeroloop.service.cli.entry import INTERRUPTED

if TYPE_CHECKING:
    from aeroloop.service.config import Settings
    from aeroloop.service.lab.attack import Attack
    from aeroloop.service.lab.margins import Bits, Margins

group = typer.Typer()


@group.command()
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
    from aeroloop.service.lab.experiment import experiment_figures
    from aeroloop.service.terminal.display import figures_table, progress_bar

    with guarded(), progress_bar("experiment", duration, hidden=json) as update:
        figures = experiment_figures(settings, duration, update)
    show(figures, json, lambda found: figures_table(found, path=found.path))


@group.command()
def tables(
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Runs of each cell, for a mean and a spread.")] = 1,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Print how the errors change with what was not fitted; takes minutes.")
    ] = False,
    engine: EngineOption = "processes",
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Predict every cell of the paper's Tables C.2 to C.4 and print it beside the published value."""
    settings = loop_of(config, overrides)
    _check_engine(engine)
    from aeroloop.service.lab.tables import markdown as as_markdown
    from aeroloop.service.lab.tables import markdown_table, predict
    from aeroloop.service.terminal.display import count_bar, paper_tables, rows_table

    if sensitivity:
        from aeroloop.service.lab.sensitivity import measure_sensitivity, rows

        with guarded(), count_bar("cells", hidden=json) as update:
            changes = measure_sensitivity(settings, seeds, update, engine)
        text = rows(changes)
        show(changes, json, lambda _: typer.echo(markdown_table(text)) if markdown else rows_table(text))
        return
    with guarded(), count_bar("cells", hidden=json) as update:
        result = predict(settings, seeds, update, engine)
    show(result, json, (lambda found: typer.echo(as_markdown(found))) if markdown else paper_tables)


@group.command()
def calibrate(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Fit the plant to two of the paper's cells, calm and windy, and print the fitted values."""
    settings = loop_of(config, overrides)
    from aeroloop.service.lab.calibrate import calibrate
    from aeroloop.service.terminal.display import calibration_table, count_bar

    with guarded(), count_bar("experiments", hidden=json) as update:
        result = calibrate(settings, lambda runs: update(runs, None))
    show(result, json, calibration_table)


@group.command()
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
            _check_figure(figure, config, force)
        pair = (settings.wire.attitude.bits, settings.wire.voltage.bits) if bits_out or bits_in else None
        found = _margins(settings, pair, disturbance or 0.0, json)
        if figure is not None:
            from aeroloop.service.lab.margins_figure import draw_margins

            with _new_file(figure, config, force) as part:
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


@group.command()
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
    _check_engine(engine)
    from aeroloop.service.terminal.attack_table import attack_table

    options: dict[str, Any] = {"engine": engine, "seed": seed, "duration_s": duration, "seconds": seconds, "out": out}
    result = _attacked(settings, runs, disturbance=disturbance, json=json, **options)
    show(result, json, lambda found: attack_table(found, verbose=verbose))
    raise typer.Exit(1 if result.beaten else 0)


@group.command()
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
    from aeroloop.service.lab.burden import measure_burden
    from aeroloop.service.lab.burden_grid import grid
    from aeroloop.service.lab.burden_table import burden_table
    from aeroloop.service.lab.burden_table import markdown as as_markdown
    from aeroloop.service.terminal.display import count_bar

    _check_engine(engine)
    with checked():
        _check_figure(figure, config, force)
        cells = grid(settings, bits or (), quantizer or (), sensors or ())
    with guarded(), count_bar("experiments", hidden=json) as update:
        result = measure_burden(settings, cells, duration, update, engine)
    show(result, json, (lambda found: typer.echo(as_markdown(found))) if markdown else burden_table)
    if figure is not None:
        from aeroloop.service.lab.burden_figure import draw_burden

        with _new_file(figure, config, force) as part:
            draw_burden(result, part)


@group.command()
def laws(
    law: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="A kind of law: ours, an entry point, or package.module:Class; may be repeated; ours if left out.",
            show_default=False,
        ),
    ] = None,
    bits: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OUT/IN",
            help="Bits of ε and ω, and of u; may be repeated; 8/6 and cont/cont if left out.",
            show_default=False,
        ),
    ] = None,
    sensors: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="perfect, encoders, gyro (2 mrad/s of noise) or shaken-gyro (20 mrad/s); may be repeated; encoders "
            "if left out. A free body has no encoders: perfect.",
            show_default=False,
        ),
    ] = None,
    wind: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="calm or wind; may be repeated; both if left out.", show_default=False),
    ] = None,
    plant: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="aero, rigid_body (a free body like it, with three motors), or a plant of your own, as plant.kind "
            "takes it; may be repeated; the first two if left out.",
            show_default=False,
        ),
    ] = None,
    within: Annotated[
        float,
        typer.Option(
            metavar="DEG", min=0.1, max=180, help="Error up to which delay and lost frames count as survived."
        ),
    ] = 10.0,
    seeds: Annotated[
        int, typer.Option(min=1, help="Runs of each combination, with seeds of wind and sensors from 0 up.")
    ] = 1,
    duration: Duration = PAPER_DURATION_S,
    engine: EngineOption = "processes",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.parquet",
            help="Table of all experiments. Rows are kept in FILE.jsonl: the same command goes on there.",
            show_default=False,
        ),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Draw the laws beside each other: a .png, .svg or .pdf file.", show_default=False),
    ] = None,
    force: Force = False,
    markdown: Markdown = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Compare control laws, tuned alike: error, effort, chatter, bits, and the delay and loss that each survives."""
    settings = loop_of(config, overrides)
    _check_engine(engine)
    from aeroloop.service.sweep.law_choices import compare
    from aeroloop.service.sweep.laws import run_comparison
    from aeroloop.service.sweep.sweep import rows_file
    from aeroloop.service.sweep.table import check_table
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.laws_table import laws_table
    from aeroloop.service.terminal.laws_table import markdown as as_markdown

    axes = {"laws": law, "bits": bits, "sensors": sensors, "winds": wind, "plants": plant}
    given = {name: values or () for name, values in axes.items()}
    with checked():
        _check_figure(figure, config, force)
        if out is not None:
            check_table(out, [config], force=force or rows_file(out).exists())  # as of `sweep`
        comparison = compare(settings, **given, seeds=seeds, duration_s=duration, within_deg=within)
    with guarded(), count_bar("experiments and searches", hidden=json) as update:
        result = run_comparison(comparison, out, engine, update)
    show(result, json, (lambda found: typer.echo(as_markdown(found))) if markdown else laws_table)
    if figure is not None:
        from aeroloop.service.sweep.laws_figure import draw_laws

        with _new_file(figure, config, force) as part:
            draw_laws(result, part)


@group.command()
def sweep(
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE.parquet",
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
    _check_engine(engine)
    from aeroloop.service.sweep.axes import parse_axes
    from aeroloop.service.sweep.sweep import plan, rows_file, run_sweep
    from aeroloop.service.sweep.table import check_table
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.sweep_table import sweep_table

    with checked():
        check_table(out, [config], force=force or rows_file(out).exists())  # the table of these rows may be made anew
        planned = plan(settings, parse_axes(vary or ()), seeds, duration)
    with guarded(), count_bar("experiments", hidden=json) as update:
        result = run_sweep(planned, out, engine=engine, progress=update)
    show(result, json, sweep_table)


@group.command()
def tune(
    gain: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Gain, or other number of the law's settings; may be repeated; all of the law's gains if left out.",
            show_default=False,
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
            show_default=False,
        ),
    ] = None,
    max_chatter: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Most changes of a voltage a second; 1.25 × the configured gains' if left out.",
            show_default=False,
        ),
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
    out: Annotated[
        Path | None, typer.Option(help="Write the gains to this file, as TOML to paste.", show_default=False)
    ] = None,
    engine: EngineOption = "processes",
    force: Force = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Search the gains of a law for the least error and effort; exit 1 if they are worse in runs not searched."""
    settings = loop_of(config, overrides)
    _check_engine(engine)
    from aeroloop.service.lab.tune import toml_of, tune
    from aeroloop.service.lab.tune_search import Plan, parse_winds
    from aeroloop.service.lab.workers import Workers
    from aeroloop.service.logs.outputs import check_output
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.tune_table import tune_table

    with checked():
        if out is not None:
            check_output(out, [config], force=force)
        plan = Plan(
            gain or (), scale, weight, max_saturated, max_chatter, seeds, parse_winds(winds), held_out, budget,
            duration, reach, seed, within,
        )  # fmt: skip
    with guarded(), count_bar("experiments", hidden=json) as update, Workers(engine) as workers:
        found = tune(settings, plan, workers, update)
    show(found, json, tune_table)
    if out is not None:
        with _new_file(out, config, force) as part:
            part.write_text(toml_of(found), encoding="utf-8")
    raise typer.Exit(INTERRUPTED if found.interrupted else 1 if found.worse else 0)


def _check_engine(engine: str) -> None:
    from aeroloop.service.lab.workers import check_engine

    with checked():
        check_engine(engine)


def _check_figure(figure: Path | None, config: Path | None, force: bool) -> None:
    if figure is not None:
        from aeroloop.service.logs.outputs import check_output
        from aeroloop.service.report.figure_style import check_path

        check_path(figure)
        check_output(figure, [config], force=force)


@contextmanager
def _new_file(figure: Path, config: Path | None, force: bool) -> Iterator[Path]:
    """A path to draw to, once the table is printed: a full disk must not cost the table."""
    from aeroloop.service.logs.outputs import writing

    with guarded(), writing(figure, [config], force=force) as part:
        yield part
