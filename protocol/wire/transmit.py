"""When a frame is sent: every tick, or only when a level changes (Remark 3), with a heartbeat.

What is quantized changes in steps, so a frame that says the same as the last one need not be sent: the other end holds
the last levels, and nothing is lost. A heartbeat, after less than half the counter's range, shows that the sender
lives and keeps its counter unmistakable. Where each frame is waited for, in lockstep, silence cannot be received: there
an empty frame stands for it, `SILENCE`, which says as much and is no frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

SILENCE: Final = b""
"""Stands for a frame that is not sent because it would say what the last one said."""

Policy = Literal["periodic", "on_change"]


class Transmit(BaseModel):
    """What each end sends, and when. The word `on_change` alone stands for both directions."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
        """The most ticks from one frame to the next, 1…counters/2 − 1.

        Args:
            period_ns: Period of a tick [ns].
            counters: How many values the counter of frames has.
        """
        return max(1, min(counters // 2 - 1, round(self.heartbeat_s * 1e9) // period_ns))


class Sender:
    """Decides, tick by tick, whether a frame is to be sent.

    Args:
        policy: When frames are sent.
        heartbeat: The most ticks from one frame to the next.
        counters: How many values the counter of frames has.
    """

    def __init__(self, policy: Policy, heartbeat: int, counters: int) -> None:
        self._always = policy == "periodic"
        self._heartbeat = heartbeat
        self._counters = counters
        self._said: Sequence[float] | None = None
        self._at: int | None = None

    def due(self, k: int, codes: Sequence[float]) -> bool:
        """Whether a frame with these codes is to be sent at tick k; if so, it counts as sent.

        Args:
            k: Tick index, rising.
            codes: What the frame would say; a sequence that nobody changes any more.
        """
        if self._always:
            return True
        since = None if self._at is None else k - self._at
        if since is not None and since < self._heartbeat and self._said is not None and _same(codes, self._said):
            return False
        # With ticks missed, its counter may be that of the last frame, and it be taken for that one's repetition: then
        # the next tick has to say it again.
        self._said = None if since is not None and since % self._counters == 0 else codes
        self._at = k
        return True

    def forget(self) -> None:
        """A session begins: whatever comes is to be sent."""
        self._said = self._at = None

    @property
    def memory(self) -> tuple[Sequence[float] | None, int | None]:
        """Codes and tick of the last frame, which is all that a sender remembers; None for what it does not."""
        return self._said, self._at

    def resume(self, codes: Sequence[float] | None, k: int | None) -> None:
        """Go on with the memory of another sender."""
        self._said, self._at = codes if codes is None else list(codes), k


def _same(codes: Sequence[float], said: Sequence[float]) -> bool:
    """Whether two frames have the same bits: 0.0 and −0.0 are equal and have not, NaN is not and has."""
    return all(
        copysign(1, a) == copysign(1, b) if a == b == 0 else a == b or (a != a and b != b)
        for a, b in zip(codes, said, strict=True)
    )
