"""Baselines: each is at rest at the reference, has the promised poles and Lyapunov function, and follows the reference.

Bodies, gains and motions are random, so that no term hides behind a zero or a symmetry.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.service.config import load, load_over
from aeroloop.service.control.laws.baselines import TUNED, Response, nearer, optimal_gain, response_of, tuned
from aeroloop.service.control.laws.registry import (
    CustomLawSettings,
    configured_gains,
    initial_state,
    law_function,
    law_of,
    law_settings,
)
from aeroloop.service.lab.experiment import experiment
from tests.support import numpy_twin as twin
from tests.support.adversary_loop import times as product
from tests.support.ideal import IDEAL
from tests.support.numpy_twin import Array

BASELINES = [*TUNED, "nonadaptive"]
PERIOD = 0.002


def unit(rng: np.random.Generator) -> Array:
    q = rng.normal(size=4)
    return np.asarray(q / np.linalg.norm(q))


class Body:
    """A body, and a law that knows it."""

    def __init__(self, kind: str, rng: np.random.Generator, **fields: Any) -> None:
        B = (rng.normal(size=(3, 3)) + 3 * np.eye(3)) / 10  # well away from singular
        body = CustomLawSettings(
            kind=kind,
            inertia=tuple(rng.uniform(0.5, 2, 3)),
            mass=rng.uniform(0.5, 2),
            centre_of_mass=tuple(rng.normal(size=3)),
            allocation=B.tolist(),
        )
        self.response = Response(tuple(rng.uniform(1, 3, 3)), tuple(rng.uniform(0.75, 1.5, 3)))
        known = {"damping_estimate": tuple(rng.uniform(0, 0.1, 3))}
        section = CustomLawSettings(**body.model_dump() | tuned(kind, body, self.response) | known | fields)
        self.p: Any = law_settings(section)
        law: Any = law_of(section, PERIOD, 3)
        self.function = law_function(law)
        self.gains, state = values_of(law)
        self.state = np.array(state)
        self.J, self.B, self.theta = np.array(self.p.inertia), B, np.array(known["damping_estimate"])

    def law(self, q: Array, omega: Array, q_d: Array, omega_d: Array, omega_d_dot: Array, state: Array) -> Any:
        """Torque B u and the next state."""
        eps, last = (q[1:], q) if q[0] >= 0 else (-q[1:], q)
        found = self.function(
            last=last, state=state, gains=self.gains, eps=eps, omega=omega, q_d=q_d, omega_d=omega_d,
            omega_d_dot=omega_d_dot,
        )  # fmt: skip
        return self.B @ np.array(found["u"]).ravel(), np.array(found["state_next"]).ravel()

    def omega_dot(self, q: Array, omega: Array, torque: Array) -> Array:
        """(C.2), from the twin's rotation."""
        p = self.p
        weight = twin.rotation(q).T @ np.array([0, 0, -p.mass * p.gravity])
        gravity = np.cross(p.centre_of_mass, weight)
        moment = torque + gravity - np.cross(omega, self.J * omega) - self.theta * omega
        return np.asarray(moment / self.J)


def slope_of(value: Any, h: float = 1e-6) -> Any:
    """Central difference of a function at 0."""
    return (value(h) - value(-h)) / (2 * h)


def values_of(law: Any) -> tuple[list[float], list[float]]:
    """Configured gains and first state of a law, each one below the other."""
    return [x for gain in configured_gains(law).values() for x in gain], [
        x for part in initial_state(law).values() for x in part
    ]


