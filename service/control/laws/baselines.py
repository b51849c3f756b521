"""Baselines beside the paper's law: one feedforward of the model, and a feedback each.

    symbol   name in code     meaning                                       unit        shape
    e^Q      attitude_error   tracking error [η̃, ε̃], (C.16)                 1           4
    ω_e^Q    rate_error       angular velocity error, (C.18)                rad/s       3
    ±        sign             which of ±e is approached                     1           1
    J θ̂ g    J, theta, g      inertia, estimate of damping, gravity         see body    3
    τ        torque           B u                                           N·m         3

With the feedforward of (C.22), the body (C.2) becomes J ω̇_e = τ, so each law is its feedback τ. The estimate of the
damping is the paper's first one, and stays. `nonadaptive` is the paper's law with that estimate. All default gains come
from one rule, `tuned`: each law gets the bandwidth and damping ratio of the paper's gains, and knows the same body.

q and −q are one attitude, so the feedback approaches e = [1, 0] or [−1, 0]. Which one is chosen at the first tick; it
changes where the other has become nearer by more than the hysteresis, so that a body that was turned by hand does not
turn back all the way (unwinding): Mayhew, Sanfelice and Teel, Quaternion-Based Hybrid Control for Robust Global
Attitude Tracking, IEEE Transactions on Automatic Control 56(11), 2011.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from math import sqrt
from typing import ClassVar, Final, Literal, NamedTuple, TypeVar

import casadi as ca
import numpy as np
from pydantic import Field, NonNegativeFloat

from aeroloop.protocol.wire.attitude import R, S
from aeroloop.protocol.wire.elementary import tanh
from aeroloop.service.control.laws.adaptive import Adaptive, AdaptiveSettings
from aeroloop.service.control.laws.interface import (
    Diagonal,
    EstimateSettings,
    ExpressionLaw,
    Floats,
    Gains3,
    LawSettings,
    MatrixGain,
    Now,
    Vector,
    check_allocation,
    gravity_torque,
    voltages_for,
)

VOLTAGE_LIMIT: Final = 24.0  # largest voltage of the Aero's supply [V]
TUNED: Final = ("pd", "pid", "adaptive-torque", "sliding", "lqr")
"""Kinds that the tuning rule has settings for. The law without adaptation has the paper's own gains."""


class Response(NamedTuple):
    """Linearised attitude error, an element an axis: bandwidth ωₙ [rad/s] and damping ratio ζ [1]."""

    bandwidth: Vector
    damping: Vector


def response_of(inertia: Vector, C1: Vector, C2: Vector) -> Response:
    """What the paper's gains give a body with this inertia [kg·m²].

    Near the reference, without quantization and with the model exact, (C.22) gives every axis of φ = 2ε̃ the equation

        J φ̈ + (C₂ + J C₁/2) φ̇ + ½ (1 + C₁C₂) φ = 0,

    from z₂ = ω_e + C₁ε̃ and ᾱ = −½ C₁ω_e to first order, for η̃ near ±1.
    """
    axes = list(zip(inertia, C1, C2, strict=True))
    bandwidth = [sqrt((1 + c1 * c2) / (2 * J)) for J, c1, c2 in axes]
    damping = [(c2 / J + c1 / 2) / (2 * wn) for (J, c1, c2), wn in zip(axes, bandwidth, strict=True)]
    return Response(_rounded(bandwidth, digits=15), _rounded(damping, digits=15))


def tuned(kind: str, body: LawSettings, response: Response) -> dict[str, Vector]:
    """The settings, by name, that give a law of this kind a response with this body; none for a kind without a rule."""
    torques = [sum(map(abs, row)) for row in body.allocation]
    axes = [_tuned_axis(kind, *axis) for axis in zip(body.inertia, torques, *response, strict=True)]
    return {name: _rounded([axis[name] for axis in axes], digits=5) for name in axes[0]}


