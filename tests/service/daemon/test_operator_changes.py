"""Operator's changes to a running loop, a stream of set-points, a session's start: each from its published tick."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from math import acos, cos, degrees, hypot, radians, sin
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import Grant, SessionRecord
from aeroloop.protocol.messages.operator import (
    MAX_POINTS,
    Change,
    Gains,
    Hold,
    Message,
    Points,
    Reference,
    Request,
    Setpoint,
    Sinusoid,
    Stream,
    Track,
)
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.wire.attitude import IDENTITY, distance
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.reference import Limits, Trajectory
from aeroloop.service.daemon.operator_changes import rest_of_reference
from aeroloop.service.settings import ControllerSettings
from tests.support.numpy_twin import attitude_of
from tests.support.operated_loop import (
    AT_REST,
    CONFIGURED,
    LEVEL,
    PERIOD,
    SWING,
    WIRE,
    Loop,
    gains_with,
    measured,
    turned,
)
from tests.support.plant_end import GAINS, claim_of, claimed, record_of

NO_VALID_VALUE: Final = [float("nan")] * 6
LATER_TOO_FAST = Points(
    times=[0.0, 1.0, 2.0, 2.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 2.0, 0.0), (0.0, 2.0, 40.0)]
)
THREE_POINTS = Points(times=[0.0, 1.0, 2.0], attitudes=[(0.0, 0.0, 1.0), (0.0, 5.0, 8.0), (0.0, 0.0, 9.0)])


def yaw_of(angle: float) -> Hold:
    return Hold(attitude=(0.0, 0.0, angle))


@pytest.fixture
def loop() -> Iterable[Loop]:
    """A session at tick 0, level; whatever a test does to it, its log must run again."""
    loop = Loop(LEVEL)
    loop.begin()
    yield loop
    loop.assert_it_runs_again()


def test_gains_hold_from_the_very_tick_that_is_published(loop: Loop) -> None:
    given = Gains(C1=(1.0, 1.0, 1.0), Gamma=(0.5, 0.5, 0.5))
    tilted = [0.0, 0.1, 0.0, 0.0, 0.3, -0.2]
    alone, unchanged = loop.fresh(), loop.fresh()
    for k in range(7):
        assert loop.tick(tilted) == alone.tick(measured(k, tilted), k) == unchanged.tick(measured(k, tilted), k)
    asked = loop.ask("set_gains", given)
    assert not asked.answers  # not before the loop comes by
    alone.set_gains(given)
    assert loop.tick(tilted) == alone.tick(measured(7, tilted), 7) != unchanged.tick(measured(7, tilted), 7)
    assert asked.answers[0].done
    assert "C1 = [1.0, 1.0, 1.0]" in asked.answers[0].text
    start, change = loop.changes()
    assert (start.tick, start.gains) == (0, gains_with())
    assert change == Change(session="s0", tick=7, gains=given)
    assert loop.controller.gains == gains_with(C1=(1.0, 1.0, 1.0), Gamma=(0.5, 0.5, 0.5))


@pytest.mark.parametrize(
    ("topic", "payload", "why"),
    [
        ("set_gains", b'{"C1": [0.3, 0.3, 300]}', "law.C1[2]: should be less than or equal to 20"),
        ("set_gains", b'{"C2": [0.2]}', "law.C2 is 3 numbers, such as 0.15 0.15 0.15, not 0.2"),
        ("set_gains", b'{"C9": [1, 1, 1]}', "no gain C9; it has C1, C2, Gamma"),
        ("set_gains", b"gains, please", "Gains"),
        ("track", Track(reference=Hold(attitude=(0.0, 61.0, 0.0))), "max_reference_tilt_deg"),
        ("track", Track(reference=Hold(attitude=(1.0, 0.0, 0.0))), "roll"),
        ("track", Track(reference=LATER_TOO_FAST), "max_reference_rate"),
    ],
)
def test_what_is_refused_is_answered_with_the_reason_and_changes_nothing(
    loop: Loop, topic: str, payload: Message | bytes, why: str
) -> None:
    alone = loop.fresh()
    asked = loop.ask(topic, payload)
    for k in range(10):
        assert loop.tick() == alone.tick(measured(k), k)
    (answer,) = asked.answers
    assert not answer.done
    assert why in answer.text
    assert len(answer.text.splitlines()) == 1
    assert len(loop.changes()) == 1  # what the session began with
    assert loop.events("changed") == []


def test_without_a_session_there_is_nothing_to_change(loop: Loop) -> None:
    loop.end()
    assert loop.live.record.session is None
    before = list(loop.network.put)
    asked = loop.ask("track", Track(reference=yaw_of(30.0)))
    loop.role.take_inbox()
    assert not asked.answers[0].done
    assert asked.answers[0].text == "nothing to change: controller-7 does not have aero"
    assert loop.network.put == before
    loop.begin()
    assert loop.changes() == [Change(session="s1", tick=0, gains=gains_with(), reference=LEVEL)]


@pytest.mark.parametrize(
    ("reference", "ends_at", "words"),
    [
        (yaw_of(30.0), yaw_of(30.0), "follows roll, pitch, yaw 0°, 0°, 30°"),
        (THREE_POINTS, yaw_of(9.0), "follows 3 points over 2 s"),
    ],
)
def test_a_reference_holds_from_the_tick_that_is_published_and_arrives(
    loop: Loop, reference: Reference, ends_at: Hold, words: str
) -> None:
    loop.run(0.1)
    answer = loop.answered("track", Track(reference=reference, within_s=1.5))
    here = ((0.0, 0.0, 0.0),) * 3
    assert loop.changes()[1:] == [Change(session="s0", tick=50, reference=reference, within_s=1.5, here=here)]
    assert answer.done
    assert words in answer.text
    assert [words in text for text in loop.events("changed")] == [True]
    loop.run(1.5 + 2.0)
    there = loop.fresh(ends_at)
    there.tick(measured(0), 0)
    assert loop.controller.desired == there.desired


@pytest.mark.parametrize("reference", [Hold(attitude=None), Stream()])
def test_coming_to_rest_is_published_as_the_attitude_at_which_it_does(loop: Loop, reference: Reference) -> None:
    loop.ask("track", Track(reference=Sinusoid(amplitude=(0.0, 0.0, 20.0), frequency=(0.0, 0.0, 0.4)), within_s=0.5))
    loop.run(1.0)
    before = loop.yaw()
    assert loop.answered("track", Track(reference=reference, within_s=0.02)).done  # brakes at once, whatever is given
    loop.run(1.1)
    rest = loop.changes()[-1].reference
    assert isinstance(rest, Hold)
    assert rest.attitude is not None
    assert before + 0.4 < rest.attitude[2] < before + 1.0  # 0.75 v² / 1 rad/s² of 6.5 to 8°/s, and a little
    assert loop.yaw() == pytest.approx(rest.attitude[2], abs=1e-12)
    loop.end()
    loop.begin()
    assert loop.changes()[0].reference == rest  # and there the next session begins, not at 0


@pytest.fixture
def streaming(loop: Loop) -> Loop:
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
    assert streaming.live.refused == 1
    assert [len(text.splitlines()) for text in streaming.events("fault")] == [1]
    assert len(streaming.changes()) == len(before) + 1  # the good one that came before it
    assert streaming.yaw() == pytest.approx(3.0, abs=1e-12)


def test_of_a_burst_of_set_points_one_is_checked_without_sampling_its_way(
    streaming: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is near is known to keep the limits by the control points of its quintic; what is far, by samples."""
    checked, sampled = list[Trajectory](), list[Trajectory]()
    _counted(monkeypatch, "check", checked)
    _counted(monkeypatch, "samples", sampled)
    for n in range(100):
        streaming.stream(yaw=0.01 * n)
    streaming.tick()
    assert [tuple(trajectory.first.angle[0]) for trajectory in checked] == [(0.0, 0.0, pytest.approx(radians(0.99)))]
    assert sampled == []
    streaming.stream(yaw=50.0)
    streaming.tick()
    assert len(checked) == 2
    assert sampled


