"""Configuration: all sections' models, filled from defaults, a TOML file, the environment and `--set`.

Each package owns the models of its own settings; only this module combines them. The defaults are the paper's
experiment.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import Field, StringConstraints, ValidationError, model_validator
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
    TomlConfigSettingsSource,
)

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Reference, Sinusoid
from aeroloop.protocol.transport.can_format import CanSettings
from aeroloop.protocol.transport.network import NetworkSettings
from aeroloop.protocol.wire.frames import MAX_COUNTER_BITS, MIN_COUNTER_BITS
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.law import LawSettings
from aeroloop.service.settings import ControllerSettings, RecorderSettings

ENV_PREFIX = "AEROLOOP_"


class ConfigError(AeroloopError):
    """The configuration is wrong; one line with the key and its allowed values."""


class Settings(BaseSettings):
    """Everything that can be configured; sections as in the TOML file."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, env_nested_delimiter="__", extra="forbid", nested_model_default_partial_update=True
    )

    vehicle: Annotated[str, StringConstraints(pattern=f"^{topics.NAME}$")] = Field(
        default="aero", description="name of the vehicle, one chunk of every key"
    )
    loop: LoopSettings = LoopSettings()
    wire: WireSpec = WireSpec()
    reference: Reference = Sinusoid()
    law: LawSettings = LawSettings()
    controller: ControllerSettings = ControllerSettings()
    plant: PlantSettings = PlantSettings()
    can: CanSettings = CanSettings()
    recorder: RecorderSettings = RecorderSettings()
    network: NetworkSettings = NetworkSettings()

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003  # the library's argument names
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003  # the same
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """`--set` over environment over file."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)

    @model_validator(mode="after")
    def _heartbeat_keeps_both_ends_alive(self) -> Settings:
        """Check that one lost frame trips neither end. A loop so slow that every tick has a frame is exempt."""
        transmit, loop = self.wire.transmit, self.loop
        ticks = transmit.heartbeat_ticks(loop.period_ns, self.wire.measurement.counters)
        every_s = ticks * loop.period
        for sends, name, patience_s in (
            ("command", "plant.watchdog_s", self.plant.watchdog_s),
            ("measurement", "controller.stale_s", self.controller.stale_s),
        ):
            sparse = getattr(transmit, sends) == "on_change" and ticks > 1 and not loop.lockstep
            if sparse and every_s > patience_s / 2:
                raise ValueError(
                    f"wire.transmit.heartbeat_s lets {every_s * 1e3:g} ms pass without a {sends}, more than half of "
                    f"{name}, which is {patience_s * 1e3:g} ms"
                )
        return self

    @model_validator(mode="after")
    def _counter_separates_late_frames_from_fresh_ones(self) -> Settings:
        """Check that its range is at least twice the time after which an end acts on missing frames."""
        wire, period_ns, on_can = self.wire, self.loop.period_ns, self.plant.via == "can"
        patience_s, name = max(
            (self.plant.watchdog_s, "plant.watchdog_s"), (self.controller.stale_s, "controller.stale_s")
        )
        needed_ns = 2 * round(patience_s * 1e9)
        if self.loop.lockstep or wire.freshness_ns(period_ns) >= needed_ns or (on_can and self.can.short_counter):
            return self
        enough = [b for b in range(MIN_COUNTER_BITS, MAX_COUNTER_BITS + 1) if period_ns << b >= needed_ns]
        ways = [
            f"set it to {enough[0]}"
            if enough
            else f"even {MAX_COUNTER_BITS} bits are too few; shorten {name}, or lower loop.rate_hz"
        ]
        if on_can:
            ways.append("can.short_counter = true accepts it")
        raise ValueError(
            f"wire.counter_bits = {wire.counter_bits} counts {wire.freshness_ns(period_ns) * 1e-6:g} ms, less than "
            f"twice {name}, which is {patience_s * 1e3:g} ms: {', or '.join(ways)}"
        )

    def description(self) -> dict[str, Any]:
        """The effective configuration, for a role's description."""
        return self.model_dump(mode="json")

    def toml(self) -> str:
        """The effective configuration as a TOML file that loads to the same."""
        return tomli_w.dumps(_for_toml(self.description()))


