"""Approaches: an operator can predict how the reference leaves one motion for another.

Each bound is written here again, from the formulas that SPEC.md states. A present state is any within the limits, or,
where an approach must stay within limits that it begins near, one that earlier motions lead to.
"""

from __future__ import annotations

import re
from itertools import pairwise
from math import radians
from typing import Final

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Hold, Reference, Sinusoid
from aeroloop.service.control.motion import (
    LEAST_TURN_S,
    Approach,
    approached,
    shortest,
    shortest_from_rest,
    to_set_point,
)
from aeroloop.service.control.reference import Angles, FollowError, Limits, Trajectory
from tests.service.control.test_motion import (
    BENCH,
    BODY,
    DENSE,
    NO_LIMITS,
    Followed,
    here,
    holds,
    piece_states,
    rounding,
    seconds,
    some_points,
    states,
    triples,
    withins,
)
from tests.support.numpy_twin import Array

SAMPLED: Final = 1.004
"""How far the largest speed may be above that of 65 samples; see test_motion.py."""

# References and states within BODY's limits

turns = st.tuples(*[st.integers(-40, 40).map(float)] * 2, st.integers(-180, 180).map(float))
slow = st.integers(0, 5).map(lambda n: n / 10)
swings = st.builds(
    Sinusoid,
    amplitude=st.tuples(*[st.integers(-30, 30).map(float)] * 2, st.integers(-60, 60).map(float)),
    frequency=st.tuples(slow, slow, slow),
)
tracked: st.SearchStrategy[Reference] = st.one_of(turns.map(lambda a: Hold(attitude=a)), swings, some_points()).filter(
    lambda reference: _fits(reference, BODY)
)


def _fits(reference: Reference, limits: Limits) -> bool:
    try:
        Trajectory.of(reference).check(limits)
    except FollowError:
        return False
    return True


@st.composite
def any_states(draw: st.DrawFn) -> Angles:
    """Angles, rates within 1 rad/s and accelerations up to 3 rad/s², whatever has led there; some axes at rest."""
    rate = np.array(draw(triples(57))) / 100
    acceleration = np.array(draw(triples(3))) * draw(st.sampled_from([0.0, 0.1, 1.0]))
    moving = np.array(draw(st.tuples(*[st.booleans()] * 3)))
    return Angles(np.radians(draw(turns))[None], (rate * moving)[None], (acceleration * moving)[None])


histories = st.lists(st.tuples(tracked, seconds(0, 4), seconds(0, 6)), max_size=4)


def after(history: list[tuple[Reference, float, float]], limits: Limits) -> tuple[Followed, float]:
    """A motion after some changes, each as early as possible or later by a time, and the time of the next [s]."""
    followed, t = Followed(Hold()), 0.0
    for reference, longer_s, passed in history:
        approach = shortest(Trajectory.of(reference), followed.motion.here(t), limits)
        followed.approach(reference, t, approach.at_least(approach.within_s + longer_s))
        t += passed
    return followed, t


