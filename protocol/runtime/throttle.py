"""Throttle: passes one message of each kind per period, and counts the others."""

from __future__ import annotations

import time
from typing import Final


class Throttle:
    """Passes one message of each kind per `period_s` [s], and counts those it holds back."""

    MAX_KINDS: Final = 1000

    def __init__(self, period_s: float = 10.0) -> None:
        self.period_s = period_s
        self._passed: dict[str, tuple[float, int]] = {}

    def let_pass(self, kind: str) -> int | None:
        """None if the message is held back; else the number held back since the last one passed."""
        now = time.monotonic()
        at, held_back = self._passed.get(kind, (-self.period_s, 0))
        if now - at < self.period_s:
            self._passed[kind] = at, held_back + 1
            return None
        if len(self._passed) >= self.MAX_KINDS:
            self._passed.clear()
        self._passed[kind] = now, 0
        return held_back
