"""Links: carry frames between the two ends, without a queue.

Both ends use the same calls on every transport. A received frame replaces one that was not yet taken: a loop needs the
newest sample, and a queue would only delay it.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from threading import Condition
from typing import NamedTuple

import zenoh


class Arrival(NamedTuple):
    """A received frame.

    Attributes:
        frame: Its bytes.
        at_ns: When it was received, on `time.monotonic_ns()`.
    """

    frame: bytes
    at_ns: int


class Link(ABC):
    """Sends frames, and receives frames in a mailbox; implemented for each transport."""

    _mailbox: Mailbox

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send a frame. Blocks only to hand it over, and never raises for a lost peer."""

    @property
    def pending(self) -> bool:
        """Whether a received frame waits to be taken."""
        return self._mailbox.pending

    def take(self) -> Arrival | None:
        """The newest frame not yet taken, or None."""
        return self._mailbox.take()

    def wait(self, timeout_s: float) -> Arrival | None:
        """As `take`, but wait up to `timeout_s` for a frame."""
        return self._mailbox.wait(timeout_s)

    @abstractmethod
    def close(self) -> None:
        """Stop receiving. May be called twice."""


class Mailbox:
    """A slot for a frame, written by a receiving thread and read by the loop; a new frame replaces the oldest.

    Args:
        changed: Notified when a frame is put; one of its own if None. Several slots may share one.
        depth: Frames it holds, for a reader that needs each of them; the oldest is taken first.
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
        """Whether a frame is in the slot."""
        return bool(self._arrivals)

    def take(self) -> Arrival | None:
        """Take the oldest frame out of the slot, or None."""
        with self._changed:
            return self._arrivals.popleft() if self._arrivals else None

    def wait(self, timeout_s: float) -> Arrival | None:
        """As `take`, but wait up to `timeout_s` for a frame."""
        with self._changed:
            if not self._arrivals:
                self._changed.wait(timeout_s)
            return self.take()


class ZenohLink(Link):
    """Frames over Zenoh: express, at real-time priority. The session outlives the link.

    If `lossless`, `send` blocks when a peer does not keep up, instead of dropping: for lockstep, where each frame is
    waited for. Without a `mailbox` the link has one of its own.
    """

    def __init__(
        self,
        session: zenoh.Session,
        send_key: str,
        receive_key: str,
        *,
        lossless: bool = False,
        mailbox: Mailbox | None = None,
    ) -> None:
        self._mailbox = mailbox or Mailbox()
        self._subscriber = session.declare_subscriber(
            receive_key, lambda sample: self._mailbox.put(sample.payload.to_bytes())
        )
        self._publisher = session.declare_publisher(
            send_key,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
            express=True,
        )
        self._open = True

    def send(self, frame: bytes) -> None:
        """Send a frame."""
        self._publisher.put(frame)

    def close(self) -> None:
        """Stop receiving."""
        if self._open:
            self._open = False
            self._subscriber.undeclare()
            self._publisher.undeclare()
