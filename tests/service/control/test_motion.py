"""Reference under any sequence of operator's changes: never jumps, stays within limits, and arrives.

Angles are compared with polynomials and sines written here, and q_d, ω_d, ω̇_d with those of the NumPy twin: the three
turns by hand. Joins are checked just before and just after. Bounds of an approach are written here again, from the
formulas that SPEC.md states.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from math import nextafter, pi, radians
from typing import Final

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import MAX_POINTS, Hold, Points, Reference, Sinusoid, Stream
from aeroloop.service.control.motion import (
    LEAST_TURN_S,
    Approach,
    Motion,
    approached,
    at_rest,
    braked,
    braking_times,
    shortest,
    to_set_point,
)
from aeroloop.service.control.reference import Angles, FollowError, Limits, Trajectory
from tests.support.numpy_twin import Array, attitude_of, motion_of, rotation

EPS: Final = 2.0**-52
ROUNDING: Final = 1e-9
NO_LIMITS = Limits(rate=1e9, tilt=pi, rolls=True)
BENCH = Limits(rate=1.0, tilt=radians(60), rolls=False)  # a 2-DOF bench as configured unless stated otherwise
BODY = BENCH._replace(rolls=True)
SAMPLED: Final = 1.004
"""How far a quartic can rise above the largest of its 65 even samples: 0.38 %, near the crests of the fourth Chebyshev
polynomial. The rate along the direction that is fastest at any time is such a quartic."""


def triples(limit: float) -> st.SearchStrategy[tuple[float, float, float]]:
    """Roll, pitch, yaw [deg], in steps of a hundredth: what matters lies in between, not in the last bit."""
    angle = st.integers(round(-100 * limit), round(100 * limit)).map(lambda n: n / 100)
    return st.tuples(angle, angle, angle)


def seconds(least: float, most: float) -> st.SearchStrategy[float]:
    return st.integers(round(1000 * least), round(1000 * most)).map(lambda n: n / 1000)


@st.composite
def some_points(draw: st.DrawFn) -> Points:
    gaps = draw(st.lists(seconds(0.05, 3.0), min_size=1, max_size=5))
    times = [0.0, *(float(t) for t in np.cumsum(gaps))]
    return Points(times=times, attitudes=draw(st.lists(triples(60), min_size=len(times), max_size=len(times))))


holds = triples(60).map(lambda attitude: Hold(attitude=attitude))
frequencies = st.integers(0, 30).map(lambda n: n / 10)
sinusoids = st.builds(Sinusoid, amplitude=triples(60), frequency=st.tuples(frequencies, frequencies, frequencies))
references: st.SearchStrategy[Reference] = st.one_of(holds, sinusoids, some_points())
withins = seconds(0.02, 5.0)


def fits(reference: Reference) -> bool:
    try:
        Trajectory.of(reference).check(BODY)
    except FollowError:
        return False
    return True


turns = st.tuples(*[st.integers(-40, 40).map(float)] * 2, st.integers(-180, 180).map(float))
slow = st.integers(0, 5).map(lambda n: n / 10)
swings = st.builds(
    Sinusoid,
    amplitude=st.tuples(*[st.integers(-30, 30).map(float)] * 2, st.integers(-60, 60).map(float)),
    frequency=st.tuples(slow, slow, slow),
)
allowed: st.SearchStrategy[Reference] = st.one_of(turns.map(lambda a: Hold(attitude=a)), swings, some_points()).filter(
    fits
)
histories = st.lists(st.tuples(allowed, seconds(0, 4), seconds(0, 6)), max_size=4)


@st.composite
def any_states(draw: st.DrawFn) -> Angles:
    """Angles, rates within 1 rad/s and accelerations up to 3 rad/s², whatever has led there; some axes at rest."""
    rate = np.array(draw(triples(57))) / 100
    acceleration = np.array(draw(triples(3))) * draw(st.sampled_from([0.0, 0.1, 1.0]))
    moving = np.array(draw(st.tuples(*[st.booleans()] * 3)))
    return Angles(np.radians(draw(turns))[None], (rate * moving)[None], (acceleration * moving)[None])


def of_axis(axis: int, *state: float) -> Angles:
    """Angle, rate and acceleration of one axis [rad]; the others are level and at rest."""
    return Angles(*(np.eye(3)[axis][None] * x for x in state))


def states(trajectory: Trajectory, t: float) -> tuple[Array, Array, Array]:
    """Angle, rate, acceleration, each of shape (3,), term by term; on a join, of the piece after it."""
    return piece_states(trajectory, max(0, sum(start <= t for start in trajectory.starts) - 1), t)


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


def way(trajectory: Trajectory, target: Trajectory, end: float) -> Angles:
    """Angles, rates, accelerations of the pieces before the target's, densely. Shapes (n, 3)."""
    edges = [*trajectory.starts[: len(trajectory.starts) - len(target.starts)], end]
    pieces = [piece_states(trajectory, i, np.linspace(a, b, 481)[:, None]) for i, (a, b) in enumerate(pairwise(edges))]
    return Angles(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def desired_of(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """The twin's q_d, ω_d, ω̇_d, of which the latter two are inertial."""
    q_d, omega, omega_dot = motion_of(*state)
    return q_d, rotation(q_d) @ omega, rotation(q_d) @ omega_dot


def quaternion(degrees: Sequence[float]) -> Array:
    return attitude_of(np.radians(degrees))


def terms(trajectory: Trajectory, i: int, t: float, order: int) -> float:
    """The sum over three axes of the terms of a derivative of piece i at time t, whatever their signs.

    ROUNDING of it is far more than rounding makes of them, and far less than a jump that anybody would notice.
    """
    tau, c = abs(t - trajectory.starts[i]), np.abs(trajectory.quintic[i])
    polynomial = sum(math.perm(n, order) * c[n] * tau ** (n - order) for n in range(order, 6))
    return float((polynomial + np.abs(trajectory.amplitude[i]) * trajectory.frequency[i] ** order).sum())


class Followed:
    """A motion, and what its trajectory should be by Trajectory's own word."""

    def __init__(self, reference: Reference) -> None:
        self.motion = Motion(reference)
        self.trajectory = Trajectory.of(reference)

    def at(self, t: float) -> tuple[Array, Array, Array]:
        q_d, omega_d, omega_d_dot = map(np.array, self.motion.at(t))
        return q_d, omega_d, omega_d_dot

    def follow(self, reference: Reference, t: float, approach: Approach) -> None:
        here = Angles(*(part[None] for part in states(self.trajectory, t)))
        self.trajectory = approached(Trajectory.of(reference), here, t, approach)
        self.motion.follow(Trajectory.of(reference), t, approach)

    @classmethod
    def after(cls, history: list[tuple[Reference, float, float]]) -> tuple[Followed, float]:
        """A motion after some changes, each as early as possible or later by a time, and the time of the next [s]."""
        followed, t = cls(Hold()), 0.0
        for reference, longer_s, passed in history:
            approach = shortest(Trajectory.of(reference), followed.motion.here(t), BODY)
            followed.follow(reference, t, approach.at_least(approach.within_s + longer_s))
            t += passed
        return followed, t


@settings(max_examples=40)
@given(start=any_states(), reference=allowed, longer_s=seconds(0, 60), t=seconds(0, 20), at_once=st.booleans())
def test_neither_angle_nor_rate_nor_acceleration_jumps_in_an_approach_or_between_points(
    start: Angles, reference: Reference, longer_s: float, t: float, at_once: bool
) -> None:
    """Wherever the approach begins, in one quintic or with braking before it."""
    target = Trajectory.of(reference)
    approach = shortest(target, start, BODY)
    approach = Approach(approach.within_s) if at_once else approach.at_least(approach.within_s + longer_s)
    trajectory = approached(target, start, t, approach)
    count = len(trajectory.starts) - len(target.starts)
    assert trajectory.starts[0] == t
    assert trajectory.starts[count] == t + approach.within_s
    joins = [(t, -1, 0), *((trajectory.starts[i + 1], i, i + 1) for i in range(len(trajectory.starts) - 1))]
    for at, before, after in joins:
        then = piece_states(trajectory, after, at)
        first = piece_states(trajectory, before, at) if before >= 0 else tuple(part[0] for part in start)
        for order in range(3):
            size = terms(trajectory, max(0, before), at, order) + terms(trajectory, after, at, order)
            assert np.abs(first[order] - then[order]).max() <= ROUNDING * (1 + size)


@settings(max_examples=40)
@given(first=references, target=holds, t=seconds(0, 10), within_s=withins)
def test_going_somewhere_ends_there_exactly_and_at_rest(
    first: Reference, target: Hold, t: float, within_s: float
) -> None:
    followed, still = Followed(first), Followed(target)
    followed.follow(target, t, Approach(within_s))
    for later in (t + within_s, t + within_s + 100):
        for got, expected in zip(followed.at(later), still.at(0.0), strict=True):
            assert np.array_equal(got, expected)
    assert not np.any(followed.at(t + within_s + 100)[1:])
    assert target.attitude is not None
    assert followed.at(1e4)[0] == pytest.approx(quaternion(target.attitude), abs=8 * EPS)


@settings(max_examples=40)
@given(first=references, points=some_points(), t=seconds(0, 10), within_s=withins)
def test_points_are_passed_each_at_its_time_and_the_last_is_held(
    first: Reference, points: Points, t: float, within_s: float
) -> None:
    followed = Followed(first)
    followed.follow(points, t, Approach(within_s))
    start, gap = t + within_s, min(np.diff(points.times))
    # Of the piece before the point: its terms, at most 15 times the differences, in a time that rounds by EPS of t.
    reach = 15 * radians(120) * 3 * max(np.diff(points.times)) / gap
    tolerance = EPS * reach * (50 + 10 * (start + points.times[-1]) / gap)
    for time_s, attitude in zip(points.times, points.attitudes, strict=True):
        for moment in (nextafter(start + time_s, 0.0), start + time_s):
            assert followed.at(moment)[0] == pytest.approx(quaternion(attitude), abs=tolerance)
    assert not np.any(followed.at(start + points.times[-1] + 1.0)[1:])


def way_through(points: Points, samples: int = 401) -> Angles:
    """The angles [rad] of each piece between two points. Shapes (pieces, samples, 3)."""
    trajectory = Trajectory.of(points)
    lengths = np.append(np.diff(trajectory.starts), 0.0)
    way = trajectory.at(lengths[:, None] * np.linspace(0, 1, samples))
    return Angles(*(part[:-1] for part in way))


def turns_back(points: Points) -> float:
    """How far a Bernstein coefficient of a piece's rate has the other sign than its way, as a share of |way|/length.

    The coefficients of the quartic Σ aₙuⁿ are bᵢ = Σₙ C(i, n)/C(4, n) aₙ.
    """
    trajectory = Trajectory.of(points)
    lengths = np.diff(trajectory.starts)
    ways = np.diff(np.radians(points.attitudes), axis=0)
    worst = 0.0
    for length, way, quintic in zip(lengths, ways, trajectory.quintic, strict=False):
        rate = np.array([(n + 1) * quintic[n + 1] * length**n for n in range(5)])
        for i in range(5):
            coefficient = sum(math.comb(i, n) / math.comb(4, n) * rate[n] for n in range(i + 1))
            scale = np.maximum(np.abs(way), 1e-9) / length
            worst = max(worst, float((-np.sign(way) * coefficient / scale).max()))
    return worst


def beyond(points: Points) -> float:
    """How far any angle leaves the range of the two points between which it is [rad]; negative if it does not."""
    angles = np.radians(points.attitudes)[:, None]
    between = way_through(points).angle
    low, high = np.minimum(angles[:-1], angles[1:]), np.maximum(angles[:-1], angles[1:])
    return float(np.maximum(between - high, low - between).max())


OVERSHOOTS: Final = Points(times=[0, 4, 50], attitudes=[(0, 0, 0), (0, 20, 60), (0, 20, 60)])


def test_points_after_a_rise_hold_what_they_say_and_the_former_way_is_still_there_for_logs() -> None:
    assert beyond(OVERSHOOTS) <= 1e-15
    assert np.array_equal(way_through(OVERSHOOTS).angle[1, :, 1:], np.radians([[20.0, 60.0]] * 401))
    former = OVERSHOOTS.model_copy(update={"interpolation": "differences"})
    assert np.degrees(way_through(former).angle.max(axis=(0, 1))) == pytest.approx([0, 99.3, 298.0], abs=0.1)


def test_between_two_points_no_angle_leaves_their_range_however_uneven_their_times() -> None:
    """Gaps from a millisecond to a minute, steps from a microdegree to a turn, up and down or only up."""
    rng = np.random.default_rng(1)
    for number in range(400):
        gaps = 10 ** rng.uniform(-3, 2, rng.integers(1, 9))
        steps = rng.choice([0, 1, 1, 1], (len(gaps) + 1, 3)) * 10 ** rng.uniform(-6, 2, (len(gaps) + 1, 3))
        signs = rng.choice([-1, 1], steps.shape if number % 2 else (1, 3))
        attitudes = np.cumsum(steps * signs, axis=0)
        times = [0.0, *np.cumsum(gaps).tolist()]
        points = Points(times=times, attitudes=[(r, p, y) for r, p, y in attitudes.tolist()])
        assert beyond(points) <= 1e-13 * (1 + np.abs(attitudes).max())
        assert turns_back(points) <= 1e-6  # of a way that may be 10⁻⁸ of the angles
        way = way_through(points)
        for part in way:  # nothing jumps at a point
            scale = np.abs(part).max(initial=1e-300)
            assert part[:-1, -1] == pytest.approx(part[1:, 0], abs=1e-9 * scale)


def test_points_on_a_line_are_passed_at_its_rate_and_a_dense_curve_is_followed() -> None:
    line = Points(times=list(range(9)), attitudes=[(0, 5 * n, -10 * n) for n in range(9)])
    way = way_through(line)
    assert np.degrees(way.rate[2:-2]) == pytest.approx(np.broadcast_to([0, 5, -10], way.rate[2:-2].shape))
    assert np.abs(way.acceleration[2:-2]).max() < 1e-12

    t = np.arange(0, 40.05, 0.1)
    yaw = 50 * (1 - np.cos(0.05 * pi * t))
    way = way_through(Points(times=t.tolist(), attitudes=[(0, 0, float(angle)) for angle in yaw]))
    at = t[:-1, None] + 0.1 * np.linspace(0, 1, 401)
    inner = slice(1, -1)  # it begins and ends at rest without an acceleration
    rate, acceleration = np.degrees(way.rate[inner, :, 2]), np.degrees(way.acceleration[inner, :, 2])
    curve_rate = 50 * 0.05 * pi * np.sin(0.05 * pi * at[inner])
    curve_acceleration = 50 * (0.05 * pi) ** 2 * np.cos(0.05 * pi * at[inner])
    turns = np.abs(np.sin(0.05 * pi * at[inner])) < 0.1  # where it turns back, a point is passed at rest
    assert np.abs(rate - curve_rate)[~turns].max() < 2e-3
    assert np.abs(acceleration - curve_acceleration)[~turns].max() < 0.02
    assert np.abs(rate - curve_rate).max() < 0.1


@settings(max_examples=40)
@given(
    first=references,
    changes=st.lists(st.tuples(references, seconds(0.05, 3), withins), max_size=3),
    steps=st.lists(seconds(0, 0.4), min_size=1, max_size=20),
)
def test_the_loops_function_gives_the_trajectorys_own_angles(
    first: Reference, changes: list[tuple[Reference, float, float]], steps: list[float]
) -> None:
    followed, t, pending = Followed(first), 0.0, list(changes)
    for step in steps:
        t += step
        if pending and t >= pending[0][1]:
            reference, _, within_s = pending.pop(0)
            followed.follow(reference, t, Approach(within_s))
        trajectory, i = followed.trajectory, followed.trajectory.piece(t)
        taken = trajectory.at(np.full((len(trajectory.starts), 1), t - trajectory.starts[i]))
        angle, rate, acceleration = (part[i, 0] for part in taken)
        tolerance = ROUNDING * ((1 + terms(trajectory, i, t, 1)) ** 2 + terms(trajectory, i, t, 2))
        for got, expected in zip(followed.at(t), desired_of((angle, rate, acceleration)), strict=True):
            assert np.abs(got - expected).max() <= tolerance
        for got, expected in zip((angle, rate, acceleration), piece_states(trajectory, i, t), strict=True):
            assert np.abs(got - expected).max() <= tolerance


def stopping(state: Angles) -> Array:
    """The distance in which each axis stops: a cubic of the rate, as long as the acceleration's limit makes it."""
    rate, acceleration = np.abs(state.rate[0]), np.abs(state.acceleration[0])
    brake_s = 1.5 * rate / (np.maximum(1.0, acceleration) - acceleration / 3)
    brake_s = np.where(acceleration > 0, np.maximum(brake_s, 0.1), brake_s) + 0.001  # whole milliseconds
    return np.asarray(rate * brake_s / 2 + acceleration * brake_s**2 / 12)


@settings(max_examples=60)
@given(start=any_states(), reference=allowed, longer_s=seconds(0, 60))
@example(of_axis(2, radians(70), radians(12), 0.0), Hold(attitude=(0.0, 0.0, 30.0)), 38.0)  # it went to 115° first
def test_no_axis_goes_further_beyond_its_start_or_its_target_than_it_takes_to_stop(
    start: Angles, reference: Reference, longer_s: float
) -> None:
    target = Trajectory.of(reference)
    approach = shortest(target, start, BODY)
    approach = approach.at_least(approach.within_s + longer_s)
    angles = way(approached(target, start, 0.0, approach), target, approach.within_s).angle
    ends = (start.angle[0], stopping(start)), (target.first.angle[0], stopping(target.first))
    assert np.all(np.minimum(*(angle - distance for angle, distance in ends)) - 1e-9 <= angles)  # rounding
    assert np.all(angles <= np.maximum(*(angle + distance for angle, distance in ends)) + 1e-9)


@settings(max_examples=40)
@given(history=histories, reference=allowed, longer_s=seconds(0, 60))
def test_after_any_history_an_approach_keeps_the_limits_of_rate_and_tilt(
    history: list[tuple[Reference, float, float]], reference: Reference, longer_s: float
) -> None:
    followed, t = Followed.after(history)
    target = Trajectory.of(reference)
    approach = shortest(target, followed.motion.here(t), BODY)
    approach = approach.at_least(approach.within_s + longer_s)
    followed.follow(reference, t, approach)
    assert way(followed.trajectory, target, t + approach.within_s).tilts().max() <= BODY.tilt * SAMPLED
    turning = [np.linalg.norm(followed.at(s)[1]) for s in np.linspace(t, t + approach.within_s, 300)]
    assert max(turning) <= BODY.rate * SAMPLED


@settings(max_examples=100)
@given(start=any_states())
@example(of_axis(1, 0.0, 1.0, 0.9))  # the acceleration that it begins with counts
@example(of_axis(1, 0.0, 0.5, -1.0))
def test_braking_stays_within_1_rad_per_s2_or_what_it_begins_with_where_no_limit_is_near(start: Angles) -> None:
    brake_s = braking_times(start, NO_LIMITS)
    assert np.all(brake_s[np.abs(start.rate[0]) + np.abs(start.acceleration[0]) == 0] == 0)
    braking = braked(start, brake_s, np.linspace(0.0, float(brake_s.max()), 500))
    largest = np.maximum(1.0, np.abs(start.acceleration[0]))
    assert np.all(np.abs(braking.acceleration).max(axis=0) <= largest * (1 + ROUNDING))


@pytest.mark.parametrize(
    ("pitch", "rate", "acceleration"),
    [
        (0.0, 0.95, 2.0),  # braking no harder than it gathers speed, it would first reach 1.1 rad/s
        (57.0, 0.5, -2.0),  # it would tilt by 62°
        (50.0, 0.5, 0.0),  # it would tilt by 60.7°
    ],
)
def test_near_the_limits_of_rate_and_tilt_it_brakes_harder(pitch: float, rate: float, acceleration: float) -> None:
    start, target = of_axis(1, radians(pitch), rate, acceleration), Trajectory.of(Hold())
    approach = shortest(target, start, BENCH)
    angles, rates, _ = way(approached(target, start, 0.0, approach), target, approach.within_s)
    assert np.abs(rates).max() <= BENCH.rate * SAMPLED
    assert np.abs(angles).max() <= BENCH.tilt * SAMPLED


@settings(max_examples=100)
@example(state=of_axis(1, 0.0, 0.0, 0.5))
@given(state=any_states())
def test_an_axis_brakes_within_1_rad_per_s2_or_with_what_it_begins(state: Angles) -> None:
    """Unless a limit of rate or tilt is near."""
    brake_s = braking_times(state, NO_LIMITS)
    stopping_way = braked(state, brake_s, np.linspace(0.0, float(brake_s.max()), 481))
    most = np.maximum(1.0, np.abs(state.acceleration[0]))
    assert np.all(np.abs(stopping_way.acceleration) <= most * (1 + ROUNDING))
    assert np.all(brake_s[state.acceleration[0] != 0] >= 0.1)  # it is let go no quicker


@settings(max_examples=40)
@given(history=histories)
def test_resting_brakes_at_once_and_stays_where_that_ends(history: list[tuple[Reference, float, float]]) -> None:
    followed, t = Followed.after(history)
    start, rest = followed.motion.here(t), followed.motion.rest(t, BODY)
    assert rest.attitude is not None
    assert np.all(np.abs(np.radians(rest.attitude) - start.angle[0]) <= stopping(start) + 1e-9)
    approach = shortest(Trajectory.of(rest), start, BODY)
    assert approach.within_s == pytest.approx(max(approach.brake_s or (0.0,)) + LEAST_TURN_S)
    followed.follow(rest, t, approach)
    for later in (approach.within_s + 1e-9, 9.0 + approach.within_s):
        assert not np.any(followed.at(t + later)[1:])


@settings(max_examples=60)
@given(start=any_states(), reference=allowed, more=st.lists(st.integers(0, 10**6), max_size=5))
def test_the_time_that_is_named_would_do_and_so_does_any_longer_and_a_twentieth_less_would_not(
    start: Angles, reference: Reference, more: list[int]
) -> None:
    target = Trajectory.of(reference)
    least = shortest(target, start, BODY)
    with pytest.raises(FollowError) as refused:
        least.lasting(0.95 * least.within_s, BODY)
    found = re.fullmatch(r"the approach is too short: with .*; --in ([0-9.]+) would do", str(refused.value))
    assert found is not None
    named = float(found[1])
    assert 0 <= named - least.within_s <= 0.01 + 1e-9
    for seconds_more in (0, *sorted(more)):
        assert least.lasting(named + seconds_more / 1000, BODY).within_s >= named
    # And truly so: it would turn too fast, or not be done with braking. A turn of 20 ms may be slower than it could be.
    turn_s = least.within_s - max(least.brake_s or (0.0,)) - max(least.run_up_s or (0.0,))
    if turn_s > LEAST_TURN_S * (1 + 1e-9) and turn_s > 0.05 * least.within_s:
        trajectory = approached(target, start, 0.0, least._replace(within_s=0.95 * least.within_s))
        assert way(trajectory, target, 0.95 * least.within_s).speeds().max() > BODY.rate * 1.04


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("start", "target", "why"),
    [
        ((0.0, 0.0, 0.0), Hold(attitude=(0.0, 0.0, 1e6)), "even 600 s would be"),
        ((0.0, 0.0, 0.0), Hold(attitude=(0.0, 0.0, 1e308)), "too far"),
        # beyond the horizontal a straight line of roll and pitch may pass through a larger tilt
        ((130.0, 50.0, 0.0), Hold(attitude=(130.0, -130.0, 0.0)), r"tilts by 130\.0°, more than .*, however long"),
    ],
)
def test_what_no_time_would_do_for_is_refused(start: tuple[float, float, float], target: Hold, why: str) -> None:
    limits = BODY._replace(tilt=radians(120))
    with pytest.raises(FollowError, match=why):
        shortest(Trajectory.of(target), at_rest(start), limits).lasting(600.0, limits)


@settings(max_examples=50)
@given(start=any_states(), target=turns.map(lambda a: Hold(attitude=a)), asked_s=seconds(0.02, 2.0))
def test_on_the_way_to_a_set_point_no_axis_swings_out(start: Angles, target: Hold, asked_s: float) -> None:
    """Beyond its start or its target, no further than braking within the time asked, or within the limit, would."""
    trajectory = Trajectory.of(target)
    assume(start.speeds().max() <= BODY.rate)
    approach = to_set_point(trajectory, start, asked_s, BODY)
    angles = way(approached(trajectory, start, 0.0, approach), trajectory, approach.within_s).angle
    within = np.abs(start.rate[0]) * asked_s / 2 + np.abs(start.acceleration[0]) * asked_s**2 / 12
    margin = np.maximum(stopping(start), within) + 2e-3  # between two of 65 samples
    ends = np.concatenate([start.angle, trajectory.first.angle])
    assert np.all(ends.min(axis=0) - margin <= angles)
    assert np.all(angles <= ends.max(axis=0) + margin)


def test_a_quintic_to_a_set_point_that_would_tilt_beyond_the_limit_is_not_taken() -> None:
    """It stays within the distance of braking, but from 57° at 0.3 rad/s to 59.5° in 1 s it would reach 61.1°."""
    start, target = of_axis(1, radians(57), 0.3, 0.0), Trajectory.of(Hold(attitude=(0.0, 59.5, 0.0)))
    assert way(approached(target, start, 0.0, Approach(1.0)), target, 1.0).tilts().max() > radians(61)
    approach = to_set_point(target, start, 1.0, BENCH)
    tilts = way(approached(target, start, 0.0, approach), target, approach.within_s).tilts()
    assert tilts.max() <= BENCH.tilt * SAMPLED


def tilts_to(start: Angles, target: Hold, asked_s: float) -> Array:
    trajectory = Trajectory.of(target)
    approach = to_set_point(trajectory, start, asked_s, BODY)
    return np.asarray(way(approached(trajectory, start, 0.0, approach), trajectory, approach.within_s).tilts())


def test_a_quintic_that_would_tilt_too_far_is_not_taken_to_a_set_point() -> None:
    """At 50° and 0.95 rad/s, asked to be at 50° a second later: a quintic would go to 60.6°."""
    start, target = of_axis(1, radians(50), 0.95, 0.0), Hold(attitude=(0.0, 50.0, 0.0))
    trajectory = Trajectory.of(target)
    quintic = approached(trajectory, start, 0.0, Approach(1.0)).samples()
    assert quintic.tilts().max() > BODY.tilt
    assert quintic.speeds().max() <= BODY.rate
    assert tilts_to(start, target, 1.0).max() <= BODY.tilt


@settings(max_examples=50)
@given(start=any_states(), target=turns.map(lambda a: Hold(attitude=a)), asked_s=seconds(0.02, 2.0))
def test_on_the_way_to_a_set_point_the_tilt_keeps_its_limit(start: Angles, target: Hold, asked_s: float) -> None:
    assume(start.speeds().max() <= BODY.rate)
    braking = braked(start, braking_times(start, BODY), np.linspace(0.0, 5.0, 500)).tilts().max()
    try:
        tilts = tilts_to(start, target, asked_s)
    except FollowError:
        return  # no way is within the limits
    assert tilts.max() <= max(BODY.tilt, braking) * SAMPLED


ROLLS = Sinusoid(amplitude=(1.0, 0.0, 0.0), frequency=(0.3, 0.0, 0.0))


@pytest.mark.parametrize(
    ("reference", "limits", "why"),
    [
        (Sinusoid(amplitude=(0.0, 30.0, 100.0), frequency=(0.0, 0.5, 0.7)), BENCH, "max_reference_rate"),
        (
            Points(times=[0.0, 1.0, 1.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, 0.0), (0.0, 5.0, 25.0)]),
            BENCH,
            "max_reference_rate",
        ),
        # neither alone is too much: acos(cos² 50°) = 65.6°
        (Sinusoid(amplitude=(50.0, 50.0, 0.0), frequency=(0.3, 0.3, 0.0)), BODY, "max_reference_tilt_deg"),
        # sampled where pitch is 0, each time; and beyond 60° only after 848 s
        (Sinusoid(amplitude=(0.0, 80.0, 1.0), frequency=(0.0, 0.7, 0.7 / 32)), BENCH, "max_reference_tilt_deg"),
        (Sinusoid(amplitude=(0.0, 80.0, 0.0), frequency=(0.0, 0.001, 0.0)), BENCH, "max_reference_tilt_deg"),
        (Hold(attitude=(0.0, -60.1, 0.0)), BENCH, "max_reference_tilt_deg"),
        (ROLLS, BENCH, "roll"),
    ],
)
def test_what_goes_too_far_is_refused_by_the_name_of_the_limit_in_one_line(
    reference: Reference, limits: Limits, why: str
) -> None:
    with pytest.raises(FollowError, match=why) as refused:
        Trajectory.of(reference).check(limits)
    assert len(str(refused.value).splitlines()) == 1
    Trajectory.of(reference).check(NO_LIMITS)