def _tuned_axis(kind: str, J: float, torque_per_volt: float, wn: float, zeta: float) -> dict[str, float]:
    match kind:
        case "pd":  # J(s² + 2ζωₙs + ωₙ²) with kp on ε̃ = φ/2
            return {"kp": 2 * J * wn**2, "kd": 2 * J * zeta * wn}
        case "pid":  # J(s² + 2ζωₙs + ωₙ²)(s + a) = Js³ + kd s² + (kp/2 + ki)s + ki c/2: a third pole, and c, by ωₙ
            a, c = 0.1 * wn, wn / 2
            ki = 2 * J * a * wn**2 / c
            kp = 2 * J * (wn**2 + 2 * zeta * wn * a) - 2 * ki
            return {"kp": kp, "kd": J * (2 * zeta * wn + a), "ki": ki, "attitude_share": c, "reset_time": 1 / wn}
        case "adaptive-torque":  # the PID, which is its special case; friction is learned a tenth as fast; for ζ < 2.1
            pid = _tuned_axis("pid", J, torque_per_volt, wn, zeta)
            C1, ki = pid["attitude_share"], pid["ki"]
            C2 = pid["kd"] - J * C1 / 2
            Gammas = {"Gamma_torque": ki, "Gamma_damping": 0.1 * ki, "Gamma_coulomb": 0.1 * ki}
            bounds = {"torque_bound": 0.5 * VOLTAGE_LIMIT * torque_per_volt, "reset_time": pid["reset_time"]}
            return {"k1": pid["kp"] - C1 * C2, "C1": C1, "C2": C2, **Gammas, **bounds}
        case "sliding":  # two real poles, −λ/2 and −K/(JΦ), so both at −ωₙ; K is half of the torque that there is
            K = 0.5 * VOLTAGE_LIMIT * torque_per_volt
            return {"slope": 2 * wn, "strength": K, "layer": K / (J * wn)}
        case "lqr":  # weights for which τ = −Jωₙ²φ − 2ζωₙJφ̇ is optimal in continuous time; they exist for ζ ≥ 1/√2
            rate_weight = max(0.0, (2 * zeta * wn * J) ** 2 - 2 * J**2 * wn**2)
            return {"attitude_weight": (J * wn**2) ** 2, "rate_weight": rate_weight}
    return {}


def _rounded(values: list[float], digits: int) -> Vector:
    x, y, z = (float(f"{value:.{digits}g}") for value in values)
    return x, y, z


_BODY: Final = LawSettings(kind="Table C.1")
_PAPER: Final = response_of(_BODY.inertia, (0.3, 0.3, 0.3), (0.15, 0.15, 0.15))  # 4.9 rad/s and 0.72, of Table C.1
DEFAULTS: Final = {kind: tuned(kind, _BODY, _PAPER) for kind in TUNED}
_PD, _PID, _SLIDING, _LQR = (DEFAULTS[kind] for kind in ("pd", "pid", "sliding", "lqr"))


class TrackingSettings(EstimateSettings):
    """Model of the plant, a damping estimate that stays, and when the nearer of two equilibria is chosen anew."""

    hysteresis: float = Field(
        default=0.4, ge=0, lt=1, description="the other equilibrium is approached from |η̃| beyond this on [1]"
    )


T = TypeVar("T", bound=TrackingSettings)


class TrackingLaw(ExpressionLaw[T]):
    """Feedforward of the model, and a feedback."""

    def initial(self) -> Mapping[str, Sequence[float]]:
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
    """±1, the equilibrium to approach: as `before`, 0 at first, until the other is nearer by the hysteresis [1]."""
    kept = before * (1 - 2 * (before * eta_e < -hysteresis))
    return ca.if_else(before == 0, 2 * (eta_e >= 0) - 1, kept)


def feedforward(p: TrackingSettings, now: Now[ca.SX]) -> ca.SX:
    """The torque with which J ω̇_e = 0 if the model is exact: −Φθ̂ − Ψ − J(S(ω)Rω_d − Rω̇_d) of (C.22). Shape (3,)."""
    omega, J, theta = now.rate, ca.SX(p.inertia), ca.SX(p.damping_estimate)
    desired = now.rate - now.rate_error  # R ω_d in the body frame, (C.18)
    R_ib = R(now.attitude).T  # (C.48)
    cancelled = S(omega) @ (J * omega) - gravity_torque(p, now.attitude) + omega * theta  # −Ψ − Φθ̂, (C.43), (C.44)
    return cancelled - J * (S(omega) @ desired - R_ib @ now.desired_acceleration)


class PDSettings(TrackingSettings):
    """Model of the plant and gains. The default gains are those of the tuning rule."""

    kind: Literal["pd"] = Field(default="pd", description="which law")
    kp: Gains3 = Field(default=_PD["kp"], description="gain of the attitude error ε̃ [N·m]")
    kd: Gains3 = Field(default=_PD["kd"], description="gain of the rate error [N·m·s/rad]")


