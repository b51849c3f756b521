"""The command `aeroloop`: its groups of verbs, and what happens when something goes wrong.

What is printed is for a person; `--json` is for a program. Errors are one line on stderr: exit code 2 for usage and
configuration, 1 for a run that failed, 130 for ^C. The verbs are in `service/cli/`, a module a group.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import typer
from typer.exceptions import TyperException

from aeroloop.service.cli import host, lab, log, op, run, show
from aeroloop.service.cli.common import state

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Adaptive attitude control over Zenoh, in frames whose every bit is a quantizer's bit.",
)
app.add_typer(run.group)
app.add_typer(lab.group, name="lab")
app.add_typer(log.group, name="log")
app.add_typer(op.group, name="op")
app.add_typer(host.group, name="host")
app.add_typer(show.group, name="show")


def main() -> None:
    """Entry point of the command."""
    sys.exit(execute(sys.argv[1:]))


def execute(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code. Whatever goes wrong is one line on stderr."""
    state["debug"] = False
    try:
        return app(list(arguments), prog_name="aeroloop", standalone_mode=False) or 0
    except TyperException as error:
        if message := error.format_message():  # empty where help was printed because nothing was asked
            command = " ".join(["aeroloop", *arguments[:1]])
            typer.echo(f"aeroloop: {message} (`{command} --help` tells more)", err=True)
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        return 130
    except Exception as error:
        if state["debug"]:
            raise
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        typer.echo(f"aeroloop: unexpected {text}; `aeroloop --debug …` shows where", err=True)
        return 1


@app.callback()
def options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Options of every command."""
    state["debug"] = debug


if __name__ == "__main__":
    main()
