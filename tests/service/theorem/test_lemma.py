"""Lemma 1 and the theorem's last step, on random states through the real quantizers: no bound is exceeded.

Half of the states are aimed: ε and ω at the corners of the quantizers' cells, as far from [1, 0] as the bounds allow,
with little error. There a bound of half the size would be exceeded, so the check has power.
"""

from __future__ import annotations

from dataclasses import replace
from math import asin, floor, radians, sin, sqrt

import numpy as np
import pytest

from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.protocol.wire.attitude import IDENTITY, received_quaternion, sent_vector
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.reference import Floats, desired
from aeroloop.service.theorem.bounds import coordinates, lemma_1, rotation, theorem_1, times
from aeroloop.service.theorem.certificate import Paper, evaluate
from tests.support import numpy_twin as twin
from tests.support.adversary_loop import times as product
from tests.support.law_tick import body_of
from tests.support.lemma import Samples, lemma_inequalities

LAW = AdaptiveSettings(
    inertia=(0.02, 0.03, 0.01),
    centre_of_mass=(0.03, -0.02, 0.02),
    allocation=((0.01, 0, 0), (0, 0.02, 0), (0, 0, 0.01)),
    C1=(0.3, 0.2, 0.25),
    C2=(0.15, 0.1, 0.12),
)
REFERENCE = Sinusoid(amplitude=(5.0, 30.0, 60.0), frequency=(0.5, 0.4, 0.3))
COUNT = 1500
DELTAS = {
    "C.50": ["delta_omega_e"], "C.51": ["delta_z2"], "C.52": ["delta_z1"], "C.53": ["delta_R"],
    "C.54": ["delta_Psi1", "delta_Psi2"], "C.55": ["delta_S1", "delta_S2"],
    "C.56": ["delta_alpha1", "delta_alpha2"], "C.57": ["delta_Phi"],
}  # fmt: skip
LEMMA = tuple(DELTAS)


def bounds(wire: WireSpec, disturbance: float = 0.0) -> Paper:
    settings = Settings(wire=wire, law=LAW, reference=REFERENCE)
    found = evaluate(settings, disturbance=disturbance).paper
    assert found is not None
    known = replace(found.known, half_angle_e=radians(15) / 2)
    return Paper(known, lemma_1(known), theorem_1(known, lemma_1(known)))


def wire_of(bits: int) -> WireSpec:
    return WireSpec(actuators=3).with_bits(f"{bits}/{bits}")


def turns(axis: Floats, angle: Floats) -> Floats:
    """Quaternions of turns by an angle [rad] about an axis, row by row."""
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return np.hstack([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis])


def random_samples(wire: WireSpec, b: Paper, seed: int) -> tuple[Samples, Floats]:
    """States along the reference, as far from it as was assumed, and what the law receives of them; and ω̇_d."""
    rng = np.random.default_rng(seed)
    minute = desired(REFERENCE, 0.01, 6000)
    q_d, omega_d, omega_d_dot = np.split(minute[rng.integers(0, 6000, COUNT)], [4, 7], axis=1)
    errors = turns(rng.standard_normal((COUNT, 3)), 2 * b.known.half_angle_e * rng.uniform(0, 1, COUNT))
    q = product(q_d, errors)
    omega = rng.uniform(-0.9, 0.9, (COUNT, 3))

    aimed = rng.random(COUNT) < 0.5
    diagonals = rng.choice(np.array([-1.0, 1.0]), (COUNT, 3))
    q[aimed] = q_d[aimed] = turns(diagonals, np.full(COUNT, 2 * _edge_before(b.known.half_angle_d, wire)))[aimed]
    # No error at all: z = 0, where what grows with ‖z‖ does not hide the rest. And no faster than the reference.
    omega[aimed] = _edges(wire, b.known.k_omega_d / sqrt(3), rng)[aimed]
    omega_d[aimed] = times(rotation(q[aimed]), omega[aimed])

    q *= rng.choice([-1.0, 1.0], (COUNT, 1))  # the truth may be given with either sign
    attitude, rate = wire.attitude.quantizer(), wire.rate.quantizer()
    sent = [sent_vector((w, x, y, z)) for w, x, y, z in q.tolist()]
    levels = np.vectorize(lambda value: attitude.level(attitude.encode(value)))(sent)
    q_Q = np.array([received_quaternion(x, y, z, IDENTITY) for x, y, z in levels.tolist()])
    omega_Q = np.vectorize(lambda value: rate.level(rate.encode(value)))(omega)
    sign = np.where((q * q_d).sum(axis=1) * (q * q_Q).sum(axis=1) >= 0, 1.0, -1.0)
    return Samples(q, omega, q_Q, omega_Q, q_d, omega_d, sign), omega_d_dot


