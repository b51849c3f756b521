"""What never came: gaps in the numbers that senders give their messages.

A sender numbers what it publishes on a key from 0, and one that starts again is another, and starts from 0. Whom the
recorder finds when it comes may be at any number, on every key it will ever speak on: a recorder that came late has
lost nothing. Whoever comes later must begin at 0.
"""

from __future__ import annotations

from typing import Final

import zenoh

_MASK: Final = 0xFFFF_FFFF
"""Numbers have 32 bits and begin again at 0."""

_FRAMES: Final = ("/measurement", "/command")


class Numbers:
    """Follows the numbers of every sender on every key. Threads may share it, as long as each has its own senders.

    Attributes:
        settled: Whether everybody who was there before has been heard, on whatever key.
    """

    def __init__(self) -> None:
        self.settled = False
        self._before: set[zenoh.ZenohId] = set()  # who was
        self._alone: dict[str, int] = {}  # what follows on a session's keys, which have one sender each
        self._following: dict[tuple[str, zenoh.ZenohId, int], int] = {}

    def missing(self, key: str, source: zenoh.SourceInfo) -> int:
        """How many messages of the same sender and key are missing before this one."""
        number = source.source_sn
        if self._alone.get(key) == number:  # the usual case, a thousand times a second
            self._alone[key] = number + 1 & _MASK
            return 0
        sender = source.source_id
        member = sender.zid
        which = key, member, sender.eid
        frames = key.endswith(_FRAMES)
        following = self._alone.get(key) if frames else self._following.get(which)
        if following is None:
            if not self.settled:
                self._before.add(member)
            following = number if member in self._before else 0
        ahead = number - following & _MASK
        if ahead > _MASK >> 1:
            return 0  # it is an older one
        if frames:
            self._alone[key] = number + 1 & _MASK
        else:
            self._following[which] = number + 1 & _MASK
        return ahead