@settings(max_examples=60)
@given(points=some_points())
def test_points_are_refused_where_one_of_65_samples_of_a_piece_is_beyond_a_limit(points: Points) -> None:
    trajectory = Trajectory.of(points)
    edges = pairwise(trajectory.starts.tolist())
    sampled = [piece_states(trajectory, i, np.linspace(a, b, 65)[:, None]) for i, (a, b) in enumerate(edges)]
    samples = Angles(*(np.concatenate(parts) for parts in zip(*sampled, strict=True)))
    fastest, tilt = float(samples.speeds().max()), float(samples.tilts().max())
    assume(min(fastest, tilt) > 1e-3)
    enough = Limits(fastest * (1 + ROUNDING), tilt * (1 + ROUNDING), rolls=True)
    trajectory.check(enough)
    for too_low in (enough._replace(rate=fastest * (1 - 2e-6)), enough._replace(tilt=tilt * (1 - 2e-6))):
        with pytest.raises(FollowError):
            trajectory.check(too_low)


@pytest.mark.parametrize("fast", [0, 198, 199, 200, 201, 399, 400, 448])
def test_one_piece_of_many_that_is_too_fast_or_too_tilted_is_found_wherever_it_is(fast: int) -> None:
    """Many are checked 200 at a time."""
    attitudes = [(0.0, 0.0, 1.0 * (n > fast)) for n in range(450)]
    steps = Trajectory.of(Points(times=[float(n) for n in range(450)], attitudes=attitudes))
    with pytest.raises(FollowError, match="max_reference_rate"):
        steps.check(BENCH._replace(rate=radians(1.1)))
    steps.check(BENCH._replace(rate=radians(2)))
    attitudes = [(0.0, 61.0 * (n == fast), 0.0) for n in range(450)]
    peak = Trajectory.of(Points(times=[1000.0 * n for n in range(450)], attitudes=attitudes))
    with pytest.raises(FollowError, match="max_reference_tilt_deg"):
        peak.check(BENCH)
    peak.check(BENCH._replace(tilt=radians(90)))


