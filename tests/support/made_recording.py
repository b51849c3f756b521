"""Recording without network and clock: a session's messages, a RollingLog, a disk that fails on request.

The fixtures are in conftest.py.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.reader import make_reader

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.recording import log_file as writer
from aeroloop.service.recording import rolling
from aeroloop.service.recording.rolling import RollingLog
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.channels import Decoder
from aeroloop.service.viewers.schemas import Decoded

TICK_S = 0.002
EVERYTHING = 1 << 60


class Arrived(NamedTuple):
    """A message, and when it was received [ns since 1970]."""

    received: Delivery
    at_ns: int


class EventLog(NamedTuple):
    """A session's messages as they were received, its description, and what its controller follows, in order."""

    key: str
    description: bytes
    messages: list[Arrived]
    changes: list[Change]


class Clock:
    """What `time.monotonic()` says, in s."""

    def __init__(self) -> None:
        self.now = 1000.0


class Disk:
    """Where files are written, which fails on request.

    Attributes:
        room: Bytes that a file can hold.
        at_once: Bytes that one call writes at the most.
        broken: An error that every write gives; 0: none.
        new_files: An error that a new file gives; 0: none.
        changes: Called before each write with where in its file it goes, to change any of these.
        writes: How often something was to be written.
    """

    def __init__(self) -> None:
        self.room = self.at_once = EVERYTHING
        self.broken = self.new_files = self.writes = 0
        self.changes: Callable[[int], None] = lambda _: None

    def write(self, fd: int, data: memoryview, offset: int) -> int:
        self.writes += 1
        self.changes(offset)
        if self.broken:
            raise OSError(self.broken, os.strerror(self.broken))
        size = min(len(data), self.at_once, self.room - offset)
        if size <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._write(fd, data[:size], offset)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._write = os.pwrite
        make = writer.LogFile

        def made(path: Path) -> writer.LogFile:
            if self.new_files:
                raise OSError(self.new_files, os.strerror(self.new_files))
            return make(path)

        monkeypatch.setattr(os, "pwrite", self.write)
        monkeypatch.setattr(os, "fdatasync", lambda _: None)
        monkeypatch.setattr(rolling, "LogFile", made)


class Recording:
    """A RollingLog, fed as the recorder feeds it: what the disk refuses waits, and a message takes a millisecond.

    Attributes:
        reported: What it reported, and whether it was bad news.
    """

    def __init__(self, clock: Clock, story: EventLog, **settings: object) -> None:
        self.reported: list[tuple[str, bool]] = []
        self._clock = clock
        self.waiting: list[Arrived] = []
        self.log = RollingLog(
            RecorderSettings.model_validate(settings), lambda *reported: self.reported.append(reported)
        )
        self.log.add_description(story.key, story.description)
        self._decoder = Decoder(25.0)
        self._decoder.configure(Description.model_validate_json(story.description))

    def take(self, messages: list[Arrived]) -> None:
        for arrived in messages:
            self.waiting.append(arrived)
            while self.waiting and self.log.writable:
                self._add(self.waiting.pop(0))
            self._clock.now += TICK_S / 2
            self.log.tend()

    def _add(self, arrived: Arrived) -> None:
        received, at_ns = arrived
        address = topics.read_key(received.key)
        assert address is not None
        decoded: list[Decoded] = self._decoder.take(address, received.payload, received.published_ns or at_ns)
        self.log.add(received, at_ns, decoded)

    def wait(self, seconds: float) -> None:
        """Nothing comes for so long."""
        self._clock.now += seconds
        self.take([])
        self.log.tend()
        while self.waiting and self.log.writable:
            self._add(self.waiting.pop(0))

    def reported_bad(self) -> list[str]:
        return [text for text, bad in self.reported if bad]


def in_order(folder: Path) -> list[Path]:
    """The files of a run, by their numbers."""
    return sorted(folder.glob("*.mcap"), key=lambda path: (len(path.stem), path.stem))


def raw(path: Path) -> Iterator[tuple[str, int, int, int, bytes]]:
    """Raw messages by mcap's own reader, which wants the index; checksums checked."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if not channel.topic.startswith("/"):
                yield channel.topic, message.sequence, message.log_time, message.publish_time, message.data


def decoded_count(paths: list[Path]) -> int:
    count = 0
    for path in paths:
        with path.open("rb") as file:
            count += sum(channel.topic.startswith("/") for _, channel, _ in make_reader(file).iter_messages())
    return count


def numbered(messages: list[Arrived]) -> list[tuple[str, int, int, int, bytes]]:
    """Messages as they must stand in the log: by their publishers' numbers, in order of their log times."""
    found = [
        (received.key, received.number, at_ns, received.published_ns or at_ns, received.payload)
        for received, at_ns in messages
    ]
    return sorted(found, key=lambda one: one[2])


def every_message(paths: list[Path]) -> list[tuple[str, int, int, int, bytes]]:
    return sorted((one for path in paths for one in raw(path)), key=lambda one: one[2])
