"""What a frame costs on a classic CAN bus, at the worst.

A data frame with an 11-bit identifier has 34 bits under stuffing besides its data, and 13 that are not stuffed: the
CRC's delimiter, the acknowledgement, the end of the frame, and the three bits of silence before the next. After five
equal bits the sender stuffs an opposite one, so at the worst one bit in four after the first is added (Davis, Burns,
Bril and Lukkien 2007). A frame of more than eight bytes fits only CAN FD, which is what this project sends it in; here
it is reckoned as the classic frames that its bytes would fill, without the header that telling them apart would take.
"""

from __future__ import annotations

from typing import Final

from aeroloop.protocol.transport.can_link import CLASSIC_BYTES

BITRATE: Final = 1_000_000
"""Bits a second of the bus whose load is reckoned, the most that classic CAN has."""
_STUFFED: Final = 34
_UNSTUFFED: Final = 13


def classic_frame_bits(data_bytes: int) -> int:
    """Bits of one classic frame with worst-case stuffing, interframe space included.

    Args:
        data_bytes: 0…8.

    Raises:
        ValueError: A classic frame does not hold so many bytes.
    """
    if not 0 <= data_bytes <= CLASSIC_BYTES:
        raise ValueError(f"a classic CAN frame holds 0 to {CLASSIC_BYTES} bytes, not {data_bytes}")
    stuffed = _STUFFED + 8 * data_bytes
    return stuffed + (stuffed - 1) // 4 + _UNSTUFFED


def classic_frames(size: int) -> list[int]:
    """Data bytes of each classic frame that one of our frames fills.

    Args:
        size: Bytes of our frame, ≥ 1.
    """
    full, rest = divmod(size, CLASSIC_BYTES)
    return [CLASSIC_BYTES] * full + [rest] * (rest > 0)


def bus_bits(size: int) -> int:
    """Bits on a classic bus, at the worst, of one of our frames of so many bytes."""
    return sum(classic_frame_bits(data_bytes) for data_bytes in classic_frames(size))
