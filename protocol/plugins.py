"""Plug-ins: classes that the configuration names, ours by a short name, a user's as `package.module:Class`.

A module is looked for where Python looks, and in the current folder. Importing it runs its code, so a class is only
looked up by a process that uses it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from hashlib import sha256
from importlib import import_module
from importlib.metadata import packages_distributions, version
from inspect import getsourcefile, getsourcelines
from pathlib import Path
from sysconfig import get_path
from traceback import extract_tb
from typing import Any, Final, TypeVar

from aeroloop.protocol.errors import AeroloopError

T = TypeVar("T")

_HERE: Final = str(Path(__file__).parent.parent)
_PACKAGES: Final = {"site-packages", "dist-packages"}


class PluginError(AeroloopError):
    """A class that is not there, is of another kind, or failed; one line with its name."""


def find(key: str, kind: str, built_in: Mapping[str, str], base: type[T]) -> type[T]:
    """The class, derived from `base`, that `kind` names: one of ours, or `module:Class`.

    `key` is the configuration's key that holds it, such as `law.kind`, for messages. Raises PluginError if there is no
    such class, its module fails, or it does not derive from `base`.
    """
    given = f"{key} = {kind!r}"
    module_name, _, name = built_in.get(kind, kind).partition(":")
    if not (module_name and name):
        raise PluginError(f"{given} is not known: it is one of {', '.join(sorted(built_in))}, or package.module:Class")
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        remedy = "install it, or add its folder to PYTHONPATH"
        raise PluginError(f"{given}: there is no module {error.name} here; {remedy}") from None
    except Exception as error:
        raise PluginError(f"{given}: its module raised {exception_line(error)}") from None
    found = vars(module).get(name)
    if isinstance(found, type) and issubclass(found, base):
        return found
    if found is not None:
        raise PluginError(f"{given} does not derive from aeroloop.{base.__name__}{place_of(found)}")
    own = [each for each in vars(module).values() if isinstance(each, type) and each.__module__ == module_name]
    names = ", ".join(each.__name__ for each in own if issubclass(each, base)) or "none"
    raise PluginError(f"{given}: {module_name} has no {name}; its classes of aeroloop.{base.__name__} are {names}")


def source_of(plugin: type[Any]) -> str:
    """Which source a class is of: its file and the file's SHA-256, and its distribution's version if it has one."""
    file = getattr(sys.modules[plugin.__module__], "__file__", None)
    named = [f"{Path(file).name} sha256:{sha256(Path(file).read_bytes()).hexdigest()[:16]}"] if file else []
    distributions = packages_distributions().get(plugin.__module__.partition(".")[0], [])
    return ", ".join(named + [f"{name} {version(name)}" for name in distributions]) or "unknown"


def exception_line(error: BaseException, called: Any = None) -> str:
    """An exception from a user's code in one line: class, text, and where it is from.

    That is the innermost line outside of this package and of installed ones, such as CasADi; where there is none, as
    where a result is refused, the first line of `called`, the user's function or class.
    """
    text = " ".join(str(error).split())
    line = f"{type(error).__name__}: {text}" if text else type(error).__name__
    ours = _HERE, "<frozen", get_path("stdlib")
    files = [(Path(frame.filename), frame.lineno) for frame in extract_tb(error.__traceback__)]
    theirs = [(file, line) for file, line in files if not str(file).startswith(ours) and not _PACKAGES & {*file.parts}]
    return line + (f" ({theirs[-1][0].name}, line {theirs[-1][1]})" if theirs else place_of(called))


def place_of(called: Any) -> str:
    """Where a function or class is defined, in brackets after a space; nothing where no source is known."""
    try:
        file, (_, line) = getsourcefile(called), getsourcelines(called)
    except (OSError, TypeError):
        return ""
    return f" ({Path(file).name}, line {line})" if file else ""
