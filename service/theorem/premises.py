"""Premises of the invariant set: the law near its reference, what the plant does beyond (C.1)–(C.2), and the wire.

Of an emulated plant the settings say all of it. Of a machine nothing is known here: what it does beyond the equations
must be stated, by `--disturbance`. Each bound that a random number could exceed counts six standard deviations:
three of a gyro's axes at 500 Hz exceed them once in four days. Vectors are diagonals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from math import cos, hypot, inf, pi, sqrt
from typing import Any, Final, NamedTuple

import numpy as np

from aeroloop.plant_emulator.model.bodies import AeroSettings
from aeroloop.plant_emulator.model.emulated import DAMPING_RATIO, RotorSettings
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import ESTIMATE_REACH, AdaptiveSettings
from aeroloop.service.control.laws.adaptive_torque import AdaptiveTorqueSettings
from aeroloop.service.control.laws.baselines import NonadaptiveSettings, PDSettings, PIDSettings
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.reference import Floats
from aeroloop.service.theorem.extremes import Extremes, chords, motors
from aeroloop.service.theorem.linear import Axis

DEVIATIONS: Final = 6
_NONE: Vector = (0.0, 0.0, 0.0)


class NoTheoremError(AeroloopError):
    """Nothing is proven of a configuration's law; one line."""


# ── the law ──


class Feedback(NamedTuple):
    """A law near its reference, (T.1) of README.md."""

    kp: Vector  # gain of ε̃ [N·m]
    kd: Vector  # gain of ω_e, without α [N·m·s/rad]
    centre: Vector  # θ̂(t₀), the centre of the ball that holds θ [N·m·s/rad]
    radius: float  # k_θ, the radius of that ball [N·m·s/rad]
    alpha: Vector = _NONE  # α, part of the gain of ω_e that acts through (η̃ I + S(ε̃)) [N·m·s/rad]
    ki: Vector = _NONE  # gain of the integral [N·m/rad]
    share: Vector = _NONE  # c, of ε̃ in z₂ = ω_e + c ε̃ and in the integral [1/s]
    reach: float = 0.0  # largest ‖θ̂ − θ̂(t₀)‖: k_θ/0.95 by the projection, 0 where nothing adapts [N·m·s/rad]
    Gamma: Vector = _NONE  # adaptation gain; 0 where nothing adapts
    volts: float = inf  # |u| from which the law itself saturates [V]
    torque: float = inf  # |θ̂_d| from which the estimate of a constant torque is kept back [N·m]
    coulomb: float = 0.0  # largest ‖θ̂_c‖, an estimate of Coulomb friction, which counts as a disturbance [N·m]
    virtual: bool = False  # whether θ̂ − θ̂(t₀) acts at the virtual rate ω − z₂ in place of ω

    @property
    def theta_error(self) -> float:
        """Largest ‖θ̃‖ [N·m·s/rad]."""
        return self.radius + self.reach

    @property
    def estimate(self) -> float:
        """Largest ‖θ̂‖ [N·m·s/rad]."""
        return hypot(*self.centre) + self.reach


