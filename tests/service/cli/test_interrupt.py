"""^C: no traceback at any moment, exit code 130, and no process left.

Real processes, each in a session of its own that gets SIGINT as a terminal would send it. Nothing is timed: each test
waits for an event of the process, for at most `PATIENCE_S`, as a shared machine can be slow.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.processes

PATIENCE_S = 60.0
COMMAND = [sys.executable, "-P", "-m", "aeroloop"]


def start(*command: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in a background job
    )


def processes_of(session: int) -> list[int]:
    """Processes of a session that still run."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(folder.name))
    return found


@pytest.mark.parametrize("module", ["typer._click.core", "aeroloop.service.cli.main", "pydantic.main", "numpy"])
def test_an_interrupted_import_leaves_no_traceback(module: str) -> None:
    process = start(sys.executable, "-P", "-X", "importtime", "-m", "aeroloop", "lab", "experiment")
    assert process.stderr is not None
    while not (line := process.stderr.readline()).rstrip().endswith(f" {module}"):
        assert line, f"{module} was not imported"
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert not [line for line in rest.splitlines() if not line.startswith("import time:")]


@pytest.mark.parametrize("verb", ["tables", "calibrate"])
def test_worker_processes_end_in_silence(verb: str) -> None:
    process = start(*COMMAND, "lab", verb)
    deadline = time.monotonic() + PATIENCE_S
    while len(processes_of(process.pid)) < 3:  # this one, multiprocessing's tracker and a worker, which imports first
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, printed = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, printed) == (130, "")
    while processes_of(process.pid):  # the tracker ends when its pipe is closed
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_workers_end_with_a_parent_that_is_killed() -> None:
    process = start(*COMMAND, "lab", "tables")
    deadline = time.monotonic() + PATIENCE_S
    while len(processes_of(process.pid)) < 3:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    while processes_of(process.pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)
