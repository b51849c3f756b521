"""Commands as a user types them, and what tests of real processes share."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

AEROLOOP: Final = [sys.executable, "-P", "-m", "aeroloop"]

PATIENT: Final = {"plant.watchdog_s": 2, "controller.stale_s": 2, "wire.counter_bits": 12}
"""For what does not try the watchdog: a machine that stalls for over 100 ms must not end a session meant to go on."""

LONGEST_S: Final = 120.0  # for a command that takes up to 10 s here; CI may have other work


def aeroloop(*words: str, code: int | None = 0, cwd: Path | None = None) -> str:
    """Run a command, which must end with this code; returns its stdout, or its stderr if the code is not 0.

    None for any code.
    """
    done = subprocess.run([*AEROLOOP, *words], cwd=cwd, capture_output=True, text=True, check=False, timeout=LONGEST_S)
    assert code in (None, done.returncode), done.stdout + done.stderr
    return done.stderr if code else done.stdout
