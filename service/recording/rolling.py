"""The files of a run, one after another, on a disk that may be full.

A file is closed when it is large or old enough. The next one begins with what it needs to be read alone: descriptions
and what the sessions' controllers follow. When the disk refuses, nothing is thrown away here: `writable` turns false,
the caller keeps its messages, and `tend` tries again every second. A disk that is only full is tried with the same
file; one that has gone away, with a new file.
"""

from __future__ import annotations

import errno
import json
import re
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.transport.publication import Delivery
from aeroloop.service.logs.mcap_file import CHANGE_METADATA, CONTRACT_METADATA, RECORDER_METADATA, opening
from aeroloop.service.recording.log_file import LogFile
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.channels import Decoded

RETRY_S: Final = 1.0
FULL: Final = (errno.ENOSPC, errno.EDQUOT)
LOOK_S: Final = 1.0
"""How often to look whether the file is still there."""


class RecorderError(AeroloopError):
    """The log cannot be written; one line that says why and what to do."""


def parts(path: Path) -> list[Path]:
    """The files of a run that began with this one, in their order."""
    numbered = re.compile(re.escape(path.stem) + r"-\d{4,}\.mcap")
    followed = sorted(other for other in path.parent.glob("*.mcap") if numbered.fullmatch(other.name))
    return [path, *followed] if path.exists() else followed


class _Entry(NamedTuple):
    received: Delivery
    at_ns: int
    decoded: list[Decoded]


