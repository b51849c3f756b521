"""Friction about each axis: viscous torque proportional to the rate, Coulomb torque against its direction.

The Coulomb torque changes sign smoothly, c·tanh(rate/width), within a rate that the plant's sensors cannot resolve.
Why: with a jump the result would depend on where the integration steps fall.
"""

from __future__ import annotations

import casadi as ca
from pydantic import BaseModel, Field


class FrictionSettings(BaseModel, extra="forbid"):
    """Friction about the axes: pitch and yaw of the Aero, x, y, z of a free body (missing ones are 0)."""

    viscous: tuple[float, ...] = Field(
        default=(0.0071, 0.0220), max_length=3, description="viscous friction about the axes [N·m·s/rad]; lab material"
    )
    coulomb: tuple[float, ...] = Field(
        default=(0.0009, 0.003040),
        max_length=3,
        description="Coulomb friction about the axes [N·m]; pitch measured (spin-down), yaw fitted by `lab calibrate`",
    )
    width: float = Field(default=0.01, gt=0, le=1, description="rate within which Coulomb torque changes sign [rad/s]")


def friction_torque(settings: FrictionSettings, rates: ca.SX) -> ca.SX:
    """Torque about each axis [N·m] from the rates about them [rad/s]. Shape (axes,)."""
    axes = rates.numel()
    viscous, coulomb = (ca.SX((*values, 0.0, 0.0, 0.0)[:axes]) for values in (settings.viscous, settings.coulomb))
    return -viscous * rates - coulomb * ca.tanh(rates / settings.width)
