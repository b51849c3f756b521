"""Entry point of the command `aeroloop`: groups of verbs, one-line errors, exit codes.

Output is for a person; `--json` is for a program. An error is one line on stderr, with exit code 2 for usage and
configuration, 1 for a failed run, 130 for ^C.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final

import typer
from typer.exceptions import TyperException

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.cli import host, lab, log, op, run, show
from aeroloop.service.cli.common import report, state
from aeroloop.service.cli.entry import INTERRUPTED

_EXTRAS: Final = {
    **dict.fromkeys(("can", "cantools"), "can"),
    **dict.fromkeys(("jinja2", "matplotlib", "plotly"), "review"),
    **dict.fromkeys(("pyarrow", "scipy"), "export"),
    "distributed": "dask",
    "foxglove": "foxglove",
    "websockets": "console",
    "prometheus_client": "metrics",
}
"""Modules that the core installs without, and the extra that brings each."""

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    help="Adaptive attitude control over Zenoh, in frames whose every bit is a quantizer's bit.",
)
app.add_typer(run.group)
for _name, _group, _help in (
    ("lab", lab.group, "Experiments, sweeps, tuning and certificates, in lockstep."),
    ("log", log.group, "Review, compare, replay, check, step through, fork, copy and export logs."),
    ("op", op.group, "Operate running roles over the network."),
    ("host", host.group, "Check this machine, install its daemons, make its keys."),
    ("show", show.group, "Print the configuration, the wire, a layout, examples."),
):
    app.add_typer(_group, name=_name, help=_help, no_args_is_help=True)


def execute(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code. Any error is one line on stderr."""
    state["debug"] = False
    try:
        return app(list(arguments), prog_name="aeroloop", standalone_mode=False) or 0
    except TyperException as error:
        message, context = error.format_message(), getattr(error, "ctx", None)
        if message.startswith("Usage: "):  # help, where no verb was given
            typer.echo(message, err=True)
        else:
            possibilities = getattr(error, "possibilities", None)
            if possibilities:  # of an unknown option those that are only faintly like it, too
                from aeroloop.protocol.wording import closest

                near = closest(getattr(error, "option_name", ""), possibilities)
                message = error.message + (f": did you mean {near}?" if near else "")
            hint = f" (see `{context.command_path} --help`)" if context else ""
            report(" ".join(message.split()).rstrip(".") + hint)
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except Exception as error:
        if state["debug"]:
            raise
        if isinstance(error, AeroloopError | ValueError):
            report(str(error).splitlines()[0])
            return getattr(error, "exit_code", 1)
        if isinstance(error, ModuleNotFoundError) and (extra := _EXTRAS.get((error.name or "").partition(".")[0])):
            report(f"this needs {error.name}, which is not installed: pip install 'aeroloop[{extra}]'")
        else:
            text = f"{type(error).__name__}: {error}".splitlines()[0]
            report(f"unexpected {text}; `aeroloop --debug …` shows where")
        return 1


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
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[  # noqa: ARG001  # its callback prints and ends
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    state["debug"] = debug
