"""Latch file: keeps a plant's trip or stop on disk while it lasts, so that it outlives the plant's process.

A thread of its own writes and removes the file: a disk may take seconds, and neither 0 V nor the loop waits for it.
"""

from __future__ import annotations

import os
import threading
import time
from datetime import UTC, datetime
from errno import EACCES
from pathlib import Path
from typing import Final

from pydantic import AwareDatetime, BaseModel, ValidationError

from aeroloop.protocol.messages.states import TripCause

KEPT_S: Final = 0.5  # so long an operator's answer waits for the disk; `op arm` waits 1 s for its answer
RETRY_S: Final = 5.0  # between attempts where the file cannot be written


class Latch(BaseModel, frozen=True, extra="forbid"):
    """Why a plant refuses claims: `text` has the operator's name, `operator_only` is what clears it."""

    cause: TripCause
    text: str
    operator_only: bool
    since: AwareDatetime


def state_directory() -> Path:
    """Where files are kept if nothing is configured: systemd's state directory, else the user's."""
    if systemd := os.environ.get("STATE_DIRECTORY"):
        return Path(systemd.partition(":")[0])
    if xdg := os.environ.get("XDG_STATE_HOME"):
        return Path(xdg) / "aeroloop"
    return Path("~/.local/state/aeroloop")


class LatchFile:
    """Keeps the latch of one vehicle's plant in a directory; in `state_directory` if it is None.

    `found` is the latch that an earlier process left, or None. A file that cannot be read counts as a stop.
    """

    def __init__(self, directory: Path | None, vehicle: str) -> None:
        try:
            folder = (directory or state_directory()).expanduser().absolute()
        except RuntimeError:  # a user without a home
            folder = Path("/nonexistent/aeroloop")
        self.path = folder / f"{vehicle}.json"
        self.found = self._read()
        self._changed = threading.Condition()
        self._wanted = self._kept = self.found
        self._wanted_at = time.monotonic()
        self._error: str | None = None  # of the last attempt for `_wanted`
        self._attempt(self.found)  # shows from the start whether the directory can be written
        threading.Thread(target=self._run, daemon=True).start()  # no hanging disk keeps the process alive

    def keep(self, latch: Latch | None) -> None:
        """Have this latch on disk from now on, or none; returns at once."""
        with self._changed:
            if latch != self._wanted:
                self._wanted, self._wanted_at, self._error = latch, time.monotonic(), None
                self._changed.notify_all()

    def wait(self) -> None:
        """Wait until the newest latch is on disk or an attempt has failed, for `KEPT_S` at most."""
        with self._changed:
            self._changed.wait_for(lambda: self._wanted == self._kept or self._error is not None, KEPT_S)

    @property
    def unkept(self) -> str | None:
        """Why the newest latch is not on disk; None if it is."""
        with self._changed:
            return None if self._wanted == self._kept else self._error or f"{self.path} is not written yet"

    @property
    def problem(self) -> str | None:
        """Why a latch is not on disk, or another could not be put there; None while the disk has `KEPT_S` for it."""
        waits = time.monotonic() - self._wanted_at < KEPT_S
        return self._error or (None if waits else self.unkept)

    def _run(self) -> None:
        while True:
            with self._changed:
                retry_s = RETRY_S if self._error else None
                self._changed.wait_for(lambda: self._wanted != self._kept and self._error is None, retry_s)
                latch = self._wanted
            self._attempt(latch)

    def _attempt(self, latch: Latch | None) -> None:
        error = None
        try:
            self._store(latch)
        except OSError as failure:
            error = f"{self.path} cannot be written ({failure.strerror}); plant.state_directory names another folder"
        with self._changed:
            self._kept = latch if error is None else self._kept
            self._error = error if latch == self._wanted else self._error
            self._changed.notify_all()

    def _read(self) -> Latch | None:
        try:
            return Latch.model_validate_json(self.path.read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValidationError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is damaged"
            text = f"{self.path} cannot be read ({why}), so the plant may have been stopped: 0 V"
            return Latch(cause=TripCause.OPERATOR, text=text, operator_only=True, since=datetime.now(UTC))

    def _store(self, latch: Latch | None) -> None:
        """Bring the directory to this state. Raises OSError."""
        folder = self.path.parent
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(EACCES, os.strerror(EACCES))
        if latch is None:
            self.path.unlink(missing_ok=True)
        else:
            new = self.path.with_name(f".{self.path.name}")  # a vehicle's name begins with no dot
            with new.open("wb") as file:
                file.write(latch.model_dump_json(indent=2).encode())
                file.flush()
                os.fsync(file.fileno())
            new.replace(self.path)
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