class RollingLog:
    """A log in files.

    Args:
        settings: Where, and how large files may grow.
        tell: Given one line about what has become of the disk, and whether it is bad news.

    Attributes:
        written: Messages added so far.
        trouble: Why nothing can be written now; empty if it can.

    Raises:
        RecorderError: The first file cannot be made.
    """

    def __init__(self, settings: RecorderSettings, tell: Callable[[str, bool], None]) -> None:
        self.settings = settings
        self.written = 0
        self.trouble = ""
        self._tell = tell
        self._base = settings.path or settings.directory / datetime.now().strftime("aeroloop-%Y%m%d-%H%M%S.mcap")
        self._descriptions: dict[str, bytes] = {}
        self._changes: dict[str, list[Change]] = {}  # of the last session of each key
        self._unwritten: list[_Entry] = []
        self._part = 0  # of the next file
        self._began = 0.0
        self._due = self._look_due = self._retry_due = 0.0
        try:
            self._base.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._begin()
        except OSError as error:
            raise RecorderError(
                f"cannot write the log {self._base}: {error.strerror}; name another with --log PATH"
            ) from None
        self._forget()

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._file.path

    @property
    def writable(self) -> bool:
        """Whether messages can be added."""
        return not self.trouble

    def add(self, received: Delivery, at_ns: int, decoded: list[Decoded]) -> None:
        """Add a message, when it was received [ns since 1970], and what was made of it; only while `writable`."""
        entry = _Entry(received, at_ns, decoded)
        self._unwritten.append(entry)
        self.written += 1
        self._put(self._file, entry)
        if self._file.full:
            self._commit()

    def add_description(self, key: str, payload: bytes) -> None:
        """Put a role's description into this file and all that follow."""
        if self._descriptions.get(key) != payload:
            self._descriptions[key] = payload
            self._file.add_metadata(CONTRACT_METADATA, {"key": key, "json": payload.decode()})

    def add_change(self, key: str, change: Change) -> None:
        """Remember what a controller follows, for the files that follow; as part of a trace it is added as any other.

        Args:
            key: Of the trace.
            change: Out of its tail.
        """
        known = self._changes.get(key)
        if known is None or known[0].session != change.session:
            known = self._changes[key] = []
        known.append(change)

    def tend(self) -> None:
        """Do what is due: close a chunk, begin a new file, try a disk again."""
        now = time.monotonic()
        if self.trouble:
            if now >= self._retry_due:
                self._retry()
        elif now >= self._due:
            self._due = now + self.settings.chunk_s
            self._commit()
            if not self.trouble and now >= self._look_due:
                self._look_due = now + LOOK_S
                self._turn_when_due(now)

    def try_again(self) -> None:
        """Try a disk that has refused, though it is not yet due."""
        if self.trouble:
            self._retry()

    def close(self, waiting: int = 0) -> None:
        """Write what there is, with the index, and close the file.

        Args:
            waiting: Messages that were not added because the disk refused.

        Raises:
            RecorderError: Not all could be written; what had been written before is whole.
        """
        try:
            self._file.commit()
            self._unwritten.clear()
            self._file.end()
        except OSError as error:
            self._file.abandon()
            lost = waiting + len(self._unwritten)
            what = f"{lost} messages and the index" if lost else "the index"
            raise RecorderError(
                f"{what} of {self.path} could not be written: {error.strerror}; "
                "what came before is whole, and `aeroloop log recover` gives it an index"
            ) from None
        if waiting:
            raise RecorderError(f"{waiting} messages could not be written: {self.trouble}")

    @staticmethod
    def _put(file: LogFile, entry: _Entry) -> None:
        file.add(entry.received, entry.at_ns)
        for decoded in entry.decoded:
            file.add_decoded(decoded)

    def _commit(self) -> None:
        try:
            self._file.commit()
            self._unwritten.clear()
        except OSError as error:
            self._refused(error)

    def _refused(self, error: OSError) -> None:
        self._retry_due = time.monotonic() + RETRY_S
        if not self.trouble:
            self.trouble = f"{self.path} cannot be written: {error.strerror}"
            self._tell(f"{self.trouble}; messages are kept in memory and written when it can be", True)

    def _retry(self) -> None:
        """Write what is pending into the same file, or, where that is gone for good, into a new one."""
        try:
            try:
                self._file.commit()
            except OSError as error:
                if error.errno in FULL:
                    raise
                self._begin_again()
        except OSError as error:
            self._refused(error)
            return
        self._unwritten.clear()
        self.trouble = ""
        self._tell(f"recording again to {self.path}", False)

    def _begin_again(self) -> None:
        """A new file with what the last one has not got to the disk."""
        file = self._begin()
        try:
            for entry in self._unwritten:
                self._put(file, entry)
            file.commit()
        except OSError:
            file.remove()
            raise
        self._file.abandon()
        self._file = file

    def _turn_when_due(self, now: float) -> None:
        settings = self.settings
        if self._file.replaced:
            self._tell(f"{self.path} was moved or removed while it was written", True)
        elif self._file.size < settings.max_file_mb * 1e6 and now - self._began < settings.max_file_s:
            return
        last = self._file
        try:
            self._file = self._begin()
        except OSError as error:  # better too large a file than none
            self._began = now
            self._tell(f"no new file can be begun ({error.strerror}), so {self.path} goes on", True)
            return
        try:
            last.end()
        except OSError as error:
            last.abandon()
            self._tell(
                f"the index of {last.path} could not be written: {error.strerror}; `aeroloop log recover` gives it one",
                True,
            )
        self._forget()

    def _begin(self) -> LogFile:
        """The next file that does not exist yet, with its header on the disk. Raises OSError."""
        path = self._next_path()
        file = LogFile(path)
        try:
            started = datetime.now(UTC)
            told = {"run": self._base.stem, "part": path.stem, "started": started.isoformat(timespec="seconds")}
            file.add_metadata(RECORDER_METADATA, {"json": json.dumps(told)})
            file.attach_specification(round(started.timestamp() * 1e9))
            for key, description in self._descriptions.items():
                file.add_metadata(CONTRACT_METADATA, {"key": key, "json": description.decode()})
            for key, changes in self._changes.items():
                for change in changes:
                    file.add_metadata(CHANGE_METADATA, {"key": key, "json": change.model_dump_json()})
            file.commit()
        except OSError:
            file.remove()
            raise
        self._began = time.monotonic()
        self._part += 1  # even if somebody removes the file: a run uses no number twice
        return file

    def _next_path(self) -> Path:
        """The next name that nobody has; the base's own comes first."""
        while True:
            part = self._part
            path = self._base.with_stem(f"{self._base.stem}-{part:04}") if part else self._base
            if not path.exists():
                return path
            self._part += 1

    def _forget(self) -> None:
        """Remove the oldest files while all together are too large; never the one that is written."""
        if self.settings.keep_gb is None:
            return
        found = []
        for path in self._base.parent.glob("*.mcap"):
            if path != self.path and self._is_own(path):
                with suppress(OSError):
                    stat = path.stat()
                    found.append((stat.st_mtime_ns, stat.st_size, path))
        room = self.settings.keep_gb * 1e9 - self._file.size - sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if room >= 0:
                return
            with suppress(OSError):
                path.unlink()
                room += size
                self._tell(f"removed {path}, the oldest, to keep logs under {self.settings.keep_gb:g} GB", False)

    def _is_own(self, path: Path) -> bool:
        """Whether a file says of itself that it is of this run, or, if we name ours by the time, of another such."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            head = opening(path)
            if head is not None and head.name == RECORDER_METADATA:
                said = json.loads(head.metadata["json"])
                runs = re.escape(self._base.stem) if self.settings.path else r"aeroloop-\d{8}-\d{6}"
                return said["part"] == path.stem and re.fullmatch(runs, said["run"]) is not None
        return False
