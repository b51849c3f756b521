"""Links: carry frames between the two ends, without a queue.

Both ends use the same calls on every transport. A received frame replaces one that was not yet taken: a loop needs the
newest sample, and a queue would only delay it.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock, Thread
from typing import Final, NamedTuple

import zenoh
from zenoh import handlers

from aeroloop.protocol.transport.direct import direct

_NEVER_S: Final = 1e6


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

    _mailbox: Mailbox | Ring

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


class Wake:
    """Wakes the one thread that waits, or is about to. As `threading.Event`, which makes a new lock for each wait."""

    def __init__(self) -> None:
        self._asleep = Lock()
        self._asleep.acquire()

    def set(self) -> None:
        """Wake the thread that waits; if none does, its next wait ends at once."""
        if self._asleep.locked():
            with suppress(RuntimeError):  # set by another thread in the meantime
                self._asleep.release()

    def clear(self) -> None:
        """Undo `set`."""
        self._asleep.acquire(blocking=False)

    def wait(self, timeout_s: float) -> None:
        """Wait until it is set, or for `timeout_s`; then it is cleared."""
        self._asleep.acquire(timeout=timeout_s)


class Mailbox:
    """A slot for a frame, written by a receiving thread and read by the loop; a new frame replaces the oldest.

    Args:
        changed: Set when a frame is put; one of its own if None. Several slots of one reader may share one.
        depth: Frames it holds, for a reader that needs each of them; the oldest is taken first.
    """

    def __init__(self, changed: Wake | None = None, depth: int = 1) -> None:
        self._changed = changed or Wake()
        self._arrivals: deque[Arrival] = deque(maxlen=depth)

    def put(self, frame: bytes) -> None:
        """Put a frame in the slot, in place of the oldest if it is full."""
        self._arrivals.append(Arrival(frame, time.monotonic_ns()))
        self._changed.set()

    @property
    def pending(self) -> bool:
        """Whether a frame is in the slot."""
        return bool(self._arrivals)

    def take(self) -> Arrival | None:
        """Take the oldest frame out of the slot, or None."""
        return self._arrivals.popleft() if self._arrivals else None

    def wait(self, timeout_s: float) -> Arrival | None:
        """As `take`, but wait up to `timeout_s` for a frame."""
        due = time.monotonic() + timeout_s
        self._changed.clear()  # of a frame that was taken without waiting
        while not self._arrivals and (left_s := due - time.monotonic()) > 0:
            self._changed.wait(left_s)  # may end too soon: a frame can be taken between its append and its set
        return self.take()


class Ring:
    """A slot as Mailbox, in which a loop waits inside Zenoh: no Python runs in the receiving thread.

    Zenoh's wait has no time-out. When one is over, a thread that sleeps until then puts a knock in the ring: a message
    that never leaves the session, with an attachment, which no frame has. A frame's time is when the loop takes it.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._subscriber = session.declare_subscriber(key, handlers.RingChannel(2))  # a frame and a knock
        self._received = self._subscriber.handler
        self._knocker = session.declare_publisher(key, allowed_destination=zenoh.Locality.SESSION_LOCAL)
        self._newest: Arrival | None = None
        self._due = self._rings_at = time.monotonic() + _NEVER_S
        self._sooner = Wake()
        self._open = True
        self._alarm = Thread(target=self._knock_when_due, name="time-out", daemon=True)
        self._alarm.start()

    @property
    def pending(self) -> bool:
        """Whether a frame is in the slot."""
        if self._newest is None:
            self._newest = self.take()
        return self._newest is not None

    def take(self) -> Arrival | None:
        """Take the newest frame out of the slot, or None."""
        newest, self._newest = self._newest, None
        while self._open and (sample := self._received.try_recv()) is not None:
            newest = self._frame_of(sample) or newest
        return newest

    def wait(self, timeout_s: float) -> Arrival | None:
        """As `take`, but wait up to `timeout_s` for a frame."""
        arrival = self.take()
        due = time.monotonic() + timeout_s
        while arrival is None and self._open and time.monotonic() < due:
            self._due = due
            if due < self._rings_at:
                self._sooner.set()
            try:
                arrival = self._frame_of(self._received.recv())
            except zenoh.ZError:  # closed
                return None
            arrival = self.take() or arrival
        return arrival

    def close(self) -> None:
        """Stop receiving, and end a wait."""
        self._open = False
        self._subscriber.undeclare()
        self._sooner.set()
        self._alarm.join()
        self._knocker.undeclare()

    @staticmethod
    def _frame_of(sample: zenoh.Sample) -> Arrival | None:
        return Arrival(sample.payload.to_bytes(), time.monotonic_ns()) if sample.attachment is None else None

    def _knock_when_due(self) -> None:
        while self._open:
            self._rings_at = due = self._due
            if self._due < due:
                continue  # set sooner before the alarm was
            self._sooner.wait(max(0.0, due - time.monotonic()))
            if time.monotonic() >= self._due:
                self._due = time.monotonic() + _NEVER_S  # until the loop, woken, sets it again
                with suppress(zenoh.ZError):  # the session is closed, which ends a wait, too
                    self._knocker.put(b"", attachment=b"knock")


class ZenohLink(Link):
    """Frames over Zenoh: express, at real-time priority. The session outlives the link.

    Without a `mailbox` the link has a Ring, for a loop that waits. A mailbox is filled by Zenoh's receiving thread, so
    its times are exact; but that thread then holds Python's lock, which delays a loop that it wakes. If `lossless`,
    `send` blocks when a peer does not keep up, instead of dropping: for lockstep, where each frame is waited for.

    A plant's link may have a second session, `also`, and a mailbox: frames are received on both, and sent on each that
    has a subscriber, which the controller has on one.
    """

    def __init__(
        self,
        session: zenoh.Session,
        send_key: str,
        receive_key: str,
        *,
        lossless: bool = False,
        mailbox: Mailbox | None = None,
        also: zenoh.Session | None = None,
    ) -> None:
        sessions = [session] if also is None else [also, session]
        self._declared: list[Callable[[], None]] = []
        if mailbox is None:
            assert also is None, "a ring is in one session"
            ring = Ring(session, receive_key)
            self._mailbox = ring
            self._declared.append(ring.close)
        else:
            self._mailbox = mailbox

            def receive(sample: zenoh.Sample) -> None:
                mailbox.put(sample.payload.to_bytes())

            handler = direct(receive)
            self._declared += [each.declare_subscriber(receive_key, handler).undeclare for each in sessions]
        self._publishers = [
            each.declare_publisher(
                send_key,
                priority=zenoh.Priority.REAL_TIME,
                congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
                reliability=zenoh.Reliability.RELIABLE if lossless else zenoh.Reliability.BEST_EFFORT,
                express=True,
            )
            for each in sessions
        ]
        self._declared += [publisher.undeclare for publisher in self._publishers]
        self._open = True

    def send(self, frame: bytes) -> None:
        """Send a frame."""
        for publisher in self._publishers:
            publisher.put(frame)

    def close(self) -> None:
        """Stop receiving."""
        if self._open:
            self._open = False
            for undeclare in self._declared:
                undeclare()
