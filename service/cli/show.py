"""`aeroloop show`: prints the configuration and what is derived from it."""

from __future__ import annotations

import inspect
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from aeroloop.service.cli.common import Config, Force, Overrides, checked, fail, load_for_loop, load_settings

if TYPE_CHECKING:
    from aeroloop.service.config import Settings

EXAMPLES = Path(__file__).parent.parent / "examples"
ALERTS = Path(__file__).parent.parent / "host" / "alerts.yml"

group = typer.Typer()


@group.command("config")
def show_config(
    check: Annotated[
        bool, typer.Option("--check", help="Print only what is wrong, and exit with 2 if its loop cannot begin.")
    ] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Print the configuration as TOML, with comments. Each key has what it means, its unit and its bounds."""
    from aeroloop.protocol.plugins import PluginError
    from aeroloop.service.config import with_law_settings

    if check:
        _check(load_for_loop(config, overrides))
        return
    settings = load_settings(config, overrides)
    with suppress(PluginError):  # a class that is not on this host: its keys as they are written
        settings = with_law_settings(settings)
    typer.echo(settings.toml(comments=True), nl=False)


def _check(settings: Settings) -> None:
    """Make what the configured processes begin with; what does not fit ends the command."""
    from aeroloop.service.control.controller import Controller

    with checked():
        Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        if settings.plant.via == "emulator":
            plant, loop = settings.plant, settings.loop
            plant.endpoint(plant.make(loop.period), loop, settings.wire).plant.close()


@group.command()
def api() -> None:
    """List the names of the Python package, with arguments or fields."""
    from aeroloop import research

    for name in research.__all__:
        value = getattr(research, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            sentence = (inspect.getdoc(value) or "").partition("\n")[0]
            typer.echo(f"{name}{_signature(value)}\n    {sentence}")
        else:
            typer.echo(f"{name}\n    A type, for the fields of a law's settings.")


def _signature(value: Any) -> str:
    """Arguments of a function or a class; of a model or a named tuple its fields."""
    if fields := getattr(value, "model_fields", None) or getattr(value, "_fields", None):
        return f"({', '.join(fields)})"
    try:
        return str(inspect.signature(value)).replace("'", "").removesuffix(" -> None")
    except ValueError:  # of a built-in base
        return ""


@group.command()
def spec(config: Config = None, overrides: Overrides = None) -> None:
    """Print the configured wire: frames, widths and quantizer steps."""
    from aeroloop.service.terminal.sheets import wire_sheets
    from aeroloop.service.terminal.show import show_all

    show_all(wire_sheets(load_settings(config, overrides).wire))


@group.command()
def dbc(config: Config = None, overrides: Overrides = None) -> None:
    """Print the DBC file of the configured wire and CAN node."""
    settings = load_settings(config, overrides)

    from aeroloop.service.viewers.dbc import dbc as describe

    with checked():
        text = describe(settings.wire, settings.can.node, settings.loop.period_ns)
    typer.echo(text, nl=False)


@group.command("c")
def show_c(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write to; made if need be.")],
    force: Force = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Write the controller and a plant's node as C99. With a Makefile and golden commands."""
    settings = load_for_loop(config, overrides)

    from aeroloop.service.firmware.export import export
    from aeroloop.service.logs.outputs import writing_into

    with checked(), writing_into(folder, force=force) as new:
        files = export(settings, new)
    typer.echo(f"wrote {len(files)} files to {folder}; `make -C {folder} test` computes the golden commands there")


@group.command()
def fmu(
    which: Annotated[Literal["aero", "law"], typer.Argument(help="The emulated plant, or the law.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.fmu", help="The new file.")],
    force: Force = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Write the emulated plant or the law as an FMU. For co-simulation by FMI 2.0; the law with both quantizers."""
    settings = load_for_loop(config, overrides)

    from aeroloop.service.firmware.fmu import write_fmu
    from aeroloop.service.logs.outputs import writing

    with checked(), writing(out, force=force) as new:
        write_fmu(settings, which, new)
    typer.echo(f"wrote {out}; it steps by {settings.loop.period:g} s")


@group.command()
def layout(config: Config = None, overrides: Overrides = None) -> None:
    """Print a layout for Foxglove or Lichtblick. It shows a log or `log live`."""
    settings = load_settings(config, overrides)

    from aeroloop.service.viewers.schemas import layout as describe

    typer.echo(describe(settings.vehicle, settings.wire.motors))


@group.command()
def alerts() -> None:
    """Print rules of Prometheus for what `op metrics` serves."""
    typer.echo(ALERTS.read_text(encoding="utf-8"), nl=False)


@group.command()
def examples(
    name: Annotated[str | None, typer.Argument(help="Example to print; all are listed if left out.")] = None,
) -> None:
    """List the example configurations and programs, or print one."""
    files = sorted(file for file in EXAMPLES.glob("*.*") if file.suffix != ".pyc" and file.name != "__init__.py")
    texts = {file.name.removesuffix(".toml"): file.read_text(encoding="utf-8") for file in files}
    if name is None:
        for file, text in texts.items():
            comment = " ".join(line[2:] for line in text.split("\n\n")[0].splitlines() if line.startswith("# "))
            docstring = text.removeprefix('"""').splitlines()[0].removesuffix('"""')
            typer.echo(f"{file:20}  {comment or docstring}")
    elif (known := name.removesuffix(".toml")) in texts:
        typer.echo(texts[known], nl=False)
    else:
        fail(f"no example {name!r}; choose from {', '.join(texts)}", 2)
