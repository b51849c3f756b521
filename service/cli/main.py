"""Entry point of the command `aeroloop`: groups of verbs, one-line errors, exit codes.

Output is for a person; `--json` is for a program. An error is one line on stderr, with exit code 2 for usage and
configuration, 1 for a failed run, 130 for ^C.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from itertools import takewhile
from typing import Annotated, Final, cast

import typer.main
from typer.exceptions import TyperException

from aeroloop.service.cli.common import logged_as, report, state
from aeroloop.service.cli.entry import INTERRUPTED
from aeroloop.service.cli.groups import Group

_GROUPS: Final = {
    "lab": "Experiments, tables, calibration and certificates, in lockstep.",
    "log": "Review, compare, replay, recover and export logs; view a live loop.",
    "op": "Operate running roles over the network.",
    "host": "Check this machine, install its daemons, make its keys.",
    "show": "Print the configuration, the wire, a DBC file, a layout, examples.",
}
"""Modules of verbs in this folder, with the help of each. Those of `run` stand beside the groups."""

_KEYS: Final = "Certificates of this host's roles, for mutual TLS between hosts."
"""Help of the group `keys`, which stands in `host`."""

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


def execute(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code. Any error is one line on stderr."""
    state["debug"] = False
    logged_as.clear()
    try:
        return root().main(list(arguments), prog_name="aeroloop", standalone_mode=False) or 0
    except TyperException as error:
        if message := _reason(error):  # empty where no verb was given and help was printed
            context = getattr(error, "ctx", None)
            words = takewhile(lambda word: not word.startswith("-"), arguments[:2])
            command = context.command_path if context else " ".join(["aeroloop", *words])
            typer.echo(f"aeroloop: {message.rstrip('.')}{_alike(error)} (see `{command} --help`)", err=True)
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except Exception as error:
        if state["debug"]:
            raise
        if isinstance(error, ModuleNotFoundError) and (missing := _EXTRAS.get((error.name or "").partition(".")[0])):
            package, extra = missing
            typer.echo(
                f"aeroloop: this needs {package}, which is not installed: pip install 'aeroloop[{extra}]'", err=True
            )
            return 1
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        report(f"unexpected {text}; `aeroloop --debug …` shows where")
        return 1


_MUST_BE: Final = {
    "float_parsing": "must be a number",
    "int_parsing": "must be a whole number",
    "greater_than_equal": "must be at least {ge}",
    "less_than_equal": "must be at most {le}",
    "value_error": "{error}",
}
"""By the type of pydantic's errors, what the value of an option or an argument must be."""


def _reason(error: TyperException) -> str:
    """What is wrong with a command line: pydantic's and Typer's own words are for programmers."""
    if alike := getattr(error, "possibilities", None):
        return f"No such option: {getattr(error, 'option_name', '')}; did you mean {' or '.join(sorted(alike))}?"
    parameter, cause = getattr(error, "param", None), error.__cause__
    if parameter is not None and cause is not None:
        from pydantic_core import ValidationError

        found = cause.errors()[0] if isinstance(cause, ValidationError) else None
        if found and (text := _MUST_BE.get(found["type"])):
            name = parameter.opts[0] if parameter.opts else parameter.name
            given = "" if found["type"] == "value_error" else f", not {found['input']!r}"
            joint = ":" if found["type"] == "value_error" else ""
            return f"{name}{joint} {text.format(**found.get('ctx', {}))}{given}"
    return error.format_message()


def _alike(error: TyperException) -> str:
    """The commands that an unknown verb may stand for, in its own group if any is there, else in another."""
    context = getattr(error, "ctx", None)
    if context is None or not error.message.startswith("No such command"):
        return ""
    top = context.find_root().command
    groups = {name: top.get_command(context, name).list_commands(context) for name in _GROUPS}
    paths = [*top.list_commands(context), *(f"{name} {verb}" for name, verbs in groups.items() for verb in verbs)]
    wrong, verbs = error.message.split("'")[1], {path.split()[-1] for path in paths}
    alike = [wrong] if wrong in verbs else get_close_matches(wrong, verbs)
    found = [f"aeroloop {path}" for path in paths if path.split()[-1] in alike]
    own = [command for command in found if command.rpartition(" ")[0] == context.command_path]
    return f"; did you mean `{'` or `'.join(own or found)}`?" if found else ""


def _print_version(requested: bool) -> None:
    if requested:
        from aeroloop.protocol.messages.models import PROTOCOL_VERSION
        from aeroloop.protocol.runtime.host import versions

        found = versions()
        revision = f" (revision {found['revision']})" if "revision" in found else ""
        typer.echo(f"aeroloop {found['aeroloop']}{revision}, protocol and log schema {PROTOCOL_VERSION}")
        raise typer.Exit(0)


def root() -> Group:
    """The command `aeroloop`, with its options, groups and verbs."""
    app = typer.Typer(
        cls=Group,
        no_args_is_help=True,
        suggest_commands=False,  # `_alike` does, across groups
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Adaptive attitude control over Zenoh, in frames whose every bit is a quantizer's bit.",
    )
    app.callback()(_options)
    command = cast(Group, typer.main.get_command(app))
    groups = {
        name: Group(name=name, module=name, help=text, no_args_is_help=True, suggest_commands=False)
        for name, text in (*_GROUPS.items(), ("keys", _KEYS))
    }
    groups["host"].add_command(groups.pop("keys"))
    for group in groups.values():
        command.add_command(group)
    return command


def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[  # noqa: ARG001  # its callback prints and ends
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    """Options of every command."""
    state["debug"] = debug
