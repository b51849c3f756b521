"""Sliding-mode law with a smooth boundary layer.

    symbol   name in code   meaning                                        unit     shape
    σ        sigma          distance from the surface                      rad/s    3
    λ        slope          of the surface ω_e = ∓λε̃                       1/s      3
    K        strength       largest torque towards the surface             N·m      3
    Φ        layer          distance from which it acts almost fully       rad/s    3

    σ = ω_e ± λ ε̃,    τ = −J (±λ/2)(η̃I + S(ε̃)) ω_e − K tanh(σ/Φ)

so that J σ̇ = −K tanh(σ/Φ), and ½σᵀJσ falls. On the surface ε̃ decays with the time constant 2/λ. Surface: J. L.
Crassidis, S. R. Vadali and F. L. Markley, Optimal Variable-Structure Control Tracking of Spacecraft Maneuvers, Journal
of Guidance, Control, and Dynamics 23(3), 2000; boundary layer against chatter: J.-J. E. Slotine and W. Li, Applied
Nonlinear Control, 1991, chapter 7; S.-C. Lo and Y.-P. Chen, Smooth Sliding-Mode Control for Spacecraft Attitude
Tracking Maneuvers, Journal of Guidance, Control, and Dynamics 18(6), 1995. The layer is tanh's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import casadi as ca
from pydantic import Field

from aeroloop.protocol.wire.attitude import S
from aeroloop.service.control.laws.interface import Diagonal, Gains3, Now
from aeroloop.service.control.laws.tracking import TrackingLaw, TrackingSettings
from aeroloop.service.control.laws.tuning import PAPER, PAPER_BODY, tune_sliding

_TUNED = tune_sliding(PAPER_BODY, PAPER)


class SlidingSettings(TrackingSettings):
    """Model of the plant, surface and layer. The defaults are those of the tuning rule."""

    kind: Literal["sliding"] = Field(default="sliding", description="which law")
    slope: Gains3 = Field(default=_TUNED["slope"], description="λ, slope of the surface [1/s]")
    strength: Gains3 = Field(default=_TUNED["strength"], description="K, largest torque towards the surface [N·m]")
    layer: Diagonal = Field(default=_TUNED["layer"], description="Φ, thickness of the boundary layer [rad/s]")


class Sliding(TrackingLaw[SlidingSettings]):
    """Smooth sliding mode with feedforward."""

    Settings = SlidingSettings
    gains = ("slope", "strength")

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """Along the surface, and towards it."""
        p, slope = self.settings, sign * now.gains["slope"]
        eta_e, eps_e, omega_e = now.attitude_error[0], now.attitude_error[1:4], now.rate_error
        sigma = omega_e + slope * eps_e
        along = ca.SX(p.inertia) * slope / 2 * ((eta_e * ca.SX.eye(3) + S(eps_e)) @ omega_e)  # ε̃ moves by (C.17)
        return -along - now.gains["strength"] * ca.tanh(sigma / ca.SX(p.layer)), {}
