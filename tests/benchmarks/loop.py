"""The loop in real time, as a user starts it: rows for `__main__.py`.

Recorder, plant and controller run on TCP loopback for some seconds a turn. Its figures are computed from the turn's log
and the plant's last status alone.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from aeroloop import read_run
from aeroloop.service.config import load
from aeroloop.service.testing.process_group import ProcessGroup, RoleName, standalone

PATIENCE_S: Final = 60.0
ROLES: Final[tuple[RoleName, ...]] = ("controller", "plant", "recorder")
AEROLOOP: Final = [sys.executable, "-Pm", "aeroloop"]


class Turn(NamedTuple):
    """Figures of one run."""

    ticks: int
    in_time: int
    skipped: int
    latency_us: dict[str, float]
    over_lockstep: float  # z_track
    memory_mb: float  # of the largest process, of 10⁶ bytes
    notes: list[str]


def lockstep(seconds: float, overrides: Sequence[str]) -> float:
    """z_track of these seconds in lockstep."""
    words = ["lab", "experiment", f"--duration={seconds}", "--json", *(f"--set={override}" for override in overrides)]
    z_track: float = json.loads(run(*words))["z_track"]
    return z_track


def turn(seconds: float, rate_hz: float, overrides: Sequence[str], z_track: float) -> Turn:
    """One run in real time, beside z_track in lockstep."""
    with tempfile.TemporaryDirectory() as folder:
        settings = standalone(load(overrides=overrides), Path(folder) / "log.mcap", duration_s=seconds)
        with ProcessGroup(settings) as processes:
            processes.start_loop(environment={})  # an interpreter each, as a user starts them: forks would share memory
            processes.eventually("a session", lambda: _state_of_plant(processes) == "driven", PATIENCE_S)
            time.sleep(seconds / 2)
            memory = max(memory_mb(processes.pid(role)) for role in ROLES)
            processes.eventually("its end", lambda: not processes.running("controller"), seconds + PATIENCE_S)
            plant = processes.statuses["plant"]
        review = json.loads(run("log", "review", f"{folder}/log.mcap", "--json"))
        latency_ns = read_run(f"{folder}/log.mcap").ticks.latency_ns
    broken = [f"{review['sessions']} sessions instead of one"] if review["sessions"] != 1 else []
    in_time = int(np.count_nonzero(latency_ns < 1e9 / rate_hz))  # the latency of a skipped tick is NaN
    ticks = round(seconds * rate_hz) - 1  # the last one ends the session
    notes = [*broken, *plant.notes, *review["trips"], *review["damages"]]
    over_lockstep = review["z_track"] / z_track
    return Turn(ticks, in_time, review["skipped_ticks"], review["latency_us"], over_lockstep, memory, notes)


def _state_of_plant(processes: ProcessGroup) -> str | None:
    """State by the plant's last status; None before the first."""
    status = processes.statuses.get("plant")
    return None if status is None else status.state


def run(*words: str) -> str:
    """Output of a verb. Ends this program with the verb's error if it fails."""
    done = subprocess.run([*AEROLOOP, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"aeroloop {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def memory_mb(pid: int) -> float:
    """Resident memory of a process now [MB], see proc(5); the kernel's kB are 1024 bytes."""
    found = re.search(r"^Rss:\s+(\d+) kB$", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1]) * 1024e-6


def cpu_s(pid: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