def way(trajectory: Trajectory, target: Trajectory, end: float) -> tuple[Array, Array, Array]:
    """Angles, rates, accelerations of the pieces before the target's, densely. Shapes (n, 3)."""
    count = len(trajectory.starts) - len(target.starts)
    edges = [*trajectory.starts[:count], end]
    pieces = [
        piece_states(trajectory, i, np.linspace(a, b, DENSE // 4)[:, None]) for i, (a, b) in enumerate(pairwise(edges))
    ]
    angles, rates, accelerations = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    return angles, rates, accelerations


def stopping(state: Angles, braking: float) -> Array:
    """The distance in which each axis stops: a cubic of the rate, as long as the acceleration's limit makes it."""
    rate, acceleration = np.abs(state.rate[0]), np.abs(state.acceleration[0])
    seconds = 1.5 * rate / (np.maximum(braking, acceleration) - acceleration / 3)
    seconds = np.where(acceleration > 0, np.maximum(seconds, 0.1), seconds) + 0.001  # whole milliseconds
    distance: Array = rate * seconds / 2 + acceleration * seconds**2 / 12
    return distance


def bounds(start: Angles, target: Trajectory, braking: float) -> tuple[Array, Array]:
    """The interval between start and target, each extended by the distance in which it stops."""
    first = target.first
    before, behind = stopping(start, braking), stopping(first, braking)
    low = np.minimum(start.angle[0] - before, first.angle[0] - behind)
    high = np.maximum(start.angle[0] + before, first.angle[0] + behind)
    return low - 1e-9, high + 1e-9  # rounding


# Where it goes


@settings(max_examples=60)
@given(start=any_states(), reference=tracked, longer_s=seconds(0, 60), braking=st.sampled_from([0.1, 1.0, 5.0]))
@example(  # at yaw 70°, turning by 12°/s: it went to 115° before it came back
    start=Angles(*(np.array([[0.0, 0.0, x]]) for x in (radians(70), radians(12), 0.0))),
    reference=Hold(attitude=(0.0, 0.0, 30.0)),
    longer_s=38.0,
    braking=1.0,
)
def test_no_axis_goes_further_beyond_its_start_or_its_target_than_it_takes_to_stop(
    start: Angles, reference: Reference, longer_s: float, braking: float
) -> None:
    target = Trajectory.of(reference)
    approach = shortest(target, start, BODY._replace(braking=braking))
    approach = approach.at_least(approach.within_s + longer_s)
    trajectory = approached(target, start, 0.0, approach)
    angles, _, _ = way(trajectory, target, approach.within_s)
    low, high = bounds(start, target, braking)
    assert np.all(low <= angles)
    assert np.all(angles <= high)


@settings(max_examples=40)
@given(start=any_states(), reference=tracked, braking=st.sampled_from([0.1, 1.0, 5.0]))
def test_braking_and_run_up_stay_within_the_limit_of_acceleration_or_the_one_that_they_find(
    start: Angles, reference: Reference, braking: float
) -> None:
    target = Trajectory.of(reference)
    limits = NO_LIMITS._replace(braking=braking)  # none that would make it brake harder
    approach = shortest(target, start, limits).at_least(1e6)  # and no turn to speak of
    trajectory = approached(target, start, 0.0, approach)
    _, _, accelerations = way(trajectory, target, approach.within_s)
    most = np.maximum(braking, np.maximum(np.abs(start.acceleration[0]), np.abs(target.first.acceleration[0])))
    assert np.all(np.abs(accelerations) <= most * (1 + 1e-6))  # 1e6 s round to 1e-10 s


@settings(max_examples=40)
@given(history=histories, reference=tracked, longer_s=seconds(0, 60))
def test_after_any_history_an_approach_keeps_the_limits_of_rate_and_tilt(
    history: list[tuple[Reference, float, float]], reference: Reference, longer_s: float
) -> None:
    followed, t = after(history, BODY)
    target = Trajectory.of(reference)
    approach = shortest(target, followed.motion.here(t), BODY)
    approach = approach.at_least(approach.within_s + longer_s)
    followed.approach(reference, t, approach)
    angles, _, _ = way(followed.trajectory, target, t + approach.within_s)
    tilts = np.arccos(np.cos(angles[:, 0]) * np.cos(angles[:, 1]))
    assert tilts.max() <= BODY.tilt * SAMPLED
    turning = [np.linalg.norm(followed.at(s)[1]) for s in np.linspace(t, t + approach.within_s, 300)]
    assert max(turning) <= BODY.rate * SAMPLED


@pytest.mark.parametrize(
    ("pitch", "rate", "acceleration"),
    [
        (0.0, 0.95, 2.0),  # braking no harder than it gathers speed, it would first reach 1.1 rad/s
        (57.0, 0.5, -2.0),  # it would tilt by 62°
        (50.0, 0.5, 0.0),  # it would tilt by 60.7°
    ],
)
def test_near_the_limits_of_rate_and_tilt_it_brakes_harder(pitch: float, rate: float, acceleration: float) -> None:
    start = Angles(*(np.array([[0.0, x, 0.0]]) for x in (radians(pitch), rate, acceleration)))
    target = Trajectory.of(Hold())
    approach = shortest(target, start, BENCH)
    angles, rates, _ = way(approached(target, start, 0.0, approach), target, approach.within_s)
    assert np.abs(rates).max() <= BENCH.rate * SAMPLED
    assert np.abs(angles).max() <= BENCH.tilt * SAMPLED


@settings(max_examples=40)
@given(start=any_states(), reference=tracked, longer_s=seconds(0, 60), t=seconds(0, 20))
def test_neither_angle_nor_rate_nor_acceleration_jumps(
    start: Angles, reference: Reference, longer_s: float, t: float
) -> None:
    target = Trajectory.of(reference)
    approach = shortest(target, start, BODY)
    approach = approach.at_least(approach.within_s + longer_s)
    trajectory = approached(target, start, t, approach)
    count = len(trajectory.starts) - len(target.starts)
    assert trajectory.starts[0] == t
    assert trajectory.starts[count] == t + approach.within_s
    sides = [((start.angle[0], start.rate[0], start.acceleration[0]), piece_states(trajectory, 0, t))]
    for i, end in enumerate(trajectory.starts[1 : count + 1]):
        sides.append((piece_states(trajectory, i, end), piece_states(trajectory, i + 1, end)))
    around = [state for side in sides for state in side]
    for before, after in sides:
        tolerance = (
            rounding(around, t + approach.within_s, float(np.diff(trajectory.starts[: count + 1]).min())) + 1e-300
        )
        for order in range(3):
            assert np.abs(before[order] - after[order]).max() <= tolerance[order]


# How long it takes


@settings(max_examples=60)
@given(start=any_states(), reference=tracked, more=st.lists(st.integers(0, 10**6), max_size=5))
def test_the_time_that_is_named_would_do_and_so_does_any_longer_and_a_twentieth_less_would_not(
    start: Angles, reference: Reference, more: list[int]
) -> None:
    target = Trajectory.of(reference)
    least = shortest(target, start, BODY)
    with pytest.raises(FollowError) as refused:
        least.lasting(0.95 * least.within_s, BODY)
    text = str(refused.value)
    assert len(text.splitlines()) == 1
    assert text.startswith("the approach is too short: ")
    found = re.search(r"; --in ([0-9.]+) would do$", text)
    assert found is not None
    named = float(found[1])
    assert least.within_s * (1 - 1e-9) <= named <= least.within_s * 1.01  # three digits
    for seconds_more in (0, *sorted(more)):
        assert least.lasting(named + seconds_more / 1000, BODY).within_s >= named
    # And truly so: it would turn too fast, or not be done with braking. A turn of 20 ms may be slower than it could be.
    turn_s = least.within_s - max(least.brake_s or (0.0,)) - max(least.run_up_s or (0.0,))
    shorter = turn_s - 0.05 * least.within_s
    if turn_s > LEAST_TURN_S * (1 + 1e-9) and shorter > 0:
        trajectory = approached(target, start, 0.0, least._replace(within_s=0.95 * least.within_s))
        angles, rates, _ = way(trajectory, target, 0.95 * least.within_s)
        assert Angles(angles, rates, rates).speeds().max() > BODY.rate * 1.04


@pytest.mark.parametrize(
    ("target", "rate", "within_s", "text"),
    [
        (
            Hold(attitude=(0.0, 0.0, 90.0)),
            0.0,
            2.0,
            "in 2 s it would turn at 1.48 rad/s, more than controller.max_reference_rate = 1 rad/s; --in 2.95 would do",
        ),
        (Hold(attitude=(0.0, 0.0, 20.0)), 0.5, 0.7, "braking alone takes 0.75 s; --in 1.06 would do"),
        (
            Sinusoid(amplitude=(0.0, 0.0, 50.0), frequency=(0.0, 0.0, 0.2)),
            0.5,
            0.7,
            "braking alone takes 0.75 s and running up to the reference takes 0.262 s; --in 1.41 would do",
        ),
        (Hold(attitude=(0.0, 0.0, 1e6)), 0.0, 600.0, "1 rad/s; even 600 s would be"),
    ],
)
def test_what_is_too_short_is_refused_with_what_takes_so_long_and_the_time_that_would_do(
    target: Reference, rate: float, within_s: float, text: str
) -> None:
    start = Angles(*(np.array([[0.0, 0.0, x]]) for x in (0.0, rate, 0.0)))
    with pytest.raises(FollowError) as refused:
        shortest(Trajectory.of(target), start, BENCH).lasting(within_s, BENCH)
    assert str(refused.value).startswith("the approach is too short: ")
    assert str(refused.value).endswith(text)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_is_too_far_for_any_time_is_refused() -> None:
    with pytest.raises(FollowError, match="too far"):
        shortest_from_rest(Trajectory.of(Hold(attitude=(0.0, 0.0, 1e308))), (0.0, 0.0, 0.0), BENCH)


def test_a_way_that_tilts_further_than_both_its_ends_is_refused_as_no_time_would_help() -> None:
    """Beyond the horizontal a straight line of roll and pitch may pass through a larger tilt."""
    limits = BODY._replace(tilt=radians(120))
    start, target = (130.0, 50.0, 0.0), Hold(attitude=(130.0, -130.0, 0.0))
    Trajectory.of(target).check(limits)
    with pytest.raises(FollowError, match=r"the approach tilts by 130\.0°, more than .*, however long it takes"):
        shortest_from_rest(Trajectory.of(target), start, limits)


# Rest


@settings(max_examples=40)
@given(history=histories)
def test_resting_brakes_at_once_and_stays_where_that_ends(history: list[tuple[Reference, float, float]]) -> None:
    followed, t = after(history, BODY)
    angle, rate, acceleration = states(followed.trajectory, t)
    rest = followed.motion.rest(t, BODY)
    assert rest.attitude is not None
    away = np.abs(np.radians(rest.attitude) - angle)
    assert np.all(away <= stopping(here((angle, rate, acceleration)), BODY.braking) + 1e-9)
    approach = shortest(Trajectory.of(rest), followed.motion.here(t), BODY)
    assert approach.within_s == pytest.approx(max(approach.brake_s or (0.0,)) + LEAST_TURN_S)
    followed.approach(rest, t, approach)
    for later in (approach.within_s + 1e-9, 9.0 + approach.within_s):
        assert not np.any(followed.at(t + later)[1])
        assert not np.any(followed.at(t + later)[2])


# Set-points of a stream


@settings(max_examples=40)
@given(start=holds, target=holds, asked_s=withins, rate=st.integers(1, 40).map(lambda n: n / 10))
def test_from_rest_a_set_point_is_reached_within_the_limit_as_asked_or_hardly_later_than_it_takes(
    start: Hold, target: Hold, asked_s: float, rate: float
) -> None:
    trajectory, limits = Trajectory.of(target), NO_LIMITS._replace(rate=rate)
    begin = Trajectory.of(start).first
    approach = to_set_point(trajectory, begin, asked_s, limits)
    assert approach.brake_s is None  # a single quintic
    asked = approached(trajectory, begin, 0.0, Approach(asked_s)).fastest()
    if asked <= rate:
        assert approach.within_s == asked_s
    else:
        # Rates fall as the time grows: the least is asked_s · asked / rate, and 5 % more is what is taken at once.
        assert approach.within_s == pytest.approx(asked_s * asked / rate * 1.05, rel=1e-9)
        assert approached(trajectory, begin, 0.0, approach).fastest() <= rate


@settings(max_examples=50)
@given(start=any_states(), target=turns.map(lambda a: Hold(attitude=a)), asked_s=seconds(0.02, 2.0))
def test_on_the_way_to_a_set_point_no_axis_swings_out(start: Angles, target: Hold, asked_s: float) -> None:
    """Beyond its start or its target, no further than braking within the time asked, or within the limit, would."""
    trajectory = Trajectory.of(target)
    assume(Angles(*start).speeds().max() <= BODY.rate)
    approach = to_set_point(trajectory, start, asked_s, BODY)
    angles, _, _ = way(approached(trajectory, start, 0.0, approach), trajectory, approach.within_s)
    within = np.abs(start.rate[0]) * asked_s / 2 + np.abs(start.acceleration[0]) * asked_s**2 / 12
    margin = np.maximum(stopping(start, BODY.braking), within) + 2e-3  # between two of 65 samples
    ends = np.concatenate([start.angle, trajectory.first.angle])
    assert np.all(ends.min(axis=0) - margin <= angles)
    assert np.all(angles <= ends.max(axis=0) + margin)
