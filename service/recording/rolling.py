"""Rolling log: the MCAP files of a run, one after another, on a disk that may be full.

Messages are collected in a chunk in memory; a closed chunk is compressed and written whole, or kept for the next try. A
file is closed at a size or an age. The next one begins with the descriptions, which a reader of it alone needs. When
the disk refuses, nothing is dropped here: `trouble` says why, the caller keeps its messages, and `tend` tries again
every second: on a full disk in the same file, after any other error in a new one.
"""

from __future__ import annotations

import errno
import json
import os
import re
import struct
import time
import uuid
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Final

from mcap.exceptions import McapError
from mcap.records import Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.runtime.host import versions
from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.logs.mcap_file import CHUNK_BYTES, DESCRIPTION_METADATA, RECORDER_METADATA, with_checksum
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.schemas import Decoded, Shape, json_shape

CHUNK_S: Final = 1.0  # a chunk is written this often: the most that a crash or a power cut costs
MAX_FILE_S: Final = 3600.0  # a new file begins after this time: what a viewer opens at once
RETRY_S: Final = 1.0
REMIND_S: Final = 60.0  # how often a fault that lasts is reported again
FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_BY_TIME: Final = "aeroloop-%Y%m%d-%H%M%S.mcap"
_TRACE: Final = Shape(
    "aeroloop.Trace",
    "x-aeroloop-trace",
    b"batch of rows: section 10 of the attachment protocol/SPEC.md; its frames by the plant's description",
    "x-aeroloop-trace",
)


class RecorderError(AeroloopError):
    """The log cannot be written; one line with the reason and the remedy."""


def parts(path: Path) -> list[Path]:
    """The files of the run that began with this one, in order."""
    numbered = re.compile(re.escape(path.stem) + r"-\d{4,}\.mcap")
    followed = sorted(other for other in path.parent.glob("*.mcap") if numbered.fullmatch(other.name))
    return [path, *followed] if path.exists() else followed


def log_path(place: Path, named: str) -> Path:
    """The new log at a place: the place itself, or a file in it, named by the time, if it is a folder.

    A folder exists as one, or its name has no ending.
    """
    if place.suffix and not place.is_dir():
        return place
    return place / datetime.now().strftime(named)


class LogFile:
    """A new MCAP file, with a channel per key. Raises OSError if it exists already or cannot be created.

    It is the stream that its own writer writes to; `size` is its bytes on the disk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()  # closed chunks and other records that are not yet on the disk
        self._channels: dict[str, int] = {}
        self._schemas: dict[Shape | None, int] = {None: 0}
        self._writer = Writer(self, chunk_size=CHUNK_BYTES, enable_data_crcs=True)  # type: ignore[arg-type]  # a stream
        self._writer.start(profile="aeroloop", library=f"aeroloop {versions()['aeroloop']}")

    def write(self, data: bytes) -> int:
        """Add bytes to those that `flush` writes."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Where the next bytes will stand."""
        return self.size + len(self._pending)

    def flush(self) -> None:
        """Write the pending bytes through to the disk, or leave the file as it was and raise OSError."""
        try:
            with memoryview(self._pending) as pending:
                written = 0
                while written < len(pending):
                    written += os.pwrite(self._file.fileno(), pending[written:], self.size + written)
            os.fdatasync(self._file.fileno())
        except OSError:
            with suppress(OSError):
                self._file.truncate(self.size)
            raise
        self.size += len(self._pending)
        self._pending.clear()

    def add(self, received: Delivery, at_ns: int, decoded: Iterable[Decoded] = ()) -> bool:
        """Add a message that was received at `at_ns` [ns since 1970], and its decoded ones, each at its own time.

        Returns:
            Whether a chunk is full and waits for `commit`.
        """
        if (channel := self._channels.get(received.key)) is None:
            topic = address.topic if (address := topics.read_key(received.key)) else None
            shape = json_shape(topic.model) if topic and topic.model else None
            channel = self._channel(received.key, _TRACE if topic and topic.kind == "trace" else shape)
        number = received.number & 0xFFFF_FFFF
        self._writer.add_message(channel, at_ns, received.payload, received.published_ns, number)
        for one in decoded:
            self._writer.add_message(self._channel(one.topic, one.shape), one.at_ns, one.data, one.at_ns)
        return len(self._pending) > 0

    def _channel(self, topic: str, shape: Shape | None) -> int:
        if topic not in self._channels:
            if shape is not None and shape not in self._schemas:
                self._schemas[shape] = self._writer.register_schema(shape.name, shape.encoding, shape.schema)
            encoding = shape.message_encoding if shape else "application/octet-stream"
            self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[shape])
        return self._channels[topic]

    def add_metadata(self, name: str, **entries: str) -> None:
        """Add a metadata record, under a checksum."""
        self._writer.add_metadata(name, with_checksum(name, entries))

    def add_description(self, key: str, payload: bytes) -> None:
        """Add a role's last description as metadata."""
        self.add_metadata(DESCRIPTION_METADATA, key=key, json=payload.decode())

    def attach(self, name: str, kind: str, data: bytes, at_ns: int) -> None:
        """Attach a file of a media type."""
        self._writer.add_attachment(at_ns, at_ns, name, kind, data)

    @property
    def removed(self) -> bool:
        """Whether the file has no name any more, or is closed."""
        return self._file.closed or os.fstat(self._file.fileno()).st_nlink == 0

    def commit(self) -> None:
        """Close the chunk and write it. Raises OSError; then it is written with the next."""
        self._writer.flush()

    def end(self) -> None:
        """Write the last chunk and the index, and close the file. After an OSError only `close` is allowed."""
        self._writer.finish()
        self.flush()
        self.close()

    def close(self) -> None:
        """Close the file as it is on the disk; drop what is not written."""
        self._file.close()


