"""Daemons under systemd: notifications of readiness, life and stop; unit files and their command lines."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from aeroloop.service.cli.main import execute as run
from aeroloop.service.host.units import UNITS
from aeroloop.service.testing.process_group import free_rendezvous


def test_a_daemon_notifies_systemd_that_it_is_ready_that_it_lives_and_that_it_stops(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(30)  # a process starts within about a second; CI may be busy
        command = [sys.executable, "-P", "-m", "aeroloop", "emulator", "--log-format", "json"]
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
    lines = [json.loads(line) for line in stderr.splitlines()]
    assert [line["message"] for line in lines] == ["plant: aero waits for a claim", "plant: aero stopped at 0 V"]
    assert all(set(line) == {"time", "level", "logger", "message"} for line in lines)


def test_units_are_printed_and_installed_for_every_daemon(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["host", "units"]) == 0
    printed = capfd.readouterr().out
    assert run(["host", "units", "--install", str(tmp_path)]) == 0
    for name in UNITS:
        text = (tmp_path / f"aeroloop-{name}.service").read_text()
        assert text in printed
        assert "Type=notify" in text
        assert f" {name} " in next(line for line in text.splitlines() if line.startswith("ExecStart="))
    assert run(["host", "units", "--install", str(tmp_path / "nowhere")]) == 1


@pytest.mark.parametrize("name", UNITS)
def test_what_a_unit_starts_is_a_command_line_that_the_daemon_takes(name: str, tmp_path: Path) -> None:
    """The options of ExecStart, with a configuration that makes the daemon end at once."""
    assert run(["host", "units", "--install", str(tmp_path)]) == 0
    text = (tmp_path / f"aeroloop-{name}.service").read_text()
    start = next(line for line in text.splitlines() if line.startswith("ExecStart=")).removeprefix("ExecStart=")
    config = tmp_path / "aeroloop.toml"
    config.write_text('[network]\nrendezvous = ""\nlisten = ["tcp/192.0.2.1:1"]\n')  # an address that is not ours
    arguments = start.replace("/etc/aeroloop/aeroloop.toml", str(config)).replace("%L", str(tmp_path)).split()[1:]
    command = [sys.executable, "-P", "-m", "aeroloop", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "cannot listen on tcp/192.0.2.1:1" in done.stderr
