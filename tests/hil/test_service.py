"""Daemons under systemd: notifications of readiness, life and stop, and a log line for each."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

from aeroloop.service.testing.process_group import free_rendezvous


def test_a_daemon_notifies_systemd_that_it_is_ready_that_it_lives_and_that_it_stops(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(30)  # a process starts within about a second; CI may be busy
        command = [sys.executable, "-P", "-m", "aeroloop", "plant"]
        daemon = subprocess.Popen(
            [*command, "--set", f"network.rendezvous={free_rendezvous()}"],
            env={**os.environ, "NOTIFY_SOCKET": str(path)},
            stderr=subprocess.PIPE,
            text=True,
        )
        received = [manager.recv(64).decode() for _ in range(3)]
        daemon.terminate()
        _, stderr = daemon.communicate(timeout=30)
        while "STOPPING=1" not in received:
            received.append(manager.recv(64).decode())
    assert received[0] == "READY=1"
    assert set(received[1:-1]) == {"WATCHDOG=1"}
    assert daemon.returncode == 0
    lines = [line.partition(" plant: ")[2] for line in stderr.splitlines()]
    assert lines == ["aero waits for a claim", "aero stopped at 0 V"]
