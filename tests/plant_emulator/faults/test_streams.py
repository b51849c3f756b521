"""Faults of streams: each acts on frames as specified, in order and number."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.faults.injection import FaultyStream
from aeroloop.plant_emulator.faults.language import Fault
from tests.support.faulty_streams import flat, letters, numbered, passed

MANY = 10_000


@pytest.mark.parametrize(
    ("faults", "frames", "ticks"),
    [
        ([], [b"a", None, b"b"], ["a", "", "b"]),
        (["off@0.2..0.4"], letters(6), ["a", "b", "", "", "e", "f"]),
        (["stuck@0.2..0.5"], [b"a", b"b", b"c", None, b"e", b"f"], ["a", "b", "b", "", "b", "f"]),
        (["stuck"], letters(3), ["a", "a", "a"]),
        (["delay=0.2"], letters(5), ["", "", "a", "b", "c"]),
        (["delay=0.05"], letters(3), ["", "a", "b"]),
        (["delay=0.2@0.1..0.4"], letters(6), ["a", "", "", "b", "cde", "f"]),  # what is on its way comes at once, first
        (["duplicate=1@0.1..0.3"], [*letters(4), None], ["a", "b", "bc", "cd", ""]),
        (["duplicate=1"], [b"a", None, None], ["a", "a", ""]),
        (["reorder=1"], letters(4), ["", "ba", "", "dc"]),
        (["reorder=1@0.1..0.2"], [b"a", b"b", None, b"d", b"e"], ["a", "", "", "db", "e"]),
        (["duplicate=1", "delay=0.1"], [b"a", None, None], ["", "a", "a"]),  # one after another, in this order
        (["delay=0.1", "off@0.1"], letters(3), ["", "", ""]),
    ],
)
def test_frames_pass_as_written(faults: list[str], frames: list[bytes | None], ticks: list[str]) -> None:
    seen = passed(*(f"command:{fault}" for fault in faults), frames=frames)
    assert [b"".join(tick).decode() for tick in seen] == ticks


@given(delay_ms=st.integers(0, 30), start=st.integers(0, 40), length=st.integers(1, 40))
def test_every_frame_passes_a_delay_once_and_in_order_and_none_too_late(delay_ms: int, start: int, length: int) -> None:
    text = f"command:delay={delay_ms / 1000}@{start / 1000}..{(start + length) / 1000}"
    frames = numbered(60)
    ticks = passed(text, frames=[*frames, *[None] * 60], period=0.001)
    assert flat(ticks) == frames
    for k, tick in enumerate(ticks):
        for frame in tick:
            sent = int.from_bytes(frame, "big")
            due = sent + delay_ms if start <= sent < start + length else sent
            assert k == min(due, max(sent, start + length))


@pytest.mark.parametrize("kind", ["drop", "garble", "duplicate", "reorder"])
def test_a_fifth_of_the_frames_fails_and_the_others_pass_as_they_are(kind: str) -> None:
    """Five binomial deviations of 40. Of n that could be held back, n·p/(1 + p) = 1667 change places."""
    frames = numbered(MANY)
    ticks = passed(f"command:{kind}=0.2@0..999.9", frames=frames)
    if kind == "drop":
        assert abs(sum(not tick for tick in ticks) - 2000) <= 200
        assert all(tick in ([], [frame]) for tick, frame in zip(ticks, frames, strict=True))
    elif kind == "garble":
        assert abs(sum(tick != [frame] for tick, frame in zip(ticks, frames, strict=True)) - 2000) <= 200
    elif kind == "duplicate":
        assert abs(len(flat(ticks)) - 12_000) <= 200
        assert sorted(set(flat(ticks))) == frames
    else:
        assert sorted(flat(ticks)) == frames  # nothing is lost or repeated
        assert abs(sum(len(tick) == 2 for tick in ticks) - 1667) <= 200
        assert all(tick[0] > tick[1] for tick in ticks if len(tick) == 2)


def test_a_garbled_frame_differs_in_exactly_one_bit_and_in_any() -> None:
    frame = bytes(range(3))
    flips = set()
    for (garbled,) in passed("command:garble=1", frames=[frame] * 500):
        difference = int.from_bytes(garbled, "big") ^ int.from_bytes(frame, "big")
        assert len(garbled) == 3
        assert difference.bit_count() == 1
        flips.add(difference)
    assert len(flips) == 24  # that a bit is spared 500 times has probability (23/24)^500 = 6e-10
    assert passed("command:garble=1", frames=[b""]) == [[b""]]


def test_a_stream_knows_only_its_own_faults() -> None:
    faults = [Fault.parse("measurement:off"), Fault.parse("rate:off")]
    assert FaultyStream("command", faults).passes(b"a", 0.0) == [b"a"]
    assert FaultyStream("measurement", faults).passes(b"a", 0.0) == []


def test_a_stream_passes_frames_untouched_until_something_is_injected_and_after_it_is_over() -> None:
    stream = FaultyStream("command", [])
    assert stream.passes(b"a", 5.0) == [b"a"]
    stream.inject(Fault.parse("measurement:off"), 5.0)
    stream.inject(Fault.parse("command:stuck@0.1..0.2"), 5.0)
    assert [stream.passes(frame, t) for frame, t in ((b"b", 5.0), (b"c", 5.1), (b"d", 5.2))] == [[b"b"], [b"b"], [b"d"]]
    stream.inject(Fault.parse("command:stuck"), 5.3)
    assert stream.passes(b"e", 5.3) == [b"d"]
    stream.clear()
    assert stream.passes(b"f", 5.4) == [b"f"]


def test_what_is_held_back_for_one_session_is_lost_with_it() -> None:
    stream = FaultyStream("command", [Fault.parse("command:delay=0.1")])
    assert stream.passes(b"a", 0.0) == []
    stream.forget()
    assert stream.passes(b"b", 0.1) == []
    assert stream.passes(None, 0.2) == [b"b"]


def test_the_two_streams_do_not_lose_the_same_ticks() -> None:
    def lost(signal: str) -> list[bool]:
        stream = FaultyStream("command" if signal == "command" else "measurement", [Fault.parse(f"{signal}:drop=0.5")])
        return [not stream.passes(b"a", 0.1 * k) for k in range(100)]

    assert lost("command") != lost("measurement")
