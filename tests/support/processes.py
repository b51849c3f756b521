"""Commands as a user types them, and what tests of real processes share."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

AEROLOOP: Final = [sys.executable, "-P", "-m", "aeroloop"]

PATIENT: Final = {"plant.watchdog_s": 2, "controller.stale_s": 2, "wire.counter_bits": 12}
"""For what does not try the watchdog: a machine that stalls for over 100 ms must not end a session meant to go on."""

LONGEST_S: Final = 120.0  # for a command that takes up to 10 s here; CI may have other work


def sessions() -> dict[int, int]:
    """The session of each process by its id, but for those that have ended and that nothing has waited for."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has just ended
            state, _, _, session, *_ = path.read_text().rsplit(")", 1)[1].split()
            if state != "Z":
                found[int(path.parent.name)] = int(session)
    return found


def aeroloop(*words: str, code: int | None = 0, cwd: Path | None = None) -> str:
    """Run a command, which must end with this code; returns its stdout, or its stderr if the code is not 0.

    None for any code.
    """
    done = subprocess.run([*AEROLOOP, *words], cwd=cwd, capture_output=True, text=True, check=False, timeout=LONGEST_S)
    assert code in (None, done.returncode), done.stdout + done.stderr
    return done.stderr if code else done.stdout


class FullPipe:
    """A pipe that nobody reads, and that takes no further byte: a stuck stderr. A context.

    `write_end` is for the process under test. `read_lines` reads it, once the test has closed its own `write_end`.
    """

    def __init__(self) -> None:
        self._read_end, self.write_end = os.pipe()
        os.set_blocking(self.write_end, False)
        self._filled = 0
        with suppress(BlockingIOError):
            while True:
                self._filled += os.write(self.write_end, b"\n")
        os.set_blocking(self.write_end, True)
        self._rest = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._read_end)
        self.close_write_end()

    def close_write_end(self) -> None:
        if self.write_end >= 0:
            os.close(self.write_end)
            self.write_end = -1

    def read_lines(self, count: int) -> list[str]:
        """The next lines that the process has written, after those that filled the pipe."""
        while self._filled:
            self._filled -= len(os.read(self._read_end, self._filled))
        lines: list[str] = []
        while len(lines) < count:
            line, found, rest = self._rest.partition(b"\n")
            if found:
                lines.append(line.decode())
                self._rest = rest
            else:
                self._rest += os.read(self._read_end, 65_536)
        return lines
