"""Reference under any sequence of operator's changes: never jumps, stays within limits, and arrives.

Angles are compared with polynomials and sines written here, and q_d, ω_d, ω̇_d with those of the NumPy twin: the three
turns by hand. Joins are checked just before and just after. Single quintics stand here; approaches that brake are in
test_approach.py, with the same doubles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from math import nextafter, pi, radians
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import (
    Hold,
    Points,
    Reference,
    Sinusoid,
    Stream,
)
from aeroloop.service.control.motion import Approach, Motion, approached
from aeroloop.service.control.reference import Angles, FollowError, Limits, Trajectory
from tests.support.numpy_twin import Array, Sinusoids

EPS: Final = 2.0**-52
NO_LIMITS = Limits(rate=1e9, braking=1e9, tilt=pi, rolls=True)
BENCH = Limits(rate=1.0, braking=1.0, tilt=radians(60), rolls=False)
"""A 2-DOF bench as configured unless stated otherwise."""
BODY = BENCH._replace(rolls=True)

# What can be asked


def triples(limit: float) -> st.SearchStrategy[tuple[float, float, float]]:
    """Roll, pitch, yaw [deg], in steps of a hundredth: what matters lies in between, not in the last bit."""
    angle = st.integers(round(-100 * limit), round(100 * limit)).map(lambda n: n / 100)
    return st.tuples(angle, angle, angle)


def seconds(least: float, most: float) -> st.SearchStrategy[float]:
    """Times to the millisecond [s]."""
    return st.integers(round(1000 * least), round(1000 * most)).map(lambda n: n / 1000)


@st.composite
def some_points(draw: st.DrawFn) -> Points:
    """Two to six points, 0.05 s to 3 s from each other."""
    gaps = draw(st.lists(seconds(0.05, 3.0), min_size=1, max_size=5))
    times = [0.0, *(float(t) for t in np.cumsum(gaps))]
    return Points(times=times, attitudes=draw(st.lists(triples(60), min_size=len(times), max_size=len(times))))


holds = triples(60).map(lambda attitude: Hold(attitude=attitude))
frequencies = st.integers(0, 30).map(lambda n: n / 10)
sinusoids = st.builds(Sinusoid, amplitude=triples(60), frequency=st.tuples(frequencies, frequencies, frequencies))
references: st.SearchStrategy[Reference] = st.one_of(holds, sinusoids, some_points())
withins = seconds(0.02, 5.0)

# A second opinion of a trajectory


def states(trajectory: Trajectory, t: float, *, before: bool = False) -> tuple[Array, Array, Array]:
    """Angle, rate, acceleration, each of shape (3,), term by term; on a join, of the piece after it unless `before`."""
    begun = [i for i, start in enumerate(trajectory.starts) if (start < t if before else start <= t)]
    return piece_states(trajectory, begun[-1] if begun else 0, t)


def piece_states(trajectory: Trajectory, i: int, t: float | Array) -> tuple[Array, Array, Array]:
    """As above, of one piece, wherever t lies; of many times at once if they are of shape (m, 1)."""
    tau, c = t - trajectory.starts[i], trajectory.quintic[i]
    a, f = trajectory.amplitude[i], trajectory.frequency[i]
    powers = range(6)
    return (
        sum((c[n] * tau**n for n in powers), a * np.sin(f * tau)),
        sum((n * c[n] * tau ** (n - 1) for n in powers[1:]), a * f * np.cos(f * tau)),
        sum((n * (n - 1) * c[n] * tau ** (n - 2) for n in powers[2:]), -a * f * f * np.sin(f * tau)),
    )


def here(state: tuple[Array, Array, Array]) -> Angles:
    """A state as code takes it."""
    return Angles(*(part[None] for part in state))


def quaternion(angles: Array) -> Array:
    """The twin's q_d, multiplied out, of angles that stand still."""
    return desired_of((angles, np.zeros(3), np.zeros(3)))[0]


