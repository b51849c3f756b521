"""Frame sizes on a classic CAN bus, with worst-case bit stuffing.

A data frame with an 11-bit identifier has, besides its data, 34 bits under stuffing and 13 without: CRC delimiter,
acknowledgement, end of frame and the three bits of interframe space. After five equal bits the sender stuffs an
opposite one, so at worst one bit is added for every four after the first (Davis, Burns, Bril and Lukkien 2007). A frame
of more than eight bytes goes as one CAN FD frame in this project; here it counts as the classic frames that its bytes
fill, without a header that distinguishes them.
"""

from __future__ import annotations

from typing import Final

from aeroloop.protocol.transport.can_format import CLASSIC_BYTES

BITRATE: Final = 1_000_000
"""Bit rate for the load, the highest of classic CAN [bit/s]."""
_STUFFED: Final = 34
_UNSTUFFED: Final = 13


def classic_frame_bits(data_bytes: int) -> int:
    """Bits of one classic frame of 0…8 data bytes with worst-case stuffing, interframe space included.

    Raises:
        ValueError: A classic frame does not hold so many bytes.
    """
    if not 0 <= data_bytes <= CLASSIC_BYTES:
        raise ValueError(f"a classic CAN frame holds 0 to {CLASSIC_BYTES} bytes, not {data_bytes}")
    stuffed = _STUFFED + 8 * data_bytes
    return stuffed + (stuffed - 1) // 4 + _UNSTUFFED


def classic_frames(size: int) -> list[int]:
    """Data bytes of each classic frame that a frame of the loop of `size` ≥ 1 bytes fills."""
    full, rest = divmod(size, CLASSIC_BYTES)
    return [CLASSIC_BYTES] * full + [rest] * (rest > 0)


def bus_bits(size: int) -> int:
    """Worst-case bits on a classic bus of a frame of the loop of `size` bytes."""
    return sum(classic_frame_bits(data_bytes) for data_bytes in classic_frames(size))
