"""Fork server: exit codes, signals, and no process left behind, however a process ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from aeroloop.service.testing.fork_server import ForkedProcess, fork_server
from aeroloop.service.testing.process_group import free_rendezvous

PATIENCE_S = 20.0
"""For what takes a tenth of a second here, or two where the server must be started first; CI may have other work."""


def start(folder: Path, *arguments: str) -> ForkedProcess:
    with (folder / "stderr").open("wb") as stderr:
        return fork_server().start(arguments, os.environ, stderr.fileno())


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_command_runs_as_typed_with_its_own_environment_folder_and_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fork_server()  # which has another folder and another environment from here on
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AEROLOOP_LOOP__RATE_HZ", "1e9")
    Path("empty.toml").write_text("")
    assert start(tmp_path, "plant", "--config", "empty.toml").wait(PATIENCE_S) == 2
    (line,) = (tmp_path / "stderr").read_text().splitlines()
    assert line.startswith("aeroloop: ")
    assert "loop.rate_hz" in line


@pytest.mark.parametrize(("signals", "code"), [((signal.SIGTERM,), 0), ((signal.SIGKILL,), -signal.SIGKILL)])
def test_a_signal_ends_it_with_the_code_that_a_child_of_this_process_would_have(
    tmp_path: Path, signals: tuple[int, ...], code: int
) -> None:
    child = start(
        tmp_path, "recorder", "--set", f"network.rendezvous={free_rendezvous()}", "--log", str(tmp_path / "l.mcap")
    )
    eventually(lambda: (tmp_path / "l.mcap").exists() or child.poll() is not None)
    assert child.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(0.01)
    for which in signals:
        child.send_signal(which)
    while child.poll() is None:
        child.send_signal(signal.SIGCONT)  # also between its end and the report of its exit code
    assert child.wait(PATIENCE_S) == code
    assert child.poll() == code
    child.kill()  # does nothing to one that has ended


ORPHANS = """
import os, time
from aeroloop.service.testing.fork_server import fork_server
server = fork_server()
words = ["can-node", f"--with-parent={server.pid}", "--set", "can.options.hop_limit=0"]
with open(os.devnull) as null:
    child = server.start(words, os.environ, null.fileno())
print(server.pid, child.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("dies", ["the process that started it", "the server"])
def test_nothing_outlives_the_process_that_started_it_or_the_server(dies: str) -> None:
    with subprocess.Popen([sys.executable, "-c", ORPHANS], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        server, child = map(int, process.stdout.readline().split())
        os.kill(process.pid if dies == "the process that started it" else server, signal.SIGKILL)
        eventually(lambda: dead(server) and dead(child))
        process.kill()


def dead(pid: int) -> bool:
    """Whether a process has ended; one that nothing has waited for counts."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_a_child_whose_parent_is_dead_already_does_not_start(tmp_path: Path) -> None:
    child = start(tmp_path, "can-node", "--with-parent=1", "--set", "can.options.hop_limit=0")
    assert child.wait(PATIENCE_S) == 0
