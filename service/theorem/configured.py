"""Configuration, as far as a certificate needs it: the sections that `service.config.Settings` has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, Self

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.operator import Reference
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.law import LawSettings
from aeroloop.service.settings import ControllerSettings


class Configured(Protocol):
    """Sections of a configuration, and a copy with some of them changed."""

    @property
    def loop(self) -> LoopSettings:
        """Tick grid."""

    @property
    def wire(self) -> WireSpec:
        """Quantizers."""

    @property
    def law(self) -> LawSettings:
        """Model and gains."""

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