def feedback_of(law: LawSettings) -> Feedback:
    """The feedback of a law's settings. Raises NoTheoremError for a law of which nothing is proven."""
    known = AdaptiveSettings, NonadaptiveSettings, PDSettings, PIDSettings, AdaptiveTorqueSettings
    if not isinstance(law, known):
        raise NoTheoremError(f"no theorem for this law, {law.kind}")
    if {len(row) for row in law.allocation} != {3}:
        raise NoTheoremError("no theorem for this vehicle, whose law.allocation is not 3 × 3")
    ball: dict[str, Any] = {"centre": law.damping_estimate, "radius": law.damping_bound}
    if isinstance(law, PDSettings):
        return Feedback(law.kp, law.kd, **ball)
    if isinstance(law, PIDSettings):
        return Feedback(law.kp, law.kd, **ball, ki=law.ki, share=law.attitude_share, volts=law.voltage_limit)
    C1, stiffness = np.array(law.C1), np.array(law.C1) * law.C2
    ball |= {"alpha": _diagonal(np.array(law.inertia) * C1 / 2), "share": law.C1}
    if isinstance(law, AdaptiveTorqueSettings):
        coulomb = np.array(law.coulomb_estimate) + law.coulomb_bound * (np.array(law.Gamma_coulomb) > 0)
        return Feedback(
            _diagonal(np.array(law.k1) + stiffness), law.C2, **ball, ki=law.Gamma_torque, Gamma=law.Gamma_damping,
            reach=sqrt(3) * law.damping_bound if any(law.Gamma_damping) else 0.0,  # a box, not a ball
            volts=law.voltage_limit, torque=min(law.torque_bound), coulomb=hypot(*coulomb.tolist()), virtual=True,
        )  # fmt: skip
    kp = _diagonal(1 + stiffness)
    if isinstance(law, NonadaptiveSettings):
        return Feedback(kp, law.C2, **ball)
    return Feedback(kp, law.C2, **ball, reach=law.damping_bound * ESTIMATE_REACH, Gamma=law.Gamma)


def _diagonal(gains: Floats) -> Vector:
    a, b, c = gains.tolist()
    return a, b, c


# ── the plant ──


class EncoderRate(NamedTuple):
    """Errors of a rate that is the filtered derivative of encoders' angles; 0 of any other sensor."""

    bandwidth: float = 0.0  # ω_n of the filter [rad/s]
    ratio: float = 0.0  # its ζ [1]
    lag: float = 0.0  # its delay, ∫|1 − step response| [s]
    ripple: float = 0.0  # largest ‖ω‖ by which the encoders' steps make it err [rad/s]
    angle: float = 0.0  # the error, as it passes the filter, of the angle whose derivative that is [rad]
    turn: float = 0.0  # error of the pitch by which joint rates become ω [rad]


NO_ENCODER: Final = EncoderRate()


@dataclass(frozen=True)
class PlantBounds:
    """What a plant does beyond the paper's equations. The default is the paper's body: three torques, perfect sensors.

    `assumed` and `unproven` say with their keys what is assumed, and what cannot be bounded: with any of it no
    certificate holds.
    """

    age: float  # longest time from a measurement to the end of its command, before the rotors' lag [s]
    lag: float = 0.0  # time constant of the rotors, between that of a rise and that of a fall; 0 without [s]
    uneven: float = 0.0  # ‖·‖ of the share of what lags by which a rotor that rises or falls errs beside that [1]
    delta_eps: float = 0.0  # largest |ε_k| by which the attitude sensor errs [1]
    delta_omega: float = 0.0  # largest ‖ω‖ by which a gyro errs [rad/s]
    encoder: EncoderRate = NO_ENCODER
    torque: float = 0.0  # largest torque of friction, dead zone, gusts and motors that differ from the law's [N·m]
    steady: float = 0.0  # largest torque that changes only as the body turns: steady wind, another weight [N·m]
    theta: Vector | None = None  # θ, if the plant's damping is known [N·m·s/rad]
    held_roll: bool = False  # whether a mechanism holds the roll, so that u₁ is never applied
    assumed: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)


