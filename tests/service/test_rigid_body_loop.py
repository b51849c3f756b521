"""Free rigid body with three motors and its own inertia, B and gains, through full turns and quantized feedback.

The plant's q turns on without a jump; the law receives only the quantized ε of the frames. For any number of bits it
must reconstruct the same q up to the quantizers, and not lose the body.
"""

from __future__ import annotations

from functools import cache
from math import cos, radians, sin, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.service import examples
from aeroloop.service.config import Settings, as_overrides, bits_overrides, load, load_over
from aeroloop.service.control.controller import Controller
from tests.support import numpy_twin as twin
from tests.support.numpy_twin import Array

BODY = (
    "inertia=[0.03, 0.02, 0.025]",
    "mass=0.8",
    "centre_of_mass=[0.001, -0.002, -0.003]",
    "allocation=[[0.03, 0.004, 0.0], [-0.003, 0.028, 0.005], [0.002, -0.004, 0.033]]",
)
"""What the plant is and the law believes. J, B and r_g are not the paper's, and B is full."""

OTHER = load(
    Path(examples.__path__[0]) / "rigid-body.toml",
    overrides=[
        "plant.voltage_limit=36",
        "plant.rigid_body.damping=[0.012, 0.008, 0.015]",
        "law.C1=[0.5, 0.6, 0.4]",
        "law.C2=[0.35, 0.3, 0.4]",
        "law.Gamma=[0.03, 0.01, 0.02]",
        "law.damping_bound=0.04",
        "wire.rate.limit=2.0",
        "wire.voltage.limit=36",
        "loop.rate_hz=250",
        "reference.amplitude=[400.0, 30.0, 400.0]",
        "reference.frequency=[0.1, 0.13, 0.08]",
        *(f"plant.rigid_body.{value}" for value in BODY),
        *(f"law.{value}" for value in BODY),
    ],
)
"""400° is more than a turn, to and fro; roll and yaw do it in turns of different length, with up to 0.9 rad/s."""

SECONDS = 60.0
AWAY = radians(60)
"""How far the body is from the desired attitude at the start, where it does not begin on the reference."""
ERRORS = {"6": 0.12, "cont": 0.02}
"""Largest |ε̃| on the way, about twice what was measured; a body that lets go passes 1."""

every_wire = pytest.mark.parametrize("bits", ERRORS)


@cache
def desired(k: int) -> tuple[Array, Array, Array]:
    """q_d, ω_d and ω̇_d at tick k, by the twin; every run here follows the same reference."""
    assert isinstance(OTHER.reference, Sinusoid)
    reference = twin.Sinusoids(np.radians(OTHER.reference.amplitude), np.array(OTHER.reference.frequency))
    return reference.desired(k * OTHER.loop.period)


class Run(NamedTuple):
    """A run; rows are ticks. q is true, q_seen as the controller reports it."""

    settings: Settings
    frames: list[bytes]
    saturated: int
    q: Array
    q_seen: Array
    q_d: Array
    sign: Array

    @property
    def e(self) -> Array:
        """q̄_d ⊗ q of the true attitude, which never jumps either. Shape (ticks, 4)."""
        eta_d, eps_d, eta, eps = self.q_d[:, :1], self.q_d[:, 1:], self.q[:, :1], self.q[:, 1:]
        scalar = eta_d * eta + np.sum(eps_d * eps, axis=1, keepdims=True)
        return np.hstack([scalar, eta_d * eps - eta * eps_d - np.cross(eps_d, eps)])


def run_from(bits: str, q: Array, omega: Array, first_tick: int, seconds: float) -> Run:
    """The closed loop in lockstep, through real frames, with the body at an attitude and rate at the start."""
    start = {"attitude": q.tolist(), "rate": omega.tolist()}
    settings = load_over(OTHER, [*bits_overrides(f"{bits}/{bits}"), *as_overrides({"plant": {"rigid_body": start}})])
    loop, wire = settings.loop, settings.wire
    plant = settings.plant.build(loop.period)
    endpoint = Endpoint(plant, wire, loop.period_ns, lockstep=True)
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    claim = Claim(controller="test", session="loop", period_ns=loop.period_ns, lockstep=True, auto_arm=True, wire=wire)
    assert isinstance(endpoint.claim(claim), Grant)
    frames, rows = list[bytes](), list[tuple[object, ...]]()
    measurement = endpoint.tick(None, 0)
    for k in range(first_tick, first_tick + loop.ticks(seconds)):
        assert measurement is not None
        frames.append(measurement)
        true = plant.truth().attitude
        command = controller.tick(measurement, k)
        assert command is not None
        rows.append((true, controller.attitude, desired(k)[0], controller.law_state["sign"]))
        measurement = endpoint.tick(command, k + 1 - first_tick)
    assert endpoint.answered == len(frames) - 1
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    return Run(settings, frames, endpoint.saturated + controller.saturated, *columns)


