"""`aeroloop show`: what would be used."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from service.commands.common import (
    Config,
    Overrides,
    settings_of,
)

if TYPE_CHECKING:
    pass

group = typer.Typer(no_args_is_help=True, help="What would be used.")


@group.command("config")
def show_config(config: Config = None, overrides: Overrides = None) -> None:
    """Print the effective configuration as TOML."""
    typer.echo(settings_of(config, overrides).toml(), nl=False)


@group.command()
def spec(config: Config = None, overrides: Overrides = None) -> None:
    """Print the wire as configured: frames, widths, steps."""
    from service.display import wire_table

    wire_table(settings_of(config, overrides).wire)
