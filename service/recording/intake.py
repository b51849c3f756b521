"""How messages come in: from Zenoh's receiving thread into a queue, many at a time.

A message at a time, most of what recording costs is waking up: some 100 µs of a core each, before a byte is written. So
the receiving thread is put to sleep where a pause begins, and what came meanwhile waits in the kernel's socket buffers
and is read in one go, at a tenth of that cost. For it all links share one thread (`one_thread`, called before the
network is joined). That thread looks for gaps, before anything is refused, and does nothing else: whoever writes takes
from the queue. While little comes, nothing waits: a handshake with somebody who joins takes several messages each way.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import stat
import sys
import termios
import threading
import time
from collections import Counter, deque
from contextlib import suppress
from typing import Final, NamedTuple

import zenoh

from protocol.links import published_ns
from service.logs.losses import Numbers

MOST_WAITING: Final = 200_000
"""Messages that may wait to be written: over a minute of a loop at 1 kHz, in some 100 MB."""

SETTLING_S: Final = 5.0
"""A backlog that does not end is left after this [s]."""

_QUIET_NS: Final = 50_000_000
"""A network from which nothing has come for so long has nothing more on its way."""

_GOES_ON_S: Final = 0.25
"""A network in which nothing has piled up for so long goes on as fast as it is taken in, and may do so for good [s]."""

_BACKLOG: Final = 16 * 1024
"""More than a loop at 1 kHz sends in 100 ms [B]."""

_PAUSE_NS: Final = 300_000
"""A message this long after the last one may have found the sockets empty: what is buffered comes ten times as fast."""

_LOOKS: Final = 8
"""At a pause, look this often whether the sockets are empty: where messages come all the time, looking is in vain."""

_BUSY_PER_S: Final = 200
"""Messages a second from which on it pays to let them gather."""


class Taken(NamedTuple):
    """A message as it came.

    Attributes:
        key: Its key.
        payload: Its bytes.
        published_ns: When it was published, on its sender's wall clock [ns since 1970].
        arrived_ns: When it was taken in, on ours [ns since 1970].
        missing: How many before it, of the same sender and key, never came.
    """

    key: str
    payload: bytes
    published_ns: int
    arrived_ns: int
    missing: int = 0


class Refusals(NamedTuple):
    """What found the queue full, by key.

    Attributes:
        messages: How many.
        missing: How many of the same senders' never came, before those.
    """

    messages: Counter[str]
    missing: Counter[str]


def one_thread() -> None:
    """Let all of Zenoh run in one thread of this process; for nothing but a process that only listens."""
    if "ZENOH_RUNTIME" not in os.environ:
        handed_over = ", ".join(f"{name}: (handover: app)" for name in ("rx", "tx", "acc", "net"))
        os.environ["ZENOH_RUNTIME"] = f"(app: (worker_threads: 1), {handed_over})"


class _Sockets:
    """The sockets of this process, as they were when it was asked for them."""

    def __init__(self) -> None:
        self._open = [int(fd) for fd in os.listdir("/proc/self/fd") if _is_socket(int(fd))]

    def waiting(self) -> int:
        """Bytes that the kernel holds and nobody has read: whoever was kept from reading must not rest now."""
        size = 0
        for fd in self._open:
            with suppress(OSError):  # it listens only, or is closed by now
                size += int.from_bytes(fcntl.ioctl(fd, termios.FIONREAD, b"\0" * 4), sys.byteorder)
        return size


def _is_socket(fd: int) -> bool:
    try:
        return stat.S_ISSOCK(os.fstat(fd).st_mode)
    except OSError:
        return False


class Intake:
    """Takes in every message of a key expression until it is closed.

    Args:
        session: An open session.
        key: What to listen to.
        batch_s: How long messages may wait in the kernel before they are taken in [s]; 0: not at all.
        most: How many may wait here.

    Attributes:
        numbers: Follows the numbers of all that comes, whether there is room for it or not.
    """

    def __init__(self, session: zenoh.Session, key: str, batch_s: float, most: int = MOST_WAITING) -> None:
        self.numbers = Numbers()
        self._refusals = Refusals(Counter(), Counter())
        self._refusing = threading.Lock()
        self._batch_s = batch_s
        self._most = most
        self._queue: deque[Taken] = deque()
        self._receiving: set[int] = set()  # threads
        self._own = threading.get_ident()  # what we publish ourselves is taken in by the thread that publishes
        self._last_ns = 0
        self._second_ns = 0  # when the running second began
        self._count = 0  # since then
        self._busy = False  # as the last second was
        self._sockets = _Sockets()
        self._looks = 0  # how often to look still whether the sockets are empty, before a rest
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(self._take, indirect=False))

    def __len__(self) -> int:
        return len(self._queue)

    def next(self) -> Taken | None:
        """The message that has waited longest, or None."""
        return self._queue.popleft() if self._queue else None

    def refusals(self) -> Refusals:
        """What found no room since this was last asked."""
        with self._refusing:
            refusals, self._refusals = self._refusals, Refusals(Counter(), Counter())
        return refusals

    def settle(self) -> bool:
        """Wait until what is on its way has been taken in: for silence or, where others go on, for nothing piled up.

        Returns:
            Whether it came to that; False if more came all the time than could be taken in.
        """
        batch_s, self._batch_s, self._busy = self._batch_s, 0.0, False
        time.sleep(batch_s)  # the receiving thread wakes from its last pause
        now = piled_up = time.monotonic()
        deadline = now + SETTLING_S
        while now < deadline:
            backlog = _Sockets().waiting()
            if backlog > _BACKLOG:
                piled_up = now
            silent = not backlog and time.time_ns() - self._last_ns > _QUIET_NS
            if silent or now - piled_up > _GOES_ON_S:
                return True
            time.sleep(0.005)
            now = time.monotonic()
        return False

    def close(self) -> None:
        """Take in no more. What is in the queue stays there."""
        self._subscriber.undeclare()

    def _take(self, sample: zenoh.Sample) -> None:
        now = time.time_ns()
        if now - self._last_ns > _PAUSE_NS or self._looks:
            self._pause(now)
            now = time.time_ns()
        key, source = str(sample.key_expr), sample.source_info
        missing = 0 if source is None else self.numbers.missing(key, source)
        if len(self._queue) < self._most:
            self._queue.append(Taken(key, sample.payload.to_bytes(), published_ns(sample, now), now, missing))
        else:
            with self._refusing:
                self._refusals.messages[key] += 1
                self._refusals.missing[key] += missing
        self._count += 1
        self._last_ns = now

    def _pause(self, now: int) -> None:
        """Nothing has come for a moment: let messages gather, unless some are waiting; then look again at the next."""
        if now - self._second_ns > 1_000_000_000:
            self._busy = bool(self._batch_s) and self._count > _BUSY_PER_S
            self._second_ns, self._count = now, 0
            self._sockets = _Sockets()
        thread = threading.get_ident()
        if thread == self._own:
            return
        if thread not in self._receiving:
            self._keep(thread)
        if not self._busy:
            return
        self._looks = (self._looks or _LOOKS) - 1
        if not self._sockets.waiting():
            self._looks = 0
            time.sleep(self._batch_s)

    def _keep(self, thread: int) -> None:
        """Keep Python's state of a thread of Zenoh's. It would be made and freed for every message, for 25 µs."""
        self._receiving.add(thread)
        ctypes.pythonapi.PyGILState_Ensure()
