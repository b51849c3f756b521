"""Hostile data: what a stranger makes of a well-formed message, log or configuration."""

from __future__ import annotations

from random import Random
from typing import Final

from aeroloop.protocol.messages.operator import MAX_VALUES

TOKENS: Final = (
    b"null", b"true", b"NaN", b"-Infinity", b"1e999", b"-0.0", b"9" * 400, b"0." + b"1" * 400, b'""', b"[]", b"{}",
    b'"\\ud800"', b'"\\u0000"', b"\xff\xfe", b"[" * 300,
    b'{"a":' * 300, b'"k":0,' * (MAX_VALUES + 1), b'"' + b"x" * 5000 + b'"',
)  # fmt: skip
"""What is put in the place of something else."""


def mutated(data: bytes, chance: Random) -> bytes:
    """The data after one to four changes: bits flipped, a piece cut, repeated, moved, or replaced by a token."""
    for _ in range(chance.randint(1, 4)):
        start = chance.randrange(len(data) + 1)
        end = min(len(data), start + chance.choice((0, 1, 2, 8, 64)))
        head, piece, tail = data[:start], data[start:end], data[end:]
        match chance.randrange(6):
            case 0:
                piece = bytes(byte ^ 1 << chance.randrange(8) for byte in piece)
            case 1:
                piece = b""
            case 2:
                piece *= chance.choice((2, 100))
            case 3:
                head, tail = tail, head
            case 4:
                tail = b""
            case _:
                piece = chance.choice(TOKENS)
        data = head + piece + tail
    return data