def test_of_points_within_the_limits_no_sines_are_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """They would take most of the time of a check of 10 000 points."""
    computed = list[int]()

    def count(samples: Angles) -> Array:
        computed.append(len(samples.angle))
        return np.zeros(len(samples.angle))

    for name in ("speeds", "tilts"):
        monkeypatch.setattr(Angles, name, count)
    times, yaw = [n / 10 for n in range(MAX_POINTS)], 60 * np.sin(0.05 * np.arange(MAX_POINTS))
    attitudes = [(0.0, angle / 2, angle) for angle in yaw.tolist()]
    Trajectory.of(Points(times=times, attitudes=attitudes)).check(BENCH)
    assert sum(computed) == 0


@settings(max_examples=100)
@example(of_axis(2, 0.0, 0.9, 0.0), (0.0, 0.0, 49.0), 1.0)  # it would turn at 1.3 rad/s
@example(of_axis(1, radians(55), 0.0, 2.0), (0.0, 55.0, 0.0), 2.0)  # it would tilt by 63°
@given(start=any_states(), target=turns, within_s=seconds(0.02, 5.0))
def test_the_quintic_to_a_set_point_keeps_the_limits_whether_samples_or_control_points_say_so(
    start: Angles, target: tuple[float, float, float], within_s: float
) -> None:
    """Where the control points keep them, the dense samples do, and they lie on the way that braking takes."""
    trajectory = Trajectory.of(Hold(attitude=target))
    try:
        approach = to_set_point(trajectory, start, within_s, BODY)
    except FollowError:
        return
    if approach.brake_s is not None or approach.within_s != within_s:
        return
    states = way(approached(trajectory, start, 0.0, approach), trajectory, within_s)
    assert states.speeds().max() <= BODY.rate * SAMPLED
    assert states.tilts().max() <= BODY.tilt * SAMPLED


