"""Tick source: a plant that sends on change and one with late frames, on a simulated link, which is the clock.

A tick's frame arrives `DELAY_NS` after the tick unless a test sets otherwise; every tick is returned once, in order,
with a frame or without.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pytest

from aeroloop.protocol.messages.trace import Received
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Sender
from aeroloop.service.daemon.tick_source import MAILBOX, PlantTick, TickSource
from tests.support.simulated_link import LOOP, PERIOD_NS, SimulatedLink, wire_of

WIRE = wire_of("on_change", "on_change")
DELAY_NS = 200_000
COUNTERS = WIRE.measurement.counters
HALF_NS = PERIOD_NS // 2


def frame(k: int, code: int = 0, wire: WireSpec = WIRE) -> bytes:
    return wire.measurement.pack(k % COUNTERS, (0, 0, 0, 0, 0, code))


def arrival(k: int, code: int = 0, *, late_ns: int = 0, content: bytes | None = None) -> Arrival:
    arrives_ns = k * PERIOD_NS + DELAY_NS + late_ns
    return Arrival(frame(k, code) if content is None else content, arrives_ns)


def in_passing(tick: PlantTick) -> bool:
    return tick.received_as in (Received.LATE, Received.MALFORMED)


class Source:
    """A tick source at one end of a simulated link, and its ticks so far."""

    def __init__(
        self,
        arrivals: Iterable[Arrival],
        *,
        depth: int = MAILBOX,
        wire: WireSpec = WIRE,
        loop: LoopSettings = LOOP,
        stale_s: float = 0.1,
    ) -> None:
        self.link = SimulatedLink(sorted(arrivals, key=lambda each: each.at_ns), depth)
        self.source = TickSource(self.link, loop, wire, stale_s=stale_s, clock=self.link)
        self.taken: list[tuple[PlantTick, int]] = []  # and when

    def run(self, until_ns: int) -> list[PlantTick]:
        """Ticks until a time; an answer takes none."""
        while self.link.now_ns < until_ns:
            tick = self.source.next(0.02)
            if tick is not None:
                self.taken.append((tick, self.link.now_ns))
        return [tick for tick, _ in self.taken]

    @property
    def ticks(self) -> list[int]:
        return [tick.tick for tick, _ in self.taken if not in_passing(tick)]

    def when(self, tick: int) -> int:
        return next(at_ns for each, at_ns in self.taken if each.tick == tick and not in_passing(each))


def until(k: int) -> int:
    """When tick k is over, frame or not."""
    return k * PERIOD_NS + DELAY_NS + HALF_NS


def heartbeats(last: int, codes: Mapping[int, int] | None = None) -> list[Arrival]:
    sender, code, sent = Sender("on_change", 15, COUNTERS), 0, []
    for k in range(last + 1):
        code = (codes or {}).get(k, code)
        if sender.due(k, (code,)):
            sent.append(arrival(k, code))
    return sent


def test_a_frame_is_a_tick_as_it_arrives_and_silence_half_a_period_later() -> None:
    source = Source(heartbeats(40, {7: 1}))
    ticks = source.run(until(40))
    assert source.ticks == list(range(41))
    sent = {k: k * PERIOD_NS + DELAY_NS for k in (0, 7, 22, 37)}
    for k in range(41):
        assert source.when(k) == sent.get(k, until(k))
    assert {each.tick: each.frame for each in ticks if each.frame} == {
        0: frame(0), 7: frame(7, 1), 22: frame(22, 1), 37: frame(37, 1)
    }  # fmt: skip
    for each in ticks:
        assert (each.missed, each.at_ns) == (0, source.when(each.tick))
        assert (each.received_as is Received.SILENT) == (each.frame == UNCHANGED) == (not each.fresh)


def test_of_frames_that_wait_together_the_newest_is_computed_and_the_others_are_missed() -> None:
    source = Source([arrival(0), *(arrival(k, k) for k in range(5, 9))])
    source.run(until(4))
    source.link.pass_time(until(8) - HALF_NS)  # the controller was kept waiting for three ticks
    ticks = source.run(until(10))[5:]
    assert [(each.tick, in_passing(each)) for each in ticks[:4]] == [(5, True), (6, True), (7, True), (8, False)]
    assert ticks[3].missed == 3
    assert source.ticks == [0, 1, 2, 3, 4, 8, 9, 10]


def test_a_frame_whose_tick_is_long_over_is_not_answered_but_held() -> None:
    """A controller that wakes from a stall goes on with the present."""
    source = Source([arrival(0), arrival(5, 9)])
    source.run(until(4))
    source.link.pass_time(until(9) + 1)
    ticks = source.run(until(10))[5:]
    assert [(each.tick, each.frame, in_passing(each), each.missed) for each in ticks] == [
        (5, frame(5, 9), True, 0),
        (9, UNCHANGED, False, 4),
        (10, UNCHANGED, False, 0),
    ]


def test_the_levels_of_a_frame_are_used_for_no_tick_before_its_own() -> None:
    """By its counter, the only evidence, one may be of a tick that is still to come."""
    early = arrival(8, 9)._replace(at_ns=arrival(5).at_ns)
    nonsense = arrival(5, content=b"\0")  # waits behind it, so that it is taken in passing
    source = Source([arrival(0), early, nonsense])
    source.run(until(9))
    assert [tick for tick in source.ticks if tick > 4][:2] == [8, 9]


@pytest.mark.parametrize("drift", [-1e-2, 1e-2])
def test_clocks_that_drift_apart_neither_miss_nor_double_a_tick(drift: float) -> None:
    """The plant's period is longer or shorter by the controller's clock, up to one that runs 1 % fast or slow."""
    last, jitter_ns = 12_000, 150_000
    sent = []
    for each in heartbeats(last, {k: k % 7 for k in range(0, last, 11)}):
        k = (each.at_ns - DELAY_NS) // PERIOD_NS
        at_ns = round(k * PERIOD_NS * (1 + drift)) + DELAY_NS + (k * 7919 % 97) * jitter_ns // 97
        sent.append(each._replace(at_ns=at_ns))
    source = Source(sent)
    ticks = source.run(round(last * PERIOD_NS * (1 + drift)))
    assert source.ticks == list(range(len(source.ticks)))
    assert len(source.ticks) >= last - 1
    assert not any(in_passing(each) or each.missed for each in ticks)


@pytest.mark.parametrize("nonsense", [UNCHANGED, b"\0", frame(5) + b"\0"], ids=["empty", "short", "long"])
def test_nonsense_is_no_tick_and_no_sign_of_life(nonsense: bytes) -> None:
    source = Source([arrival(0), *(arrival(k, content=nonsense) for k in range(1, 9))])
    ticks = source.run(until(8))
    assert source.ticks == list(range(9))
    assert [source.when(k) for k in range(1, 9)] == [until(k) for k in range(1, 9)]
    assert not any(each.fresh for each in ticks[1:])
    assert [each.frame for each in ticks if in_passing(each)] == [nonsense] * 8


def test_in_lockstep_an_empty_frame_is_the_next_tick_whatever_the_time() -> None:
    """And ticks count on over a heartbeat that was lost, here that of tick 30."""
    contents = [frame(0), *[UNCHANGED] * 14, frame(15), *[UNCHANGED] * 28, frame(45)]
    arrivals = [Arrival(content, 7 * PERIOD_NS * i) for i, content in enumerate(contents)]
    source = Source(arrivals, loop=LOOP.model_copy(update={"lockstep": True}))
    ticks = source.run(7 * PERIOD_NS * 45)
    assert [(each.tick, each.frame) for each in ticks] == list(zip([*range(44), 45], contents, strict=True))


PERIODIC = WireSpec()


def test_a_frame_that_is_later_than_the_stale_time_is_not_answered_and_shows_no_life() -> None:
    """A link that holds everything up for a while and then delivers it: what is old is refused, what is new is not."""
    held = range(100, 225)  # all of them arrive with tick 225
    arrivals = [arrival(k, late_ns=(225 - k) * PERIOD_NS if k in held else 0) for k in range(300)]
    source = Source(arrivals, depth=300, wire=PERIODIC)  # each is taken
    taken = source.run(until(299))
    stale = [each.tick for each in taken if each.received_as is Received.LATE]
    assert stale
    assert all(each.late_ns > 100_000_000 and not each.fresh for each in taken if each.tick in stale)
    assert all(each.late_ns <= 100_000_000 for each in taken if each.received_as is Received.FRAME)
    assert source.ticks == [k for k in range(300) if k not in stale]
    assert set(stale) <= set(held)


def test_a_malformed_frame_where_silence_is_allowed_is_no_tick_and_costs_none() -> None:
    source = Source([arrival(0), arrival(1, content=b"junk"), arrival(2)])
    source.run(until(3))
    assert source.ticks == [0, 1, 2, 3]
    (junk,) = (tick for tick, _ in source.taken if tick.received_as is Received.MALFORMED)
    assert (junk.tick, junk.missed, junk.fresh) == (0, 0, False)
