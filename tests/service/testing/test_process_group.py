"""Processes of a group: exit codes, signals, and none left behind, however the process that started them ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from aeroloop.service.testing.process_group import free_rendezvous, start_command

pytestmark = pytest.mark.processes
PATIENCE_S = 20.0
"""For what takes a tenth of a second here, or two where the server must be started first; CI may have other work."""


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("environment", [None, {"LANG": "C"}], ids=["fork", "new interpreter"])
def test_a_command_runs_as_typed_in_this_folder_without_this_process_s_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str] | None
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AEROLOOP_LOOP__NONSENSE", "1")
    Path("wrong.toml").write_text("loop.rate_hz = 1e9")
    child = start_command(["plant", "--config", "wrong.toml"], tmp_path / "output", environment)
    child.join(PATIENCE_S)
    assert child.exitcode == 2
    (line,) = (tmp_path / "output").read_text().splitlines()
    assert line.startswith("aeroloop: loop.rate_hz")


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 0), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_signal_ends_it_with_the_code_that_a_child_of_a_shell_would_have(
    tmp_path: Path, sent: int, code: int
) -> None:
    log = tmp_path / "l.mcap"
    words = ["recorder", "--set", f"network.rendezvous={free_rendezvous()}", "--log", str(log)]
    child = start_command(words, tmp_path / "output")
    eventually(lambda: log.exists() or not child.is_alive())
    assert child.is_alive()
    assert child.pid is not None
    os.kill(child.pid, sent)
    child.join(PATIENCE_S)
    assert child.exitcode == code


ORPHAN = """
import time
from pathlib import Path
from aeroloop.service.testing.process_group import start_command
if __name__ == "__main__":
    print(start_command(["can-node", "--set", "can.options.hop_limit=0"], Path("output")).pid, flush=True)
    time.sleep(60)
"""


def test_nothing_outlives_the_process_that_started_it_even_if_that_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", ORPHAN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        process.kill()
        eventually(lambda: not running(child))
    eventually(lambda: not any(session_of(line) == process.pid for line in stats()))


def running(pid: int) -> bool:
    """Whether a process has not ended; one that nothing has waited for has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def stats() -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            found.append(path.read_text())
        except OSError:  # it has just ended
            continue
    return [line for line in found if line.rsplit(")", 1)[1].split()[0] != "Z"]


def session_of(line: str) -> int:
    return int(line.rsplit(")", 1)[1].split()[3])
