"""`aeroloop host keys`: a private authority, and the certificates of this host's roles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from aeroloop.service.cli.common import Config, Json, Overrides, address_of, checked, guarded

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
    role: Annotated[str, typer.Argument(help="plant, controller, operator, observer, recorder, router.")],
    name: Annotated[str, typer.Argument(help="Host or person that gets it.")],
    vehicle: Annotated[
        str | None,
        typer.Option(help="Its vehicle, which plant and controller need; every vehicle if none.", show_default=False),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="How long the certificate is valid, in days.")] = 90,
    directory: Directory = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Issue a certificate with a new key. 90 days, because none can be revoked: a stolen key is good until then."""
    folder = _folder(directory, config, overrides)
    from aeroloop.service.host import keys

    with guarded():
        typer.echo(keys.issue(folder, role, name, vehicle, days))


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