def test_what_stays_within_the_limits_is_not_refused() -> None:
    steep = Points(times=[0.0, 4.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 59.0, 100.0)])
    for reference in (Sinusoid(), Hold(attitude=(0.0, 59.9, 7200.0)), Stream(), steep):
        Trajectory.of(reference).check(BENCH)
    Trajectory.of(ROLLS).check(BODY)


def test_braking_has_the_rate_of_its_angle_and_the_acceleration_of_its_rate() -> None:
    """Simpson's rule is exact for cubics, so the integrals are those of the rate and the acceleration to a rounding."""
    random = np.random.default_rng(2)
    for _ in range(20):
        begin, times = Angles(*random.uniform(-1, 1, (3, 1, 3))), random.uniform(0.1, 3, 3)
        for axis in range(3):
            s = np.linspace(0, times[axis], 3)
            angle, rate, acceleration = (part[:, axis] for part in braked(begin, times, s))
            weights = np.array([1, 4, 1]) * times[axis] / 6
            assert angle[2] - begin.angle[0, axis] == pytest.approx(weights @ rate, abs=1e-14)
            assert rate[2] - begin.rate[0, axis] == pytest.approx(weights @ acceleration, abs=1e-14)
            assert (rate[2], acceleration[2]) == pytest.approx((0, 0), abs=1e-14)
