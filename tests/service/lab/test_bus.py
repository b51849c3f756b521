"""CAN frame sizes, against hand-computed values and frames built bit by bit."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.service.lab.bus import bus_bits, classic_frame_bits, classic_frames


def stuffed_length(identifier: int, data: bytes) -> int:
    """Bits on the bus of a classic data frame, from the start of frame to the end of the interframe space."""
    head = f"0{identifier:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    crc = 0
    for bit in head:
        crc = (crc << 1) ^ (0x4599 if int(bit) ^ (crc >> 14) else 0)
        crc &= 0x7FFF
    stuffed, run, last = 0, 0, ""
    for bit in f"{head}{crc:015b}":
        run = run + 1 if bit == last else 1
        stuffed, last = stuffed + 1, bit
        if run == 5:
            stuffed, run, last = stuffed + 1, 1, "1" if bit == "0" else "0"
    return stuffed + 1 + 2 + 7 + 3  # CRC delimiter, acknowledgement, end of frame, interframe space


def test_classic_frames_take_the_bits_that_the_literature_has() -> None:
    # Davis, Burns, Bril and Lukkien, Controller Area Network schedulability analysis, 2007: 55 + 10 s bits.
    assert [classic_frame_bits(n) for n in range(9)] == [55, 65, 75, 85, 95, 105, 115, 125, 135]


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_frame_takes_more_than_the_worst(identifier: int, data: bytes) -> None:
    assert 47 + 8 * len(data) <= stuffed_length(identifier, data) <= classic_frame_bits(len(data))


@pytest.mark.parametrize("size", range(1, 9))
def test_the_worst_is_nearly_reached(size: int) -> None:
    """Runs of four equal bits after a stuffed one: only the header and the CRC are not as bad as that."""
    worst = max(stuffed_length(0x078, bytes([byte]) * size) for byte in range(256))
    assert worst >= classic_frame_bits(size) - 7


def test_what_does_not_fit_one_classic_frame_is_split_over_several() -> None:
    assert classic_frames(7) == [7]
    assert classic_frames(8) == [8]
    assert classic_frames(10) == [8, 2]
    assert classic_frames(49) == [8, 8, 8, 8, 8, 8, 1]
    assert bus_bits(7) == 125
    assert bus_bits(10) == 135 + 75
    assert bus_bits(49) == 6 * 135 + 65
    for size in (-1, 9):
        with pytest.raises(ValueError, match="8 bytes"):
            classic_frame_bits(size)
