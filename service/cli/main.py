"""Entry point of the command `aeroloop`: groups of verbs, one-line errors, exit codes.

Output is for a person; `--json` is for a program. An error is one line on stderr, with exit code 2 for usage and
configuration, 1 for a failed run, 130 for ^C.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import Annotated, Final, Literal

import typer
from typer.exceptions import TyperException

from aeroloop.service.cli import host, lab, log, op, run, show
from aeroloop.service.cli.common import logged_as, report, state
from aeroloop.service.cli.entry import DAEMONS, INTERRUPTED
from aeroloop.service.cli.processes import log_as

_GROUPS: Final = {
    "lab": (lab.group, "Experiments, sweeps, tuning and certificates, in lockstep."),
    "log": (log.group, "Review, compare, replay, recover and export logs."),
    "op": (op.group, "Operate running roles over the network."),
    "host": (host.group, "Check this machine, install its daemons, make its keys."),
    "show": (show.group, "Print the configuration, the wire, a layout, examples."),
}

_EXTRAS: Final = {
    "can": ("python-can", "can"),
    "cantools": ("cantools", "can"),
    "distributed": ("distributed", "dask"),
    "foxglove": ("foxglove-sdk", "foxglove"),
    "jinja2": ("Jinja2", "review"),
    "matplotlib": ("matplotlib", "review"),
    "plotly": ("plotly", "review"),
    "pyarrow": ("pyarrow", "export"),
    "scipy": ("scipy", "export"),
}
"""Modules that the core installs without: the package, and the extra that brings it."""

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    help="Adaptive attitude control over Zenoh, in frames whose every bit is a quantizer's bit.",
)
app.add_typer(run.group)
for _name, (_group, _help) in _GROUPS.items():
    app.add_typer(_group, name=_name, help=_help, no_args_is_help=True)


def execute(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code. Any error is one line on stderr."""
    state["debug"] = False
    logged_as.clear()
    try:
        return app(list(arguments), prog_name="aeroloop", standalone_mode=False) or 0
    except TyperException as error:
        message, context = error.format_message(), getattr(error, "ctx", None)
        if message.startswith("Usage: "):  # help, where no verb was given
            typer.echo(message, err=True)
        else:
            words = takewhile(lambda word: not word.startswith("-"), arguments[:2])
            command = context.command_path if context else " ".join(["aeroloop", *words])
            typer.echo(f"aeroloop: {_words(message)} (see `{command} --help`)", err=True)
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except Exception as error:
        if state["debug"]:
            raise
        if isinstance(error, ModuleNotFoundError) and (missing := _EXTRAS.get((error.name or "").partition(".")[0])):
            package, extra = missing
            report(f"this needs {package}, which is not installed: pip install 'aeroloop[{extra}]'")
        else:
            text = f"{type(error).__name__}: {error}".splitlines()[0]
            report(f"unexpected {text}; `aeroloop --debug …` shows where")
        return 1


def _words(message: str) -> str:
    """What is wrong with a command line, in one line; a verb without its group is found: `aeroloop op stop`."""
    if message.startswith("No such command"):
        verb = message.split("'")[1]
        paths = [
            f"`aeroloop {name} {verb}`"
            for name, (group, _) in _GROUPS.items()
            for each in group.registered_commands
            if verb == (each.name or getattr(each.callback, "__name__", None))
        ]
        if paths:
            return f"No such command '{verb}'; did you mean {' or '.join(paths)}?"
    return " ".join(message.split()).rstrip(".")


def _print_version(requested: bool) -> None:
    if requested:
        from aeroloop.protocol.messages.models import PROTOCOL_VERSION
        from aeroloop.protocol.runtime.host import versions

        found = versions()
        revision = f" (revision {found['revision']})" if "revision" in found else ""
        typer.echo(f"aeroloop {found['aeroloop']}{revision}, protocol and log schema {PROTOCOL_VERSION}")
        raise typer.Exit(0)


@app.callback()
def _options(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    log_format: Annotated[
        Literal["text", "json"], typer.Option("--log-format", help="Format of a daemon's log lines on stderr.")
    ] = "text",
    version: Annotated[  # noqa: ARG001  # its callback prints and ends
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    state["debug"] = debug
    if role := DAEMONS.get(context.invoked_subcommand or ""):
        log_as(role, as_json=log_format == "json")
