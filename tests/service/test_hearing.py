"""What a controller hears of a plant that sends only what is new: on a simulated link, which is also the clock.

A tick's frame arrives `DELAY_NS` after the tick, unless a test says otherwise; every tick must be heard once, in order,
whether it has a frame or not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pytest

from protocol.clock import LoopSettings
from protocol.frames import DEFAULT_COUNTER_BITS
from protocol.links import Arrival
from protocol.transmit import SILENCE, Sender
from protocol.wire import WireSpec
from service import hearing
from service.hearing import Heard, Hearing
from tests.service.logs.silent_loop import LOOP, PERIOD_NS, START_NS, Wire, wire_of

COUNTERS = 1 << DEFAULT_COUNTER_BITS

WIRE = wire_of("on_change", "on_change")
DELAY_NS = 200_000
HALF_NS = PERIOD_NS // 2


def frame(k: int, code: int = 0, wire: WireSpec = WIRE) -> bytes:
    return wire.measurement.pack(k % COUNTERS, (0, 0, 0, 0, 0, code))


def arrival(k: int, code: int = 0, *, late_ns: int = 0, content: bytes | None = None) -> Arrival:
    """The frame of tick k; published on time, however late it arrives."""
    arrives_ns = k * PERIOD_NS + DELAY_NS + late_ns
    return Arrival(frame(k, code) if content is None else content, arrives_ns, START_NS + k * PERIOD_NS)


class Ear:
    """A hearing at one end of a simulated link, and what it has heard."""

    def __init__(
        self,
        arrivals: Iterable[Arrival],
        monkeypatch: pytest.MonkeyPatch,
        *,
        wire: WireSpec = WIRE,
        loop: LoopSettings = LOOP,
        own_grid: bool = False,
    ) -> None:
        self.link = Wire(sorted(arrivals, key=lambda each: each.at_ns), hearing.MAILBOX)
        monkeypatch.setattr(hearing, "time", self.link)
        if own_grid:
            monkeypatch.setattr("protocol.clock.time", self.link)
        self.hearing = Hearing(self.link, loop, wire, own_grid=own_grid)
        self.heard: list[tuple[Heard, int]] = []  # and when

    def listen(self, until_ns: int) -> list[Heard]:
        """What is heard until a time, of which an answer takes no time."""
        while self.link.now_ns < until_ns:
            heard = self.hearing.next(0.02)
            if heard is not None:
                self.heard.append((heard, self.link.now_ns))
        return [heard for heard, _ in self.heard]

    @property
    def ticks(self) -> list[int]:
        """Ticks that were computed."""
        return [heard.tick for heard, _ in self.heard if not heard.late]

    def when(self, tick: int) -> int:
        """When a tick was heard."""
        return next(at_ns for heard, at_ns in self.heard if heard.tick == tick and not heard.late)


def until(k: int) -> int:
    """When tick k is over, frame or not."""
    return k * PERIOD_NS + DELAY_NS + HALF_NS


def heartbeats(last: int, codes: Mapping[int, int] | None = None) -> list[Arrival]:
    """Arrivals of a plant whose code becomes what `codes` say at their ticks."""
    sender, code, sent = Sender("on_change", 15, COUNTERS), 0, []
    for k in range(last + 1):
        code = (codes or {}).get(k, code)
        if sender.due(k, (code,)):
            sent.append(arrival(k, code))
    return sent


def test_a_frame_is_heard_as_it_arrives_and_silence_half_a_period_later(monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear(heartbeats(40, {7: 1}), monkeypatch)
    heard = ear.listen(until(40))
    assert ear.ticks == list(range(41))
    sent = {k: at_ns for at_ns, k in ((k * PERIOD_NS + DELAY_NS, k) for k in (0, 7, 22, 37))}
    for k in range(41):
        assert ear.when(k) == sent.get(k, until(k))
    assert {each.tick: each.frame for each in heard if each.frame} == {
        0: frame(0), 7: frame(7, 1), 22: frame(22, 1), 37: frame(37, 1)
    }  # fmt: skip
    assert all(each.missed == 0 for each in heard)
    assert all((each.published_ns is None) == (each.frame == SILENCE) for each in heard)
    assert all(each.due_ns == ear.when(each.tick) for each in heard)


def test_nothing_is_heard_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear([arrival(30)], monkeypatch)
    ear.listen(until(32))
    assert ear.heard[0][0].frame == frame(30)
    assert ear.ticks == [30 % COUNTERS + i for i in range(3)]  # a session's first frame has a counter below 16


def test_a_late_frame_is_no_second_tick_and_brings_its_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    late = arrival(5, 9, late_ns=HALF_NS + 1)
    ear = Ear([arrival(0), late], monkeypatch)
    heard = ear.listen(until(8))
    assert ear.ticks == list(range(9))
    assert [(each.tick, each.frame) for each in heard if each.late] == [(5, frame(5, 9))]
    assert ear.when(5) == until(5)


def test_of_frames_that_wait_together_the_newest_is_computed_and_the_others_are_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ear = Ear([arrival(0), *(arrival(k, k) for k in range(5, 9))], monkeypatch)
    ear.listen(until(4))
    ear.link.pass_time(until(8) - HALF_NS)  # the controller was kept waiting for three ticks
    heard = ear.listen(until(10))[5:]
    assert [(each.tick, each.late) for each in heard[:4]] == [(5, True), (6, True), (7, True), (8, False)]
    assert heard[3].missed == 3
    assert ear.ticks == [0, 1, 2, 3, 4, 8, 9, 10]


def test_a_frame_whose_tick_is_long_over_is_not_answered_but_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """A controller that wakes from a stall goes on with the present."""
    ear = Ear([arrival(0), arrival(5, 9)], monkeypatch)
    ear.listen(until(4))
    ear.link.pass_time(until(9) + 1)
    heard = ear.listen(until(10))[5:]
    assert [(each.tick, each.frame, each.late, each.missed) for each in heard] == [
        (5, frame(5, 9), True, 0),
        (9, SILENCE, False, 4),
        (10, SILENCE, False, 0),
    ]


def test_the_levels_of_a_frame_are_used_for_no_tick_before_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its counter, which is all that tells, one may be of a tick that is still to come."""
    early = arrival(8, 9)._replace(at_ns=arrival(5).at_ns, published_ns=arrival(5).published_ns)
    nonsense = arrival(5, content=b"\0")  # waits behind it, so that it is taken in passing
    ear = Ear([arrival(0), early, nonsense], monkeypatch)
    ear.listen(until(9))
    assert [tick for tick in ear.ticks if tick > 4][:2] == [8, 9]


