"""Sources of the configuration: `--set`, the environment and a TOML file, the stronger first, as one tree.

`Target` is all that a command of `aeroloop op` reads of it.
"""

from __future__ import annotations

import logging
import os
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeVar

from pydantic import BaseModel, Field, StringConstraints, ValidationError, model_validator

from aeroloop.protocol.errors import ConfigError as ConfigError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wording import SHOWN, closest, keys, problems

log: Final = logging.getLogger("aeroloop")

ModelT = TypeVar("ModelT", bound=BaseModel)

ENV_PREFIX: Final = "AEROLOOP_"
"""Every variable of the environment that begins with it is a key: `AEROLOOP_LOOP__RATE_HZ` is `loop.rate_hz`."""

BODY: Final = ("inertia", "mass", "gravity", "centre_of_mass", "allocation")
"""The model of the plant in `[law]`, which all laws have."""

MAX_DEPTH: Final = 32
"""Sections and lists within each other, more than any setting needs."""

_TOO_DEEP: Final = f"nested too deeply, more than {MAX_DEPTH} sections or lists within each other"

_FREE: Final = ("can.options.", "plant.own.", "law.")
"""Sections in which any key may be given: a user's, or another library's."""

OTHER_SECTIONS: Final = ("loop", "wire", "reference", "law", "controller", "plant", "can", "recorder")
"""Those that `Target` leaves out."""

_KINDS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {"reference": ("sinusoid", ()), "law": ("adaptive", BODY)}
"""Sections of several kinds: the kind where none is named, and keys that all kinds have."""


