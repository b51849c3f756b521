"""`aeroloop host keys`: a private authority, and the certificates of this host's roles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from aeroloop.service.cli.common import Config, Json, Overrides, address_of, checked, fail, guarded

group = typer.Typer()

DEFAULT: Final = Path("~/.config/aeroloop/keys")
"""Directory where none is configured."""

Directory = Annotated[
    Path | None,
    typer.Option(
        "--directory", help="Folder; network.security.directory if configured, else ~/.config/aeroloop/keys.",
        show_default=False,
    ),
]  # fmt: skip
Days = Annotated[int, typer.Option(min=1, max=3650, help="How long the certificate is valid, in days.")]
Vehicle = Annotated[
    str | None,
    typer.Option(help="Its vehicle, which plant and controller need; every vehicle if none.", show_default=False),
]


@group.command()
def init(
    directory: Annotated[Path | None, typer.Argument(metavar="[DIR]", help="Folder.", show_default=False)] = None,
    days: Annotated[int, typer.Option(min=1, max=36500, help="How long the authority is valid, in days.")] = 3650,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Make a private authority, which signs this network's certificates; its key, ca.key, stays in the folder."""
    folder = _folder(directory, config, overrides)
    from aeroloop.service.host import keys

    with guarded():
        typer.echo(keys.init(folder, days))
    typer.echo(
        f"next: `aeroloop host keys issue ROLE NAME`, and in every configuration [network.security] directory = "
        f'"{folder}"',
        err=True,
    )


@group.command()
def issue(
    role: Annotated[str | None, typer.Argument(help="plant, controller, operator, observer, recorder, router.")] = None,
    name: Annotated[str | None, typer.Argument(help="Host or person that gets it.")] = None,
    vehicle: Vehicle = None,
    days: Days = 90,
    request: Annotated[
        Path | None,
        typer.Option(help="Sign this request instead: its key stays where it was made.", show_default=False),
    ] = None,
    directory: Directory = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Issue a certificate with a new key, or one that a request from another host asks for.

    90 days, because none can be revoked: a stolen key is good until its certificate expires.
    """
    folder = _folder(directory, config, overrides)
    from aeroloop.service.host import keys

    if request is None:
        if role is None or name is None:
            fail("ROLE and NAME are needed, or --request FILE (see `aeroloop host keys issue --help`)", 2)
        with guarded():
            made = keys.issue(folder, role, name, vehicle, days)
    else:
        if role or name or vehicle:
            fail("role, name and vehicle are the request's own; leave them out", 2)
        with guarded():
            made = keys.issue_requested(folder, request, days)
    typer.echo(made)
    if request is not None:
        typer.echo(f"next: copy it and {folder / 'ca.pem'} beside the key on the host of the request", err=True)


@group.command()
def request(
    role: Annotated[str, typer.Argument(help="plant, controller, operator, observer, recorder, router.")],
    name: Annotated[str, typer.Argument(help="Host or person that gets it.")],
    vehicle: Vehicle = None,
    directory: Directory = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Make a key here and a request for its certificate, for `issue --request` where the authority is."""
    folder = _folder(directory, config, overrides)
    from aeroloop.service.host import keys

    with guarded():
        made = keys.request(folder, role, name, vehicle)
    typer.echo(made)
    typer.echo(f"next, where ca.key is: `aeroloop host keys issue --request {made.name}`", err=True)


@group.command()
def renew(
    roles: Annotated[
        list[str] | None, typer.Argument(help="Roles, or names such as plant.aero; all if none.", show_default=False)
    ] = None,
    days: Days = 90,
    new_key: Annotated[bool, typer.Option("--new-key", help="Make new keys, too.")] = False,
    directory: Directory = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Renew certificates; where the authority's key is not, make requests for that. What is replaced is kept beside."""
    folder = _folder(directory, config, overrides)
    from aeroloop.service.host import keys

    with guarded():
        made = keys.renew(folder, roles or (), days, new_key=new_key)
    for path in made:
        typer.echo(path)
    if made[0].suffix == ".csr":
        typer.echo("next, where ca.key is: `aeroloop host keys issue --request FILE` of each", err=True)
    else:
        typer.echo("next: restart the daemons that use them; one that runs listens with its old certificate", err=True)


@group.command()
def show(json: Json = False, directory: Directory = None, config: Config = None, overrides: Overrides = None) -> None:
    """Print the authority and the certificates of this host; exits with 1 if one cannot be used."""
    folder = _folder(directory, config, overrides)
    from aeroloop.service.host import keys

    with guarded():
        rows = keys.show(folder)
    if json:
        from json import dumps

        typer.echo(dumps([row.model_dump(mode="json") for row in rows], indent=2))
    else:
        from aeroloop.service.terminal.keys_table import keys_table

        keys_table(folder, rows)
    if any(row.problem for row in rows):
        raise typer.Exit(1)


def _folder(given: Path | None, config: Path | None, overrides: list[str] | None) -> Path:
    """The folder that is given, else the configured one, else the default."""
    if given is None:
        with checked():
            given = address_of(config, overrides).network.security.folder or DEFAULT
    return given.expanduser().absolute()