@pytest.mark.parametrize("kind", BASELINES)
@pytest.mark.parametrize("motors", [2, 3])
def test_at_the_reference_a_law_holds_the_weight_and_nothing_else(kind: str, motors: int) -> None:
    law: Any = law_of(load(overrides=[f"law.kind={kind}"]).law, PERIOD, motors)
    q = np.array([np.sqrt(1 - 0.05), 0.0, 0.2, -0.1])
    gains, state = values_of(law)
    still = dict.fromkeys(("omega", "omega_d", "omega_d_dot"), [0.0] * 3)
    for q_d in (q, -q):  # the same attitude
        found = law_function(law)(last=q, state=state, gains=gains, eps=q[1:], q_d=q_d, **still)
        p = law.settings
        weight = np.cross(p.centre_of_mass, twin.rotation(q).T @ np.array([0, 0, -p.mass * p.gravity]))
        u = np.array(found["u"]).ravel()
        assert u.shape == (motors,)
        assert (np.array(p.allocation)[3 - motors :, 3 - motors :] @ u) == pytest.approx(-weight[3 - motors :])
        sign, *rest = np.array(found["state_next"]).ravel()
        assert sign == (1 if q_d is q else -1)
        assert rest == state[1:]


POLES: dict[str, Callable[[float, Any], Any]] = {
    "pd": lambda _, pair: pair,
    "lqr": lambda _, pair: pair,
    "pid": lambda wn, pair: [*pair, -wn / 10],
    "adaptive-torque": lambda wn, pair: [*pair, -wn / 10],
    "sliding": lambda wn, _: [-wn, -wn],
}


@pytest.mark.parametrize("kind", [*TUNED, "nonadaptive"])
def test_near_the_reference_each_axis_has_the_poles_of_the_tuning_rule(kind: str) -> None:
    """Of the linearised tick, by differences; the paper's gains have the bandwidth and damping that the rule reads."""
    rng = np.random.default_rng(1)
    C1, C2 = (0.9, 1.2, 0.6), (1.5, 2.0, 1.0)
    body = Body(kind, rng, **({"C1": C1, "C2": C2} if kind == "nonadaptive" else {}))
    response = response_of(body.p.inertia, C1, C2) if kind == "nonadaptive" else body.response
    q_d, zero = unit(rng), np.zeros(3)
    extra = len(body.state) - 1
    for axis in range(3):

        def derivative(x: Array, axis: int = axis) -> Array:
            """Of the axis's angle, rate and further state."""
            error, omega, state = np.zeros(3), np.zeros(3), body.state.copy()
            error[axis], omega[axis], state[0] = x[0] / 2, x[1], 1.0
            if extra:
                state[1 + axis] = x[2]
            q = product(q_d, np.append(np.sqrt(1 - error @ error), error))
            torque, after = body.law(q, omega, q_d, zero, zero, state)
            further = [(after[1 + axis] - state[1 + axis]) / PERIOD] if extra else []
            return np.array([x[1], body.omega_dot(q, omega, torque)[axis], *further])

        one_by_one = np.eye(2 + bool(extra))
        A = np.column_stack([slope_of(lambda h, x=x: derivative(h * x)) for x in one_by_one])
        wn, zeta = response.bandwidth[axis], response.damping[axis]
        pair = np.roots([1, 2 * zeta * wn, wn**2])
        expected = POLES.get(kind, POLES["pd"])(wn, pair)
        # the regulator's gains are for ticks of a period: off by a part of ωₙT
        assert np.poly(A) == pytest.approx(np.poly(expected), rel=3 * wn * PERIOD if kind == "lqr" else 1e-4)


def test_the_other_equilibrium_is_approached_only_once_it_is_nearer_by_the_hysteresis() -> None:
    eta_e, before = ca.SX.sym("eta_e"), ca.SX.sym("before")
    sign = ca.Function("sign", [eta_e, before], [nearer(eta_e, before, 0.4)])
    chosen = [float(sign(e, s)) for e, s in ((0.1, 0), (-0.1, 0), (-0.3, 1), (-0.5, 1), (0.3, -1), (0.5, -1))]
    assert chosen == [1, -1, 1, -1, -1, 1]


