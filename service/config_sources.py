"""Sources of the configuration: a TOML file, the environment and `--set`, each as a tree of sections and keys.

`Target` is all that a command of `aeroloop op` reads of them.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, Field, StringConstraints, ValidationError, create_model, model_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wording import closest, keys, problems

ENV_PREFIX: Final = "AEROLOOP_"
"""Every variable of the environment that begins with it is a key: `AEROLOOP_LOOP__RATE_HZ` is `loop.rate_hz`."""

BODY: Final = ("inertia", "mass", "gravity", "centre_of_mass", "allocation")
"""The model of the plant in `[law]`, which all laws have."""

UNREAD: Final = ("loop", "wire", "reference", "law", "controller", "plant", "can", "recorder")
"""Sections that a `Target` does not read."""

_FREE: Final = ("can.options.", "plant.own.", "law.")
"""Sections in which any key may be given: a user's, or another library's."""


class ConfigError(AeroloopError):
    """The configuration is wrong; one line with the key and its allowed values."""


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


def sources(
    file: Path | None, overrides: Sequence[str], model: type[BaseModel], unread: Collection[str] = ()
) -> Iterator[dict[str, Any]]:
    """What is configured, as a tree for each source; a later one replaces values of an earlier one.

    Args:
        file: A TOML file, or None.
        overrides: `section.key=value`, values as TOML writes them (quotes may be left out).
        model: Has the keys that the environment may give.
        unread: Sections of which the environment's variables are not read.

    Raises:
        ConfigError: A source cannot be read, or the environment gives a key that the model does not have.
    """
    if file is not None:
        yield _read(file)
    yield tree_of(_environment(model, unread))
    yield tree_of(overrides)


def tree_of(overrides: Iterable[str]) -> dict[str, Any]:
    """The tree of `section.key=value` overrides. Raises ConfigError."""
    tree: dict[str, Any] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set takes section.key=value, not {override!r}")
        _put(tree, key.strip(), _value(text.strip()))
    return tree


def merge(tree: dict[str, Any], changes: dict[str, Any]) -> None:
    """Put the values of one tree into another. A reference or a law of another kind replaces the one that is there."""
    for name, value in changes.items():
        present: Any = tree.get(name)
        if not (isinstance(value, dict) and isinstance(present, dict)):
            tree[name] = value
        elif name in ("reference", "law") and value.get("kind", present.get("kind")) != present.get("kind"):
            kept = BODY if name == "law" else ()  # another kind has other keys; all laws have the body
            tree[name] = {key: present[key] for key in kept if key in present} | value
        else:
            merge(present, value)


def _read(file: Path) -> dict[str, Any]:
    try:
        tree = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"no configuration file at {file}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read {file}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{file} is not TOML: {error}") from None
    reference = tree.get("reference")
    if isinstance(reference, dict) and isinstance(reference.get("path"), str):
        reference["path"] = str(file.parent / reference["path"])
    return tree


def _environment(model: type[BaseModel], unread: Collection[str]) -> Iterator[str]:
    """Variables of the environment as overrides, without those of the sections that are not read."""
    given = {name: text for name, text in os.environ.items() if name.upper().startswith(ENV_PREFIX)}
    known = {key.upper(): key for key in keys(model)} if given else {}
    for name, text in sorted(given.items()):
        key = name[len(ENV_PREFIX) :].replace("__", ".")
        if key.lower().partition(".")[0] in unread:
            continue
        if key.upper() in known:
            key = known[key.upper()]
        elif free := next((section for section in _FREE if key.lower().startswith(section)), None):
            rest = key[len(free) :]
            key = free + (rest.lower() if rest.isupper() else rest)  # as written if in mixed case
        else:
            found = closest(key, known.values())
            variable = ENV_PREFIX + (found or "").upper().replace(".", "__")
            hint = f"did you mean {variable}?" if found else "unset it, or see `aeroloop show config`"
            raise ConfigError(f"{name} in the environment is no setting: {hint}")
        yield f"{key}={text}"


def _put(tree: dict[str, Any], key: str, value: Any) -> None:
    *sections, name = key.split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{section} is given a value, and then {key}: set its keys one by one")
    tree[name] = value


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def load_target(file: Path | None = None, overrides: Sequence[str] = ()) -> Target:
    """Vehicle and network of a configuration; arguments as of `config.load`.

    Why nothing else is read: `aeroloop op` starts sooner, and a mistake in another section does not keep it from
    stopping a plant. Names of sections are checked all the same: what stands in `[netwrok]` would otherwise be missed.

    Raises:
        ConfigError: A source cannot be read, a section is unknown, or vehicle or network is wrong.
    """
    tree: dict[str, Any] = {}
    for given in sources(file, overrides, Target, UNREAD):
        merge(tree, {name: value for name, value in given.items() if name not in UNREAD})
    try:
        return Target.model_validate(tree)
    except ValidationError as error:
        others: dict[str, Any] = dict.fromkeys(UNREAD, (Any, None))
        sections = create_model("Sections", __base__=Target, **others)
        raise ConfigError("; ".join(problems(error, sections))) from None