def _counted(monkeypatch: pytest.MonkeyPatch, name: str, calls: list[Trajectory]) -> None:
    method = getattr(Trajectory, name)

    def counted(trajectory: Trajectory, *arguments: Any) -> Any:
        calls.append(trajectory)
        return method(trajectory, *arguments)

    monkeypatch.setattr(Trajectory, name, counted)


LONG = Points(times=[n / 10 for n in range(MAX_POINTS)], attitudes=[(0.0, n % 3, n % 2) for n in range(MAX_POINTS)])


def test_ten_thousand_points_are_checked_before_the_loop_takes_them(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In their topic's thread, which is the one that calls the queryable: the loop evaluates two pieces at the most."""
    checked, evaluated = list[Trajectory](), list[Trajectory]()
    _counted(monkeypatch, "check", checked)
    asked = loop.ask("track", Track(reference=LONG))
    assert [len(trajectory.starts) for trajectory in checked] == [MAX_POINTS]
    _counted(monkeypatch, "at", evaluated)
    _counted(monkeypatch, "samples", evaluated)
    loop.tick()
    assert asked.answers[0].done
    assert len(checked) == 1
    assert max(len(trajectory.starts) for trajectory in evaluated) <= 2


def test_a_record_is_shown_at_once_and_encoded_once_however_often_it_is_asked_for(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the thread of its topic, while the loop does something else."""
    encoded = list[SessionRecord]()
    encode, loops_thread = SessionRecord.encode, threading.get_ident()

    def counted(record: SessionRecord) -> bytes:
        assert threading.get_ident() != loops_thread
        encoded.append(record)
        return encode(record)

    monkeypatch.setattr(SessionRecord, "encode", counted)

    def shown() -> SessionRecord:
        with ThreadPoolExecutor(1) as topic:
            (payload,) = topic.submit(loop.ask, "show", Request()).result().replies
        return SessionRecord.model_validate_json(payload)

    first = loop.live.record
    assert [shown() for _ in range(50)] == [first] * 50
    assert encoded == [first]
    assert loop.answered("track", Track(reference=yaw_of(3.0))).done
    assert shown().reference == yaw_of(3.0)
    assert shown().reference == yaw_of(3.0)
    assert encoded == [first, loop.live.record]


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


angle = st.integers(-20, 20).map(float)
attitudes = st.tuples(st.just(0.0), angle, angle)
gain = st.tuples(*[st.integers(1, 2000).map(lambda n: n / 1000)] * 3)
gains = st.builds(Gains, C1=gain | st.none(), C2=gain | st.none(), Gamma=gain | st.none())
within = st.integers(100, 3000).map(lambda n: n / 1000)
tenths = st.integers(0, 10).map(lambda n: n / 10)
swings = st.builds(Sinusoid, amplitude=attitudes, frequency=st.tuples(st.just(0.0), tenths, tenths))
points = st.lists(st.tuples(st.integers(200, 2000), attitudes), min_size=2, max_size=4).map(
    lambda rows: Points(
        times=[ms / 1000 for ms in accumulate((gap for gap, _ in rows[1:]), initial=0)],
        attitudes=[attitude for _, attitude in rows],
    )
)
holds = st.builds(Hold, attitude=attitudes | st.none())
anything = st.one_of(holds, swings, points, st.builds(Stream, within_s=st.just(0.2)))
codes = st.lists(st.integers(-100, 100).map(lambda n: n / 250), min_size=6, max_size=6)
ticks = st.tuples(st.just("ticks"), st.lists(codes, min_size=1, max_size=60))
steps: st.SearchStrategy[tuple[str, Any]] = st.one_of(
    ticks,
    ticks,
    st.tuples(st.just("set_gains"), gains),
    st.tuples(st.just("track"), st.builds(Track, reference=anything, within_s=within | st.none())),
    st.tuples(st.just("set-points"), st.lists(attitudes, min_size=1, max_size=3)),
    st.tuples(st.just("time"), st.sampled_from([0.1, 1.0])),
    st.tuples(st.sampled_from(["no valid value", "malformed", "gap", "next session"]), st.none()),
)


@settings(max_examples=40)
@given(
    configured=st.one_of(st.just(Sinusoid()), st.just(LEVEL), st.just(Stream())),
    after_restart=st.sampled_from(["hold", "resume", "configured"]),
    history=st.lists(steps, min_size=4, max_size=25),
)
def test_from_the_logged_changes_a_fresh_controller_gives_the_same_commands_byte_for_byte(
    configured: Reference, after_restart: str, history: list[tuple[str, Any]]
) -> None:
    given = {"max_reference_rate": 50.0, "after_restart": after_restart}
    loop = Loop(configured, ControllerSettings.model_validate(given))
    loop.begin()
    for what, value in [*history, ("ticks", [[0.1, 0.0, 0.2, 0.0, 0.1, 0.3]] * 30)]:
        match what:
            case "ticks":
                for row in value:
                    loop.tick(row)
            case "set_gains" | "track":
                loop.ask(what, value)
            case "set-points":
                for _, pitch, yaw in value:
                    loop.stream(yaw, pitch)
            case "time":
                loop.clock.advance(value)
            case "no valid value":
                loop.tick(NO_VALID_VALUE)
            case "malformed":
                loop.malformed()
            case "gap":
                loop.k += 40
            case "next session":
                loop.end()
                loop.begin()
    loop.assert_it_runs_again()


# ── what a session begins with: nothing jumps, and nothing moves that was not asked for ──


TARGET = Hold(attitude=(0.0, 0.0, 60.0))


def of(after_restart: str, reference: Reference = SWING) -> Loop:
    return Loop(reference, ControllerSettings.model_validate({"after_restart": after_restart}))


def record(reference: Reference, *, ended: TripCause = TripCause.HOLDER_GONE) -> SessionRecord:
    return record_of("controller-6", reference=reference, ended=ended, ended_tick=5000)


def asked(loop: Loop, reference: Reference = TARGET) -> None:
    loop.ask("set_gains", GAINS)
    loop.ask("track", Track(reference=reference, within_s=3.0))
    loop.run(4.0)


def start(loop: Loop, yaw: float, last: SessionRecord | None = None) -> float:
    """Begin a session with the body at a yaw [deg]; that of the reference at the first tick."""
    loop.begin(last)
    loop.tick(turned(yaw))
    return loop.yaw()


def reached(loop: Loop, yaw: float) -> float:
    """The reference's yaw after seven seconds with the body at a yaw [deg]."""
    for _ in range(3500):
        loop.tick(turned(yaw))
    return loop.yaw()


@settings(max_examples=10)
@given(yaw=st.floats(-179, 179))
def test_held_is_the_attitude_found_and_it_stays_there_until_an_operator_moves_it(yaw: float) -> None:
    """From the first valid measurement on; the configured reference is followed when an operator asks for it."""
    loop = of("hold", Hold(attitude=(0.0, 0.0, 15.0)))
    loop.begin()
    loop.tick([WIRE.attitude.quantizer().invalid] * 6)
    for _ in range(50):
        loop.tick(turned(yaw))
        assert loop.yaw() == pytest.approx(yaw, abs=0.01)
        assert max(map(abs, loop.controller.rate_error)) == 0.0
    assert (loop.live.record.reference_from, loop.live.record.gains_from) == ("held", "configured")
    assert [(change.tick, change.start is not None) for change in loop.changes()] == [(0, False), (1, True)]
    assert loop.answered("track", Track(reference=None)).done
    assert reached(loop, yaw) == pytest.approx(15.0)
    assert loop.live.record.reference_from == "configured"
    loop.assert_it_runs_again()


CONFIGURED_GAINS = gains_with()
TOO_TILTED = Hold(attitude=(0.0, 70.0, 0.0))


@pytest.mark.parametrize(
    ("ran", "last", "found", "goes_to", "source", "gains"),
    [
        (False, None, 30.0, 30.0, "held", CONFIGURED_GAINS),
        (False, record(TARGET), 30.0, 60.0, "resumed", GAINS),
        (False, record(LEVEL), 15.0, 0.0, "resumed", GAINS),  # however near it is
        (False, record(LEVEL), 90.0, 0.0, "resumed", GAINS),
        (False, record(TARGET, ended=TripCause.OPERATOR), 30.0, 30.0, "held", GAINS),
        (True, None, 0.0, 60.0, "resumed", GAINS),  # the plant was restarted: its own session counts
        (True, record(Hold()), 30.0, 30.0, "held", GAINS),  # and is not what the plant has as the last one
        (True, record(TOO_TILTED), 30.0, 30.0, "held", GAINS),
    ],
)
def test_a_session_is_resumed_from_where_the_body_is_or_else_the_attitude_found_is_held(
    ran: bool, last: SessionRecord | None, found: float, goes_to: float, source: str, gains: Gains
) -> None:
    loop = of("resume")
    if ran:
        start(loop, 0.0)
        asked(loop)
        loop.end()
    assert start(loop, found, last) == pytest.approx(found, abs=1.0)  # a level of ε is 0.9° wide
    way = loop.changes()[-1]
    assert way.start is not None
    assert source == "held" or way.within_s >= 2.0  # no faster than the operator asked for
    assert reached(loop, found) == pytest.approx(goes_to, abs=1.0 if source == "held" else 1e-6)
    assert (loop.controller.gains, loop.live.record.reference_from) == (gains, source)
    assert len(loop.events("fault")) == (last is not None and last.reference == TOO_TILTED)
    loop.assert_it_runs_again()


def test_a_stream_is_resumed_at_rest_where_the_body_is_and_no_earlier_set_point_moves_it() -> None:
    loop = of("resume")
    loop.stream(yaw=-50.0)
    assert start(loop, 30.0, record(Stream(within_s=0.5))) == pytest.approx(30.0, abs=1.0)
    assert reached(loop, 30.0) == pytest.approx(30.0, abs=1.0)
    loop.stream(yaw=33.0)
    assert reached(loop, 30.0) == pytest.approx(33.0)
    assert (loop.live.record.reference, loop.live.record.reference_from) == (Stream(within_s=0.5), "resumed")


@given(
    gaps=st.lists(st.integers(1, 3000), min_size=1, max_size=8),
    since=st.integers(0, 2000),
    followed=st.integers(0, 30_000),
    within=st.integers(0, 10),
)
def test_points_go_on_with_the_first_that_was_not_reached(
    gaps: list[int], since: int, followed: int, within: int
) -> None:
    times = [t / 1000 for t in accumulate(gaps, initial=0)]
    attitudes = [(0.0, 0.0, float(i)) for i in range(len(times))]
    points = Points(times=times, attitudes=attitudes, interpolation="differences")
    ended = {"since_tick": since, "ended_tick": since + followed, "within_s": float(within)}
    left = rest_of_reference(record(points).model_copy(update=ended), PERIOD)
    ahead = [i for i, t in enumerate(times) if t >= followed * PERIOD - within]
    if len(ahead) < 2:
        assert left == Hold(attitude=points.attitudes[-1])
    else:
        assert isinstance(left, Points)
        assert left.attitudes == points.attitudes[ahead[0] :]
        assert left.interpolation == points.interpolation
        assert left.times == pytest.approx([times[i] - times[ahead[0]] for i in ahead])


def test_a_body_found_beyond_the_limit_of_tilt_is_brought_back_whatever_the_tilt_on_the_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An operator's reference may tilt by 60°. From a roll of 170° and a pitch of 80° the way back tilts even more."""
    monkeypatch.setattr(Limits, "of", lambda *_: Limits(rate=1.0, tilt=radians(60.0), rolls=True))
    loop = of("configured", LEVEL)
    loop.begin()
    roll, pitch = radians(170.0) / 2, radians(80.0) / 2
    found = [sin(roll) * cos(pitch), cos(roll) * sin(pitch), -sin(roll) * sin(pitch)]
    for _ in range(5_000):
        loop.tick([*found, 0.0, 0.0, 0.0])
    (text,) = loop.events("changed")
    assert "away from its reference: approaches" in text
    assert distance(loop.controller.desired, IDENTITY) < 1e-6
    loop.assert_it_runs_again()


@pytest.mark.parametrize(
    ("stopped", "ended", "source"), [(False, "released", "resumed"), (True, TripCause.OPERATOR, "held")]
)
def test_a_session_that_was_released_is_resumed_unless_an_operator_stopped_the_plant_since(
    stopped: bool, ended: str, source: str
) -> None:
    """By the plant's own record; the next claim is granted after an `op arm`."""
    endpoint, _ = claimed()
    assert endpoint.keep(record_of("a", reference=TARGET))
    endpoint.release("of-a")
    if stopped:
        endpoint.stop()
        endpoint.arm()
    grant = endpoint.claim(claim_of("b"))
    assert isinstance(grant, Grant)
    assert grant.last is not None
    assert grant.last.ended == ended
    loop = of("resume")
    loop.begin(grant.last)
    assert loop.live.record.reference_from == source


def test_configured_follows_the_configuration_at_first_and_then_what_the_last_session_followed() -> None:
    loop = of("configured")
    start(loop, 0.0, record(TARGET))
    assert (loop.live.record.reference, loop.live.record.reference_from) == (SWING, "configured")
    asked(loop)
    loop.end()
    start(loop, 0.0, record(LEVEL))
    assert (loop.live.record.reference, loop.live.record.reference_from) == (TARGET, "operator")
    assert loop.controller.gains == GAINS
    loop.assert_it_runs_again()


def test_a_body_found_beyond_its_limit_of_tilt_is_approached_all_the_same() -> None:
    """Rolled by 120° and pitched by 85°, which is 92.5°, it passes 94° on its way to level."""
    # Three actuators turn it about every axis.
    wire = WireSpec(attitude=WIRE.attitude, rate=WIRE.rate, voltage=WIRE.voltage, actuators=3)
    loop = Loop(LEVEL, ControllerSettings(after_restart="resume"), wire=wire)
    loop.begin(record(LEVEL))
    attitude = WIRE.attitude.quantizer()
    found = [attitude.encode(x) for x in attitude_of(np.radians([120.0, 85.0, 0.0]))[1:]]
    for _ in range(3):
        loop.tick([*found, *AT_REST[3:]])
    change = loop.changes()[-1]
    assert change.start == pytest.approx((120.0, 85.0, 0.0), abs=1e-3)
    assert change.reference == LEVEL
