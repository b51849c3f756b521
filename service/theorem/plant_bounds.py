"""Bounds of what a configured plant does beyond (C.1)–(C.2): lag, friction, wind, sensors, a mechanism.

An emulated plant's settings say all of it. Of a machine nothing is known here: what it does beyond the equations
must be stated, by `--disturbance`. Each bound that a random number could exceed counts six standard deviations:
three of a gyro's axes at 500 Hz exceed them once in four days.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from math import hypot, pi, sqrt
from typing import Final

import numpy as np

from aeroloop.plant_emulator.model.aero import AeroSettings
from aeroloop.plant_emulator.model.emulated import RotorSettings
from aeroloop.plant_emulator.model.sensors import SensorSettings
from aeroloop.plant_emulator.settings import IDEAL_AERO, PlantSettings
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.control.reference import Floats
from aeroloop.service.theorem.configured import Configured, Sections

DEVIATIONS: Final = 6


@dataclass(frozen=True)
class PlantBounds:
    """What a plant does beyond the paper's equations. The default is a body of which nothing else is known.

    Attributes:
        age: Longest time from a measurement to the end of its command's effect [s].
        delta_eps: Largest |ε_k| by which the attitude sensor errs [1].
        delta_omega: Largest ‖ω‖ by which the rate sensor errs, without its lag [rad/s].
        rate_lag: Mean delay of the rate sensor's filter [s].
        torque: Largest torque of friction, dead zone, wind and a model that differs [N·m].
        theta: θ, if the plant's damping is known [N·m·s/rad].
        held_roll: Whether a mechanism holds the roll, so that u₁ is never applied.
        assumed: What is assumed of it, each with its key.
        unproven: What cannot be bounded, each with its key; no certificate holds with any.
    """

    age: float
    delta_eps: float = 0.0
    delta_omega: float = 0.0
    rate_lag: float = 0.0
    torque: float = 0.0
    theta: Vector | None = None
    held_roll: bool = False
    assumed: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)


def paper_body(settings: Sections) -> PlantBounds:
    """The paper's plant: three torques, perfect sensors, no lag; commands are held for a period."""
    return PlantBounds(age=settings.loop.period)


def plant_bounds(settings: Configured, stated: bool) -> PlantBounds:
    """The configured plant.

    Args:
        settings: The configuration.
        stated: Whether a disturbance bound is stated, as a machine needs.
    """
    plant, law, loop = settings.plant, settings.law, settings.loop
    age = loop.period * (1 if loop.lockstep else 2)
    if not loop.lockstep:
        timely = "every frame arrives within its period, none is lost or missed (`lab certify` prints how many may)"
    else:
        timely = "the plant waits for every command (loop.lockstep)"
    if plant.via in ("can", "quanser") or not plant.emulated:
        key = "kind" if plant.via == "emulator" else "via"
        beyond = f"lag, friction and sensors of the machine (plant.{key} = {getattr(plant, key)!r})"
        held = settings.wire.actuators == 2
        unknown = [] if stated else [f"{beyond} are not known: state --disturbance"]
        return PlantBounds(
            age, held_roll=held, assumed=[timely, f"{beyond} are within --disturbance"], unproven=unknown
        )

    assumed, unproven = [timely], list[str]()
    held = plant.kind == "aero"
    aero = IDEAL_AERO if plant.ideal else plant.aero
    body = aero if held else plant.rigid_body
    torque = body.gravity * hypot(
        *(body.mass * a - law.mass * b for a, b in zip(body.centre_of_mass, law.centre_of_mass, strict=True))
    )
    if body.gravity != law.gravity or body.inertia != law.inertia:
        unproven.append("gravity or inertia of the plant differ from the law's")
    B = np.array(law.allocation)[1:, 1:] if held else np.array(law.allocation)
    applied = np.array(aero.thrust) if isinstance(body, AeroSettings) else np.array(plant.rigid_body.allocation)
    motors = len(B)
    torque += float(np.linalg.norm(applied - B, 2)) * sqrt(motors) * plant.voltage_limit
    if plant.faults:
        unproven.append("plant.faults are no part of any theorem")
    if plant.ideal:
        return PlantBounds(age, torque=torque, theta=body.damping, held_roll=held, assumed=assumed, unproven=unproven)

    if plant.rotor.present:
        age += _rotors_age(plant.rotor, B)
        assumed.append("the motors were in balance once, and the state within the set ever since (plant.rotor)")
    torque += float(np.linalg.norm(applied, 2)) * sqrt(motors) * plant.rotor.dead_zone_v
    torque += hypot(*plant.friction.coulomb)
    if plant.wind.blowing:
        torque += hypot(*plant.wind.torque) * (1 + DEVIATIONS * plant.wind.gust)
        assumed.append(f"gusts stay within {DEVIATIONS} standard deviations (plant.wind.gust)")
    return _with_sensors(
        plant.sensors,
        settings.wire.rate.limit,
        PlantBounds(age, torque=torque, theta=_damping(plant), held_roll=held, assumed=assumed, unproven=unproven),
    )