def load(file: Path | None = None, overrides: Sequence[str] = ()) -> Settings:
    """The effective configuration.

    Args:
        file: A TOML file, or None.
        overrides: `section.key=value`, values as TOML writes them (quotes may be left out).

    Raises:
        ConfigError: The configuration is wrong.
    """
    if file is not None and not file.is_file():
        raise ConfigError(f"no configuration file at {file}")

    class Configured(Settings):
        model_config = SettingsConfigDict(toml_file=file)

    try:
        return Configured(**_tree(overrides))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{file} is not TOML: {error}") from None
    except SettingsError as error:  # a section in the environment is JSON
        raise ConfigError(f"{error}: write its keys one by one, as {ENV_PREFIX}SECTION__KEY") from None
    except ValidationError as error:
        raise _config_error(error) from None


def as_overrides(settings: Mapping[str, Any], section: str = "") -> list[str]:
    """Settings as `load` takes them: `section.key` to value, nested by section, or both."""
    words: list[str] = []
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            words += as_overrides(value, f"{section}{name}.")
        else:
            words.append(f"{section}{name}={json.dumps(value, ensure_ascii=False, default=str)}")
    return words


def from_description(config: dict[str, Any]) -> Settings:
    """The configuration in a role's description.

    Raises:
        ConfigError: This version cannot read it.
    """
    try:
        return Settings.model_validate(config)
    except ValidationError as error:
        raise _config_error(error) from None


def load_over(settings: Settings, overrides: Sequence[str]) -> Settings:
    """A configuration with some values replaced. Raises ConfigError as `load` does."""
    tree = settings.description()
    for override in overrides:
        _merge(tree, _tree([override]))
    return from_description(tree)


def _merge(tree: dict[str, Any], changes: dict[str, Any]) -> None:
    for name, value in changes.items():
        if isinstance(value, dict) and isinstance(tree.get(name), dict):
            _merge(tree[name], value)
        else:
            tree[name] = value


def _tree(overrides: Sequence[str]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for override in overrides:
        path, equals, text = override.partition("=")
        if not equals or not path:
            raise ConfigError(f"--set takes section.key=value, not {override!r}")
        *sections, name = path.strip().split(".")
        branch = tree
        for section in sections:
            branch = branch.setdefault(section, {})
            if not isinstance(branch, dict):
                raise ConfigError(f"--set gives {section} a value, and then {path.strip()}: set its keys one by one")
        branch[name] = _value(text.strip())
    return tree


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _config_error(error: ValidationError, section: str = "") -> ConfigError:
    return ConfigError("; ".join(section + _explain(dict(e)) for e in error.errors(include_url=False)))


def _explain(error: dict[str, Any]) -> str:
    where = ".".join(str(part) for part in error["loc"]) or "the configuration"
    if error["type"] == "extra_forbidden":
        return f"unknown configuration key {where}; `aeroloop show config` lists the known ones"
    message = str(error["msg"]).removeprefix("Value error, ")
    text = f"{where}: {message[0].lower()}{message[1:]}"
    if error["type"] == "value_error" and isinstance(error["input"], dict):  # of a section; names its values
        return text
    return f"{text}, not {error['input']!r}"


def _for_toml(tree: dict[str, Any]) -> dict[str, Any]:
    """Replace null, which TOML lacks: bits become "cont", other unset values are left out."""
    out: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            out[name] = _for_toml(value)
        elif value is not None:
            out[name] = value
        elif name == "bits":
            out[name] = "cont"
    return out


def with_bits(settings: Settings, bits_out: str | None, bits_in: str | None) -> Settings:
    """The settings with other bits: `bits_out` for ε and ω, `bits_in` for u; None leaves them unchanged.

    Raises:
        ConfigError: Not a number of bits, and not "cont".
    """
    wire = settings.wire.model_dump()
    for bits, signals, option in ((bits_out, ("attitude", "rate"), "--bits-out"), (bits_in, ("voltage",), "--bits-in")):
        if bits is not None:
            if bits != "cont" and not (bits.isdecimal() and MIN_BITS <= int(bits) <= MAX_BITS):
                raise ConfigError(f"{option} takes {MIN_BITS} to {MAX_BITS} bits or cont, not {bits!r}")
            for signal in signals:
                wire[signal]["bits"] = bits if bits == "cont" else int(bits)
    try:
        return settings.model_copy(update={"wire": WireSpec.model_validate(wire)})
    except ValidationError as error:  # some kinds of quantizer allow other numbers of bits
        raise _config_error(error, "wire.") from None
