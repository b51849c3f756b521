"""`aeroloop host`: checks this machine, installs its daemons, makes its keys."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from aeroloop.service.cli.common import Config, Json, Overrides, load_settings, report, show, working

Directory = Annotated[Path, typer.Option("--directory", help="Folder of this host's keys.")]
DIRECTORY: Final = Path("~/.config/aeroloop/keys")

group = typer.Typer()
keys = typer.Typer()
group.add_typer(
    keys, name="keys", help="Certificates of this host's roles, for mutual TLS between hosts.", no_args_is_help=True
)


@group.command()
def doctor(
    network: Annotated[bool, typer.Option("--network", help="Shake hands with each configured place, too.")] = False,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Check whether this machine holds the configured rate. Checks its certificates, too, and prints what to change."""
    settings = load_settings(config, overrides)
    from aeroloop.service.host.doctor import CHECK_S, diagnose
    from aeroloop.service.terminal.sheets import diagnosis_sheets

    with working("check", json, CHECK_S) as update:
        diagnosis = diagnose(settings.loop, settings.network, update, handshakes=network)
    show(diagnosis, json, diagnosis_sheets, keys=2)
    if not diagnosis.holds:
        raise typer.Exit(1)


@group.command()
def units(
    install: Annotated[Path | None, typer.Option("--install", help="Write the units into this folder instead.")] = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print systemd units for the configured daemons, or install them.

    Ends with the commands that start them. The configuration is /etc/aeroloop/aeroloop.toml unless --config names one.
    """
    from aeroloop.service.host import units

    file = config or (units.CONFIG if units.CONFIG.exists() else None)
    source = units.Source(file or units.CONFIG, overrides or [], load_settings(file, overrides))
    if install is None:
        for name in units.units_of(source.settings):
            typer.echo(f"# aeroloop-{name}.service\n{units.unit(name, source)}")
        rules = units.firewall(source.settings.network)
        if rules:
            typer.echo(f"# {units.FIREWALL}\n{rules}")
    else:
        for path in units.install(install, source):
            typer.echo(path)
    typer.echo("# next:")
    for step in units.next_steps(install, source):
        typer.echo(f"#   {step}" if install is None else step)


@keys.command()
def init(directory: Directory = DIRECTORY) -> None:
    """Make an authority that signs this network's certificates. Its key, ca.key, stays in the folder."""
    from aeroloop.service.host import keys

    folder = directory.expanduser().absolute()
    typer.echo(keys.init(folder))
    directory_key = f'[network.security] directory = "{folder}"'
    report(f"next: `aeroloop host keys issue ROLE NAME`, and in every configuration {directory_key}")


@keys.command()
def issue(
    role: Annotated[str, typer.Argument(help="plant, controller, operator, observer, recorder, router.")],
    name: Annotated[str, typer.Argument(help="Host or person that gets it.")],
    vehicle: Annotated[
        str | None, typer.Option(help="Its vehicle, which plant and controller need; every vehicle if none.")
    ] = None,
    directory: Directory = DIRECTORY,
) -> None:
    """Issue a certificate with a new key, for 90 days."""
    from aeroloop.service.host import keys

    typer.echo(keys.issue(directory.expanduser().absolute(), role, name, vehicle))


@keys.command("show")
def show_keys(json: Json = False, directory: Directory = DIRECTORY) -> None:
    """Print this host's certificates and their authority. Exits with 1 if one cannot be used."""
    from aeroloop.service.host import keys
    from aeroloop.service.terminal.sheets import key_sheets

    folder = directory.expanduser().absolute()
    files = keys.show(folder)
    show(files, json, partial(key_sheets, str(folder)), keys=2)
    if any(file.problem for file in files):
        raise typer.Exit(1)
