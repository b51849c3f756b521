"""Operator's changes to a running loop: each takes effect at the published tick, and the log replays."""

from __future__ import annotations

from itertools import accumulate
from math import radians
from typing import Any, Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Change, Gains, Hold, Message, Points, Reference, Sinusoid, Stream, Track
from aeroloop.service.settings import ControllerSettings
from tests.support.operated_loop import LAW, LEVEL, PERIOD, Loop, gains_with, measured, turned

NO_VALID_VALUE: Final = [float("nan")] * 6
LATER_TOO_FAST = Points(
    times=[0.0, 1.0, 2.0, 2.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 2.0, 0.0), (0.0, 2.0, 40.0)]
)
THREE_POINTS = Points(times=[0.0, 1.0, 2.0], attitudes=[(0.0, 0.0, 1.0), (0.0, 5.0, 8.0), (0.0, 0.0, 9.0)])


def yaw_of(angle: float) -> Hold:
    return Hold(attitude=(0.0, 0.0, angle))


# Gains


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


@pytest.mark.parametrize("given", [Gains(), Gains(C1=LAW.C1), gains_with()])
def test_gains_that_change_nothing_are_answered_and_publish_no_event(loop: Loop, given: Gains) -> None:
    assert loop.answered("set_gains", given).done
    assert loop.events("changed") == []
    assert len(loop.changes()) == 1  # the session's start


@pytest.mark.parametrize(
    ("topic", "payload", "why"),
    [
        ("set_gains", b'{"C1": [0.3, 0.3, 300]}', "law.C1[2]: should be less than or equal to 20"),
        ("set_gains", b'{"C9": [1, 1, 1]}', "no gain C9; it has C1, C2, Gamma"),
        ("set_gains", b'{"C1": [0.3, 0.0, 0.3]}', "law.C1[1]: should be greater than 0"),
        ("set_gains", b"gains, please", "Gains"),
        ("track", b'{"reference": {"kind": "dance"}}', "Track"),
        ("track", Track(reference=Hold(attitude=(0.0, 61.0, 0.0))), "max_reference_tilt_deg"),
        ("track", Track(reference=Hold(attitude=(1.0, 0.0, 0.0))), "roll"),
        ("track", Track(reference=yaw_of(90.0), within_s=0.5), "max_reference_rate"),
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


@pytest.mark.parametrize(
    ("topic", "message"), [("set_gains", Gains(C1=(1.0, 1.0, 1.0))), ("track", Track(reference=LEVEL))]
)
def test_without_a_session_there_is_nothing_to_change(loop: Loop, topic: str, message: Message) -> None:
    loop.end()
    before = list(loop.network.put)
    asked = loop.ask(topic, message)
    loop.role.take_inbox()
    assert not asked.answers[0].done
    assert asked.answers[0].text == "nothing to change: controller-7 does not have aero"
    assert loop.network.put == before
    loop.begin()
    assert loop.changes() == [Change(session="s1", tick=0, gains=gains_with(), reference=LEVEL)]


# References


@pytest.mark.parametrize(
    ("reference", "ends_at", "words"),
    [
        (yaw_of(30.0), yaw_of(30.0), "turns to roll 0°, pitch 0°, yaw 30°"),
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


@pytest.mark.parametrize("reference", [yaw_of(30.0), THREE_POINTS, Sinusoid(amplitude=(0.0, 0.0, 30.0))])
def test_without_a_time_a_reference_is_reached_in_the_shortest_that_is_not_refused(reference: Reference) -> None:
    def ask(within_s: float | None) -> tuple[bool, float]:
        loop = Loop(LEVEL)
        loop.begin()
        return loop.answered("track", Track(reference=reference, within_s=within_s)).done, loop.changes()[-1].within_s

    done, shortest = ask(None)
    assert done
    assert ask(shortest * (1 + 1e-9))[0]
    assert not ask(shortest * (1 - 1e-6))[0]


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


# The next session


def test_a_session_that_begins_far_from_its_reference_goes_there_from_where_the_body_is(loop: Loop) -> None:
    loop.ask("track", Track(reference=LEVEL, within_s=0.2))
    loop.run(0.5)
    loop.end()
    loop.begin()
    loop.tick(turned(90.0))
    (first, way) = loop.changes()
    assert (first.tick, way.tick, way.reference) == (0, 0, LEVEL)
    assert way.start == pytest.approx((0.0, 0.0, 90.0), abs=1.0)  # a level of ε is 0.9° wide here
    # From rest to rest a quintic is at most 15/8 of its mean speed.
    assert way.within_s == pytest.approx(radians(90) * 15 / 8 / 1.0, rel=0.1)
    assert loop.yaw() == pytest.approx(90.0, abs=1.0)
    for _ in range(round(way.within_s / PERIOD) + 2):
        loop.tick(turned(90.0))
    assert loop.yaw() == pytest.approx(0.0, abs=1e-9)
    assert len(loop.changes()) == 2


# The log

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
