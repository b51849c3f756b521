"""Test double of CAN adapters on serial ports: pseudo-terminals with the slcan protocol, all on one bus.

A frame written to an open port goes to all other open ports, as on a bus, and is acknowledged. There is no arbitration,
no bit rate and no error frame, and a frame takes no time. A port with a slow reader loses whole frames, never parts.
A port can be unplugged and plugged in again under the same path: the path is a link to a pseudo-terminal with another
name each time, as with /dev/serial/by-id.
"""

from __future__ import annotations

import os
import pty
import re
import select
import threading
import tty
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

MOST_WAITING: Final = 64 * 1024
"""Bytes kept for a reader that does not keep up; pseudo-terminals themselves hold 4 KiB."""

FRAME: Final = re.compile(
    rb"(?:[tdb][0-7][0-9A-F]{2}|[TDB][01][0-9A-F]{7})([0-9A-F])((?:[0-9A-F]{2})*)"  # id, length code, data
    rb"|r[0-7][0-9A-F]{2}[0-8]"
)
LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
SETTING: Final = re.compile(rb"S[0-9]|s[0-9A-F]{4,}|Y[0-9]|")
OK: Final = b"\r"
ERROR: Final = b"\a"


class _Port:
    def __init__(self, path: Path) -> None:
        self.near, self.far = pty.openpty()  # we hold both ends: one that is not opened must not look hung up
        tty.setraw(self.far)
        os.set_blocking(self.near, False)
        self.path = path
        self.is_open = False
        self.unread = b""
        self.unsent = b""
        path.symlink_to(os.ttyname(self.far))

    def close(self) -> None:
        self.path.unlink()
        os.close(self.near)
        os.close(self.far)

    def lines(self) -> list[bytes]:
        """What was said since, whole lines only."""
        with suppress(BlockingIOError):
            self.unread += os.read(self.near, 65536)
        *lines, self.unread = self.unread.split(b"\r")
        return lines

    def say(self, line: bytes) -> None:
        """Give the reader something; dropped if it is far behind."""
        if len(self.unsent) < MOST_WAITING:
            self.unsent += line
            self.flush()

    def flush(self) -> None:
        with suppress(BlockingIOError):
            self.unsent = self.unsent[os.write(self.near, self.unsent) :]


class SlcanAdapter:
    """Serial ports on one bus. A context; a thread of its own does the work.

    Args:
        folder: Where the ports are.
        names: What they are called there.

    Attributes:
        frames: Frames that crossed so far, as slcan writes them.
    """

    def __init__(self, folder: Path, *names: str) -> None:
        self._folder = folder
        self._ports: dict[str, _Port] = {}
        self._lock = threading.Lock()
        self._stopped = False
        self._wake_reader, self._wake_writer = os.pipe()
        self.frames: list[bytes] = []
        for name in names:
            self.plug(name)
        self._thread = threading.Thread(target=self._run, name="slcan", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped = True
        os.write(self._wake_writer, b"x")
        self._thread.join()
        for name in list(self._ports):
            self.unplug(name)
        os.close(self._wake_reader)
        os.close(self._wake_writer)

    def path(self, name: str) -> str:
        """What to open."""
        return str(self._folder / name)

    def plug(self, name: str) -> None:
        """Plug a port in."""
        with self._lock:
            self._ports[name] = _Port(self._folder / name)
        os.write(self._wake_writer, b"x")

    def unplug(self, name: str) -> None:
        """Pull a port out: a process that has it open gets an error, and the path is gone."""
        with self._lock:
            self._ports.pop(name).close()

    def _run(self) -> None:
        while not self._stopped:
            with self._lock:
                reading = [port.near for port in self._ports.values()]
                writing = [port.near for port in self._ports.values() if port.unsent]
            with suppress(OSError, ValueError):  # one that is pulled out just now
                select.select([self._wake_reader, *reading], writing, [], 0.1)
            with self._lock:
                if select.select([self._wake_reader], [], [], 0)[0]:
                    os.read(self._wake_reader, 4096)
                for port in self._ports.values():
                    if port.unsent:
                        port.flush()
                    for line in port.lines():
                        port.say(self._answer(port, line))

    def _answer(self, port: _Port, line: bytes) -> bytes:
        """Do what a line says, and say what the adapter answers."""
        if line in (b"O", b"C"):
            port.is_open = line == b"O"
            return OK
        if SETTING.fullmatch(line):  # an empty line is one of them: python-can sends it for "no data bit rate"
            return ERROR if port.is_open and line else OK
        frame = FRAME.fullmatch(line)
        if frame is None or not port.is_open:
            return ERROR
        if frame[1] is not None:
            dlc = int(frame[1], 16)
            if len(frame[2]) != 2 * LENGTHS[dlc] or (dlc > 8 and line[:1] in b"tT"):
                return ERROR
        self.frames.append(line)
        for other in self._ports.values():
            if other is not port and other.is_open:
                other.say(line + OK)
        return (b"Z" if line[:1].isupper() else b"z") + OK
