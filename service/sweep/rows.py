"""Rows of a sweep, one an experiment, in a file of JSON lines that only grows.

A row is named by configuration, seed and version, so a sweep that was interrupted, or that gets more values, seeds or
axes, runs what is missing. A line that a crash cut off is dropped, and its experiment runs again.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.figures import Figures

_HEAD: Final = b'{"aeroloop": "sweep", "layout": 2}\n'


class SweepError(AeroloopError):
    """A sweep cannot begin or go on; one line with the reason."""


class Key(NamedTuple):
    """Name of a row: two rows with the same are the same, to the last bit."""

    configuration: str  # SHA-256 of what the experiment depends on, but for the seed
    seed: int
    version: str  # of aeroloop, and what it computes: `sentinel.fingerprint`


class Measured(NamedTuple):
    """What an experiment gave, by the names of `Figures`; without figures, the reason."""

    z_track: float | None = None
    u_total: float | None = None
    max_error_deg: float | None = None
    final_error_deg: float | None = None
    second_half_error_deg: float | None = None
    command_changes_per_s: float | None = None
    skipped_ticks: int | None = None
    measurement_frames_per_s: float | None = None
    measurement_bits_per_s: float | None = None
    command_frames_per_s: float | None = None
    command_bits_per_s: float | None = None
    reason: str | None = None


def measured(found: Figures | str) -> Measured:
    """What stands in a row of figures, or of the reason why there are none."""
    if isinstance(found, str):
        return Measured(reason=found)
    of_streams = {
        f"{name}_{figure}": getattr(getattr(found, name), figure)
        for name in ("measurement", "command")
        for figure in ("frames_per_s", "bits_per_s")
    }
    return Measured(**{name: getattr(found, name) for name in _OF_FIGURES}, **of_streams)


_OF_FIGURES: Final = [name for name in Measured._fields if name in Figures.model_fields]


class Rows:
    """The rows of a file, which is made if there is none. A context, in which no other sweep can use the file.

    Raises:
        SweepError: The file holds something else, is in use, or cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = path.open("a+b", buffering=0)
        except OSError as error:
            raise SweepError(f"{path} cannot be used: {error.strerror}") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.found = self._read()
        except BlockingIOError:
            self._file.close()
            raise SweepError(f"{path} is in use by another sweep") from None
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _read(self) -> dict[Key, Measured]:
        self._file.seek(0)
        text = self._file.read()
        if not text.endswith(b"\n"):  # cut off while it was written
            whole = text.rfind(b"\n") + 1
            if not (_HEAD.startswith(text) or text.startswith(_HEAD)):
                raise SweepError(f"{self._path} does not hold a sweep: name another file")
            os.ftruncate(self._file.fileno(), whole)
            text = text[:whole]
        if not text:
            self._file.write(_HEAD)
            return {}
        if not text.startswith(_HEAD):
            raise SweepError(f"{self._path} does not hold a sweep: name another file")
        return dict(self._parsed(text.splitlines()[1:]))

    def _parsed(self, lines: Iterable[bytes]) -> Iterator[tuple[Key, Measured]]:
        for number, line in enumerate(lines, 2):
            try:
                row: dict[str, Any] = json.loads(line)
                yield Key(*(row.pop(name) for name in Key._fields)), Measured(**row)
            except (ValueError, KeyError, TypeError, AttributeError):
                raise SweepError(f"{self._path}, line {number}, is no row of a sweep: remove it to go on") from None

    def append(self, rows: Iterable[tuple[Key, Measured]]) -> None:
        """Add rows, to the file in one write. Raises SweepError if the disk does not take them."""
        new = dict(rows)
        lines = b"".join(json.dumps(key._asdict() | row._asdict()).encode() + b"\n" for key, row in new.items())
        try:
            whole = self._file.write(lines) == len(lines)
        except OSError as error:
            raise SweepError(f"{self._path} cannot be written: {error.strerror}") from None
        if not whole:
            raise SweepError(f"{self._path} cannot be written: the disk is full")
        self.found |= new