class PD(TrackingLaw[PDSettings]):
    """PD+: τ = −k_p (±ε̃) − k_d ω_e. With V = 2 Σ k_p (1 − ±η̃) + ½ ω_eᵀJω_e for equal k_p, V̇ = −ω_eᵀk_d ω_e.

    J. T.-Y. Wen and K. Kreutz-Delgado, The Attitude Control Problem, IEEE Transactions on Automatic Control 36(10),
    1991; the feedforward of a PD+ law: B. Paden and R. Panja, Globally Asymptotically Stable 'PD+' Controller for Robot
    Manipulators, International Journal of Control 47(6), 1988.
    """

    Settings = PDSettings
    gains = ("kp", "kd")

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return -now.gains["kp"] * sign * now.attitude_error[1:4] - now.gains["kd"] * now.rate_error, {}


class PIDSettings(TrackingSettings):
    """Model of the plant, gains and anti-windup. The defaults are those of the tuning rule."""

    kind: Literal["pid"] = Field(default="pid", description="which law")
    kp: Gains3 = Field(default=_PID["kp"], description="gain of the attitude error ε̃ [N·m]")
    kd: Gains3 = Field(default=_PID["kd"], description="gain of the rate error [N·m·s/rad]")
    ki: Gains3 = Field(default=_PID["ki"], description="gain of the integral [N·m/rad]")
    attitude_share: Diagonal = Field(
        default=_PID["attitude_share"], description="c, of ε̃ beside the rate error in the integral [1/s]"
    )
    reset_time: Diagonal = Field(
        default=_PID["reset_time"], description="T_t, time in which the integral gives way to a saturated motor [s]"
    )
    voltage_limit: float = Field(default=VOLTAGE_LIMIT, gt=0, description="at which a motor saturates [V]")


