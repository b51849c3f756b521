"""Base of the baselines: a law that cancels what the model knows and adds a feedback of the errors.

    symbol   name in code     meaning                                       unit        shape
    e^Q      attitude_error   tracking error [η̃, ε̃], (C.16)                 1           4
    ω_e^Q    rate_error       angular velocity error, (C.18)                rad/s       3
    ±        sign             which of ±e is approached                     1           1
    J θ̂ g    J, theta, g      inertia, estimate of damping, gravity         see body    3
    τ        torque           B u                                           N·m         3

With the feedforward of (C.22), the body (C.2) becomes J ω̇_e = τ_feedback, so each law is its feedback. The estimate of
the damping is the paper's first one, and stays.

q and −q are one attitude, so the feedback approaches e = [1, 0] or [−1, 0]. Which one is chosen at the first tick; it
changes where the other has become nearer by more than the hysteresis, so that a body that was turned by hand does not
turn back all the way (unwinding), and noise at half a turn does not make it hesitate: Mayhew, Sanfelice and Teel,
Quaternion-Based Hybrid Control for Robust Global Attitude Tracking, IEEE Transactions on Automatic Control 56(11),
2011.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TypeVar

import casadi as ca
from pydantic import Field

from aeroloop.protocol.wire.attitude import R, S
from aeroloop.service.control.laws.body import gravity_torque, voltages_for
from aeroloop.service.control.laws.interface import ExpressionLaw, LawSettings, Now, Vector


class TrackingSettings(LawSettings):
    """Model of the plant, a damping estimate that stays, and when the nearer of two equilibria is chosen anew."""

    damping_estimate: Vector = Field(
        default=(0.0, 0.0070, 0.0095), description="θ̂(t0), first estimate of the damping [N·m·s/rad]"
    )
    hysteresis: float = Field(
        default=0.4, ge=0, lt=1, description="the other equilibrium is approached from |η̃| beyond this on [1]"
    )


T = TypeVar("T", bound=TrackingSettings)


class TrackingLaw(ExpressionLaw[T]):
    """Feedforward of the model, and a feedback."""

    def initial(self) -> Mapping[str, Sequence[float]]:
        """The sign, not yet chosen."""
        return {"sign": [0.0]}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """The voltages of feedforward and feedback."""
        sign = nearer(now.attitude_error[0], now.state["sign"], self.settings.hysteresis)
        torque, state = self.feedback(now, sign)
        u = voltages_for(self.settings, feedforward(self.settings, now) + torque, self.actuators)
        return u, {"sign": sign, **state}

    @abstractmethod
    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """The torque of the feedback [N·m], shape (3,), and the rest of the state after this tick."""


def nearer(eta_e: ca.SX, before: ca.SX, hysteresis: float) -> ca.SX:
    """±1, the equilibrium to approach: as before, until the other is nearer by the hysteresis. Shape (1,).

    Args:
        eta_e: η̃ [1].
        before: ±1 at the last tick; 0 before the first.
        hysteresis: |η̃| from which the other is approached [1].
    """
    kept = before * (1 - 2 * (before * eta_e < -hysteresis))
    return ca.if_else(before == 0, 2 * (eta_e >= 0) - 1, kept)


def feedforward(p: TrackingSettings, now: Now[ca.SX]) -> ca.SX:
    """The torque with which J ω̇_e = 0 if the model is exact: −Φθ̂ − Ψ − J(S(ω)Rω_d − Rω̇_d) of (C.22). Shape (3,)."""
    omega, J, theta = now.rate, ca.SX(p.inertia), ca.SX(p.damping_estimate)
    desired = now.rate - now.rate_error  # R ω_d in the body frame, (C.18)
    R_ib = R(now.attitude).T  # (C.48)
    cancelled = S(omega) @ (J * omega) - gravity_torque(p, now.attitude) + omega * theta  # −Ψ − Φθ̂, (C.43), (C.44)
    return cancelled - J * (S(omega) @ desired - R_ib @ now.desired_acceleration)
