"""Controller, frames, endpoint and plant in lockstep: against law twin and plant twin, and through full turns.

A free body's q turns on without a jump; the law receives only the quantized ε of the frames. For any number of bits it
must reconstruct the same q up to the quantizers, and not lose the body.
"""

from __future__ import annotations

from math import cos, radians, sin, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from aeroloop.plant_emulator.model.emulated import SUBSTEPS
from aeroloop.protocol.messages.operator import Hold, Reference, Sinusoid
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service import examples
from aeroloop.service.config import Settings, as_overrides, bits_overrides, load, load_over
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.lab.experiment import run_experiment
from tests.support import numpy_twin as twin
from tests.support.adversary_loop import times as product
from tests.support.ideal import IDEAL
from tests.support.law_tick import body_of
from tests.support.numpy_twin import Array

LAW = AdaptiveSettings()
TICKS = 600


def test_the_closed_loop_agrees_with_the_twins() -> None:
    settings = load(overrides=[*IDEAL, *(f"wire.{signal}.bits=cont" for signal in ("attitude", "rate", "voltage"))])
    period, wire, aero, reference = settings.loop.period, settings.wire, settings.plant.aero, Sinusoid()
    plant = settings.plant.build(period)
    controller = Controller(wire, LAW, reference, period)
    law, theta = body_of(LAW), np.array(LAW.damping_estimate)
    desired = twin.Sinusoids(np.radians(reference.amplitude), np.array(reference.frequency)).desired
    body = twin.LockedBody(law, np.vstack([np.zeros(2), aero.thrust]), np.array(aero.damping), np.zeros(4))
    q: Array = np.array([1.0, 0.0, 0.0, 0.0])
    sign, limited = 0.0, list[bool]()

    def compare(k: int, _: bytes, command: bytes) -> None:
        nonlocal q, sign, theta
        assert plant.truth().attitude == pytest.approx(body.q, abs=1e-12)
        assert plant.truth().rate == pytest.approx(body.omega, abs=1e-12)
        q = twin.reconstructed(body.q[1:] * (1 if body.q[0] >= 0 else -1), q)
        wanted = desired(k * period)
        sign = sign or (1.0 if q @ wanted[0] >= 0 else -1.0)  # the scalar of (C.16) is the quaternions' inner product
        expected = twin.law(law, q, body.omega, *wanted, theta, sign)
        theta = theta + period * expected.theta_dot
        u = expected.u[1:]
        held = np.clip(u, -24.0, 24.0)
        limited.append(bool(np.any(held != u)))
        # A tick rounds by 1e-13 of u (B's condition). The loop is stable and forgets it within a second, 500 ticks,
        # so what has gathered stays below 500 of these.
        assert controller.voltages == pytest.approx(u, rel=5e-11, abs=5e-11)
        assert controller.attitude_error == pytest.approx(expected.e[1:], abs=1e-12)
        assert controller.law_state["damping_estimate"] == pytest.approx(theta, abs=1e-12)
        read = wire.command.unpack(command)
        assert read is not None
        assert list(read[1]) == pytest.approx(held, rel=5e-11, abs=5e-11)
        body.advance(held, period, SUBSTEPS)

    run_experiment(settings, TICKS * period, plant=plant, controller=controller, watch=compare)
    assert len(limited) == TICKS
    assert any(limited)  # the start is hard enough to meet the limits, which are part of what is compared
    assert abs(body.x[1]) > radians(10)  # and it went somewhere


# ── a free rigid body with three motors and its own inertia, B and gains, through full turns and quantized feedback ──


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
        "controller.max_reference_rate=2",
        *(f"plant.rigid_body.{value}" for value in BODY),
        *(f"law.{value}" for value in BODY),
    ],
)
"""400° is more than a turn, to and fro; roll and yaw do it in turns of different length, with up to 0.9 rad/s."""

AWAY = radians(60)
"""How far the body is from the desired attitude at the start, where it does not begin on the reference."""
ERRORS = {"6": 0.12, "cont": 0.02}
"""Largest |ε̃| on the way, about twice what was measured; a body that lets go passes 1."""

every_wire = pytest.mark.parametrize("bits", ERRORS)


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
        return product(self.q_d * [1, -1, -1, -1], self.q)


def run_from(bits: str, q: Array, omega: Array, seconds: float, reference: Reference = OTHER.reference) -> Run:
    """The closed loop in lockstep, through real frames, with the body at an attitude and rate at the start."""
    start = {"attitude": q.tolist(), "rate": omega.tolist()}
    settings = load_over(OTHER, [*bits_overrides(f"{bits}/{bits}"), *as_overrides({"plant": {"rigid_body": start}})])
    plant = settings.plant.build(settings.loop.period)
    controller = Controller(settings.wire, settings.law, reference, settings.loop.period)
    frames, rows = list[bytes](), list[tuple[object, ...]]()

    def watch(_: int, measurement: bytes, __: bytes) -> None:
        frames.append(measurement)
        sign = controller.law_state["sign"]
        rows.append((plant.truth().attitude, controller.attitude, controller.desired, sign))

    run_experiment(settings, seconds, plant=plant, controller=controller, watch=watch)
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    return Run(settings, frames, controller.saturated, *columns)


def crossings(eta: Array) -> int:
    """How often it changes its sign; to stay at 0 for a while, as a quantized η does, is not to change it."""
    return int(np.count_nonzero(np.diff(np.sign(eta[eta != 0]))))


# ── through full turns ──


@every_wire
def test_the_sign_of_q_goes_on_while_that_of_what_is_sent_turns_over_and_the_body_is_not_lost(bits: str) -> None:
    reference = OTHER.reference
    assert isinstance(reference, Sinusoid)
    desired = twin.Sinusoids(np.radians(reference.amplitude), np.array(reference.frequency)).desired
    run = run_from(bits, *desired(0.0)[:2], 60.0)  # there is nothing to settle
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
    """To an attitude that is described by η < 0, from a q of η ≥ 0 as received: η̃ < 0."""
    there = (0.0, 20.0, 290.0)
    q_d = twin.attitude_of(np.radians(there))
    q = product(q_d, np.append(cos(AWAY / 2), sin(AWAY / 2) * np.array([1, 2, -2]) / 3))
    q *= 1 if q[0] >= 0 else -1
    run = run_from(bits, q, np.zeros(3), 30.0, Hold(attitude=there))
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


def test_an_empty_frame_is_silence_only_where_measurements_are_sent_on_change() -> None:
    """Elsewhere it is malformed: the levels of an older measurement are not taken for those of this tick."""
    for transmit, answered, refused in (("periodic", False, 1), ("on_change", True, 0)):
        settings = load(overrides=[f'wire.transmit="{transmit}"'])
        controller = Controller(settings.wire, LAW, Hold(), settings.loop.period)
        assert controller.tick(settings.wire.measurement.pack(0, [0] * 6), 0)
        assert (controller.tick(UNCHANGED, 1) is not None) == answered
        assert (controller.refused, controller.tick_index) == (refused, int(answered))
