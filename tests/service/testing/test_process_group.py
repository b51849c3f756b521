"""Processes of a group: exit codes, signals, and none left behind, however the process that started them ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from aeroloop.service.testing.process_group import free_rendezvous, start_command
from tests.support.processes import LONGEST_S, sessions
from tests.support.zenoh_network import eventually

pytestmark = pytest.mark.processes


@pytest.mark.parametrize("environment", [None, {"LANG": "C"}], ids=["fork", "new interpreter"])
def test_a_command_runs_as_typed_in_this_folder_without_this_process_s_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str] | None
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AEROLOOP_LOOP__NONSENSE", "1")
    Path("wrong.toml").write_text("loop.rate_hz = 1e9")
    child = start_command(["plant", "--config", "wrong.toml"], tmp_path / "output", environment)
    child.join(LONGEST_S)
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
    eventually("recording", lambda: log.exists() or not child.is_alive())
    assert child.is_alive()
    assert child.pid is not None
    os.kill(child.pid, sent)
    child.join(LONGEST_S)
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
        eventually("its end", lambda: child not in sessions())
    eventually("the end of all", lambda: process.pid not in sessions().values())