def crossings(eta: Array) -> int:
    """How often it changes its sign; to stay at 0 for a while, as a quantized η does, is not to change it."""
    return int(np.count_nonzero(np.diff(np.sign(eta[eta != 0]))))


# ── through full turns ──


@every_wire
def test_the_sign_of_q_goes_on_while_that_of_what_is_sent_turns_over_and_the_body_is_not_lost(bits: str) -> None:
    q_d, omega_d, _ = desired(0)  # there is nothing to settle
    run = run_from(bits, q_d, omega_d, 0, SECONDS)
    assert crossings(run.q[:, 0]) == crossings(run.q_seen[:, 0]) >= 4
    assert run.q[:, 0].min() < -0.8  # far enough to mean it
    assert run.q[:, 0].max() > 0.8
    assert run.saturated == 0
    # ε is known to δ. η = √(1 − εᵀε), and |√a − √b| ≤ √|a − b|, where a − b is at most 2δ + δ²: the worst is at η = 0.
    # Scaling ε to unit length (Remark 2) takes it nearer to every unit ε. εᵀε rounds by 2e-16, so η by its root.
    attitude = run.settings.wire.attitude.quantizer()
    delta = sqrt(3) * attitude.bound
    assert np.linalg.norm(run.q_seen - run.q, axis=1).max() <= sqrt(delta**2 + (2 * delta + delta**2)) + 3e-8
    sent = [run.settings.wire.measurement.unpack(frame) for frame in run.frames]
    eps = np.array([[attitude.level(code) for code in read[1][:3]] for read in sent if read is not None])
    jumps = np.linalg.norm(np.diff(eps, axis=0), axis=1) > 1  # where η = 0, ‖ε‖ = 1 and so it jumps by 2
    assert np.count_nonzero(jumps) == crossings(run.q[:, 0])
    assert np.linalg.norm(run.e[:, 1:], axis=1).max() < ERRORS[bits]
    assert run.e[:, 0].min() > 0  # the body never starts to unwind
    assert (run.sign == 1).all()


# ── towards the other equilibrium ──


@every_wire
def test_a_start_with_negative_eta_of_the_error_goes_the_short_way_and_stays_there(bits: str) -> None:
    """From where q_d has its smallest η, with q of η ≥ 0 as received: η̃ < 0."""
    first = min(range(OTHER.loop.ticks(SECONDS)), key=lambda k: float(desired(k)[0][0]))
    q_d, omega_d, _ = desired(first)
    eta, eps = cos(AWAY / 2), sin(AWAY / 2) * np.array([1, 2, -2]) / 3
    q = np.append(q_d[0] * eta - q_d[1:] @ eps, q_d[0] * eps + eta * q_d[1:] + np.cross(q_d[1:], eps))
    q *= 1 if q[0] >= 0 else -1
    run = run_from(bits, q, twin.rotation(q).T @ omega_d, first, 30.0)
    assert run.q_d[0, 0] < -0.8
    assert run.q[0, 0] > 0
    assert run.e[0, 0] < -0.8  # cos 30°
    assert (run.sign == -1).all()
    assert run.saturated == 0
    error = np.linalg.norm(run.e[:, 1:], axis=1)
    assert run.e[:, 0].max() < 0  # the long way would pass η̃ = 0
    assert error.max() <= sin(AWAY / 2) + ERRORS[bits]
    # The slowest pole, near −2.4 1/s, has made less than 1e-5 of the start after 5 s.
    assert error[run.settings.loop.ticks(5.0) :].max() < ERRORS[bits]
