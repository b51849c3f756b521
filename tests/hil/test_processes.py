"""Whole system as a user starts it: real processes, real sockets, real logs.

Tests that need no clock run in lockstep. A test in real time states its slack: the suite must pass on a shared machine
with two cores, where a process may wait for hundreds of milliseconds.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from pathlib import Path

import pytest

from aeroloop.protocol.messages.models import Event
from aeroloop.service.config import load
from aeroloop.service.review.review import review
from aeroloop.service.testing.hil import HilLog
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous
from tests.support.processes import AEROLOOP, LONGEST_S, PATIENT, aeroloop
from tests.support.zenoh_network import eventually

FIGURES = ("duration_s", "z_track", "u_total", "max_error_deg", "final_error_deg", "measurement", "command")


@pytest.mark.parametrize("cell", [["--bits", "cont"], ["--set", "wire.transmit=on_change"], []])
def test_a_demo_in_lockstep_gives_the_experiments_figures_to_the_last_bit_and_review_those_of_the_demo(
    tmp_path: Path, cell: list[str]
) -> None:
    log, fault = tmp_path / "a.mcap", "rate:bias=0.01@0.5..1"
    cell = ["--json", "--duration", "2", "--set", f'plant.faults=["{fault}"]', *cell]
    demo = json.loads(aeroloop("demo", "--lockstep", "--log", str(log), *cell))
    experiment = json.loads(aeroloop("lab", "experiment", *cell))
    assert {name: demo[name] for name in FIGURES} == {name: experiment[name] for name in FIGURES}
    assert (demo["skipped_ticks"], demo["trips"]) == (0, [])
    assert [(one["fault"], one["begin_s"], one["end_s"]) for one in demo["faults"]] == [(fault, 0.5, 1.0)]
    judged = json.loads(aeroloop("log", "review", str(log), "--json"))
    figures = {name: judged[name] for name in demo}
    figures["reasons"] = {name: why for name, why in judged["reasons"].items() if name in demo}
    assert figures == demo  # which holds nothing against the theorem


def batches(log: Path) -> int:
    """How many of the controller's batches a log holds so far; it publishes ten a second."""
    return len(HilLog(log).batches("controller")) if log.exists() and log.stat().st_size else 0


@pytest.mark.smoke
def test_a_demo_in_real_time_tracks_and_interrupting_it_ends_it_cleanly_with_a_readable_log(tmp_path: Path) -> None:
    """Slack: half the ticks and 10 degrees separate a loop that works from one that does not.

    On a busy machine the plant holds its last command meanwhile, and the error stays that of the start, 2.5 degrees.
    """
    log = tmp_path / "a.mcap"
    patient = [word for key, value in PATIENT.items() for word in ("--set", f"{key}={value}")]
    command = [*AEROLOOP, "demo", "--duration", "60", "--json", "--log", str(log), *patient]
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    eventually("two seconds of ticks", lambda: batches(log) > 20, LONGEST_S)
    demo.send_signal(signal.SIGINT)
    out, _ = demo.communicate(timeout=LONGEST_S)
    assert demo.returncode == 130
    figures = json.loads(out)
    assert figures["z_track"] == review(log).z_track
    assert figures["duration_s"] > 1.0
    assert figures["command"]["frames_per_s"] > 250
    assert figures["max_error_deg"] < 10
    assert figures["latency_us"]["count"] > 0
    last = {event.role: event.kind for _, event in HilLog(log).messages(Event)}
    assert last == {"plant": "stopped", "controller": "stopped", "recorder": "started"}


def test_a_loop_runs_over_unix_sockets(tmp_path: Path) -> None:
    places = json.dumps([f"unixsock-stream/{tmp_path}/{i}" for i in range(3)])
    lockstep = ["loop.lockstep=true", "controller.auto_arm=true", "controller.duration_s=0.5"]
    with ProcessGroup(load(overrides=[f"network.rendezvous={places}", *lockstep])) as processes:
        processes.start("plant")
        controller = processes.start("controller")
        controller.join(30)  # for two processes to start
        assert controller.exitcode == 0


def test_a_daemon_notifies_systemd_that_it_is_ready_that_it_lives_and_that_it_stops(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(30)  # a process starts within about a second; CI may be busy
        command = [*AEROLOOP, "plant", "--set", f"network.rendezvous={free_rendezvous()}"]
        daemon = subprocess.Popen(
            command, env={**os.environ, "NOTIFY_SOCKET": str(path)}, stderr=subprocess.PIPE, text=True
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
