"""Plug-ins: classes that the configuration names, ours by a short name, a user's as `package.module:Class`.

A module is looked for where Python looks, and in the current folder. Importing it runs its code, so a class is only
looked up by a process that uses it, and only if its module is trusted: ours, imported already, installed beside
aeroloop, or named by the user (`vouch_for`) in the configuration, by `--set` or by `--law`. What only a log names, or a
description from the network, is imported within `trusting` alone: `--trust-law`.
"""

from __future__ import annotations

import site
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from hashlib import sha256
from importlib import import_module
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from inspect import getsourcefile, getsourcelines
from pathlib import Path
from sysconfig import get_path
from traceback import extract_tb
from typing import Any, Final, TypeVar

from aeroloop.protocol.errors import ConfigError

T = TypeVar("T")

_OURS: Final = tuple(str(Path(__file__).parents[1] / name) for name in ("protocol", "plant_emulator", "service"))
"""Folders of this package's code. In a clone tests and a user's files lie beside them."""
_PACKAGES: Final = {"site-packages", "dist-packages"}


class PluginError(ConfigError):
    """A class that is not there, is of another kind, or failed; one line with its name."""


class UntrustedError(PluginError):
    """A class whose module is not trusted, and so not imported."""


_named: set[str] = set()
_trusts_all: ContextVar[bool] = ContextVar("trusts_all", default=False)


def vouch_for(*words: str) -> None:
    """The user has named these classes, or files of code: this process may run them."""
    _named.update(words)


def vouched_for() -> frozenset[str]:
    """All that the user has named in this process."""
    return frozenset(_named)


@contextmanager
def trusting(everything: bool = True) -> Iterator[None]:
    """Import whatever a log names while this lasts, if `everything`: `--trust-law`."""
    token = _trusts_all.set(everything or _trusts_all.get())
    try:
        yield
    finally:
        _trusts_all.reset(token)


def check_named(key: str, what: str) -> None:
    """Raise UntrustedError unless the user has named this, such as the file of an FMU, whose binary code would run."""
    if not (_trusts_all.get() or what in _named):
        raise UntrustedError(f"{key} = {what!r} is not run, as only a log names it: give --trust-law, which does")


def is_trusted(kind: str) -> bool:
    """Whether `module:Class` may be imported. This imports nothing."""
    module = kind.partition(":")[0]
    return _trusts_all.get() or kind in _named or module in sys.modules or _is_installed(module.partition(".")[0])


def _is_installed(package: str) -> bool:
    """Whether a top-level package is ours, or in a folder into which packages are installed."""
    if package == __name__.partition(".")[0]:
        return True
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):
        return False
    if spec is None:
        return False
    places = [Path(place).parent for place in spec.submodule_search_locations or ()]
    if not places and spec.origin is not None:
        places = [Path(spec.origin).parent]
    folders = {Path(folder) for folder in (get_path("purelib"), get_path("platlib"), *site.getsitepackages())}
    if site.ENABLE_USER_SITE:
        folders.add(Path(site.getusersitepackages()))
    return bool(places) and all(place in folders for place in places)


def find(key: str, kind: str, built_in: Mapping[str, str], base: type[T]) -> type[T]:
    """The class, derived from `base`, that `kind` names: one of ours, or `module:Class`.

    `key` is the configuration's key that holds it, such as `law.kind`, for messages. Raises UntrustedError if its
    module is not trusted, PluginError if there is no such class, its module fails, or it does not derive from `base`.
    """
    given = f"{key} = {kind!r}"
    module_name, _, name = built_in.get(kind, kind).partition(":")
    if not (module_name and name):
        raise PluginError(f"{given} is not known: it is one of {', '.join(sorted(built_in))}, or package.module:Class")
    if kind not in built_in and not is_trusted(kind):
        remedy = f"give --trust-law, which runs its code (in Python, import {module_name} first)"
        raise UntrustedError(f"{given} is not imported, as only a log names it: {remedy}")
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
    ours = (*_OURS, "<frozen", get_path("stdlib"))
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
