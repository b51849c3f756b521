"""Verbs of `aeroloop lab` about control laws: compare them, and search their gains."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aeroloop.service.cli.common import (
    PAPER_DURATION_S,
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
)
from aeroloop.service.cli.entry import INTERRUPTED


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
            metavar="FILE.parquet|FILE.csv",
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
    check_engine(engine)
    from aeroloop.service.lab.laws import compare, run_comparison, sheets, table_extras
    from aeroloop.service.lab.sweep import check_table
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.show import show_result

    axes = {"laws": law, "bits": bits, "sensors": sensors, "winds": wind, "plants": plant}
    given = {name: values or () for name, values in axes.items()}
    with checked():
        check_figure(figure, config, force)
        comparison = compare(settings, **given, seeds=seeds, duration_s=duration, within_deg=within)
        if out is not None:
            check_table(out, comparison.plan, [config], more=table_extras(within), force=force)
    with guarded(), count_bar("experiments and searches", hidden=json) as update:
        result = run_comparison(comparison, out, engine, update)
    show_result(result, sheets, json=json, markdown=markdown)
    if figure is not None:
        from aeroloop.service.lab.laws_figure import draw_laws

        with new_file(figure, config, force) as part:
            draw_laws(result, part)


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
    check_engine(engine)
    from aeroloop.service.lab.tune import sheets, toml_of, tune
    from aeroloop.service.lab.tune_search import TuneOptions, parse_winds
    from aeroloop.service.lab.workers import open_workers
    from aeroloop.service.logs.outputs import check_output
    from aeroloop.service.terminal.display import count_bar
    from aeroloop.service.terminal.show import show_result

    with checked():
        if out is not None:
            check_output(out, [config], force=force)
        options = TuneOptions(
            gain or (), scale, weight, max_saturated, max_chatter, seeds, parse_winds(winds), held_out, budget,
            duration, reach, seed, within,
        )  # fmt: skip
    with guarded(), count_bar("experiments", hidden=json) as update, open_workers(engine) as workers:
        found = tune(settings, options, workers, update)
    show_result(found, sheets, json=json)
    if out is not None:
        with new_file(out, config, force) as part:
            part.write_text(toml_of(found), encoding="utf-8")
    raise typer.Exit(INTERRUPTED if found.interrupted else 1 if found.worse else 0)
