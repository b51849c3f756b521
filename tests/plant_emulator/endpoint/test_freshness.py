"""Freshness of commands and the watchdog, by counters alone, against a model that has the tick of every measurement.

The model holds for both that judge commands: the plant's endpoint and the bridge of a CAN bus.

A short counter of 16 ticks and a watchdog of 5, so that counters wrap often.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.wire.spec import WireSpec
from tests.plant_emulator.endpoint.test_endpoint import OFF, RecordingPlant

PERIOD_NS = 2_000_000
COUNTERS, WATCHDOG = 16, 5
WIRE = WireSpec(counter_bits=4)
CLAIM = Claim(controller="c", session="s", period_ns=PERIOD_NS, lockstep=False, wire=WIRE)


def claimed(watchdog: int = WATCHDOG) -> Endpoint:
    """An endpoint that sends its first measurement at tick 0."""
    endpoint = Endpoint(RecordingPlant(), WIRE, PERIOD_NS, watchdog_s=watchdog * PERIOD_NS * 1e-9, armed=True)
    assert isinstance(endpoint.claim(CLAIM), Grant)
    return endpoint


class BridgeEnd(Relay):
    """A bridge to which a plant's measurements and a controller's commands come as to an endpoint, tick by tick."""

    def __init__(self) -> None:
        super().__init__(WIRE, PERIOD_NS, lockstep=False, watchdog_s=WATCHDOG * PERIOD_NS * 1e-9, armed=True)
        assert isinstance(self.claim(CLAIM), Grant)

    def tick(self, frame: bytes | None, k: int) -> None:
        """The command received since tick k − 1, then measurement k; a nanosecond after a deadline it is over."""
        if self.session is None:
            self.outcome = Outcome.NONE
            return
        now_ns = (k - 1) * PERIOD_NS
        if frame is not None:
            self.command(frame, now_ns)
        if k == 0 or not self.watch(now_ns + 1):
            self.measurement(WIRE.measurement.pack(k % COUNTERS, [0] * 6))
        if k == 0:
            self.watch(0)


def command(answers: int) -> bytes:
    """A command that answers the measurement of a tick; its voltage says which."""
    return WIRE.command.pack(answers % COUNTERS, (answers % 31 + 1, 0))


class Model:
    """What is to become of commands, by the ticks that they answer."""

    def __init__(self) -> None:
        self.answered = -1
        self.fresh_at = 0
        self.driven = self.tripped = False

    def judge(self, answers: int | None, now: int) -> Outcome:
        """Of a command that comes after the measurement of tick `now`."""
        if answers is None or self.tripped:
            return Outcome.NONE
        if answers <= self.answered:
            return Outcome.REPEATED
        if now - answers > WATCHDOG:
            return Outcome.STALE
        self.answered, self.fresh_at, self.driven = answers, now, True
        return Outcome.ACTED

    def watch(self, now: int) -> None:
        """The watchdog, over the period that begins at tick `now`."""
        self.tripped |= now - self.fresh_at >= (WATCHDOG if self.driven else COUNTERS - 1)


late = st.one_of(st.integers(0, WATCHDOG + 2), st.integers(0, COUNTERS - 1), st.none())
"""By how many ticks a command is late; None: it is lost. A whole round of the counter cannot be detected."""


@pytest.mark.parametrize("end", [claimed, BridgeEnd])
@settings(max_examples=120)
@example(delays=[WATCHDOG + 1, *[None] * COUNTERS])  # stale
@example(delays=[2, 0, *[None] * COUNTERS])  # overtaken, then none
@example(delays=[0, WATCHDOG, *[0] * COUNTERS])  # just in time
@given(delays=st.lists(late, min_size=1, max_size=120))
def test_commands_are_judged_as_by_the_ticks_that_they_answer(
    end: Callable[[], Endpoint | BridgeEnd], delays: list[int | None]
) -> None:
    endpoint, model = end(), Model()
    endpoint.tick(None, 0)
    stale = 0
    for now in range(len(delays)):
        due = [k for k in range(now + 1) if delays[k] is not None and k + (delays[k] or 0) == now]
        answers = due[-1] if due else None  # the newest that came is taken
        expected = model.judge(answers, now)
        model.watch(now)
        endpoint.tick(None if answers is None else command(answers), now + 1)
        assert endpoint.outcome is expected
        stale += expected is Outcome.STALE
        assert endpoint.stale == stale
        assert (endpoint.session is None) == model.tripped
        assert endpoint.answered == (-1 if model.tripped else model.answered)
        in_force = (WIRE.voltage.quantizer().level(model.answered % 31 + 1), 0.0)
        assert endpoint.voltages == (OFF if model.tripped or model.answered < 0 else in_force)


@settings(max_examples=50)
@given(delay=st.integers(0, 5 * COUNTERS))
def test_a_stream_that_is_late_for_good_drives_within_the_watchdogs_time_and_never_beyond(delay: int) -> None:
    """Also where its echoes look fresh, because the counter has come round: by then the session is over."""
    endpoint = claimed()
    endpoint.tick(None, 0)
    for now in range(delay + 3 * COUNTERS):
        endpoint.tick(command(now - delay) if now >= delay else None, now + 1)
    assert (endpoint.accepted > 0) == (delay <= WATCHDOG)
    assert (endpoint.trip is TripCause.COMMAND_TIMEOUT) == (delay > WATCHDOG)


def test_a_counter_that_is_short_by_configuration_detects_no_such_stream() -> None:
    endpoint = claimed(watchdog=50)
    endpoint.tick(None, 0)
    for now in range(COUNTERS + 10):
        endpoint.tick(command(now - COUNTERS) if now >= COUNTERS else None, now + 1)
    assert endpoint.accepted > 0