def desired_of(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """The twin's q_d, ω_d, ω̇_d of any angles, rates, accelerations."""

    class Now(Sinusoids):
        def angles(self, _t: float) -> tuple[Array, Array, Array]:
            return state

    return Now(np.zeros(3), np.zeros(3)).desired(0.0)


def terms(trajectory: Trajectory, i: int, t: float, order: int) -> float:
    """The sum over three axes of the terms of a derivative of piece i at time t, whatever their signs."""
    tau, c = abs(t - trajectory.starts[i]), np.abs(trajectory.quintic[i])
    polynomial = sum(math.perm(n, order) * c[n] * tau ** (n - order) for n in range(order, 6))
    return float((polynomial + np.abs(trajectory.amplitude[i]) * trajectory.frequency[i] ** order).sum())


# A motion that is watched


class Followed:
    """A motion, and what its trajectory should be by Trajectory's own word."""

    def __init__(self, reference: Reference) -> None:
        self.motion = Motion(reference)
        self.trajectory = Trajectory.of(reference)

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """q_d, ω_d, ω̇_d as the loop reads them."""
        q_d, omega_d, omega_d_dot = map(np.array, self.motion.at(t))
        return q_d, omega_d, omega_d_dot

    def follow(self, reference: Reference, t: float, within_s: float) -> None:
        """Follow something else, and know the trajectory of that."""
        self.approach(reference, t, Approach(within_s))

    def approach(self, reference: Reference, t: float, approach: Approach) -> None:
        """The same, by any approach."""
        self.trajectory = approached(Trajectory.of(reference), here(states(self.trajectory, t)), t, approach)
        self.motion.follow(Trajectory.of(reference), t, approach)


def rounding(around: Sequence[tuple[Array, Array, Array]], t: float, within_s: float) -> Array:
    """How far angle, rate and acceleration may be off where a quintic ends, by rounding alone. Shape (3,).

    Its terms are at most 15 (|Δ| + |v| T + |a| T²) of the states around, and n orders of derivatives grow that by
    (5/T)ⁿ. They round by EPS some thirty times. What rounds τ, by EPS of t, counts as one derivative more.
    """
    T = within_s
    sizes = [[np.abs(part).max() * T**order for order, part in enumerate(state)] for state in around]
    size = float(max(map(sum, sizes)))
    orders = np.arange(3)
    return 30 * EPS * 15 * size * (5 / T) ** orders + 2 * EPS * (t + T) * 15 * size * (5 / T) ** (orders + 1)


@settings(max_examples=40)
@given(
    first=references,
    changes=st.lists(st.tuples(references, seconds(0, 3), withins), min_size=1, max_size=4),
)
def test_what_the_loop_reads_does_not_jump_however_often_the_mind_is_changed(
    first: Reference, changes: list[tuple[Reference, float, float]]
) -> None:
    """Also in the middle of an approach. q_d, ω_d and ω̇_d at the very time of the change, before it and after it."""
    followed = Followed(first)
    t = 0.0
    for reference, passed, within_s in changes:
        t += passed
        before = followed.at(t)
        now = states(followed.trajectory, t)
        followed.follow(reference, t, within_s)
        # At τ = 0 only c₀, c₁ and 2·c₂ count, which are the state itself; the products of three turns round on.
        tolerance = 100 * EPS * (1 + np.abs(now).max()) ** 2
        for left, right in zip(before, followed.at(t), strict=True):
            assert np.abs(left - right).max() <= tolerance


# Arriving


@settings(max_examples=40)
@given(first=references, target=holds, t=seconds(0, 10), within_s=withins)
def test_going_somewhere_ends_there_exactly_and_at_rest(
    first: Reference, target: Hold, t: float, within_s: float
) -> None:
    followed, still = Followed(first), Followed(target)
    followed.follow(target, t, within_s)
    for later in (t + within_s, t + within_s + 100):
        for got, expected in zip(followed.at(later), still.at(0.0), strict=True):
            assert np.array_equal(got, expected)
    assert not np.any(followed.at(t + within_s + 100)[1:])
    assert target.attitude is not None
    assert followed.at(1e4)[0] == pytest.approx(quaternion(np.radians(target.attitude)), abs=8 * EPS)


@settings(max_examples=40)
@given(first=references, points=some_points(), t=seconds(0, 10), within_s=withins)
def test_points_are_passed_each_at_its_time_from_rest_to_rest(
    first: Reference, points: Points, t: float, within_s: float
) -> None:
    followed = Followed(first)
    followed.follow(points, t, within_s)
    start = t + within_s
    shortest = min(np.diff(points.times))
    # Of the piece before the point: its terms, at most 15 times the differences, in a time that rounds by EPS of t.
    reach = 15 * radians(120) * 3 * max(np.diff(points.times)) / shortest
    tolerance = EPS * reach * (50 + 10 * (start + points.times[-1]) / shortest)
    for time_s, attitude in zip(points.times, points.attitudes, strict=True):
        expected = quaternion(np.radians(attitude))
        assert followed.at(nextafter(start + time_s, 0.0))[0] == pytest.approx(expected, abs=tolerance)
        q_d, omega_d, omega_d_dot = followed.at(start + time_s)
        assert q_d == pytest.approx(expected, abs=tolerance)
        if time_s in (points.times[0], points.times[-1]):
            # The rounding of the start, over the shortest gap, once for the rate and twice for the acceleration.
            assert np.abs(omega_d).max() <= tolerance / shortest * 5
            assert np.abs(omega_d_dot).max() <= tolerance / shortest**2 * 25
    assert not np.any(followed.at(start + points.times[-1] + 1.0)[1])


@settings(max_examples=40)
@given(points=some_points())
def test_between_points_neither_rate_nor_acceleration_jumps(points: Points) -> None:
    trajectory = Trajectory.of(points)
    gaps = np.diff(points.times)
    for i, (start, gap) in enumerate(zip(trajectory.starts[1:], gaps, strict=True)):
        before, there = piece_states(trajectory, i, trajectory.starts[i]), piece_states(trajectory, i + 1, start)
        tolerance = rounding([before, there], float(start), float(gap)) + 1e-300
        for order, (left, right) in enumerate(zip(piece_states(trajectory, i, start), there, strict=True)):
            assert np.abs(left - right).max() <= tolerance[order]


# The loop's function


@settings(max_examples=40)
@given(
    first=references,
    changes=st.lists(st.tuples(references, seconds(0.05, 3), withins), max_size=3),
    steps=st.lists(seconds(0, 0.4), min_size=1, max_size=20),
)
def test_the_loops_function_gives_the_plans_own_angles(
    first: Reference, changes: list[tuple[Reference, float, float]], steps: list[float]
) -> None:
    followed = Followed(first)
    t, pending = 0.0, list(changes)
    for step in steps:
        t += step
        if pending and t >= pending[0][1]:
            reference, _, within_s = pending.pop(0)
            followed.follow(reference, t, within_s)
        trajectory, i = followed.trajectory, followed.trajectory.piece(t)
        taken = trajectory.at(np.full((len(trajectory.starts), 1), t - trajectory.starts[i]))
        state = tuple(part[i, 0] for part in taken)
        rate, acceleration = terms(trajectory, i, t, 1), terms(trajectory, i, t, 2)
        for order, (got, expected) in enumerate(
            zip(followed.at(t), desired_of((state[0], state[1], state[2])), strict=True)
        ):
            # Either way the terms round by EPS some fifty times: of angles below 10, rates and accelerations.
            size = (10.0, 10 * (1 + rate), 10 * (1 + rate) ** 2 + acceleration)[order]
            assert np.abs(got - expected).max() <= 200 * EPS * size
        for got, expected in zip(state, piece_states(trajectory, i, t), strict=True):
            assert np.abs(got - expected).max() <= 200 * EPS * (10 + rate + acceleration)


# Limits

TOO_FAST = Sinusoid(amplitude=(0.0, 30.0, 100.0), frequency=(0.0, 0.5, 0.7))
TOO_TILTED = Sinusoid(amplitude=(0.0, 61.0, 10.0), frequency=(0.0, 0.3, 0.3))
TILTED_BY_BOTH = Sinusoid(amplitude=(50.0, 50.0, 0.0), frequency=(0.3, 0.3, 0.0))
ROLLS = Sinusoid(amplitude=(1.0, 0.0, 0.0), frequency=(0.3, 0.0, 0.0))
FAST_POINTS = Points(times=[0.0, 1.0, 1.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, 0.0), (0.0, 5.0, 25.0)])
TILTED_POINTS = Points(times=[0.0, 4.0, 8.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 60.5, 0.0), (0.0, 0.0, 0.0)])


