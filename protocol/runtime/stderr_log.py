"""Log on stderr that no loop waits for: a bounded queue, which a thread of its own empties.

A pipe that nothing reads, a terminal that is halted by ^S or a stuck journal block the thread that writes there. Here
that thread has no other work. Messages that find the queue full are dropped and counted; `dropped` is in the status of
every role, and a line says how many once stderr takes lines again.
"""

from __future__ import annotations

import logging
import os
from logging.handlers import QueueHandler, QueueListener
from queue import Full, Queue
from threading import Event
from typing import Any, Final

from aeroloop.protocol.printable import printable

WAITING: Final = 1000  # most messages that wait for stderr
FLUSH_S: Final = 0.5  # longest wait at the end of the process for those that were not written yet
STDERR: Final = 2
_LINE: Final = "%(asctime)s %(levelname)s %(role)s: %(message)s"


class _OneLine(logging.Formatter):
    """Formats a record as one printable line, whatever names and texts of the network it has."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # of the library
        return printable(super().formatMessage(record))


class _Stderr(logging.Handler):
    """Writes lines to stderr's descriptor, as a thread that hangs in `sys.stderr` makes the interpreter abort at exit.

    `lost` counts lines that stderr refused, such as of a terminal that is closed.
    """

    lost = 0

    def createLock(self) -> None:  # noqa: N802  # logging's name
        """Have no lock: one thread writes, and `logging.shutdown` must not wait for it."""
        self.lock = None

    def handle(self, record: logging.LogRecord) -> bool:
        """Write a message. The library's own takes the lock, since Python 3.13 even where there is none."""
        self.emit(record)
        return True

    def emit(self, record: logging.LogRecord) -> None:
        line = f"{self.format(record)}\n".encode(errors="backslashreplace")
        try:
            while line:
                line = line[os.write(STDERR, line) :]
        except OSError:
            self.lost += 1


class _Listener(QueueListener):
    """Hands the messages to stderr. An Event in the queue is set when all messages before it were handed over."""

    def handle(self, record: Any) -> None:
        if isinstance(record, Event):
            record.set()
        else:
            super().handle(record)


class StderrLog(QueueHandler):
    """Handler that puts messages in the queue."""

    def __init__(self) -> None:
        self._messages: Queue[Any] = Queue(WAITING)
        super().__init__(self._messages)
        self._full = 0  # messages that found the queue full
        self._reported = 0  # of those, how many a line has reported
        self._stderr = _Stderr()
        self._stderr.setFormatter(_OneLine(_LINE, defaults={"role": "aeroloop"}))
        _Listener(self._messages, self._stderr).start()

    @property
    def dropped(self) -> int:
        """Lines that are lost: they found the queue full, or stderr refused them."""
        return self._full + self._stderr.lost

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue a message, after a line with the number of those dropped before it; or drop it."""
        try:
            if self._full > self._reported:
                self._messages.put_nowait(self._notice(self._full - self._reported))
                self._reported = self._full
            self._messages.put_nowait(record)
        except Full:
            self._full += 1

    def flush(self) -> None:
        """Wait until stderr has taken what was logged so far, for `FLUSH_S` at most."""
        written = Event()
        try:
            self._messages.put_nowait(written)
        except Full:
            return
        written.wait(FLUSH_S)

    @staticmethod
    def _notice(count: int) -> logging.LogRecord:
        text = f"{count} lines of this log were dropped: nothing read stderr"
        fields = {"name": "aeroloop", "levelno": logging.WARNING, "levelname": "WARNING", "msg": text}
        return logging.makeLogRecord(fields)


def log_to_stderr() -> None:
    """Have this process log to stderr, from INFO on, by a `StderrLog`; nothing if its log has a handler already."""
    root = logging.getLogger()
    if not root.handlers:
        root.addHandler(StderrLog())
        root.setLevel(logging.INFO)


def flush_log() -> None:
    """Wait until stderr has taken this process's log, for `FLUSH_S` at most: before another line or the end."""
    for handler in logging.getLogger().handlers:
        handler.flush()


def dropped_lines() -> int:
    """Lines of this process's log that were dropped so far."""
    handlers = logging.getLogger().handlers
    return sum(handler.dropped for handler in handlers if isinstance(handler, StderrLog))
