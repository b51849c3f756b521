"""A stream of set-points: followed within its limits, refused or silent without harm."""

from __future__ import annotations

from math import acos, degrees, hypot

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Hold, Setpoint, Stream, Track
from tests.support.operated_loop import CONFIGURED, Loop


@pytest.fixture
def streaming(loop: Loop) -> Loop:
    """A loop that follows a stream, at rest and level, at tick 50."""
    loop.ask("track", Track(reference=Stream(timeout_s=0.5, within_s=0.2), within_s=0.05))
    loop.run(0.1)
    return loop


@settings(max_examples=12)
@example(sent=[(1.0, 0), (2.0, 0), (-3.0, 10), (4.0, 10)])
@given(sent=st.lists(st.tuples(st.floats(-4, 4), st.sampled_from([0, 0, 1, 10, 50])), min_size=1, max_size=8))
def test_of_set_points_between_two_ticks_the_newest_counts_and_is_taken_up_on_the_way_to_the_last(
    sent: list[tuple[float, int]],
) -> None:
    loop = Loop(Stream(within_s=0.2))
    loop.begin()
    loop.tick()
    expected = []
    for k, (yaw, ticks) in enumerate(sent):
        loop.stream(yaw)
        if ticks or k == len(sent) - 1:
            expected.append((loop.k, Hold(attitude=(0.0, 0.0, yaw))))
        for _ in range(ticks):
            loop.tick()
    loop.run(0.6)
    assert [(change.tick, change.reference) for change in loop.changes()[1:]] == expected
    assert all(change.within_s >= 0.2 for change in loop.changes()[1:])
    assert loop.yaw() == pytest.approx(sent[-1][0], abs=1e-12)
    loop.assert_it_runs_again()


@pytest.mark.parametrize(
    "payload",
    [
        b"yaw 10",
        b'{"attitude": [0, 0, NaN]}',
        Setpoint(attitude=(0.0, 61.0, 0.0)).encode(),
        Setpoint(attitude=(5.0, 0.0, 0.0)).encode(),
    ],
)
def test_a_set_point_that_is_refused_is_counted_and_changes_nothing(streaming: Loop, payload: bytes) -> None:
    before = streaming.changes()
    streaming.stream(3.0)
    streaming.raw(payload)
    streaming.run(0.3)
    assert streaming.live.setpoints.refused == 1
    assert [len(text.splitlines()) for text in streaming.events("fault")] == [1]
    assert len(streaming.changes()) == len(before) + 1  # the good one that came before it
    assert streaming.yaw() == pytest.approx(3.0, abs=1e-12)


def test_silence_is_reported_once_and_the_last_set_point_held_until_there_is_another(streaming: Loop) -> None:
    streaming.clock.advance(0.499)
    streaming.tick()
    assert streaming.events("lost") == []
    streaming.clock.advance(0.002)
    streaming.tick()
    assert len(streaming.events("lost")) == 1  # one that never begins is silent, too
    for yaw in (2.0, -2.0):
        streaming.stream(yaw)
        streaming.run(0.3)
        before = len(streaming.events("lost"))
        for silent_s in (0.499, 0.002, 100.0):
            streaming.clock.advance(silent_s)
            streaming.run(0.1)
        assert streaming.events("lost")[before:] == ["no set-point for 0.5 s: holds the last one"]
        assert streaming.yaw() == pytest.approx(yaw, abs=1e-12)


def test_set_points_without_a_stream_reference_are_ignored(loop: Loop) -> None:
    loop.stream(5.0)
    loop.raw(b"junk")
    loop.clock.advance(5.0)
    loop.run(0.3)
    assert (loop.live.setpoints.refused, loop.yaw(), len(loop.changes())) == (0, 0.0, 1)
    assert loop.events("lost") == loop.events("fault") == []


def test_a_stream_is_over_once_something_else_is_tracked_and_moves_no_later_stream(streaming: Loop) -> None:
    streaming.stream(9.0)
    streaming.ask("track", Track(reference=Hold(attitude=(0.0, 0.0, 4.0)), within_s=0.2))  # between the same two ticks
    streaming.tick()
    streaming.stream(-3.0)
    streaming.clock.advance(5.0)
    streaming.run(0.3)
    assert streaming.yaw() == pytest.approx(4.0, abs=1e-12)
    assert streaming.events("lost") == []
    streaming.ask("track", Track(reference=Stream(), within_s=0.2))
    streaming.run(0.5)
    assert streaming.yaw() == pytest.approx(4.0, abs=1e-12)


far = st.tuples(st.just(0.0), st.integers(-65, 65).map(float), st.integers(-180, 180).map(float))


@settings(max_examples=10)
@given(
    sent=st.lists(st.tuples(far, st.integers(1, 400)), min_size=2, max_size=5),
    within_s=st.sampled_from([0.02, 0.2, 1.0]),
)
def test_whatever_streams_however_quickly_the_limits_hold(
    sent: list[tuple[tuple[float, float, float], int]], within_s: float
) -> None:
    """Set-points anywhere, some of them too tilted, up to 0.8 s from each other, most in the middle of the last."""
    loop = Loop(Stream(within_s=within_s), CONFIGURED)
    loop.begin()
    for attitude, ticks in [*sent, ((0.0, 0.0, 0.0), 1500)]:
        loop.raw(Setpoint(attitude=attitude).encode())
        for _ in range(ticks):
            loop.tick()
            # The body is level and at rest, so its rate's error is ω_d. Ways are sampled, which may miss 0.4 % of a
            # rate (../control/test_motion.py), and of a tilt, at such a rate, less than a hundredth of a degree.
            assert hypot(*loop.controller.rate_error) <= 1.0 * 1.004
            _, x, y, _ = loop.controller.desired
            assert degrees(acos(1 - 2 * (x * x + y * y))) <= 60.01
    for change in loop.changes()[1:]:
        assert change.within_s <= 60.0  # and it gets there
    loop.assert_it_runs_again()


def test_the_next_session_waits_where_the_stream_has_left_it_and_goes_on_with_it(streaming: Loop) -> None:
    streaming.stream(3.0)
    streaming.run(0.1)
    streaming.end()
    streaming.begin()
    assert [change.reference for change in streaming.changes()] == [Hold(attitude=(0.0, 0.0, 3.0))]
    streaming.run(0.1)
    assert streaming.yaw() == pytest.approx(3.0, abs=1e-12)
    streaming.stream(1.0)
    streaming.run(0.3)
    assert streaming.yaw() == pytest.approx(1.0, abs=1e-12)