@pytest.mark.parametrize(
    ("reference", "limits", "why"),
    [
        (TOO_FAST, BENCH, "max_reference_rate"),
        (FAST_POINTS, BENCH, "max_reference_rate"),
        (TOO_TILTED, BENCH, "max_reference_tilt_deg"),
        (TILTED_BY_BOTH, BODY, "max_reference_tilt_deg"),  # neither alone is too much: acos(cos² 50°) = 65.6°
        (TILTED_POINTS, BENCH, "max_reference_tilt_deg"),
        # sampled where pitch is 0, each time; beyond 60° only after 848 s; and any
        (Sinusoid(amplitude=(0.0, 80.0, 1.0), frequency=(0.0, 0.7, 0.7 / 32)), BENCH, "max_reference_tilt_deg"),
        (Sinusoid(amplitude=(0.0, 80.0, 0.0), frequency=(0.0, 0.001, 0.0)), BENCH, "max_reference_tilt_deg"),
        (Sinusoid(amplitude=(0.0, 360.0, 1.0), frequency=(0.0, 0.15, 0.0005)), BENCH, "max_reference_tilt_deg"),
        (Hold(attitude=(0.0, -60.1, 0.0)), BENCH, "max_reference_tilt_deg"),
        (Hold(attitude=(0.0, 180.0, 0.0)), BENCH, "max_reference_tilt_deg"),
        (ROLLS, BENCH, "roll"),
        (Hold(attitude=(-0.1, 0.0, 0.0)), BENCH, "roll"),
    ],
)
def test_what_goes_too_far_is_refused_by_the_name_of_the_limit_in_one_line(
    reference: Reference, limits: Limits, why: str
) -> None:
    with pytest.raises(FollowError, match=why) as refused:
        Trajectory.of(reference).check(limits)
    assert len(str(refused.value).splitlines()) == 1
    Trajectory.of(reference).check(NO_LIMITS)


