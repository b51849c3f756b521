"""Controller: a frame in, a frame out, and its state in between.

Frames are packed here by protocol.frames, which has its own tests; the controller's results are compared with the NumPy
twin. Invalid values and saturation: `test_tick.py`; full turns: `tests/service/test_rigid_body_loop.py`.
"""

from __future__ import annotations

from math import cos, isnan, pi, radians, sin

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.settings import IDEAL_AERO, PlantSettings
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.protocol.wire.attitude import Quaternion, Vector, sent_vector
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from tests.support import numpy_twin as twin
from tests.support.numpy_twin import Array
from tests.support.twin_body import body_of

COUNTERS = 1 << 8

PERIOD = 0.002
PERIOD_NS = 2_000_000
LAW = AdaptiveSettings()
PAPER = Sinusoid()
LEVEL = Sinusoid(amplitude=(0.0, 0.0, 0.0))
"""Hold q_d = [1, 0, 0, 0]."""

QUANTIZED = WireSpec()
CONTINUOUS = WireSpec().with_bits("cont/cont")
AT_REST: Vector = (0.0, 0.0, 0.0)


def _controller(wire: WireSpec = CONTINUOUS, reference: Sinusoid = PAPER, law: AdaptiveSettings = LAW) -> Controller:
    return Controller(wire, law, reference, PERIOD)


def _yawed(angle: float) -> Quaternion:
    return cos(angle / 2), 0.0, 0.0, sin(angle / 2)


def _frame(wire: WireSpec, counter: int, attitude: Quaternion, rate: Vector) -> bytes:
    """A measurement as a plant end sends it."""
    attitude_of, rate_of = wire.attitude.quantizer(), wire.rate.quantizer()
    codes = [attitude_of.encode(x) for x in sent_vector(attitude)] + [rate_of.encode(x) for x in rate]
    return wire.measurement.pack(counter % COUNTERS, codes)


def _answer(wire: WireSpec, frame: bytes | None) -> tuple[int, list[float]]:
    """Echo and voltages [V] of a command frame."""
    assert frame is not None
    read = wire.command.unpack(frame)
    assert read is not None
    return read[0], [wire.voltage.quantizer().level(code) for code in read[1]]


class TwinLoop:
    """The twin of the controller between its frames: law, reference, θ̂ and the sign."""

    def __init__(self, reference: Sinusoid, law: AdaptiveSettings = LAW) -> None:
        self.body = body_of(law)
        self.reference = twin.Sinusoids(np.radians(reference.amplitude), np.array(reference.frequency))
        self.theta: Array = np.array(law.damping_estimate)
        self.s = 0.0
        self.e: Array = np.zeros(4)

    def tick(self, q: Array, omega: Array, k: int) -> Array:
        """u₂ and u₃ before any limit [V]."""
        desired = self.reference.desired(k * PERIOD)
        if not self.s:
            eta_e = q @ desired[0]  # the scalar of (C.16) is the quaternions' inner product
            self.s = 1.0 if eta_e >= 0 else -1.0
        state = twin.law(self.body, q, omega, *desired, self.theta, self.s)
        self.theta = self.theta + PERIOD * state.theta_dot
        self.e = state.e
        return state.u[1:]


def _sign(controller: Controller) -> float:
    """Of the equilibrium that is approached."""
    return controller.law_state["sign"][0]


# Frames in, frames out


@pytest.mark.parametrize("wire", [QUANTIZED, CONTINUOUS], ids=["8/6 bits", "cont"])
def test_every_answer_echoes_the_counter_of_its_measurement(wire: WireSpec) -> None:
    controller = _controller(wire)
    for k in range(2 * COUNTERS):
        counter = (5 * k + 3) % COUNTERS  # in no order: the counter is the plant's business
        echo, _ = _answer(wire, controller.tick(_frame(wire, counter, _yawed(0.1), AT_REST), k))
        assert (echo, controller.counter, controller.tick_index) == (counter, counter, k)


def test_nothing_in_gives_nothing_out() -> None:
    controller = _controller()
    assert controller.tick(None, 0) is None
    assert (controller.tick_index, _sign(controller), controller.refused) == (-1, 0, 0)


@pytest.mark.parametrize("wire", [QUANTIZED, CONTINUOUS], ids=["8/6 bits", "cont"])
def test_malformed_bytes_are_counted_and_give_nothing_out(wire: WireSpec) -> None:
    quantized, wire = (
        wire is QUANTIZED,
        WireSpec.model_validate({**wire.model_dump(), "counter_bits": 4}),
    )  # has padding
    controller, untouched = _controller(wire), _controller(wire)
    frame = _frame(wire, 7, _yawed(0.3), (0.1, 0.2, 0.3))
    # 8 bits: the padding's last bit is set; cont: a bit of the gap after the counter is
    padding = frame[:-1] + bytes([frame[-1] | 1]) if quantized else bytes([frame[0] | 1]) + frame[1:]
    for k, junk in enumerate((b"", frame[:-1], frame + b"\0", padding)):
        assert controller.tick(junk, k) is None
        assert controller.refused == k + 1
    assert controller.tick(frame, 9) == untouched.tick(frame, 9)  # it left no trace
    assert controller.refused == 4


