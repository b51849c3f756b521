"""Controller, frames, endpoint and Aero against law twin and plant twin, tick by tick.

Full turns and the sign of Assumption 3: `tests/service/test_rigid_body_loop.py`.
"""

from __future__ import annotations

from math import radians

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.model.emulated import SUBSTEPS
from aeroloop.protocol.messages.models import Grant
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from tests.support import ideal
from tests.support import numpy_twin as twin
from tests.support.numpy_twin import Array
from tests.support.plant_end import claim_of
from tests.support.twin_body import body_of

PERIOD = 0.002
LAW = AdaptiveSettings()
CONTINUOUS = WireSpec().with_bits("cont/cont")


def test_the_closed_loop_agrees_with_the_twins() -> None:
    period_ns, reference = round(PERIOD * 1e9), Sinusoid()
    plant = ideal.PLANT.build(PERIOD)
    endpoint = Endpoint(plant, CONTINUOUS, period_ns, lockstep=True)
    assert isinstance(endpoint.claim(claim_of(wire=CONTINUOUS, period_ns=period_ns, lockstep=True)), Grant)
    controller = Controller(CONTINUOUS, LAW, reference, PERIOD)
    law, theta = body_of(LAW), np.array(LAW.damping_estimate)
    desired = twin.Sinusoids(np.radians(reference.amplitude), np.array(reference.frequency)).desired
    thrust, damping = np.vstack([np.zeros(2), ideal.AERO.thrust]), np.array(ideal.AERO.damping)
    body = twin.LockedBody(law, thrust, damping, np.zeros(4))
    q: Array = np.array([1.0, 0.0, 0.0, 0.0])
    sign, limited = 0.0, 0
    measurement = endpoint.tick(None, 0)
    for k in range(1000):
        assert measurement is not None
        command = controller.tick(measurement, k)
        q = twin.reconstructed(body.q[1:] * (1 if body.q[0] >= 0 else -1), q)
        wanted = desired(k * PERIOD)
        sign = sign or (1.0 if q @ wanted[0] >= 0 else -1.0)  # the scalar of (C.16) is the quaternions' inner product
        expected = twin.law(law, q, body.omega, *wanted, theta, sign)
        theta = theta + PERIOD * expected.theta_dot
        u = expected.u[1:]
        held = np.clip(u, -24.0, 24.0)
        limited += bool(np.any(held != u))
        # A tick rounds by 1e-13 of u (B's condition). The loop is stable and forgets it within a second, 500 ticks,
        # so what has gathered stays below 500 of these.
        assert controller.voltages == pytest.approx(u, rel=5e-11, abs=5e-11)
        assert controller.attitude_error == pytest.approx(expected.e[1:], abs=1e-12)
        assert controller.law_state["damping_estimate"] == pytest.approx(theta, abs=1e-12)
        assert command is not None
        read = CONTINUOUS.command.unpack(command)
        assert read is not None
        assert list(read[1]) == pytest.approx(held, rel=5e-11, abs=5e-11)
        measurement = endpoint.tick(command, k + 1)
        body.advance(held, PERIOD, SUBSTEPS)
        assert plant.truth().attitude == pytest.approx(body.q, abs=1e-12)
        assert plant.truth().rate == pytest.approx(body.omega, abs=1e-12)
    assert limited > 0  # the start is hard enough to meet the limits, which are part of what is compared
    assert abs(body.x[1]) > radians(10)  # and it went somewhere
    assert endpoint.accepted == 1000