class Target(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """Name of a vehicle, and the network on which it is."""

    vehicle: Annotated[str, StringConstraints(pattern=f"^{topics.NAME}$")] = Field(
        default="aero", description="name of the vehicle, one chunk of every key"
    )
    network: NetworkSettings = Field(
        default=NetworkSettings(), description="Zenoh endpoints of this process and of others"
    )

    @model_validator(mode="after")
    def _messages_of_its_own_vehicle_are_taken(self) -> Self:
        """Name the vehicle among those whose peers have rights, wherever certificates give them."""
        security = self.network.security
        if security.directory and self.vehicle not in security.vehicles:
            named = security.model_copy(update={"vehicles": [self.vehicle, *security.vehicles]})
            self.network = self.network.model_copy(update={"security": named})
        return self


Warn = Callable[[str], object]
"""Takes one line about what is left unread."""


def read_sources(
    file: Path | None,
    overrides: Iterable[str],
    known: Collection[str],
    unread: Collection[str] = (),
    warn: Warn | None = None,
) -> dict[str, Any]:
    """The tree of all sources; `known` are the keys that there are, but for those of the sections `unread`.

    With `warn`, a variable of the environment that is like no key that there is only gets a warning.

    Raises:
        ConfigError: A source cannot be read, or a variable of the environment is no key.
    """
    tree = _file(file) if file is not None else {}
    for words in (_environment(known, unread, warn), overrides):
        tree = merged(tree, tree_of(words))
    return tree


def _file(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ConfigError(f"no configuration file at {path}")
    try:
        tree = _parsed(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not TOML: {error}") from None
    reference = tree.get("reference")
    if isinstance(reference, dict) and isinstance(reference.get("path"), str):
        reference["path"] = str(path.parent / reference["path"])
    return tree


def _parsed(text: str, source: str) -> dict[str, Any]:
    """TOML as a tree. Raises ConfigError, which names the source, where it is nested too deeply to be walked through.

    Raises tomllib.TOMLDecodeError if it is not TOML.
    """
    try:
        tree = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{source}: {_TOO_DEEP}") from None
    layer: list[Any] = [tree]
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for node in layer:
            if isinstance(node, dict):
                below += node.values()
            elif isinstance(node, list):
                below += node
        layer = below
    if layer:
        raise ConfigError(f"{source}: {_TOO_DEEP}")
    return tree


def _environment(known: Collection[str], unread: Collection[str], warn: Warn | None) -> Iterator[str]:
    """Variables of the environment as words of `--set`, each key as its model writes it. Raises ConfigError."""
    written = {key.upper(): key for key in known}
    for name, text in os.environ.items():
        if not name.upper().startswith(ENV_PREFIX):
            continue
        given = name[len(ENV_PREFIX) :].replace("__", ".")
        key = written.get(given.upper())
        if key is None:
            key = given.lower() if given.isupper() else given
            section = closest(key.partition(".")[0], {*known, *unread})
            if section not in unread and not key.lower().startswith(_FREE):
                near = closest(key, known)
                variable = ENV_PREFIX + (near or "").upper().replace(".", "__")
                hint = f"did you mean {variable}?" if near else "unset it, or see `aeroloop show config`"
                problem = f"{name} in the environment is no setting: {hint}"
                if warn is None or section or _may_be_meant_as(key, known):
                    raise ConfigError(problem)
                warn(problem)
                continue
        yield f"{key}={text}"


def _may_be_meant_as(name: str, known: Collection[str]) -> bool:
    """Whether an unknown name is like one of the known keys, or is the last part of one: `rendezvous`."""
    last_parts = {key.rpartition(".")[2].lower() for key in known}
    return closest(name, known) is not None or name.lower() in last_parts


def tree_of(overrides: Iterable[str]) -> dict[str, Any]:
    """The tree of `section.key=value` words, values as TOML writes them. Raises ConfigError."""
    tree: dict[str, Any] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set takes section.key=value, not {override!r}")
        if key.count(".") >= MAX_DEPTH:
            raise ConfigError(f"--set {key[:SHOWN]}…: {_TOO_DEEP}")
        value: Any = text.strip()
        with suppress(tomllib.TOMLDecodeError):  # else a string without quotes
            value = _parsed(f"value = {value}", f"--set {key[:SHOWN]}")["value"]
        for name in reversed(key.strip().split(".")):
            value = {name: value}
        tree = merged(tree, value, one_source=True)
    return tree


def merged(weaker: dict[str, Any], stronger: dict[str, Any], *, one_source: bool = False) -> dict[str, Any]:
    """Two trees as one. A law or a reference of another kind replaces the weaker one; a law keeps the body.

    Of `one_source` nothing is weaker: a law's keys hold whether they stand before or after its kind.
    """
    tree = weaker | stronger
    for name in weaker.keys() & stronger.keys():
        old, new = weaker[name], stronger[name]
        if isinstance(old, dict) and isinstance(new, dict):
            default, kept = _KINDS.get(name, (None, ()))
            another_kind = "kind" in new and new["kind"] != old.get("kind", default)
            if default and another_kind and not one_source:
                old = {key: old[key] for key in kept if key in old}
            tree[name] = merged(old, new, one_source=one_source)
    return tree


def load_target(file: Path | None = None, overrides: Iterable[str] = (), warn: Warn = log.warning) -> Target:
    """Vehicle and network of a configuration; arguments as of `config.load`.

    Nothing else is read: a mistake in another section, or in its name, does not keep `op stop` from a plant, nor does
    an unknown section or variable of the environment: `warn` takes a line about each. What may be meant as vehicle or
    network, as `[netwrok]` is, is refused: a stop must not miss its plant.

    Raises:
        ConfigError: A source cannot be read, or vehicle or network is wrong, or an unknown name is like one of theirs.
    """
    known = keys(Target)
    sections = (*Target.model_fields, *OTHER_SECTIONS)
    read: dict[str, Any] = {}
    for name, content in read_sources(file, overrides, known, OTHER_SECTIONS, warn).items():
        section = closest(name, sections)
        if section in Target.model_fields or _may_be_meant_as(name, known):
            read[name] = content
        elif section is None:
            warn(f"{name} in the configuration is no setting, and is left unread")
    return valid(Target, read)


def valid(
    model: type[ModelT],
    tree: dict[str, Any],
    extra: Literal["ignore"] | None = None,
    context: dict[str, bool] | None = None,
) -> ModelT:
    """A model of a tree. Raises ConfigError, with a line for each mistake."""
    try:
        return model.model_validate(tree, extra=extra, context=context)
    except ValidationError as error:
        raise ConfigError("; ".join(problems(error, model))) from None