@pytest.mark.parametrize(
    ("reference", "limits"),
    [
        (Sinusoid(), BENCH),
        (Sinusoid(amplitude=(0.0, 59.9, 0.0), frequency=(0.0, 0.5, 0.0)), BENCH),
        (Sinusoid(amplitude=(0.0, 60.0, 0.0), frequency=(0.0, 0.5, 0.0)), BENCH),
        (Sinusoid(amplitude=(0.0, 0.0, 100.0), frequency=(0.0, 0.0, 0.5)), BENCH),
        (Hold(attitude=(0.0, 59.9, 7200.0)), BENCH),
        (Hold(attitude=None), BENCH),
        (Stream(), BENCH),
        (ROLLS, BODY),
        (Points(times=[0.0, 4.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 59.0, 100.0)]), BENCH),
    ],
)
def test_what_stays_within_the_limits_is_not_refused(reference: Reference, limits: Limits) -> None:
    Trajectory.of(reference).check(limits)


def test_a_sinusoid_that_is_too_fast_only_after_many_periods_is_refused() -> None:
    """Nearly equal frequencies: roll and yaw oppose each other at the steepest pitch within an hour, not before."""
    trajectory = Trajectory.of(Sinusoid(amplitude=(60.0, 50.0, 80.0), frequency=(0.4, 0.4006, 0.4002)))
    first, hour = (
        Angles(*(part[0] for part in trajectory.at(np.arange(0, seconds, 0.05)[None]))).speeds().max()
        for seconds in (8 * 2 * pi / 0.4, 3600)
    )
    assert first < 0.86 < hour <= trajectory.fastest() < 1.03 * hour
    trajectory.check(BODY._replace(tilt=pi))
    with pytest.raises(FollowError, match="max_reference_rate"):
        trajectory.check(BODY._replace(tilt=pi, rate=0.86))


DENSE: Final = 30 * 64 + 1
"""Times, among which are the 65 that are sampled."""

QUARTIC_BETWEEN_SAMPLES: Final = 1.004
"""How far a quartic can rise above the largest of its 65 even samples: 0.38 %, near the crests of the fourth Chebyshev
polynomial (the least Σ|w| of weights w that give every quartic's value there from its samples). The rate along the
direction that is fastest at any time is such a quartic."""


@settings(max_examples=40)
@given(first=references, target=holds, t=seconds(0, 5), within_s=seconds(0.2, 5.0))
def test_the_fastest_of_the_samples_is_the_fastest(first: Reference, target: Hold, t: float, within_s: float) -> None:
    """Without roll, where Σ rate² is all; from any state, so from any acceleration."""
    angle, rate, acceleration = (part * [0.0, 1.0, 1.0] for part in states(Trajectory.of(first), t))
    assert target.attitude is not None
    level = Trajectory.of(Hold(attitude=(0.0, *target.attitude[1:])))
    trajectory = approached(level, here((angle, rate, acceleration)), t, Approach(within_s))
    _, rates, _ = piece_states(trajectory, 0, t + within_s * np.linspace(0, 1, DENSE)[:, None])
    fastest = np.linalg.norm(rates, axis=1).max()
    # 1e-9: rounding of terms 15 (5/T) times the angles, at most 400, that cancel; in what is hardly moving, too.
    assert trajectory.fastest() <= fastest * (1 + 1e-9) + 1e-9
    assert fastest <= trajectory.fastest() * QUARTIC_BETWEEN_SAMPLES + 1e-9
