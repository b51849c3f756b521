"""Memory of each daemon while a loop runs, with memory locked and not; page faults of the loops after their warm-up.

The floor is an interpreter that has imported the libraries of the daemons and opened a Zenoh session, and does nothing.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from aeroloop.service.bench.running import ROLES, running_loop
from aeroloop.service.config import Settings, load

SETTLED_S: Final = 20.0
QUICK_SETTLED_S: Final = 4.0
WARM_UP_S: Final = 5.0
"""Of a loop: from then on each of its paths has run, once-a-second ones included."""

_FLOOR: Final = """
import casadi, numpy, pydantic, rich, typer, zenoh
config = zenoh.Config()
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print(open("/proc/self/status").read())
"""


class Memory(NamedTuple):
    """Memory of one daemon.

    Attributes:
        role: Which.
        locked: Whether it was asked to lock its memory (`loop.realtime` = try); the recorder never does.
        resident_mb: Resident memory [MB].
        floor_mb: Resident memory of an idle interpreter with the same libraries [MB].
        faults: Page faults of all of its threads, minor and major, after the first seconds of the session: Zenoh's
            threads carry the frames. 0 of the recorder, which has no loop.
        ticks: Ticks of the loop meanwhile.
        refused: What the host refused, a line each.
    """

    role: str
    locked: bool
    resident_mb: float
    floor_mb: float
    faults: int
    ticks: int
    refused: list[str]


def measure(settings: Settings | None = None, *, quick: bool = False) -> Iterator[Memory]:
    """Memory of controller, plant and recorder, locked and then not, after 20 s of the loop; if `quick`, 4 s, locked.

    Raises:
        ProcessGroupError: A process did not start, or failed.
    """
    settings = settings or load()
    floor_mb = megabytes(_run(_FLOOR), "VmRSS")
    for locked in (True,) if quick else (True, False):
        loop = settings.loop.model_copy(update={"realtime": "try" if locked else "off"})
        yield from _measure(settings.model_copy(update={"loop": loop}), locked, floor_mb, quick)


def _measure(settings: Settings, locked: bool, floor_mb: float, quick: bool) -> Iterator[Memory]:
    with running_loop(settings, own_interpreters=True) as running:
        running.await_drive()
        time.sleep(WARM_UP_S)
        procs = {role: Path(f"/proc/{running.processes.pid(role)}") for role in ROLES}
        before, faults_before = running.statuses(), {role: faults(procs[role]) for role in ROLES}
        time.sleep(QUICK_SETTLED_S if quick else SETTLED_S)
        after, faults_after = running.statuses(), {role: faults(procs[role]) for role in ROLES}
        for role, proc in procs.items():
            yield Memory(
                role=role,
                locked=locked and role != "recorder",
                resident_mb=megabytes((proc / "status").read_text(), "VmRSS"),
                floor_mb=floor_mb,
                faults=faults_after[role] - faults_before[role] if after[role].timing else 0,
                ticks=after[role].ticks - before[role].ticks,
                refused=after[role].notes if role != "recorder" else [],
            )


def faults(proc: Path) -> int:
    """Page faults of a process, minor and major, of all threads that it has had; `proc` is its folder in /proc."""
    fields = (proc / "stat").read_text().rpartition(")")[2].split()  # from the third on, see proc(5)
    return int(fields[7]) + int(fields[9])


def megabytes(text: str, name: str) -> float:
    """A quantity of /proc/PID/status [MB], see proc(5); the kernel's kB are 1024 bytes.

    Raises:
        ValueError: It is not there.
    """
    found = re.search(rf"^{name}:\s+(\d+) kB$", text, re.MULTILINE)
    if found is None:
        raise ValueError(f"{name} is not in {text[:40]!r}…")
    return int(found[1]) * 1024e-6


def _run(code: str) -> str:
    return subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True).stdout
