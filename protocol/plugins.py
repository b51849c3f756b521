"""Plug-ins: classes that the configuration names, ours by a short name, a user's as `package.module:Class`.

A short name is one of ours or an entry point of the group, such as `aeroloop.laws`. A module is looked for where Python
looks, and in the current folder. Importing it runs its code, so a class is only looked up by a process that uses it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from hashlib import sha256
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points, packages_distributions, version
from pathlib import Path
from traceback import extract_tb
from typing import Any, Final, TypeVar

from aeroloop.protocol.errors import AeroloopError

T = TypeVar("T")

_HERE: Final = str(Path(__file__).parent.parent)


class PluginError(AeroloopError):
    """A class that is not there, is of another kind, or failed; one line with its name."""


def find(key: str, kind: str, group: str, built_in: Mapping[str, str], base: type[T]) -> type[T]:
    """The class that `kind` names.

    Args:
        key: The configuration's key that holds it, such as `law.kind`, for messages.
        kind: One of ours, an entry point's name, or `package.module:Class`.
        group: The entry points' group.
        built_in: Ours, each as `package.module:Class`, by name.
        base: What the class must derive from.

    Raises:
        PluginError: There is no such class, its module fails, or it does not derive from `base`.
    """
    said = f"{key} = {kind!r}"
    target = built_in.get(kind, kind)
    if ":" not in target:
        installed = {point.name: point for point in entry_points(group=group)}
        if kind not in installed:
            known = ", ".join(sorted({*built_in, *installed}))
            raise PluginError(f"{said} is not known: it is one of {known}, or package.module:Class")
        target = installed[kind].value
    point = EntryPoint(kind, target, group)
    if not EntryPoint.pattern.match(target) or not (point.module and point.attr):
        raise PluginError(f"{said} does not name a class: write package.module:Class")
    found = _loaded(said, point)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise PluginError(f"{said} does not derive from aeroloop.{base.__name__}")
    return found


def _loaded(said: str, point: EntryPoint) -> Any:
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        module: Any = import_module(point.module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{point.module}.".startswith(f"{error.name}."):
            raise PluginError(f"{said} needs the module {error.name}, which is not installed here") from None
        raise PluginError(
            f"{said}: there is no module {point.module} here; install it, or add its folder to PYTHONPATH"
        ) from None
    except Exception as error:
        raise PluginError(f"{said}: its module raised {own_words(error)}") from None
    try:
        return point.load()
    except AttributeError:
        classes = ", ".join(name for name, value in vars(module).items() if isinstance(value, type))
        raise PluginError(f"{said}: {point.module} has no {point.attr}; its classes are {classes or 'none'}") from None


def source_of(plugin: type[Any]) -> str:
    """Which source a class is of: its file and the file's SHA-256, and its distribution's version if it has one."""
    module = sys.modules[plugin.__module__]
    file = getattr(module, "__file__", None)
    named = [f"{Path(file).name} sha256:{sha256(Path(file).read_bytes()).hexdigest()[:16]}"] if file else []
    for name in packages_distributions().get(plugin.__module__.partition(".")[0], []):
        named.append(f"{name} {version(name)}")
    return ", ".join(named) or "unknown"


def own_words(error: BaseException) -> str:
    """An exception from a user's code in one line: class, text, and the innermost line that is not ours."""
    text = " ".join(str(error).split())
    said = f"{type(error).__name__}: {text}" if text else type(error).__name__
    frames = [frame for frame in extract_tb(error.__traceback__) if not frame.filename.startswith((_HERE, "<frozen"))]
    if isinstance(error, SyntaxError) and error.filename:
        return f"{type(error).__name__}: {error.msg} ({Path(error.filename).name}, line {error.lineno})"
    return f"{said} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else said