def _edge_before(half_angle: float, wire: WireSpec) -> float:
    """The largest half-angle up to this one whose ε, along a diagonal, has just left the cell before."""
    step = 2 * wire.attitude.quantizer().bound
    return asin(sqrt(3) * (floor(sin(half_angle) / sqrt(3) / step - 0.5) + 0.501) * step)


def _edges(wire: WireSpec, most: float, rng: np.random.Generator) -> Floats:
    """Values beside the edges of the rate's cells, up to ±most [rad/s]. Shape (COUNT, 3)."""
    step = 2 * wire.rate.quantizer().bound
    cells = floor(most / step - 0.5)
    beside = rng.choice(np.array([-0.499, 0.499]), (COUNT, 3))
    edges: Floats = (rng.integers(-cells, cells + 1, (COUNT, 3)).astype(np.float64) + beside) * step
    return edges


@pytest.mark.parametrize("bits", [3, 8, 12])
def test_no_random_state_exceeds_a_bound_of_the_lemma(bits: int) -> None:
    wire = wire_of(bits)
    b = bounds(wire)
    samples, _ = random_samples(wire, b, seed=bits)
    inequalities = lemma_inequalities(samples, LAW, b.known, b.lemma)
    assert [i.equation for i in inequalities] == ["C.28", "C.29", "C.26", "C.27", *LEMMA]
    assert {i.equation: int(i.broken.sum()) for i in inequalities if i.broken.any()} == {}


@pytest.mark.parametrize("equation", LEMMA)
def test_half_of_a_bound_is_exceeded(equation: str) -> None:
    """Of 12 bits, where every bound of the lemma is nearly attained (0.58 of it by (C.57), which holds for ‖d_ω‖)."""
    wire = wire_of(12)
    b = bounds(wire)
    samples, _ = random_samples(wire, b, seed=12)
    halved = replace(b.lemma, **{name: getattr(b.lemma, name) / 2 for name in DELTAS[equation]})
    broken = {i.equation for i in lemma_inequalities(samples, LAW, b.known, halved) if i.broken.any()}
    assert broken == {equation}


def test_v_falls_as_fast_as_the_theorem_says() -> None:
    """V̇ of the body under the quantized law, with any θ, θ̂ and disturbance in their bounds, by the twin's equations."""
    wire = wire_of(8).model_copy(update={"voltage": SignalSpec(bits=8, limit=1000.0)})  # no command saturates
    disturbance = 0.02
    b = bounds(wire, disturbance)
    t = b.theorem
    x, omega_d_dot = random_samples(wire, b, seed=5)
    rng = np.random.default_rng(5)
    body, voltage = body_of(LAW), wire.voltage.quantizer()
    theta, estimate, torque = (_within(r, rng) for r in (LAW.damping_bound, LAW.damping_bound / 0.95, disturbance))
    q = np.where((x.q * x.q_Q).sum(axis=1, keepdims=True) < 0, -x.q, x.q)
    c = coordinates(q, x.omega, x.q_d, x.omega_d, x.sign, np.array(LAW.C1))
    V_dot = np.empty(COUNT)
    for i in range(COUNT):
        args = x.q_d[i], x.omega_d[i], omega_d_dot[i], estimate[i], x.sign[i]
        seen = twin.law(body, x.q_Q[i], x.omega_Q[i], *args)
        true = twin.law(body, q[i], x.omega[i], *args)
        u = np.array([voltage.level(voltage.encode(value)) for value in seen.u])
        R, J, omega = twin.rotation(q[i]).T, body.J, x.omega[i]
        gravity = np.cross(body.r_g, R @ np.array([0.0, 0.0, -body.m * body.g]))
        J_omega_dot = -np.cross(omega, J @ omega) + gravity - omega * theta[i] + body.B @ u + torque[i]
        turning = np.cross(omega, R @ x.omega_d[i]) - R @ omega_d_dot[i] - true.alpha_bar
        V_dot[i] = (
            x.sign[i] * true.e[1:] @ true.omega_e  # 2 z₁ᵀż₁ = z₁ᵀGᵀω_e
            + true.z2 @ (J_omega_dot + J @ turning)
            - (theta[i] - estimate[i]) @ np.linalg.solve(body.Gamma, seen.theta_dot)
        )
    z = c.norm
    margin = -t.margin * z**2 + t.delta_Qdist - V_dot
    assert margin.min() >= 0
    assert (V_dot > 0).any()  # a law whose V always fell would need no theorem
    assert np.all(V_dot[z > sqrt(t.delta_Qdist / t.margin)] < 0)


def _within(radius: float, rng: np.random.Generator) -> Floats:
    """Vectors no longer than a radius, half of them as long. Shape (COUNT, 3)."""
    directions = rng.standard_normal((COUNT, 3))
    lengths = radius * np.minimum(1.0, 2 * rng.random(COUNT))
    vectors: Floats = directions / np.linalg.norm(directions, axis=1, keepdims=True) * lengths[:, None]
    return vectors
