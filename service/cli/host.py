"""`aeroloop host`: checks this machine, installs its daemons."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aeroloop.service.cli.common import Config, Json, Overrides, guarded, settings_of, show

group = typer.Typer()


@group.command()
def doctor(
    network: Annotated[
        bool, typer.Option("--network", help="Try this host's certificates at every endpoint, too.")
    ] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Check whether this machine holds the configured rate, and its certificates; print what to change if not."""
    settings = settings_of(config, overrides)
    from aeroloop.service.host.doctor import CHECK_S, diagnose
    from aeroloop.service.terminal.display import diagnosis_table, progress_bar

    with guarded(), progress_bar("check", CHECK_S, hidden=json) as update:
        tried = settings.network if network else None
        diagnosis = diagnose(settings.loop, update, settings.network.security.folder, tried)
    show(diagnosis, json, diagnosis_table)
    if not diagnosis.holds:
        raise typer.Exit(1)


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
