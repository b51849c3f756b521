"""Links: carry frames between the two ends, without a queue, by the same calls on every transport.

A received frame replaces one that was not yet taken: a loop needs the newest sample, and a queue would only delay it. A
frame that cannot be read is refused before it could replace one.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from threading import Condition
from typing import Any, NamedTuple

import zenoh
from zenoh.handlers import Callback


class Arrival(NamedTuple):
    """A received frame, and when it was received on `time.monotonic_ns()`."""

    frame: bytes
    at_ns: int


class Mailbox:
    """A slot for `depth` frames, written by a receiving thread and read by the loop; a new frame replaces the oldest.

    `changed` is notified when a frame is put; several mailboxes of one reader may share it.
    """

    def __init__(self, changed: Condition | None = None, depth: int = 1) -> None:
        self._changed = changed or Condition()
        self._arrivals: deque[Arrival] = deque(maxlen=depth)

    def put(self, frame: bytes) -> None:
        """Put a frame in the slot, in place of the oldest if it is full."""
        arrival = Arrival(frame, time.monotonic_ns())
        with self._changed:
            self._arrivals.append(arrival)
            self._changed.notify()

    @property
    def pending(self) -> bool:
        """Whether a received frame waits to be taken."""
        return bool(self._arrivals)

    def take(self) -> Arrival | None:
        """Take the oldest frame out of the slot, or None."""
        return self._arrivals.popleft() if self._arrivals else None

    def wait(self, timeout_s: float) -> Arrival | None:
        """As `take`, but wait up to `timeout_s` for a frame."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrivals, timeout_s)
            return self.take()


class Link(Mailbox, ABC):
    """A mailbox for the frames received, and a way to send some; implemented for each transport."""

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send a frame. Blocks only to hand it over, and never raises for a lost peer."""

    @abstractmethod
    def close(self) -> None:
        """Stop receiving. May be called twice."""


class ZenohLink(Link):
    """Frames over Zenoh: express, at real-time priority. The session outlives the link.

    A received frame that `accepts` says no to is dropped and counted by `refused`; it is called for each frame in
    Zenoh's thread. If `lossless`, `send` blocks when a peer does not keep up, instead of dropping: for lockstep, where
    each frame is waited for. A plant's link may have a second session, `also`: frames are received and published on
    both, and Zenoh carries them where a peer subscribes.
    """

    def __init__(
        self,
        session: zenoh.Session,
        send_key: str,
        receive_key: str,
        accepts: Callable[[bytes], bool],
        *,
        lossless: bool = False,
        changed: Condition | None = None,
        depth: int = 1,
        also: zenoh.Session | None = None,
    ) -> None:
        super().__init__(changed, depth)
        sessions = [session] if also is None else [also, session]
        self.refused = 0

        def receive(sample: zenoh.Sample) -> None:
            frame = sample.payload.to_bytes()
            if accepts(frame):
                self.put(frame)
            else:
                self.refused += 1

        handler = Callback(receive, indirect=False)  # in Zenoh's thread: one of Python's would be one wake-up more
        self._subscribers = [each.declare_subscriber(receive_key, handler) for each in sessions]
        control = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        reliability = zenoh.Reliability.RELIABLE if lossless else zenoh.Reliability.BEST_EFFORT
        how: dict[str, Any] = {
            "priority": zenoh.Priority.REAL_TIME,
            "congestion_control": control,
            "reliability": reliability,
        }
        self._publishers = [each.declare_publisher(send_key, express=True, **how) for each in sessions]

    def send(self, frame: bytes) -> None:
        for publisher in self._publishers:
            publisher.put(frame)

    def close(self) -> None:
        while self._subscribers:
            self._subscribers.pop().undeclare()
        while self._publishers:
            self._publishers.pop().undeclare()