@pytest.mark.parametrize(("kind", "gain"), [("pid", "ki"), ("adaptive-torque", "Gamma_torque")])
def test_where_a_motor_saturates_the_integral_gives_way_and_else_it_does_not(kind: str, gain: str) -> None:
    def held(reset_time: float) -> Array:
        """Integral torque [N·m] after an error of 30° that no command moves, for 20 s. Shape (3,)."""
        overrides = [f"law.kind={kind}", f"law.{gain}=[0.2, 0.2, 0.2]", f"law.reset_time={[reset_time] * 3}"]
        overrides += ["law.torque_bound=[9, 9, 9]"] if kind == "adaptive-torque" else []
        law: Any = law_of(load(overrides=overrides).law, 0.02, 2)
        function, (gains, first) = law_function(law), values_of(law)
        state = ca.DM(first)
        turned = {"omega": [0.0] * 3, "omega_d": [0.0] * 3, "omega_d_dot": [0.0] * 3, "q_d": IDENTITY}
        for _ in range(1000):
            answer = function(last=IDENTITY, state=state, gains=gains, eps=[0, 0.18, 0.18], **turned)
            state = answer["state_next"]
        assert np.array(state).ravel()[4:].tolist() == first[4:]  # no friction is learned
        integral: Array = np.array(state).ravel()[1:4] * (law.settings.ki if kind == "pid" else 1)
        return np.abs(integral[1:])

    assert (held(1e9) > 5 * held(0.2)).all()
    assert (held(0.2) < 0.2).all()  # the motors have 0.05 and 0.08


def test_without_adaptation_the_voltages_are_the_papers_with_its_first_estimate() -> None:
    settings = load(overrides=["law.damping_estimate=[0.01, 0.02, 0.03]"])
    laws: list[Any] = [
        law_of(load_over(settings, overrides).law, PERIOD, 2)
        for overrides in ([], ["law.kind=nonadaptive", "law.damping_estimate=[0.01, 0.02, 0.03]"])
    ]
    rng = np.random.default_rng(5)
    motion = dict(zip(("omega", "omega_d", "omega_d_dot"), rng.normal(size=(3, 3)), strict=True))
    q = np.abs(unit(rng))
    found = []
    for law in laws:
        gains, state = values_of(law)
        found.append(law_function(law)(last=q, state=state, gains=gains, eps=q[1:], q_d=q, **motion))
    assert np.array(found[0]["u"]).tolist() == np.array(found[1]["u"]).tolist()
    assert laws[1].initial().keys() == {"sign"}


BODY = (
    "plant.kind=rigid_body", "plant.limits.max_tilt_deg=180", "wire.actuators=3",
    "plant.rigid_body.damping=[0.0, 0.0070, 0.0095]",
    "plant.rigid_body.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]", "law.centre_of_mass=[0, 0, 0]",
    "law.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]", "reference.amplitude=[300, 40, 300]",
    "reference.frequency=[0.1, 0.13, 0.08]",
)  # fmt: skip


@pytest.mark.parametrize("kind", BASELINES)
def test_without_quantization_a_free_body_follows_a_reference_of_full_turns(kind: str) -> None:
    settings = load(overrides=[f"law.kind={kind}", *IDEAL, *BODY])
    settings = settings.model_copy(update={"wire": settings.wire.with_bits("cont/cont")})
    found = experiment(settings, 30.0)
    assert found.compiled
    assert found.figures.second_half_error_deg is not None
    assert found.figures.second_half_error_deg < 0.1
    assert found.figures.z_track is not None
    assert found.figures.z_track < 4.5e-4


def test_the_regulators_gains_are_optimal() -> None:
    J, T, weights = 0.7, 0.05, (2.0, 0.3)
    A, B = np.array([[1, T], [0, 1]]), np.array([[T * T / 2 / J], [T / J]])
    X = solve_discrete_are(A, B, np.diag(weights), np.eye(1))
    assert optimal_gain(J, *weights, T) == pytest.approx((np.linalg.solve(1 + B.T @ X @ B, B.T @ X @ A))[0])