@pytest.mark.parametrize("wire", [QUANTIZED, CONTINUOUS], ids=["8/6 bits", "cont"])
def test_a_measurement_without_a_valid_value_is_no_tick_of_the_law_and_answered_without_one(wire: WireSpec) -> None:
    controller = _controller(wire)
    codes = [*(wire.attitude.quantizer().encode(0.1) for _ in range(3)), *[wire.rate.quantizer().invalid] * 3]
    echo, voltages = _answer(wire, controller.tick(wire.measurement.pack(2, codes), 4))
    assert (echo, [isnan(u) for u in voltages]) == (2, [True, True])
    assert (controller.tick_index, controller.counter, _sign(controller), controller.invalid) == (-1, 0, 0, 1)


# The sign of z₁, Assumption 3

AHEAD = Sinusoid(amplitude=(0.0, 0.0, 170.0), frequency=(0.0, 0.0, pi))
"""Yaw is at its crest of 170° at t = 0.5 s, tick 250."""


def test_the_sign_is_that_of_the_first_error_and_stays() -> None:
    near = _controller(reference=LEVEL)
    near.tick(_frame(CONTINUOUS, 0, _yawed(radians(100)), AT_REST), 0)
    assert _sign(near) == 1

    far = _controller(reference=AHEAD)
    far.tick(_frame(CONTINUOUS, 0, _yawed(radians(-170)), AT_REST), 250)  # η̃ = cos 170° < 0: 20° the short way
    assert _sign(far) == -1
    for k, yaw in enumerate((-120, -60, 0, 60, 120, 170), start=251):  # all the way round: η̃ = +1 at the end
        far.tick(_frame(CONTINUOUS, k, _yawed(radians(yaw)), AT_REST), k)
    # the desired yaw is 6 ticks past its crest: 170° (1 − cos 2°) = 0.12°, so ε̃ = sin 0.06°
    assert far.attitude_error == pytest.approx((0.0, 0.0, sin(radians(85 * (1 - cos(0.012 * pi))))), abs=1e-12)
    assert _sign(far) == -1


# The whole loop


def test_the_closed_loop_agrees_with_the_twins() -> None:
    """Controller, frames, endpoint and Aero against law twin and plant twin, tick by tick."""
    aero = IDEAL_AERO
    plant = PlantSettings(ideal=True).build(PERIOD)
    endpoint = Endpoint(plant, CONTINUOUS, PERIOD_NS, lockstep=True)
    claim = Claim(controller="test", session="loop", period_ns=PERIOD_NS, lockstep=True, auto_arm=True, wire=CONTINUOUS)
    assert isinstance(endpoint.claim(claim), Grant)
    controller, loop = _controller(), TwinLoop(PAPER)
    body = twin.LockedBody(body_of(LAW), np.vstack([np.zeros(2), aero.thrust]), np.array(aero.damping), np.zeros(4))
    q: Array = np.array([1.0, 0.0, 0.0, 0.0])
    measurement = endpoint.tick(None, 0)
    limited = 0
    for k in range(1000):
        command = controller.tick(measurement, k)
        q = twin.reconstructed(body.q[1:] * (1 if body.q[0] >= 0 else -1), q)
        u = loop.tick(q, body.omega, k)
        held = np.clip(u, -24.0, 24.0)
        limited += bool(np.any(held != u))
        # A tick rounds by 1e-13 of u (B's condition). The loop is stable and forgets it within a second, 500 ticks,
        # so what has gathered stays below 500 of these.
        assert controller.voltages == pytest.approx(u, rel=5e-11, abs=5e-11)
        assert controller.attitude_error == pytest.approx(loop.e[1:], abs=1e-12)
        assert controller.law_state["damping_estimate"] == pytest.approx(loop.theta, abs=1e-12)
        _, sent = _answer(CONTINUOUS, command)
        assert sent == pytest.approx(held, rel=5e-11, abs=5e-11)
        measurement = endpoint.tick(command, k + 1)
        body.advance(held, PERIOD, PlantSettings().substeps)
        assert plant.truth().attitude == pytest.approx(body.q, abs=1e-12)
        assert plant.truth().rate == pytest.approx(body.omega, abs=1e-12)
    assert limited > 0  # the start is hard enough to meet the limits, which are part of what is compared
    assert abs(body.x[1]) > radians(10)  # and it went somewhere
    assert endpoint.accepted == 1000