def plant_bounds(settings: Settings, stated: bool) -> PlantBounds:
    """The configured plant; a machine's needs a `stated` disturbance."""
    plant, law, loop = settings.plant, settings.law, settings.loop
    assumed, unproven = ["the plant waits for every command (loop.lockstep)"], list[str]()
    if not loop.lockstep:
        assumed = ["every frame arrives within its period, none is lost or missed (`lab certify` prints how many may)"]
    age = loop.period * (1 if loop.lockstep else 2)
    if plant.via in ("can", "quanser") or not plant.emulated:
        key = "kind" if plant.via == "emulator" else "via"
        beyond = f"lag, friction and sensors of the machine (plant.{key} = {getattr(plant, key)!r})"
        assumed.append(f"{beyond} are within --disturbance")
        unproven += [] if stated else [f"{beyond} are not known: state --disturbance"]
        return PlantBounds(age, held_roll=settings.wire.actuators == 2, assumed=assumed, unproven=unproven)

    held = plant.kind == "aero"
    body, first = (plant.aero, 1) if held else (plant.rigid_body, 0)
    B = np.array(law.allocation)[first:, first:]
    applied = np.array(body.thrust if isinstance(body, AeroSettings) else body.allocation)
    per_volt = np.linalg.norm([applied - B, applied], 2, axis=(1, 2)) * sqrt(len(B))
    torque = float(per_volt @ (plant.voltage_limit, plant.rotor.dead_zone_v)) + hypot(*plant.friction.coulomb)
    shift = body.mass * np.array(body.centre_of_mass) - law.mass * np.array(law.centre_of_mass)
    steady = body.gravity * hypot(*shift.tolist())
    if body.gravity != law.gravity or body.inertia != law.inertia:
        unproven.append("gravity or inertia of the plant differ from the law's")
    if plant.faults:
        unproven.append("plant.faults are no part of any theorem")
    lag, uneven = _rotors(plant.rotor, B)
    if lag:
        assumed.append("the motors were in balance once, and the state within the set ever since (plant.rotor)")
    if plant.wind.blowing:
        steady += (blows := hypot(*plant.wind.torque))
        torque += blows * DEVIATIONS * plant.wind.gust
        assumed.append(f"gusts stay within {DEVIATIONS} standard deviations (plant.wind.gust)")

    sensors, delta_omega, encoder = plant.sensors, 0.0, NO_ENCODER
    steps = hypot(*(2 * pi / counts for counts in sensors.counts))
    if sensors.rate == "derivative":
        variation, passed, delay = _filter(sensors.bandwidth, DAMPING_RATIO)
        turn, angle = 2 * pi / sensors.counts[0] * sqrt(2), steps / 2 * passed
        encoder = EncoderRate(sensors.bandwidth, DAMPING_RATIO, delay, steps * variation, angle, turn)
        assumed.append("the rate's filter was in balance once, and the state within the set ever since (plant.sensors)")
    elif sensors.rate == "gyro":
        delta_omega = hypot(*sensors.gyro_bias) + sqrt(3) * DEVIATIONS * sensors.gyro_noise
        if sensors.gyro_noise:
            assumed.append(f"the gyro's noise stays within {DEVIATIONS} standard deviations (plant.sensors.gyro_noise)")
    return PlantBounds(
        age, lag, uneven, steps / 2 if sensors.attitude == "encoders" else 0.0, delta_omega, encoder, torque, steady,
        _damping(plant), held, assumed, unproven,
    )  # fmt: skip


def _rotors(rotor: RotorSettings, B: Floats) -> tuple[float, float]:
    """The rotors' lag [s], and what it errs by where a rise and a fall differ, as a share of a torque's lagging part.

    V̇ = (u − V)/T(t) with either lag is (1 + e)(u − V)/T with the harmonic mean T and |e| ≤ |T₁ − T₂|/(T₁ + T₂). Each
    motor has its own e: of the torques it is B diag(e) B⁻¹, largest where all |e| are.
    """
    up, down = rotor.lag_up_s, rotor.lag_down_s
    if not rotor.present:
        return 0.0, 0.0
    signs = (np.diag(each) for each in product((-1.0, 1.0), repeat=len(B)))
    most = max(float(np.linalg.norm(B @ sign @ np.linalg.inv(B), 2)) for sign in signs)
    return 2 * up * down / (up + down), abs(up - down) / (up + down) * most


def _damping(plant: PlantSettings) -> Vector:
    """θ with viscous friction: about a held roll's joints it acts as damping about the body's axes does."""
    a, b, c = (*plant.friction.viscous, 0.0, 0.0, 0.0)[:3]
    own, viscous = (plant.aero.damping, (b, a, b)) if plant.kind == "aero" else (plant.rigid_body.damping, (a, b, c))
    return _diagonal(np.add(own, viscous))


