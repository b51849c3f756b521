"""Sources of the configuration, by pydantic-settings: `--set`, the environment and a TOML file, the stronger first.

`Target` is all that a command of `aeroloop op` reads of them.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Self, TypeVar

from pydantic import BaseModel, Field, StringConstraints, ValidationError, model_validator
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wording import closest, keys, problems

ENV_PREFIX: Final = "AEROLOOP_"
"""Every variable of the environment that begins with it is a key: `AEROLOOP_LOOP__RATE_HZ` is `loop.rate_hz`."""

BODY: Final = ("inertia", "mass", "gravity", "centre_of_mass", "allocation")
"""The model of the plant in `[law]`, which all laws have."""

_FREE: Final = ("can.options.", "plant.own.", "law.")
"""Sections in which any key may be given: a user's, or another library's."""

_KINDS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {"reference": ("sinusoid", ()), "law": ("adaptive", BODY)}
"""Sections of several kinds: the kind where none is named, and keys that all kinds have."""


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


class Sources(BaseSettings):
    """Base of a model that is filled from the sources; `toml_file` of its `model_config` is the file, if any."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX,
        env_nested_delimiter="__",
        case_sensitive=True,  # `_variables` writes every key as its model does
        enable_decoding=False,  # values are TOML, as with `--set`, and not JSON
        nested_model_default_partial_update=True,
    )

    @classmethod
    def settings_customise_sources(
        cls, settings_cls: type[BaseSettings], init_settings: PydanticBaseSettingsSource, *_: Any, **__: Any
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """`--set` before the environment before the file."""
        return init_settings, _Environment(settings_cls), _File(settings_cls)


class _Environment(EnvSettingsSource):
    def __init__(self, settings_cls: type[BaseSettings]) -> None:
        super().__init__(settings_cls)
        self.env_vars = _variables(settings_cls)

    def __call__(self) -> dict[str, Any]:
        return merged(_values(super().__call__()), self.current_state)


class _File(TomlConfigSettingsSource):
    def __call__(self) -> dict[str, Any]:
        tree = super().__call__()
        reference = tree.get("reference")
        if isinstance(reference, dict) and isinstance(reference.get("path"), str):
            reference["path"] = str(Path(str(self.toml_file_path)).parent / reference["path"])
        return merged(tree, self.current_state)


def _variables(model: type[BaseModel]) -> dict[str, str | None]:
    """Variables of the environment that are keys, each written as the model writes it. Raises ConfigError."""
    known = {key.upper(): key for key in keys(model)}
    unread = tuple(f"{name}." for name, field in model.model_fields.items() if field.annotation is Any)
    found: dict[str, str | None] = {}
    for name, text in os.environ.items():
        if not name.upper().startswith(ENV_PREFIX):
            continue
        key = name[len(ENV_PREFIX) :].replace("__", ".")
        if key.upper() in known:
            key = known[key.upper()]
        elif key.lower().startswith((*_FREE, *unread)):
            key = key.lower() if key.isupper() else key
        else:
            near = closest(key, known.values())
            variable = ENV_PREFIX + (near or "").upper().replace(".", "__")
            hint = f"did you mean {variable}?" if near else "unset it, or see `aeroloop show config`"
            raise ConfigError(f"{name} in the environment is no setting: {hint}")
        found[ENV_PREFIX + key.replace(".", "__")] = text
    return found


def _values(tree: dict[str, Any]) -> dict[str, Any]:
    return {name: _values(each) if isinstance(each, dict) else value_of(each) for name, each in tree.items()}


def value_of(text: str) -> Any:
    """A value as TOML writes it; quotes of a string may be left out."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def tree_of(overrides: Iterable[str]) -> dict[str, Any]:
    """The tree of `section.key=value` overrides. Raises ConfigError."""
    tree: dict[str, Any] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set takes section.key=value, not {override!r}")
        value = value_of(text.strip())
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


SourcesT = TypeVar("SourcesT", bound=Sources)


def read(model: type[SourcesT], overrides: Iterable[str]) -> SourcesT:
    """A model filled from its sources. Raises ConfigError."""
    file = model.model_config.get("toml_file")
    if isinstance(file, Path) and not file.is_file():
        raise ConfigError(f"no configuration file at {file}")
    try:
        return model(**tree_of(overrides))
    except ValidationError as error:
        raise ConfigError("; ".join(problems(error, model))) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read {file}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{file} is not TOML: {error}") from None


def load_target(file: Path | None = None, overrides: Iterable[str] = ()) -> Target:
    """Vehicle and network of a configuration; arguments as of `config.load`.

    Nothing else is read: a mistake in another section, or in its name, does not keep `op stop` from a plant. An unknown
    section is refused if it may be meant as vehicle or network, as `[netwrok]` is: a stop must not miss its plant.

    Raises:
        ConfigError: A source cannot be read, a section is like none of the others, or vehicle or network is wrong.
    """

    class Configured(Target, Sources):
        model_config = SettingsConfigDict(toml_file=file)
        loop: Any = None
        wire: Any = None
        reference: Any = None
        law: Any = None
        controller: Any = None
        plant: Any = None
        can: Any = None
        recorder: Any = None

        @model_validator(mode="before")
        @classmethod
        def _without_misspelled_other_sections(cls, tree: dict[str, Any]) -> dict[str, Any]:
            others = {*cls.model_fields} - {*Target.model_fields}
            return {key: value for key, value in tree.items() if closest(key, cls.model_fields) not in others}

    return read(Configured, overrides)
