"""What never came: gaps in the numbers that senders give their messages.

A sender numbers what it publishes on a key from 0, and one that starts again starts from 0. Whom the recorder finds
when it comes may be at any number: a recorder that came late has lost nothing. Whoever comes later must begin at 0.
"""

from __future__ import annotations

from typing import NamedTuple

import zenoh


class _Source(NamedTuple):
    sender: str
    following: int


class Numbers:
    """Follows the numbers of every key.

    Attributes:
        settled: Whether everybody who was there before is known by now.
    """

    def __init__(self) -> None:
        self.settled = False
        self._current: dict[str, _Source] = {}
        self._others: dict[tuple[str, str], int] = {}  # senders that take turns on a key

    def missing(self, key: str, source: zenoh.SourceInfo) -> int:
        """How many messages of the same sender and key are missing before this one."""
        number = source.source_sn
        current = self._current.get(key)
        if current is not None and number == current.following:  # the usual case: no need to ask who it is
            self._current[key] = _Source(current.sender, number + 1 & 0xFFFF_FFFF)
            return 0
        sender = f"{source.source_id.zid}:{source.source_id.eid}"
        following = 0 if self.settled else number
        if current is not None:
            if current.sender == sender:
                following = current.following
            else:
                self._others[key, current.sender] = current.following
                following = self._others.get((key, sender), following)
        self._current[key] = _Source(sender, number + 1 & 0xFFFF_FFFF)
        return max(0, number - following)
