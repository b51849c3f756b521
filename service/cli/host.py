"""`aeroloop host`: checks this machine, measures and soaks the loop on it, installs its daemons."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aeroloop.service.cli.common import (
    Config,
    Json,
    Markdown,
    NewLog,
    Overrides,
    checked,
    guarded,
    report,
    settings_of,
    show,
)
from aeroloop.service.cli.entry import INTERRUPTED

group = typer.Typer()


@group.command()
def doctor(json: Json = False, config: Config = None, overrides: Overrides = None) -> None:
    """Check whether this machine holds the configured rate, and its certificates; print what to change if not."""
    settings = settings_of(config, overrides)
    from aeroloop.service.host.doctor import CHECK_S, diagnose
    from aeroloop.service.terminal.display import diagnosis_table, progress_bar

    with guarded(), progress_bar("check", CHECK_S, hidden=json) as update:
        diagnosis = diagnose(settings.loop, update, settings.network.security.folder)
    show(diagnosis, json, diagnosis_table)
    if not diagnosis.holds:
        raise typer.Exit(1)


@group.command()
def soak(
    minutes: Annotated[float, typer.Option("--minutes", min=0.1, help="Length of the soak, in minutes.")] = 20.0,
    log: NewLog = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the three processes for a long time and report growth, drift and losses."""
    settings = settings_of(config, overrides)
    from aeroloop.service.lab.soak import run_soak
    from aeroloop.service.recording.rolling import log_path
    from aeroloop.service.terminal.display import progress_bar, soak_table

    path = log_path(log or settings.recorder.directory, "soak-%Y%m%d-%H%M%S.mcap")
    with guarded(), progress_bar("soak", minutes * 60, hidden=json) as update:
        result = run_soak(settings, minutes, path, update)
    show(result, json, soak_table)
    if result.findings:
        raise typer.Exit(1)


@group.command()
def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer turns and items: 90 s.")] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="ITEM", help="An item, or a group such as loop; may be repeated.", show_default=False),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What --json printed earlier: exit with 1 if a ratio is worse by more than its margin.",
            show_default=False,
        ),
    ] = None,
    markdown: Markdown = False,
    json: Json = False,
) -> None:
    """Measure what this project takes beside what the machine gives, in turns: item, ours, floor, ratio, aim.

    Each figure is printed on stderr as it is found; ^C ends with the table of those found until then.
    """
    from aeroloop.service.bench.items import ITEMS
    from aeroloop.service.bench.results import chosen, compared, measure, read_results
    from aeroloop.service.terminal.bench_table import bench_markdown, bench_table

    with checked():
        items = chosen(ITEMS, only or ())
        earlier = read_results(compare) if compare else None
    with guarded():
        results = measure(items, quick=quick, progress=lambda line: typer.echo(line, err=True))
    changes = compared(results, earlier, items) if earlier else []
    show(
        results,
        json,
        lambda _: typer.echo(bench_markdown(results, changes)) if markdown else bench_table(results, changes),
    )
    worse = [change for change in changes if change.worse]
    for change in worse:
        report(str(change))
    raise typer.Exit(INTERRUPTED if results.interrupted else 1 if worse else 0)


@group.command()
def units(
    install: Annotated[
        Path | None, typer.Option("--install", help="Write the units into this folder instead.", show_default=False)
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace units that exist.")] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print systemd units for the daemons of this configuration, or install them; ends with the commands to start them.

    The configuration is /etc/aeroloop/aeroloop.toml unless --config names another.
    """
    from aeroloop.service.host import units

    file = config or (units.CONFIG if units.CONFIG.exists() else None)
    source = units.Source(file or units.CONFIG, overrides or [], settings_of(file, overrides))
    if install is None:
        for name in units.units_of(source.settings):
            typer.echo(f"# aeroloop-{name}.service\n{units.unit(name, source)}")
    else:
        with guarded():
            for path in units.install(install, source, force=force):
                typer.echo(path)
    typer.echo("# next:")
    for step in units.next_steps(install, source):
        typer.echo(f"#   {step}" if install is None else step)
