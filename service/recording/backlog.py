"""Backlog of messages taken and not yet written, mostly while the disk refuses: bounded, drops the newest."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final

from aeroloop.protocol.transport.history import Delivery

MOST_MESSAGES: Final = 200_000
MOST_BYTES: Final = 128_000_000
"""Bytes of payload. With Python's overhead for 200 000 messages the recorder grows by some 200 MB at most."""


class Backlog:
    """A queue of messages with their times of arrival [ns since 1970].

    Attributes:
        refused: Messages dropped because there was no room, by key.
    """

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        self._queue: deque[tuple[Delivery, int]] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._queue)

    def room(self, received: Delivery) -> bool:
        """Whether there is room for one more."""
        return len(self._queue) < MOST_MESSAGES and self._bytes + len(received.payload) <= MOST_BYTES

    def put(self, received: Delivery, at_ns: int) -> None:
        """Add a message, or count it as refused."""
        if self.room(received):
            self._queue.append((received, at_ns))
            self._bytes += len(received.payload)
        else:
            self.refused[received.key] += 1

    def next(self) -> tuple[Delivery, int] | None:
        """Remove and return the oldest message; None if there is none."""
        if not self._queue:
            return None
        received, at_ns = self._queue.popleft()
        self._bytes -= len(received.payload)
        return received, at_ns
