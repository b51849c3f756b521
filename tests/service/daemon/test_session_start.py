"""What a session begins with: nothing jumps, and nothing moves that was not asked for."""

from __future__ import annotations

from itertools import accumulate

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Gains, Hold, Points, Reference, Stream, Track
from aeroloop.protocol.messages.states import TripCause
from aeroloop.service.daemon.operator_changes import rest_of_reference
from aeroloop.service.settings import ControllerSettings
from tests.support.operated_loop import LEVEL, PERIOD, SWING, WIRE, Loop, gains_with, turned

GAINS = Gains(C1=(0.5, 0.5, 0.5), C2=(0.4, 0.4, 0.4), Gamma=(0.1, 0.1, 0.1))
TARGET = Hold(attitude=(0.0, 0.0, 60.0))


def of(after_restart: str, reference: Reference = SWING) -> Loop:
    return Loop(reference, ControllerSettings.model_validate({"after_restart": after_restart}))


def record(reference: Reference, *, ended: TripCause = TripCause.HOLDER_GONE) -> SessionRecord:
    return SessionRecord(
        controller="controller-6", session="s", gains=GAINS, gains_from="operator", reference=reference,
        reference_from="operator", within_s=2.0, since_tick=0, ended=ended, ended_tick=5000,
    )  # fmt: skip


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


CONFIGURED = gains_with()
TOO_TILTED = Hold(attitude=(0.0, 70.0, 0.0))


@pytest.mark.parametrize(
    ("ran", "last", "found", "goes_to", "source", "gains"),
    [
        (False, None, 30.0, 30.0, "held", CONFIGURED),
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
    points = Points(times=times, attitudes=[(0.0, 0.0, float(i)) for i in range(len(times))])
    ended = {"since_tick": since, "ended_tick": since + followed, "within_s": float(within)}
    left = rest_of_reference(record(points).model_copy(update=ended), PERIOD)
    ahead = [i for i, t in enumerate(times) if t >= followed * PERIOD - within]
    if len(ahead) < 2:
        assert left == Hold(attitude=points.attitudes[-1])
    else:
        assert isinstance(left, Points)
        assert left.attitudes == points.attitudes[ahead[0] :]
        assert left.times == pytest.approx([times[i] - times[ahead[0]] for i in ahead])


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
