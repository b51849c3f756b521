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
from aeroloop.service.config import load
from aeroloop.service.control.laws.baselines import TUNED, Response, nearer, optimal_gain, response_of, tuned
from aeroloop.service.control.laws.registry import CustomLawSettings
from aeroloop.service.lab.experiment import experiment
from tests.support.adversary_loop import times as product
from tests.support.ideal import IDEAL
from tests.support.law_tick import Tick, acceleration, unit, weight_torque
from tests.support.numpy_twin import Array

BASELINES = [*TUNED, "nonadaptive"]
PERIOD = 0.002


class Body:
    def __init__(self, kind: str, rng: np.random.Generator, **fields: Any) -> None:
        B = (rng.normal(size=(3, 3)) + 3 * np.eye(3)) / 10  # well away from singular
        body = CustomLawSettings(
            kind=kind, inertia=tuple(rng.uniform(0.5, 2, 3)), mass=rng.uniform(0.5, 2),
            centre_of_mass=tuple(rng.normal(size=3)), allocation=B.tolist(),
        )  # fmt: skip
        self.response = Response(tuple(rng.uniform(1, 3, 3)), tuple(rng.uniform(0.75, 1.5, 3)))
        self.theta = rng.uniform(0, 0.1, 3)
        known = {"damping_estimate": tuple(self.theta)}
        section = CustomLawSettings(**body.model_dump() | tuned(kind, body, self.response) | known | fields)
        self.tick, self.B = Tick(section), B

    def moved(self, q: Array, omega: Array, q_d: Array, state: Array) -> tuple[Array, Array]:
        found = self.tick(state, q, omega, q_d, np.zeros(3), np.zeros(3))
        torque = self.B @ found["u"] - self.theta * omega
        return acceleration(self.tick.law.settings, q, omega, torque), found["state_next"]


def slope_of(value: Any, h: float = 1e-6) -> Any:
    return (value(h) - value(-h)) / (2 * h)


@pytest.mark.parametrize("kind", BASELINES)
@pytest.mark.parametrize("motors", [2, 3])
def test_at_the_reference_a_law_holds_the_weight_and_nothing_else(kind: str, motors: int) -> None:
    tick, zero = Tick(load(overrides=[f"law.kind={kind}"]).law, PERIOD, motors), np.zeros(3)
    q, p = np.array([np.sqrt(1 - 0.05), 0.0, 0.2, -0.1]), tick.law.settings
    for q_d in (q, -q):  # the same attitude
        found = tick(tick.first, q, zero, q_d, zero, zero)
        assert found["u"].shape == (motors,)
        held = np.array(p.allocation)[3 - motors :, 3 - motors :] @ found["u"]
        assert held == pytest.approx(-weight_torque(p, q)[3 - motors :])
        sign, *rest = found["state_next"]
        assert sign == (1 if q_d is q else -1)
        assert rest == tick.first[1:].tolist()


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
    inertia = body.tick.law.settings.inertia
    response = response_of(inertia, C1, C2) if kind == "nonadaptive" else body.response
    q_d, first = unit(rng), body.tick.first
    extra = len(first) - 1
    for axis in range(3):

        def derivative(x: Array, axis: int = axis) -> Array:
            error, omega, state = np.zeros(3), np.zeros(3), first.copy()
            error[axis], omega[axis], state[0] = x[0] / 2, x[1], 1.0
            if extra:
                state[1 + axis] = x[2]
            q = product(q_d, np.append(np.sqrt(1 - error @ error), error))
            omega_dot, after = body.moved(q, omega, q_d, state)
            further = [(after[1 + axis] - state[1 + axis]) / PERIOD] if extra else []
            return np.array([x[1], omega_dot[axis], *further])

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
        tick, zero = Tick(load(overrides=overrides).law, 0.02, 2), np.zeros(3)
        state, q = tick.first, np.array([np.sqrt(1 - 2 * 0.18**2), 0, 0.18, 0.18])
        for _ in range(1000):
            state = tick(state, q, zero, np.array(IDENTITY), zero, zero)["state_next"]
        assert state[4:].tolist() == tick.first[4:].tolist()  # no friction is learned
        integral: Array = state[1:4] * (tick.law.settings.ki if kind == "pid" else 1)
        return np.abs(integral[1:])

    given_way = held(0.2)
    assert (held(1e9) > 5 * given_way).all()
    assert (given_way < 0.2).all()  # the motors have 0.05 and 0.08


def test_without_adaptation_the_voltages_are_the_papers_with_its_first_estimate() -> None:
    known = "law.damping_estimate=[0.01, 0.02, 0.03]"
    rng = np.random.default_rng(5)
    q, (omega, omega_d, omega_d_dot) = np.abs(unit(rng)), rng.normal(size=(3, 3))
    papers, its = (
        tick(tick.first, q, omega, q, omega_d, omega_d_dot)["u"]
        for tick in (Tick(load(overrides=[f"law.kind={kind}", known]).law) for kind in ("adaptive", "nonadaptive"))
    )
    assert papers.tolist() == its.tolist()


BODY = (
    "plant.kind=rigid_body", "plant.limits.max_tilt_deg=180", "wire.actuators=3",
    "plant.rigid_body.damping=[0.0, 0.0070, 0.0095]",
    "plant.rigid_body.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]", "law.centre_of_mass=[0, 0, 0]",
    "law.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]", "reference.amplitude=[300, 40, 300]",
    "reference.frequency=[0.1, 0.13, 0.08]", "controller.max_reference_tilt_deg=180", "controller.max_reference_rate=2",
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
