"""`aeroloop show`: prints the configuration and what is derived from it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aeroloop.service.cli.common import Config, Overrides, fail, settings_of

EXAMPLES = Path(__file__).parent.parent / "examples"

group = typer.Typer()


@group.command("config")
def show_config(
    bare: Annotated[bool, typer.Option("--bare", help="Leave out the comments.")] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print the effective configuration as TOML, each key with what it means, its unit and its bounds."""
    typer.echo(settings_of(config, overrides).toml(comments=not bare), nl=False)


@group.command()
def spec(config: Config = None, overrides: Overrides = None) -> None:
    """Print the configured wire: frames, widths and quantizer steps."""
    from aeroloop.service.terminal.wire_table import wire_table

    wire_table(settings_of(config, overrides).wire)


@group.command()
def dbc(config: Config = None, overrides: Overrides = None) -> None:
    """Print the DBC file of the configured wire and CAN node."""
    settings = settings_of(config, overrides)

    from aeroloop.protocol.transport.dbc import dbc as describe

    typer.echo(describe(settings.wire, settings.can.node, settings.loop.period_ns), nl=False)


@group.command()
def layout(
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", metavar="NAME", help="Vehicle to show; the configured one if left out.")
    ] = None,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print a layout file for Foxglove or Lichtblick that shows a log or `log live`."""
    settings = settings_of(config, overrides, *([f'vehicle="{vehicle}"'] if vehicle is not None else []))

    from aeroloop.service.viewers.layout import layout as describe

    typer.echo(describe(settings.vehicle, settings.wire.motors))


@group.command()
def examples(
    name: Annotated[
        str | None, typer.Argument(help="Example to print; all are listed if left out.", show_default=False)
    ] = None,
) -> None:
    """List the example configurations, or print one of them."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(EXAMPLES.glob("*.toml"))}
    if name is None:
        for stem, text in texts.items():
            about = " ".join(line[2:] for line in text.split("\n\n")[0].splitlines() if line.startswith("# "))
            typer.echo(f"{stem:12}  {about}")
    elif name in texts:
        typer.echo(texts[name], nl=False)
    else:
        fail(f"no example {name!r}; choose from {', '.join(texts)}", 2)