def _filter(omega_n: float, zeta: float) -> tuple[float, float, float]:
    """Of ω_n²/(s² + 2ζω_n s + ω_n²), three figures for the errors of a rate.

    They are the largest rate of its output for an input that varies by 1 [1/s], its output for an input within ±1 [1],
    and ∫|1 − step response| [s].
    """
    t = np.linspace(0, 40 / (zeta * omega_n), 40_000)
    ringing = omega_n * sqrt(1 - zeta**2)
    decay = np.exp(-zeta * omega_n * t)
    rate = omega_n**2 / ringing * decay * np.sin(ringing * t)  # of a step of the angle
    settled = decay * (np.cos(ringing * t) + zeta * omega_n / ringing * np.sin(ringing * t))  # 1 − step response
    variation = float(np.abs(np.diff(rate)).sum()) / 2
    return variation, float(np.trapezoid(np.abs(rate), t)), float(np.trapezoid(np.abs(settled), t))


# ── all of it ──


@dataclass(frozen=True)
class Premises:
    """What the set is computed from. Letters as in `bounds`."""

    law: Feedback
    desired: Extremes
    plant: PlantBounds  # with any further torque or age of a command
    J: Vector  # inertia [kg·m²]
    weight: float  # ‖r_g‖ m g [N·m]
    weight_roll: float  # |r_g,y| m g: the weight's torque about the held roll [N·m]
    norm_B: float  # ‖B‖ [N·m/V]
    delta_omega: float  # largest ‖ω^Q − ω‖, without a rate's errors by encoders [rad/s]
    delta_u: float  # largest ‖u^Q − u‖ [V]
    delta_q: Callable[[float], float]  # largest ‖q^Q − q‖ where the attitude errs by half an angle [rad]
    period: float  # of the loop [s]

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Each axis that differs; with a held roll x and z mix, and their means stand for both."""
        law, encoder = self.law, self.plant.encoder
        gains = np.array([law.kp, law.kd, law.alpha, law.ki, law.share, law.centre, self.J]).T.tolist()
        if self.plant.held_roll:
            x, y, z = gains
            gains = [y, [*((a + b) / 2 for a, b in zip(x[:-1], z[:-1], strict=True)), max(self.J)]]
        late = self.plant.lag, encoder.bandwidth, encoder.ratio
        shares = [1.0, self.phi, 1.0] if self.plant.held_roll else [1.0] * 3
        return tuple(dict.fromkeys(Axis(*[*gain, share, *late]) for gain, share in zip(gains, shares, strict=False)))

    @property
    def phi(self) -> float:
        """φ: the mean share of a yaw torque that the motors produce along the reference [1]."""
        return (1 + cos(self.desired.pitch) ** 2) / 2 if self.plant.held_roll else 1.0


def premises(
    settings: Settings, desired: Extremes, plant: PlantBounds, disturbance: float = 0.0, late_s: float = 0.0
) -> Premises:
    """Premises of the invariant set, with a further torque [N·m] and a further age of every command [s]."""
    wire, law = settings.wire, settings.law
    gravity = law.mass * law.gravity
    return Premises(
        law=feedback_of(law),
        desired=desired,
        plant=replace(plant, age=plant.age + late_s, torque=plant.torque + disturbance),
        J=law.inertia,
        weight=float(np.linalg.norm(law.centre_of_mass)) * gravity,
        weight_roll=abs(law.centre_of_mass[1]) * gravity,
        norm_B=float(np.linalg.norm(motors(settings), 2)),
        delta_omega=quantization_error(wire.rate, 3) + plant.delta_omega,
        delta_u=quantization_error(wire.voltage, wire.actuators),
        delta_q=chords(desired, quantization_error(wire.attitude, 1) + plant.delta_eps),
        period=settings.loop.period,
    )


@lru_cache(maxsize=64)
def quantization_error(signal: SignalSpec, elements: int) -> float:
    """‖δ_y‖ of (C.15) for a vector with equal quantizers for all elements [signal's unit]."""
    return sqrt(elements) * signal.quantizer().bound
