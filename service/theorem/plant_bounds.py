"""Bounds of what a configured plant does beyond (C.1)–(C.2): lag, friction, wind, sensors, a mechanism.

An emulated plant's settings say all of it. Of a machine nothing is known here: what it does beyond the equations
must be stated, by `--disturbance`. Each bound that a random number could exceed counts six standard deviations:
three of a gyro's axes at 500 Hz exceed them once in four days.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from math import hypot, pi, sqrt
from typing import Final, NamedTuple

import numpy as np

from aeroloop.plant_emulator.model.bodies import AeroSettings
from aeroloop.plant_emulator.model.emulated import DAMPING_RATIO, RotorSettings, SensorSettings
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.config import Settings
from aeroloop.service.control.reference import Floats

DEVIATIONS: Final = 6


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
    """What a plant does beyond the paper's equations. The default is a body of which nothing else is known.

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


def paper_body(settings: Settings) -> PlantBounds:
    """The paper's plant: three torques, perfect sensors, no lag; commands are held for a period."""
    return PlantBounds(age=settings.loop.period)


def plant_bounds(settings: Settings, stated: bool) -> PlantBounds:
    """The configured plant; a machine's needs a `stated` disturbance."""
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
    body = plant.aero if held else plant.rigid_body
    steady = body.gravity * hypot(
        *(body.mass * a - law.mass * b for a, b in zip(body.centre_of_mass, law.centre_of_mass, strict=True))
    )
    if body.gravity != law.gravity or body.inertia != law.inertia:
        unproven.append("gravity or inertia of the plant differ from the law's")
    B = np.array(law.allocation)[1:, 1:] if held else np.array(law.allocation)
    applied = np.array(body.thrust) if isinstance(body, AeroSettings) else np.array(plant.rigid_body.allocation)
    motors = len(B)
    torque = float(np.linalg.norm(applied - B, 2)) * sqrt(motors) * plant.voltage_limit
    if plant.faults:
        unproven.append("plant.faults are no part of any theorem")
    lag, uneven = _rotors(plant.rotor, B)
    if lag:
        assumed.append("the motors were in balance once, and the state within the set ever since (plant.rotor)")
    torque += float(np.linalg.norm(applied, 2)) * sqrt(motors) * plant.rotor.dead_zone_v
    torque += hypot(*plant.friction.coulomb)
    if plant.wind.blowing:
        steady += (blows := hypot(*plant.wind.torque))
        torque += blows * DEVIATIONS * plant.wind.gust
        assumed.append(f"gusts stay within {DEVIATIONS} standard deviations (plant.wind.gust)")
    found = PlantBounds(
        age,
        lag=lag,
        uneven=uneven,
        torque=torque,
        steady=steady,
        theta=_damping(plant),
        held_roll=held,
        assumed=assumed,
        unproven=unproven,
    )
    return _with_sensors(plant.sensors, found)


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
    if plant.kind == "aero":
        pitch, yaw = (*plant.friction.viscous, 0.0, 0.0)[:2]
        x, y, z = plant.aero.damping
        return x + yaw, y + pitch, z + yaw
    a, b, c = (*plant.friction.viscous, 0.0, 0.0, 0.0)[:3]
    x, y, z = plant.rigid_body.damping
    return x + a, y + b, z + c


def _with_sensors(sensors: SensorSettings, plant: PlantBounds) -> PlantBounds:
    steps = hypot(*(2 * pi / counts for counts in sensors.counts))
    delta_eps = steps / 2 if sensors.attitude == "encoders" else 0.0
    delta_omega, encoder, assumed = 0.0, EncoderRate(), list(plant.assumed)
    if sensors.rate == "derivative":
        of, ratio = sensors.bandwidth, DAMPING_RATIO
        variation, passed, lag = _filter(of, ratio)
        turn = 2 * pi / sensors.counts[0] * sqrt(2)
        encoder = EncoderRate(of, ratio, lag, ripple=steps * variation, angle=steps / 2 * passed, turn=turn)
        assumed.append("the rate's filter was in balance once, and the state within the set ever since (plant.sensors)")
    elif sensors.rate == "gyro":
        delta_omega = hypot(*sensors.gyro_bias) + sqrt(3) * DEVIATIONS * sensors.gyro_noise
        if sensors.gyro_noise:
            assumed.append(f"the gyro's noise stays within {DEVIATIONS} standard deviations (plant.sensors.gyro_noise)")
    return replace(plant, delta_eps=delta_eps, delta_omega=delta_omega, encoder=encoder, assumed=assumed)


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
