"""Script: what a controller receives, as test_golden.c reads it, and what the controller answers.

Commands are codes, so they would seldom show a difference in the last bits of what the law computes. A digest does: of
the voltages before quantization and of the law's state after each tick.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any, Final

from aeroloop.protocol.messages.operator import Change, Gains
from aeroloop.service.control.controller import Controller, ControllerSnapshot

NO_ANSWER: Final = 255
_PRIME: Final = 0x100000001B3  # of FNV-1a
_DIGEST_BYTES: Final = 8


class ScriptedController(Controller):
    """A controller that writes what it receives to `script`, and its commands to `answers`.

    It was `asked` for so many; `digest` is of what it has computed.
    """

    def __init__(self, *given: Any) -> None:
        self.script, self.answers, self.asked, self.digest = bytearray(), bytearray(), 0, 0
        super().__init__(*given)

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """As the controller's."""
        answer = super().tick(frame, k)
        if frame is not None:
            self.asked += 1
            for bits in struct.iter_unpack("=Q", bytes(self.last_valid["u"]) + bytes(self.last_valid["state_next"])):
                self.digest = (self.digest ^ bits[0]) * _PRIME % 2**64
            self.script += struct.pack("<cqB", b"T", k, len(frame)) + frame
            self.answers += bytes([NO_ANSWER if answer is None else len(answer)]) + (answer or b"")
        return answer

    def hold(self, frame: bytes) -> bool:
        """As the controller's."""
        self.script += struct.pack("<cB", b"H", len(frame)) + frame
        return super().hold(frame)

    def set_gains(self, gains: Gains) -> None:
        """As the controller's."""
        super().set_gains(gains)
        self.script += b"G" + _doubles(number for gain in self.gains.named.values() for number in gain)

    def apply(self, change: Change) -> None:
        """As the controller's."""
        super().apply(change)
        if change.reference is not None:
            starts, *parts = self.motion.trajectory
            self.script += struct.pack("<cI", b"P", len(starts))
            for start, *piece in zip(starts, *parts, strict=True):
                self.script += _doubles([start, *(number for part in piece for number in part.ravel())])

    def restore(self, state: ControllerSnapshot) -> None:
        """As the controller's."""
        super().restore(state)
        self.script += b"S" + _state(self.state, self.wire.actuators)


def _state(state: ControllerSnapshot, actuators: int) -> bytes:
    held, voltages, sent = state.held or (0.0,) * 6, state.voltage_codes, state.sent_codes or (0.0,) * actuators
    has = [part is not None for part in (state.held, voltages, state.sent_codes, state.sent_tick)]
    law = [number for part in state.law.values() for number in part]
    before, after = [*state.attitude, *law], [*held, *(voltages or (float("nan"),) * actuators), *sent]
    return _doubles(before) + bytes(has) + _doubles(after) + struct.pack("<q", state.sent_tick or 0)


def _doubles(numbers: Iterable[float]) -> bytes:
    numbers = [*numbers]
    return struct.pack(f"<{len(numbers)}d", *numbers)


def answers_in(data: bytes) -> tuple[list[bytes | None], int]:
    """What a program wrote: its answers in order, and its digest.

    An answer is a command's frame, empty if unchanged, None if there is none.
    """
    answers, at = list[bytes | None](), 0
    while at < len(data) - _DIGEST_BYTES:
        size = data[at]
        end = at + 1 + (0 if size == NO_ANSWER else size)
        answers.append(None if size == NO_ANSWER else data[at + 1 : end])
        at = end
    return answers, int.from_bytes(data[at:], "little")
