"""Decoder of a viewer: its rate, rows of traces, and what is broken."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.trace import ENDS, Sent
from aeroloop.protocol.wire.attitude import sent_vector
from aeroloop.service.config import load
from tests.support.decoded import (
    ATTITUDE,
    NOW,
    RAW,
    WIRE,
    about,
    address,
    batch,
    configured,
    decode,
    frame,
    measurement,
    said,
    telemetry,
)
from tests.support.viewer_double import fields


def test_a_topic_that_streams_gives_at_most_so_many_a_second_by_time_of_publication() -> None:
    decoder = configured(30.0)
    given = [NOW + k * 1_000_000 for k in range(3000) if decode(decoder, "truth", RAW["truth"], NOW + k * 1_000_000)]
    assert len(given) == pytest.approx(90, abs=1)
    assert max(b - a for a, b in pairwise(given)) < 2 / 30 * 1e9


def test_without_a_rate_everything_is_given_and_what_happens_once_whatever_the_rate() -> None:
    for rate_hz, names in ((None, list(RAW)), (0.001, ["event", "loss", "status"])):
        decoder = configured(rate_hz)
        assert all(decode(decoder, name, RAW[name], NOW + k) for name in names for k in range(5))


def test_a_clock_that_is_set_back_does_not_silence_a_topic() -> None:
    decoder = configured(30.0)
    assert decode(decoder, "truth", RAW["truth"], NOW)
    assert decode(decoder, "truth", RAW["truth"], NOW - 3600 * 10**9)


def test_the_rows_of_each_end_give_what_it_sent_as_frames_do_at_the_times_of_sending() -> None:
    frames = {
        "plant": ("measurement", measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0)),
        "controller": ("command", frame(WIRE.command, [WIRE.voltage.quantizer()] * 2, [24.0, None])),
    }
    for end in ENDS:
        name, sent = frames[end]
        given = configured().take(
            address("trace", end), batch(end, [(NOW, Sent.FRAME, sent), (NOW + 2_000_000, Sent.FRAME, sent)]), 5
        )
        assert given == [
            shown for at_ns in (NOW, NOW + 2_000_000) for shown in configured().frame(address(name), sent, at_ns)
        ]


def test_ticks_at_which_nothing_or_silence_was_sent_give_nothing() -> None:
    sent = measurement(0, 0, 0, 0, 0, 0)
    rows = [(NOW, Sent.NONE, sent), (NOW + 1000, Sent.SILENT, sent), (NOW + 2000, Sent.FRAME, sent)]
    given = configured(25.0).take(address("trace"), batch("plant", rows), NOW)
    assert {shown.at_ns for shown in given} == {NOW + 2000}


@given(times=st.lists(st.integers(0, 3000), max_size=60).map(sorted), cuts=st.sets(st.integers(1, 59)))
def test_of_the_rows_in_a_slot_of_time_the_first_is_given_however_they_are_batched(
    times: list[int], cuts: set[int]
) -> None:
    """Times in ms; at 10 Hz."""
    sent = measurement(0, 0, 0, 0, 0, 0)
    rows = [(NOW + ms * 1_000_000, Sent.FRAME, sent) for ms in times]
    edges = [0, *sorted(cut for cut in cuts if cut < len(rows)), len(rows)]
    decoder = configured(10.0)
    given = [
        shown.at_ns
        for begin, end in pairwise(edges)
        for shown in decoder.take(address("trace"), batch("plant", rows[begin:end]), 0)
        if shown.topic == "/aero/pose"
    ]
    first = {at_ns // 10**8: at_ns for at_ns, *_ in reversed(rows)}
    assert given == sorted(first.values())


def test_frames_beside_a_trace_are_not_decoded_twice() -> None:
    """A log may hold both; `take` is for what a log holds."""
    decoder = configured()
    assert [decoder.take(address(name), RAW[name], NOW) for name in topics.FRAMES] == [[], []]
    assert decoder.malformed == 0


def test_rows_of_another_wire_spec_are_counted_and_those_of_no_time_are_left_out() -> None:
    other = load(None, ["wire.attitude.bits=12"]).wire
    decoder = configured()
    rows = [(NOW, Sent.FRAME, bytes(other.measurement.size))]
    assert decoder.take(address("trace"), batch("plant", rows, other), NOW) == []
    assert decoder.malformed == 1
    payload = bytearray(RAW["trace"])
    payload[40:48] = (-(2**62)).to_bytes(8, "little", signed=True)  # the header's wall clock
    assert configured().take(address("trace"), bytes(payload), NOW) == []


@given(
    name=st.sampled_from(sorted(RAW)),
    payload=st.binary(max_size=80) | st.sampled_from(sorted(RAW.values())),
    at_ns=st.integers(0, 2**64 - 1),
)
def test_any_bytes_at_any_time_give_something_or_nothing_and_never_raise(name: str, payload: bytes, at_ns: int) -> None:
    decoder = configured()
    assert bool(decode(decoder, name, payload, at_ns)) != bool(decoder.malformed)


@given(st.integers(0, len(RAW["trace"]) - 1), st.binary(min_size=1, max_size=8))
def test_a_damaged_trace_gives_something_or_nothing_and_never_raises(place: int, damage: bytes) -> None:
    payload = RAW["trace"][:place] + damage + RAW["trace"][place + len(damage) :]
    assert all(0 <= shown.at_ns < 2**64 for shown in configured(25.0).take(address("trace"), payload, NOW))


@pytest.mark.parametrize("name", sorted(RAW))
def test_a_time_beyond_what_viewers_can_hold_is_the_last_they_can(name: str) -> None:
    for shown in decode(configured(), name, RAW[name], 2**64 - 1):
        assert shown.at_ns == 2**64 - 1 or name == "trace"  # whose rows have their own
        if shown.shape.name == "foxglove.PoseInFrame" and name != "trace":
            assert fields(fields(shown.data)[1][0])[1] == [2**32 - 1]


def test_numbers_beyond_all_bounds_are_shown_or_null() -> None:
    text = telemetry(about(1, 0.1)).encode().replace(b"[0.0,0.0349", b"[1e999,0.0349")
    for shown in configured().take(address("telemetry"), text, NOW):
        assert shown.shape.encoding == "protobuf" or said(shown)["error_p_deg_s"] is None
