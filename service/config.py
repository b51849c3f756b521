"""Configuration: all sections' models, filled from defaults and from what `config_sources` reads.

Each package owns the models of its own settings; only this module combines them. The defaults are the paper's
experiment.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, Field, SerializeAsAny, model_validator

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol import plugins
from aeroloop.protocol.messages.operator import AS_PUBLISHED, Reference, Sinusoid
from aeroloop.protocol.transport.can_format import CanSettings, counter_fills_frame
from aeroloop.protocol.wire.frames import MAX_COUNTER_BITS, MIN_COUNTER_BITS
from aeroloop.protocol.wire.spec import LoopSettings, SignalBits, WireSpec
from aeroloop.protocol.wording import keys
from aeroloop.service.config_sources import ENV_PREFIX as ENV_PREFIX
from aeroloop.service.config_sources import ConfigError as ConfigError
from aeroloop.service.config_sources import Target, merged, read_sources, tree_of, valid
from aeroloop.service.config_text import toml
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.registry import CustomLawSettings, LawError, LawSection, law_settings
from aeroloop.service.settings import ControllerSettings, RecorderSettings, read_points


class PointsFile(BaseModel, extra="forbid"):
    """Points of a CSV file. It is read with the configuration; descriptions and logs hold the points themselves."""

    kind: Literal["file"] = Field(default="file", description="which reference")
    path: Path = Field(
        description="CSV file of time [s], roll, pitch, yaw [deg]; in a TOML file, relative to that file's folder"
    )


def _points_of(reference: Any) -> Any:
    if not (isinstance(reference, dict) and reference.get("kind") == "file"):
        return reference
    try:
        return read_points(valid(PointsFile, reference).path)
    except ConfigError as error:
        raise ValueError(str(error)) from None


OneReference = Annotated[
    Reference,
    BeforeValidator(_points_of, json_schema_input_type=Annotated[Reference | PointsFile, Field(discriminator="kind")]),
]


class Settings(Target):
    """Everything that can be configured; sections as in the TOML file."""

    loop: LoopSettings = Field(default=LoopSettings(), description="tick grid and process set-up of both ends")
    wire: WireSpec = Field(default=WireSpec(), description="quantizers and frames, on which both ends must agree")
    reference: OneReference = Field(default=Sinusoid(), description="attitude to follow over time")
    law: SerializeAsAny[LawSection] = Field(
        default=AdaptiveSettings(), description="which law, its model of the plant and its gains"
    )
    controller: ControllerSettings = Field(default=ControllerSettings(), description="the controller daemon")
    plant: PlantSettings = Field(default=PlantSettings(), description="the plant end: plant, sensors, faults, limits")
    can: CanSettings = Field(default=CanSettings(), description="the CAN bus, for plant.via = 'can'")
    recorder: RecorderSettings = Field(default=RecorderSettings(), description="the recorder")

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
        wire, period_ns = self.wire, self.loop.period_ns
        patience_s, name = max(
            (self.plant.watchdog_s, "plant.watchdog_s"), (self.controller.stale_s, "controller.stale_s")
        )
        needed_ns, counted_ns = 2 * round(patience_s * 1e9), period_ns << wire.counter_bits
        if self.loop.lockstep or counted_ns >= needed_ns:
            return self
        if self.plant.via == "can" and counter_fills_frame(self.can, wire):
            return self
        enough = [b for b in range(MIN_COUNTER_BITS, MAX_COUNTER_BITS + 1) if period_ns << b >= needed_ns]
        way = (
            f"set it to {enough[0]}"
            if enough
            else f"even {MAX_COUNTER_BITS} bits are too few; shorten {name}, or lower loop.rate_hz"
        )
        raise ValueError(
            f"wire.counter_bits = {wire.counter_bits} counts {counted_ns * 1e-6:g} ms, less than "
            f"twice {name}, which is {patience_s * 1e3:g} ms: {way}"
        )

    def description(self) -> dict[str, Any]:
        """The effective configuration, for a role's description."""
        return self.model_dump(mode="json")

    def toml(self, *, comments: bool = False) -> str:
        """The effective configuration as a TOML file that loads to the same, if wanted with a comment on every key."""
        return toml(self.description(), self if comments else None)


def load(file: Path | None = None, overrides: Sequence[str] = (), *, runs_law: bool = False) -> Settings:
    """The effective configuration.

    Args:
        file: A TOML file, or None.
        overrides: `section.key=value`, values as TOML writes them (quotes may be left out).
        runs_law: Whether the law runs in this process: as `with_law_settings`.

    Raises:
        ConfigError: The configuration is wrong.
    """
    defaults = Settings().model_dump(exclude={"law"})  # a section may set one key of a signal, and leave the others
    settings = vouched(valid(Settings, merged(defaults, read_sources(file, overrides, keys(Settings)))))
    return with_law_settings(settings) if runs_law else settings


def vouched(settings: Settings) -> Settings:
    """A configuration whose classes, and whose FMU, the user has named: their code may run in this process."""
    plugins.vouch_for(settings.law.kind, settings.plant.kind, str(settings.plant.own.get("file")))
    return settings


def with_law_settings(settings: Settings) -> Settings:
    """The configuration with a user's law as its own model has it, defaults included. This imports its module.

    Raises:
        ConfigError: There is no such law, or its settings are wrong.
    """
    try:
        return settings.model_copy(update={"law": law_settings(settings.law)})
    except LawError as error:
        raise ConfigError(str(error)) from None


def as_overrides(settings: Mapping[str, Any], section: str = "") -> list[str]:
    """Settings as `load` takes them: `section.key` to value, nested by section, or both."""
    words: list[str] = []
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            words += as_overrides(value, f"{section}{name}.")
        elif value is None and name.rpartition(".")[2] == "bits":
            words.append(f"{section}{name}=cont")  # as in a TOML file, which has no null
        elif value is not None:  # a None is a key that is not set
            words.append(f"{section}{name}={json.dumps(value, ensure_ascii=False, default=str)}")
    return words


def from_description(config: dict[str, Any]) -> Settings:
    """The configuration in a role's description. Keys that this version does not have are left out.

    Raises:
        ConfigError: This version cannot read it, or a whole section is missing, as of what no role publishes.
    """
    if missing := [name for name in Settings.model_fields if name not in config]:
        raise ConfigError(f"a description without {', '.join(missing)}")
    settings = valid(Settings, config, extra="ignore", context=AS_PUBLISHED)
    if isinstance(settings.law, CustomLawSettings):  # keys of a user's law, which are not ours to know
        return settings.model_copy(update={"law": CustomLawSettings.model_validate(config["law"])})
    return settings


def load_over(settings: Settings, overrides: Sequence[str]) -> Settings:
    """A configuration with some values replaced. Classes that the overrides name, the user has named.

    Raises:
        ConfigError: An override is wrong.
    """
    tree = tree_of(overrides)
    replaced = valid(Settings, merged(settings.description(), tree))
    for section in ("law", "plant"):
        given = tree.get(section)
        if isinstance(given, dict) and "kind" in given:
            plugins.vouch_for(getattr(replaced, section).kind)
    return replaced


def bits_overrides(text: str | None) -> list[str]:
    """Overrides that set the bits of all signals, as of `SignalBits.parse`; none for None. Raises ConfigError."""
    if text is None:
        return []
    try:
        bits = SignalBits.parse(text)._asdict()
    except ValueError as error:
        raise ConfigError(f"--bits: {error}") from None
    return as_overrides({"wire": {f"{name}.bits": each for name, each in bits.items()}})