def _rotors_age(rotor: RotorSettings, B: Floats) -> float:
    """The age of a torque by the rotors' lags [s].

    A motor that lags by K(t) errs by ∫ w(s) u̇(t − s) ds with e^{−s/K₁} ≤ w(s) ≤ e^{−s/K₂}, K₁ the smaller lag. So the
    torque errs by K₁ of its largest rate, and by K₂ − K₁ times the norm of B D B⁻¹, which for 0 ≤ D ≤ I is largest
    where D has 0s and 1s alone, and 1 only if B is orthogonal or diagonal.
    """
    low, high = sorted((rotor.lag_up_s, rotor.lag_down_s))
    some = (np.diag(each) for each in product((0.0, 1.0), repeat=len(B)))
    return low + (high - low) * max(float(np.linalg.norm(B @ D @ np.linalg.inv(B), 2)) for D in some)


def _damping(plant: PlantSettings) -> Vector:
    """θ with viscous friction: about a held roll's joints it acts as damping about the body's axes does."""
    if plant.kind == "aero":
        pitch, yaw = (*plant.friction.viscous, 0.0, 0.0)[:2]
        x, y, z = plant.aero.damping
        return x + yaw, y + pitch, z + yaw
    a, b, c = (*plant.friction.viscous, 0.0, 0.0, 0.0)[:3]
    x, y, z = plant.rigid_body.damping
    return x + a, y + b, z + c


def _with_sensors(sensors: SensorSettings, rate_limit: float, plant: PlantBounds) -> PlantBounds:
    delta_eps = delta_omega = rate_lag = 0.0
    steps = hypot(*(2 * pi / counts for counts in sensors.counts))
    assumed = list(plant.assumed)
    if sensors.attitude == "encoders":
        delta_eps = steps / 2
    if sensors.rate == "derivative":
        ripple, rate_lag = _filter(sensors.bandwidth, sensors.damping_ratio)
        # The pitch by which joint rates become ω errs by a step, and the yaw's rate is within the wire's range.
        delta_omega = steps * ripple + 2 * pi / sensors.counts[0] * sqrt(2) * rate_limit
        assumed.append("the state was within the set for as long as the rate's filter lasts (plant.sensors.bandwidth)")
    elif sensors.rate == "gyro":
        delta_omega = hypot(*sensors.gyro_bias) + sqrt(3) * DEVIATIONS * sensors.gyro_noise
        if sensors.gyro_noise:
            assumed.append(f"the gyro's noise stays within {DEVIATIONS} standard deviations (plant.sensors.gyro_noise)")
    return replace(plant, delta_eps=delta_eps, delta_omega=delta_omega, rate_lag=rate_lag, assumed=assumed)


def _filter(omega_n: float, zeta: float) -> tuple[float, float]:
    """Of ω_n² s/(s² + 2ζω_n s + ω_n²): its output for an input that varies by 1 [1/s], its ∫|1 − step| [s]."""
    t = np.linspace(0, 40 / (zeta * omega_n), 40_000)
    ringing = omega_n * sqrt(1 - zeta**2)
    decay = np.exp(-zeta * omega_n * t)
    rate = omega_n**2 / ringing * decay * np.sin(ringing * t)  # of a step of the angle
    settled = decay * (np.cos(ringing * t) + zeta * omega_n / ringing * np.sin(ringing * t))  # 1 − step response
    return float(np.abs(np.diff(rate)).sum()) / 2, float(np.trapezoid(np.abs(settled), t))
