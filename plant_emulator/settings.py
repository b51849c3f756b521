"""What the plant end can be told."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from plant_emulator.aero import Aero, AeroSettings
from plant_emulator.plant import EmulatedPlant
from protocol.clock import WATCHDOG_S


class PlantSettings(BaseModel):
    """The plant end: which plant, and how it looks after itself."""

    model_config = ConfigDict(extra="forbid")

    watchdog_s: float = Field(
        default=WATCHDOG_S, gt=0, le=10, description="0 V after this long without a fresh command [s]"
    )
    answer_timeout_s: float = Field(
        default=2.0, gt=0, le=600, description="lockstep only: 0 V after waiting this long for an answer [s]"
    )
    truth_rate_hz: float = Field(default=50.0, ge=0, le=10_000, description="publish the true state this often [Hz]")
    aero: AeroSettings = AeroSettings()

    def build(self, period: float) -> EmulatedPlant:
        """The plant, to be advanced in steps of `period` [s]."""
        return Aero(self.aero, period)
