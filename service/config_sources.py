"""Sources of the configuration: a TOML file, the environment and `--set`, each as a tree of sections and keys.

`VehicleAddress` is all that a command of `aeroloop op` reads of them.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, Field, StringConstraints, ValidationError, model_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wording import closest, keys, problems

ENV_PREFIX: Final = "AEROLOOP_"
"""Every variable of the environment that begins with it is a key: `AEROLOOP_LOOP__RATE_HZ` is `loop.rate_hz`."""


BODY: Final = ("inertia", "mass", "gravity", "centre_of_mass", "allocation")
"""The model of the plant in `[law]`, which all laws have."""


class ConfigError(AeroloopError):
    """The configuration is wrong; one line with the key and its allowed values."""


UNREAD: Final = ("loop", "wire", "reference", "law", "controller", "plant", "can", "recorder")
"""The other sections of a configuration."""


class VehicleAddress(BaseModel, extra="forbid", coerce_numbers_to_str=True):
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
    yield _environment(model, unread)
    yield tree_of(overrides)


def tree_of(overrides: Sequence[str]) -> dict[str, Any]:
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
    value: Any
    present: Any
    for name, value in changes.items():
        present = tree.get(name)
        # A reference or a law of another kind has other keys; the kinds of a quantizer share theirs.
        other_kind = name in ("reference", "law") and isinstance(value, dict) and "kind" in value
        if (
            isinstance(value, dict)
            and isinstance(present, dict)
            and not (other_kind and value["kind"] != present["kind"])
        ):
            merge(present, value)
        else:
            same = {key: present[key] for key in BODY if key in present} if other_kind and name == "law" else {}
            tree[name] = {**same, **value} if same else value


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


def _environment(model: type[BaseModel], unread: Collection[str]) -> dict[str, Any]:
    given = {name: text for name, text in os.environ.items() if name.upper().startswith(ENV_PREFIX)}
    known = {key.upper(): key for key in keys(model)} if given else {}
    tree: dict[str, Any] = {}
    for name, text in sorted(given.items()):
        key = name[len(ENV_PREFIX) :].replace("__", ".")
        free = next((each for each in _FREE if key.lower().startswith(each)), None)
        if key.lower().partition(".")[0] in unread:
            continue
        if key.upper() in known:
            key = known[key.upper()]
        elif free is not None:  # in lower case, or as written if in mixed case
            own = key[len(free) :]
            key = free + (own.lower() if own.isupper() else own)
        else:
            found = closest(key, known.values())
            variable = ENV_PREFIX + (found or "").upper().replace(".", "__")
            hint = f"did you mean {variable}?" if found else "unset it, or see `aeroloop show config`"
            raise ConfigError(f"{name} in the environment is no setting: {hint}")
        _put(tree, key, _value(text))
    return tree


_FREE: Final = ("can.options.", "plant.own.", "law.")
"""Sections in which any key may be given: a user's, or another library's."""


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


def load_vehicle_address(file: Path | None = None, overrides: Sequence[str] = ()) -> VehicleAddress:
    """Vehicle and network of a configuration; arguments as of `config.load`.

    Why nothing else is read: `aeroloop op` starts sooner, and a mistake in another section does not keep it from
    stopping a plant. Names of sections are checked all the same: what stands in `[netwrok]` would otherwise be missed.

    Raises:
        ConfigError: A source cannot be read, a section is unknown, or vehicle or network is wrong.
    """
    tree: dict[str, Any] = {}
    for given in sources(file, overrides, VehicleAddress, UNREAD):
        merge(tree, {name: value for name, value in given.items() if name not in UNREAD})
    sections = (*VehicleAddress.model_fields, *UNREAD)
    for name in set(tree).difference(sections):
        found = closest(name, sections)
        raise ConfigError(
            f"unknown key {name}" + (f": did you mean {found}?" if found else f"; there are {', '.join(sections)}")
        )
    try:
        return VehicleAddress.model_validate(tree)
    except ValidationError as error:
        raise ConfigError("; ".join(problems(error, VehicleAddress))) from None