def test_a_stall_of_the_controller_in_silence_is_told_as_ticks_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear([arrival(0)], monkeypatch)
    ear.listen(until(4))
    ear.link.pass_time(until(9) + 1)
    heard = ear.listen(until(11))
    assert ear.ticks == [0, 1, 2, 3, 4, 9, 10, 11]
    assert [each.missed for each in heard] == [0, 0, 0, 0, 0, 4, 0, 0]


@pytest.mark.parametrize("drift", [-1e-4, -3e-5, 3e-5, 1e-4])
@pytest.mark.parametrize("jitter_ns", [0, 150_000])
def test_clocks_that_drift_apart_neither_miss_nor_double_a_tick(
    drift: float, jitter_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plant's period is longer or shorter by the controller's clock; after 10 000 ticks they are a tick apart."""
    last = 12_000
    sent = []
    for each in heartbeats(last, {k: k % 7 for k in range(0, last, 11)}):
        k = (each.published_ns - START_NS) // PERIOD_NS
        at_ns = round(k * PERIOD_NS * (1 + drift)) + DELAY_NS + (k * 7919 % 97) * jitter_ns // 97
        sent.append(each._replace(at_ns=at_ns))
    ear = Ear(sent, monkeypatch)
    heard = ear.listen(round(last * PERIOD_NS * (1 + drift)))
    assert ear.ticks == list(range(len(ear.ticks)))
    assert len(ear.ticks) >= last - 1
    assert not any(each.late or each.missed for each in heard)


@pytest.mark.parametrize("nonsense", [SILENCE, b"\0", frame(5) + b"\0"], ids=["empty", "short", "long"])
def test_nonsense_is_no_tick_and_no_sign_of_life(nonsense: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear([arrival(0), *(arrival(k, content=nonsense) for k in range(1, 9))], monkeypatch)
    heard = ear.listen(until(8))
    assert ear.ticks == list(range(9))
    assert [ear.when(k) for k in range(1, 9)] == [until(k) for k in range(1, 9)]
    assert all(each.published_ns is None for each in heard[1:])
    assert [each.frame for each in heard if each.late] == [nonsense] * 8


def test_a_frame_that_nonsense_follows_at_once_keeps_its_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    both = [arrival(5, 9, late_ns=HALF_NS - 10), arrival(5, late_ns=HALF_NS - 10, content=b"\0")]
    ear = Ear([arrival(0), *both], monkeypatch)
    heard = ear.listen(until(6))
    assert [each.frame for each in heard if each.tick >= 4] == [SILENCE, frame(5, 9), b"\0", SILENCE, SILENCE]
    assert ear.ticks == list(range(7))


def test_a_frame_that_comes_twice_is_heard_once(monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear([arrival(0), arrival(3, 1), arrival(3, 1, late_ns=1000), arrival(3, 1, late_ns=PERIOD_NS)], monkeypatch)
    ear.listen(until(6))
    assert ear.ticks == list(range(7))
    assert not any(each.late for each, _ in ear.heard)


def numbered(sent: Iterable[Arrival]) -> list[Arrival]:
    return [each._replace(number=number) for number, each in enumerate(sent)]


@pytest.mark.parametrize("late_ns", [0, HALF_NS + 1])
def test_frames_that_were_sent_and_did_not_come_are_told_with_the_next_that_does(
    late_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = numbered(arrival(k, k) for k in (0, 2, 3, 5, 8))
    came = [each for each in sent if each.number not in (1, 3)]
    came[-1] = came[-1]._replace(at_ns=came[-1].at_ns + late_ns)
    ear = Ear(came, monkeypatch)
    heard = ear.listen(until(9))
    assert ear.ticks == list(range(10))
    assert {each.tick: each.lost_since for each in heard if each.frame} == {0: None, 3: 0, 8: 3}
    told = [slip for each in heard for slip in ear.hearing.lapses(each, each.tick + each.late - 1, used=True)]
    assert told == [("lost", 0, 3), ("lost", 3, 5), *([("late", 8, 1)] if late_ns else [])]


def test_what_a_sender_does_not_number_is_never_told_as_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear([arrival(0), arrival(3), arrival(9)], monkeypatch)
    assert all(each.lost_since is None for each in ear.listen(until(9)))


def test_nonsense_came_and_a_frame_lost_before_it_is_told_with_the_next_that_can_be_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent = numbered(
        [arrival(0), arrival(1, content=b"\0"), arrival(2), arrival(3), arrival(4, content=b"\0"), arrival(5)]
    )
    ear = Ear([each for each in sent if each.number != 3], monkeypatch)
    heard = ear.listen(until(6))
    assert {each.tick: each.lost_since for each in heard if len(each.frame) > 1} == {0: None, 2: None, 5: 2}


def test_in_lockstep_an_empty_frame_is_the_next_tick_and_time_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    contents = [frame(0), *[SILENCE] * 14, frame(15), *[SILENCE] * 3]
    arrivals = [Arrival(content, 7 * PERIOD_NS * i, 0) for i, content in enumerate(contents)]
    ear = Ear(arrivals, monkeypatch, loop=LOOP.model_copy(update={"lockstep": True}))
    heard = ear.listen(7 * PERIOD_NS * 18)
    assert [(each.tick, each.frame, each.missed) for each in heard] == [(k, each, 0) for k, each in enumerate(contents)]


def test_in_lockstep_ticks_count_on_over_a_heartbeat_that_was_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    contents = [frame(0), *[SILENCE] * 14, *[SILENCE] * 14, frame(30)]  # the frame of tick 15 is not there
    arrivals = [Arrival(content, PERIOD_NS * i, 0) for i, content in enumerate(contents)]
    ear = Ear(arrivals, monkeypatch, loop=LOOP.model_copy(update={"lockstep": True}))
    ear.listen(PERIOD_NS * 30)
    assert ear.ticks == [*range(29), 30]


# On a grid of one's own


@pytest.mark.parametrize("phase_ns", [250_000, 700_000, 1_300_000, 1_900_000])
@pytest.mark.parametrize("every", [1, 2, 5])
def test_on_a_grid_of_ones_own_every_tick_of_the_plant_is_still_heard(
    phase_ns: int, every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever in the plant's period it stands, but for its first tenth, and however often there is a frame."""
    last = 300
    ear = Ear(heartbeats(last, {k: k % 5 for k in range(0, last, every)}), monkeypatch, own_grid=True)
    ear.hearing._grid.start_ns = phase_ns + DELAY_NS  # type: ignore[union-attr]  # it has one
    heard = ear.listen(last * PERIOD_NS)
    assert len(ear.ticks) > last - 5
    assert sorted(set(ear.ticks)) == ear.ticks
    assert sum(each.missed for each in heard) <= 1


def test_on_a_grid_of_ones_own_what_has_piled_up_is_caught_up_with_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    ear = Ear([arrival(k, k % 5) for k in range(100)], monkeypatch, own_grid=True)
    ear.listen(until(9))
    ear.link.pass_time(until(14))
    ear.listen(until(60))
    behind = [at_ns - each.tick * PERIOD_NS - DELAY_NS for each, at_ns in ear.heard if each.tick > 15]
    assert max(behind) < PERIOD_NS
    assert ear.ticks[-40:] == list(range(ear.ticks[-1] - 39, ear.ticks[-1] + 1))
