"""PD+ law: a quaternion PD feedback over the feedforward of the model.

    symbol   name in code   meaning                        unit          shape
    k_p      kp             gain of the attitude error     N·m           3
    k_d      kd             gain of the rate error         N·m·s/rad     3

    τ = −k_p (±ε̃) − k_d ω_e

with V = 2 Σ k_p (1 − ±η̃) + ½ ω_eᵀJω_e for equal k_p, V̇ = −ω_eᵀk_d ω_e: J. T.-Y. Wen and K. Kreutz-Delgado, The
Attitude Control Problem, IEEE Transactions on Automatic Control 36(10), 1991; the feedforward of a PD+ law: B. Paden
and R. Panja, Globally Asymptotically Stable 'PD+' Controller for Robot Manipulators, International Journal of Control
47(6), 1988.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import casadi as ca
from pydantic import Field

from aeroloop.service.control.laws.interface import Gains3, Now
from aeroloop.service.control.laws.tracking import TrackingLaw, TrackingSettings
from aeroloop.service.control.laws.tuning import PAPER, PAPER_BODY, tune_pd

_TUNED = tune_pd(PAPER_BODY, PAPER)


class PDSettings(TrackingSettings):
    """Model of the plant and gains. The default gains are those of the tuning rule."""

    kind: Literal["pd"] = Field(default="pd", description="which law")
    kp: Gains3 = Field(default=_TUNED["kp"], description="gain of the attitude error ε̃ [N·m]")
    kd: Gains3 = Field(default=_TUNED["kd"], description="gain of the rate error [N·m·s/rad]")


class PD(TrackingLaw[PDSettings]):
    """PD+ with feedforward."""

    Settings = PDSettings
    gains = ("kp", "kd")

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """Proportional to both errors."""
        return -now.gains["kp"] * sign * now.attitude_error[1:4] - now.gains["kd"] * now.rate_error, {}
