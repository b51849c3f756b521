"""Transmit policy: sends a frame every tick, or only when a level changes (Remark 3), with a heartbeat.

Quantized values change in steps, so a frame equal to the last one need not be sent: the receiver holds the last
levels. A heartbeat, after less than half the counter's range, is the sender's sign of life and keeps its counter
unambiguous. In lockstep each frame is waited for: an empty frame, `UNCHANGED`, stands for one that is not sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign
from typing import Any, Final, Literal

from pydantic import BaseModel, Field, model_validator

UNCHANGED: Final = b""
Policy = Literal["periodic", "on_change"]


class Transmit(BaseModel, frozen=True, extra="forbid"):
    """When each end sends its frames. The word `on_change` alone stands for both directions."""

    measurement: Policy = Field(default="periodic", description="measurement frames: every tick, or on a change")
    command: Policy = Field(default="periodic", description="command frames: every tick, or on a change")
    heartbeat_s: float = Field(
        default=0.03,
        gt=0,
        le=1,
        allow_inf_nan=False,
        description="on_change: send at least this often, and before half the counter's range has passed [s]",
    )

    @model_validator(mode="before")
    @classmethod
    def _one_word(cls, value: Any) -> Any:
        return {"measurement": value, "command": value} if isinstance(value, str) else value

    def heartbeat_ticks(self, period_ns: int, counters: int) -> int:
        """The most ticks from one frame to the next, 1…counters/2 − 1, for a counter with this many values."""
        return max(1, min(counters // 2 - 1, round(self.heartbeat_s * 1e9) // period_ns))


class Sender:
    """Decides, tick by tick, whether a frame is to be sent.

    `heartbeat` is the most ticks between two frames, `counters` the number of values of the frames' counter.
    """

    def __init__(self, policy: Policy, heartbeat: int, counters: int) -> None:
        self._always = policy == "periodic"
        self._heartbeat = heartbeat
        self._counters = counters
        self._codes: Sequence[float] | None = None
        self._at: int | None = None

    def due(self, k: int, codes: Sequence[float]) -> bool:
        """Whether a frame with these codes is to be sent at tick k, which rises; if so, it counts as sent.

        The codes must not be modified afterwards.
        """
        if self._always:
            return True
        since = None if self._at is None else k - self._at
        if since is not None and since < self._heartbeat and self._codes is not None and _same(codes, self._codes):
            return False
        # After missed ticks its counter may equal the last frame's, of which the receiver takes it for a repetition:
        # then the next tick's frame is due as well.
        self._codes = None if since is not None and since % self._counters == 0 else codes
        self._at = k
        return True

    def forget(self) -> None:
        """Clear the memory at a session's start: the next frame is due."""
        self._codes = self._at = None

    @property
    def memory(self) -> tuple[Sequence[float] | None, int | None]:
        """Codes and tick of the last frame, a sender's whole memory; None where there is none."""
        return self._codes, self._at

    def resume(self, codes: Sequence[float] | None, k: int | None) -> None:
        """Restore the memory of another sender."""
        self._codes, self._at = codes if codes is None else list(codes), k


def _same(codes: Sequence[float], last: Sequence[float]) -> bool:
    """Whether two frames have the same bits. 0.0 equals −0.0 but differs in bits; NaN is the reverse."""
    return all(
        copysign(1, a) == copysign(1, b) if a == b == 0 else a == b or (a != a and b != b)
        for a, b in zip(codes, last, strict=True)
    )
