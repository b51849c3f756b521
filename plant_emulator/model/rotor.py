"""Rotors: lag of thrust behind the commanded voltage, and a dead zone.

The voltage that makes thrust follows the commanded one with a first-order lag, a little faster up than down: drag
brakes a rotor less than the motor drives it. Below the dead zone a rotor makes no thrust.
"""

from __future__ import annotations

import casadi as ca
from pydantic import BaseModel, Field, model_validator


class RotorSettings(BaseModel, extra="forbid"):
    """Lag and dead zone of the rotors. Lags of 0 leave the rotors out."""

    lag_up_s: float = Field(
        default=0.154, ge=0, le=10, description="time constant while |thrust| rises [s]; measured on an Aero"
    )
    lag_down_s: float = Field(
        default=0.176, ge=0, le=10, description="time constant while |thrust| falls [s]; measured on an Aero"
    )
    dead_zone_v: float = Field(
        default=0.0,
        ge=0,
        le=24,
        description="no thrust below this [V]; 2–3 V measured on an Aero, but off: with 2.5 V, height and friction "
        "fitted again are -2.94 mm and 1.94 mN·m (published: -3.8, 3.7), and the tables are predicted no better",
    )

    @model_validator(mode="after")
    def _both_lags_or_none(self) -> RotorSettings:
        if (self.lag_up_s > 0) != (self.lag_down_s > 0):
            raise ValueError("lag_up_s and lag_down_s are both positive, or both 0 to leave the rotors out")
        return self

    @property
    def present(self) -> bool:
        """Whether there is any lag."""
        return self.lag_up_s > 0 and self.lag_down_s > 0


def rotor_derivative(settings: RotorSettings, state: ca.SX, command: ca.SX) -> ca.SX:
    """V̇ of the voltages that make thrust [V/s], from those and the commanded ones [V]. Shape as given."""
    rising = (command - state) * state >= 0  # away from zero; a rotor that reverses falls first, then rises
    return (command - state) / ca.if_else(rising, settings.lag_up_s, settings.lag_down_s)


def thrust_voltage(settings: RotorSettings, state: ca.SX) -> ca.SX:
    """Voltage beyond the dead zone [V]. Shape as given."""
    if not settings.dead_zone_v:
        return state
    return ca.sign(state) * ca.fmax(ca.fabs(state) - settings.dead_zone_v, 0)
