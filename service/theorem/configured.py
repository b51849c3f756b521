"""Configuration, as far as a certificate needs it: the sections of `service.config.Settings`, with the paper's law."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, Self, cast

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Reference
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.settings import ControllerSettings


class Sections(Protocol):
    """Sections of a configuration, and a copy with some of them changed."""

    @property
    def loop(self) -> LoopSettings:
        """Tick grid."""

    @property
    def wire(self) -> WireSpec:
        """Quantizers."""

    @property
    def law(self) -> LawSettings:
        """Law."""

    @property
    def reference(self) -> Reference:
        """Reference."""

    @property
    def controller(self) -> ControllerSettings:
        """How a session begins."""

    @property
    def plant(self) -> PlantSettings:
        """Plant."""

    def model_copy(self, *, update: Mapping[str, Any] | None = None) -> Self:
        """A copy with sections replaced."""


class Configured(Sections, Protocol):
    """The same, with the paper's law."""

    @property
    def law(self) -> AdaptiveSettings:
        """Model and gains."""


class NoTheoremError(AeroloopError):
    """Nothing is proven of a configuration's law; one line."""


def with_theorem(settings: Sections) -> Configured:
    """The same configuration, whose law the theorem is about.

    Raises:
        NoTheoremError: It is another law, or B is not 3 × 3.
    """
    law = settings.law
    if not isinstance(law, AdaptiveSettings):
        raise NoTheoremError(f"no theorem for this law, {law.kind}")
    if {len(row) for row in law.allocation} != {3}:
        raise NoTheoremError("no theorem for this vehicle, whose law.allocation is not 3 × 3")
    return cast(Configured, settings)