class PID(TrackingLaw[PIDSettings]):
    """PID: the PD+ law less k_i e_I. A back-calculation ends the windup: ė_I = ω_e ± c ε̃ + B(u − sat u)/(k_i T_t).

    Integral: F. Goodarzi, D. Lee and T. Lee, Geometric Nonlinear PID Control of a Quadrotor UAV on SE(3), European
    Control Conference, 2013, with ε̃ in place of their error in SO(3). Back-calculation: K. J. Åström and T. Hägglund,
    PID Controllers: Theory, Design, and Tuning, 2nd edition, 1995, section on integrator windup.
    """

    Settings = PIDSettings
    gains = ("kp", "kd", "ki")
    units: ClassVar = {"integral": "rad"}

    def initial(self) -> Mapping[str, Sequence[float]]:
        return {**super().initial(), "integral": [0.0] * 3}

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        eps_e = sign * now.attitude_error[1:4]
        e_I = now.state["integral"]
        torque = -now.gains["kp"] * eps_e - now.gains["kd"] * now.rate_error - now.gains["ki"] * e_I
        return torque, {"integral": e_I + self.period * (now.rate_error + ca.SX(self.settings.attitude_share) * eps_e)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """The voltages, and the integral less what they exceed the limit by."""
        u, state = super().expressions(now)
        p = self.settings
        B = ca.SX(check_allocation(p, self.actuators)[:, -self.actuators :])
        excess = B @ (u - ca.fmax(-p.voltage_limit, ca.fmin(p.voltage_limit, u)))
        ki = ca.fmax(now.gains["ki"], 1e-9)  # a gain of 0 is no integral
        share = ca.fmin(1, self.period / ca.SX(p.reset_time))
        return u, {**state, "integral": state["integral"] + share * excess / ki}


class SlidingSettings(TrackingSettings):
    """Model of the plant, surface and layer. The defaults are those of the tuning rule."""

    kind: Literal["sliding"] = Field(default="sliding", description="which law")
    slope: Gains3 = Field(default=_SLIDING["slope"], description="λ, slope of the surface [1/s]")
    strength: Gains3 = Field(default=_SLIDING["strength"], description="K, largest torque towards the surface [N·m]")
    layer: Diagonal = Field(default=_SLIDING["layer"], description="Φ, thickness of the boundary layer [rad/s]")


class Sliding(TrackingLaw[SlidingSettings]):
    """Smooth sliding mode: with σ = ω_e ± λ ε̃, τ = −J (±λ/2)(η̃I + S(ε̃)) ω_e − K tanh(σ/Φ), so ½σᵀJσ falls.

    On the surface σ = 0, ε̃ decays with the time constant 2/λ. Surface: J. L. Crassidis, S. R. Vadali and F. L. Markley,
    Optimal Variable-Structure Control Tracking of Spacecraft Maneuvers, Journal of Guidance, Control, and Dynamics
    23(3), 2000; boundary layer against chatter: J.-J. E. Slotine and W. Li, Applied Nonlinear Control, 1991, chapter 7.
    """

    Settings = SlidingSettings
    gains = ("slope", "strength")

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        p, slope = self.settings, sign * now.gains["slope"]
        eta_e, eps_e, omega_e = now.attitude_error[0], now.attitude_error[1:4], now.rate_error
        sigma = omega_e + slope * eps_e
        along = ca.SX(p.inertia) * slope / 2 * ((eta_e * ca.SX.eye(3) + S(eps_e)) @ omega_e)  # ε̃ moves by (C.17)
        return -along - now.gains["strength"] * tanh(sigma / ca.SX(p.layer)), {}


class LQRSettings(TrackingSettings):
    """Model of the plant and weights. The default weights are those of the tuning rule."""

    kind: Literal["lqr"] = Field(default="lqr", description="which law")
    attitude_weight: Diagonal = Field(
        default=_LQR["attitude_weight"], description="q_φ, of the angle's square against the torque's [(N·m/rad)²]"
    )
    rate_weight: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = Field(
        default=_LQR["rate_weight"], description="q_ω, of the rate's square against the torque's [(N·m·s/rad)²]"
    )


class LQR(TrackingLaw[LQRSettings]):
    """The discrete-time optimal regulator −K [±2ε̃, ω_e]. K follows from weights and period, so no gain may change.

    With the feedforward an axis is a double integrator, J φ̈ = τ with φ = ±2ε̃ to first order, held for a period. B. D.
    O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990.
    """

    Settings = LQRSettings

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        p = self.settings
        axes = zip(p.inertia, p.attitude_weight, p.rate_weight, strict=True)
        K = ca.SX(np.array([optimal_gain(J, angle, rate, self.period) for J, angle, rate in axes]))
        return -K[:, 0] * 2 * sign * now.attitude_error[1:4] - K[:, 1] * now.rate_error, {}


def optimal_gain(J: float, attitude_weight: float, rate_weight: float, T: float) -> Floats:
    """Gains of angle [N·m/rad] and rate [N·m·s/rad] for ticks of T [s]: K of x⁺ = A x + B τ, Σ xᵀQx + τ². Shape (2,).

    X = AᵀX(I + BBᵀX)⁻¹A + Q by doubling the horizon: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin and C.-S. Wang,
    Structure-Preserving Algorithms for Periodic Discrete-Time Algebraic Riccati Equations, International Journal of
    Control 77(8), 2004. SciPy, whose `solve_discrete_are` would do, is no dependency of the core. ValueError if none.
    """
    A, B = np.array([[1.0, T], [0.0, 1.0]]), np.array([[T * T / 2], [T]]) / J
    X = np.diag([attitude_weight, rate_weight])
    F, G = A, B @ B.T
    for _ in range(60):  # of 2⁶⁰ ticks
        W = np.linalg.inv(np.eye(2) + G @ X)
        F, G, X, last = F @ W @ F, G + F @ W @ G @ F.T, X + F.T @ X @ W @ F, X
        if np.abs(X - last).max() <= 1e-14 * np.abs(X).max():
            return np.asarray((B.T @ X @ A / (1 + B.T @ X @ B))[0])
    raise ValueError("law: these weights and this period have no optimal gains")


class NonadaptiveSettings(EstimateSettings):
    """Model of the plant, known damping included, and gains of the law. The default is Table C.1."""

    kind: Literal["nonadaptive"] = Field(default="nonadaptive", description="which law")
    C1: MatrixGain = Field(default=(0.3, 0.3, 0.3), description="gain of the attitude error [1/s]")
    C2: MatrixGain = Field(default=(0.15, 0.15, 0.15), description="gain of the rate error [N·m·s/rad]")


class Nonadaptive(ExpressionLaw[NonadaptiveSettings]):
    """(C.37) with a constant θ̂, so Γ = 0 in (C.38): what it does worse than `adaptive` is what adaptation is for."""

    Settings = NonadaptiveSettings
    gains = ("C1", "C2")

    def initial(self) -> Mapping[str, Sequence[float]]:
        return {"sign": (0.0,)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        adaptive = Adaptive(AdaptiveSettings(**self.settings.model_dump(exclude={"kind"})), self.period, self.actuators)
        gains = {**now.gains, "Gamma": ca.SX.zeros(3)}
        known = {**now.state, "damping_estimate": ca.SX(self.settings.damping_estimate)}
        u, state = adaptive.expressions(now._replace(gains=gains, state=known))
        return u, {"sign": state["sign"]}
