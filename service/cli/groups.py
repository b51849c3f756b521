"""Groups of verbs: a group's module is imported when one of its verbs is looked up, and only that verb is built."""

from __future__ import annotations

from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any

from typer.core import TyperCommand, TyperGroup
from typer.main import get_command_from_info, get_command_name

if TYPE_CHECKING:
    from typer.models import CommandInfo

# Contexts are Any: the class in the signatures of Typer's classes is private.


class Verb(TyperCommand):
    """A command. Its help is that of `terminal/help.py`."""

    def format_help(self, ctx: Any, _: object) -> None:
        """Print its help."""
        from aeroloop.service.terminal.help import print_help

        print_help(self, ctx)


class Group(TyperGroup):
    """A command with the verbs of a module's `group`, and with the groups that are added to it."""

    format_help = Verb.format_help  # type: ignore[assignment]  # of any command

    def __init__(self, *, module: str = "run", **options: Any) -> None:
        super().__init__(**options)
        self._module = module

    @cached_property
    def _verbs(self) -> dict[str, CommandInfo]:
        verbs = import_module(f"{__package__}.{self._module}").group.registered_commands
        for verb in verbs:
            verb.cls = Verb
        return {verb.name or get_command_name(verb.callback.__name__): verb for verb in verbs}

    def get_params(self, ctx: Any) -> list[Any]:
        """Its options, all of them flags. By default False: Typer imports pydantic to check None, its own default."""
        options = super().get_params(ctx)
        for option in options:
            option.default = False
        return options

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of its verbs, in the module's order, and of its groups."""
        return [*self._verbs, *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Its group or verb of a name; None if there is none."""
        found = super().get_command(ctx, cmd_name)
        if found is None and cmd_name in self._verbs:
            return get_command_from_info(self._verbs[cmd_name], pretty_exceptions_short=True, rich_markup_mode=None)
        return found