class RollingLog:
    """A log in files. Raises RecorderError if the first cannot be created.

    `report` is called with one line on the state of the disk, and whether it is a fault. `written` counts messages,
    `trouble` is why nothing can be written now; empty if it can. `clock` is monotonic [s].
    """

    def __init__(
        self,
        settings: RecorderSettings,
        report: Callable[[str, bool], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings, self.written, self.trouble = settings, 0, ""
        self._report, self._clock = report, clock
        self._id = uuid.uuid4().hex
        self._base = log_path(settings.path, _BY_TIME)
        self._ours = re.escape(self._base.stem) if self._base == settings.path else r"aeroloop-\d{8}-\d{6}"
        self._descriptions: dict[str, bytes] = {}
        self._unwritten: list[tuple[Delivery, int, list[Decoded]]] = []  # in the open chunk
        self._parts = 0  # numbers that were used: none is used twice, even if its file is removed
        self._due = self._remind_due = self._begun = 0.0
        self._broken = False  # whether the file cannot be used any more
        try:
            self._base.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._begin()
        except OSError as error:
            raise RecorderError(
                f"cannot write the log {self._base}: {error.strerror}; name another with --log PATH"
            ) from None
        self._remove_oldest()

    @property
    def path(self) -> Path:
        """The current file."""
        return self._file.path

    def add(self, received: Delivery, at_ns: int, decoded: list[Decoded]) -> None:
        """Add a message received at `at_ns` [ns since 1970] and its decoded ones; only without `trouble`."""
        self._unwritten.append((received, at_ns, decoded))
        self.written += 1
        if self._file.add(received, at_ns, decoded):
            self._write()

    def add_description(self, key: str, payload: bytes) -> None:
        """Put a role's description into this file and all later ones."""
        if self._descriptions.get(key) != payload:
            self._descriptions[key] = payload
            self._file.add_description(key, payload)

    def tend(self, *, at_once: bool = False) -> None:
        """Do what is due: write the chunk, retry the disk, begin a new file. If `at_once`, retry before it is due."""
        now = self._clock()
        if now >= self._due or (at_once and self.trouble):
            self._due = now + CHUNK_S
            self._write()

    def close(self, waiting: int = 0) -> None:
        """Write the rest and the index, and close the file; `waiting` messages were not added: the disk refused.

        Raises:
            RecorderError: Not all could be written; all written before is whole.
        """
        try:
            if self._file.removed:
                self._next_file()
            self._file.commit()
            self._unwritten.clear()
            self._end(self._file)
        except OSError as error:
            self._file.close()
            lost = waiting + len(self._unwritten)
            what = f"{lost} messages and the index" if lost else "the index"
            raise RecorderError(
                f"{what} of {self.path} could not be written: {error.strerror}; "
                "what came before is whole, and `aeroloop log export --format mcap` gives it an index"
            ) from None
        if waiting:
            raise RecorderError(f"{waiting} messages could not be written: {self.trouble}")

    def _write(self) -> None:
        """Write the chunk, into a new file if this one is removed or broken; begin the next file if that is due."""
        now, last, gone = self._clock(), self.path, self._file.removed
        try:
            if gone or self._broken:
                self._next_file()
            else:
                self._file.commit()
                self._unwritten.clear()
        except OSError as error:
            self._due = now + RETRY_S
            self._broken |= error.errno not in FULL
            if not self.trouble or now >= self._remind_due:
                self.trouble = f"{last} cannot be written: {error.strerror}"
                self._remind(f"{self.trouble}; messages are kept in memory and written when it can be")
            return
        if self.trouble:
            self.trouble, self._broken = "", False
            self._report(f"recording again to {self.path}", False)
        elif gone:
            self._report(f"{last} was removed while it was written", True)
        if self._file.size >= self.settings.max_file_mb * 1e6 or now - self._begun >= MAX_FILE_S:
            try:
                self._next_file()
            except OSError as error:
                if now >= self._remind_due:  # a file that is too large is better than none
                    self._remind(f"no new file can be begun ({error.strerror}), so {last} goes on")

    def _remind(self, text: str) -> None:
        self._remind_due = self._clock() + REMIND_S
        self._report(text, True)

    def _next_file(self) -> None:
        """Begin a new file with what is unwritten, and close the last one. Raises OSError if none can be begun."""
        last = self._file
        if last.removed:
            last.close()  # while it is open, it takes its room from a disk that may be full
        self._file = self._begin()
        self._unwritten.clear()
        try:
            if not last.removed:
                self._end(last)
        except OSError as error:
            last.close()
            what = f"the index of {last.path} could not be written: {error.strerror}"
            self._report(f"{what}; `aeroloop log export --format mcap` gives it one", True)
        self._remove_oldest()

    def _end(self, file: LogFile) -> None:
        """Put the descriptions at the file's end, too, as a damaged copy must not cost the log, and close it."""
        for key, description in self._descriptions.items():
            file.add_description(key, description)
        file.end()

    def _begin(self) -> LogFile:
        """Create a file under the next unused name; write its head and what is unwritten. Raises OSError."""
        path, part = self._base, 0
        while part < self._parts or path.exists():
            part += 1
            path = self._base.with_stem(f"{self._base.stem}-{part:04}")
        file = LogFile(path)
        try:
            now, text = datetime.now(UTC), files("aeroloop.protocol").joinpath("SPEC.md").read_bytes()
            started = now.isoformat(timespec="seconds")
            run = {"run": self._base.stem, "id": self._id, "part": path.stem, "started": started}
            file.add_metadata(RECORDER_METADATA, json=json.dumps(run))
            file.attach("protocol/SPEC.md", "text/markdown", text, round(now.timestamp() * 1e9))  # to read frames by
            for key, description in self._descriptions.items():
                file.add_description(key, description)
            for entry in self._unwritten:
                file.add(*entry)
            file.commit()
        except OSError:
            file.close()
            with suppress(OSError):
                path.unlink()
            raise
        self._begun, self._parts = self._clock(), part + 1
        return file

    def _remove_oldest(self) -> None:
        """Remove the oldest files while all together are too large; never the current one, nor another's."""
        if (keep_gb := self.settings.keep_gb) is None:
            return
        with suppress(OSError):  # a file is gone; the others are removed next time
            others = [path for path in self._base.parent.glob("*.mcap") if path != self.path and self._is_own(path)]
            sizes = {path: path.stat().st_size for path in sorted(others, key=lambda path: path.stat().st_mtime_ns)}
            excess = self._file.size + sum(sizes.values()) - keep_gb * 1e9
            for path, size in sizes.items():
                if excess <= 0:
                    return
                with suppress(OSError):
                    path.unlink()
                    excess -= size
                    self._report(f"removed {path}, the oldest, to keep logs under {keep_gb:g} GB", False)

    def _is_own(self, path: Path) -> bool:
        """Whether a file's metadata name this run or, if runs are named by the time, any run so named."""
        foreign = (OSError, McapError, struct.error, ValueError, KeyError, TypeError, RecursionError)
        with suppress(*foreign), path.open("rb") as file:
            _, head = islice(StreamReader(file, record_size_limit=1 << 20).records, 2)
            if isinstance(head, Metadata) and head.name == RECORDER_METADATA:
                run = json.loads(head.metadata["json"])
                return run["part"] == path.stem and re.fullmatch(self._ours, run["run"]) is not None
        return False
