"""Operator's verbs on a running loop, by the command line, and their traces in the log."""

from __future__ import annotations

import getpass
import json
import socket
import subprocess
import sys
import time
from datetime import UTC
from math import degrees
from pathlib import Path

import numpy as np
import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Telemetry, Truth
from aeroloop.protocol.messages.operator import Setpoint
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.service.review.review import read
from aeroloop.service.testing.hil import Hil
from tests.hil.test_faults import PATIENT

AEROLOOP = [sys.executable, "-P", "-m", "aeroloop"]


def op(hil: Hil, *arguments: str) -> subprocess.CompletedProcess[str]:
    network = ["--set", f"network.rendezvous={hil.settings.network.rendezvous}"]
    return subprocess.run(
        [*AEROLOOP, "op", *arguments, *network], capture_output=True, text=True, timeout=60, check=False
    )


def done(hil: Hil, *arguments: str) -> str:
    """As `op`, for what must succeed."""
    result = op(hil, *arguments)
    assert result.returncode == 0, result.stderr
    return result.stdout


def refused(hil: Hil, *arguments: str) -> str:
    """As `op`, for what must be refused in one line."""
    result = op(hil, *arguments)
    assert result.returncode in (1, 2), result.stdout
    assert len(result.stderr.splitlines()) == 1
    return result.stderr


@pytest.mark.smoke
def test_an_operator_turns_the_body_and_changes_gains_and_the_log_is_computed_again_to_the_last_bit(hil: Hil) -> None:
    hil.start(settings={**PATIENT, "reference.kind": "hold"})
    done(hil, "goto", "0", "-10", "20", "--in", "1")
    done(hil, "set-gains", "--C2", "0.2", "0.2", "0.2")
    assert " would do" in refused(hil, "goto", "0", "0", "170", "--in", "0.5")  # the first may still have to brake
    assert "rolls" in refused(hil, "goto", "5", "0", "0", "--in", "3")
    assert "law.C1[2]: should be less than or equal to 20" in refused(hil, "set-gains", "--C1", "1", "1", "100")
    hil.run(2.0)
    log = hil.log
    last = [message for _, message in log.messages("telemetry") if isinstance(message, Telemetry)][-1]
    roll, pitch, yaw = (degrees(angle) for angle in to_euler(last.desired))
    assert (roll, pitch, yaw) == pytest.approx((0.0, -10.0, 20.0), abs=1e-6)  # quintics and quaternions, rounded
    # The review computes the errors again from frames and changes; the controller published what it had computed.
    ticks = read(log.path).ticks
    computed = dict(zip(ticks.k.tolist(), map(tuple, ticks.attitude_error.tolist()), strict=True))
    published = [message for _, message in log.messages("telemetry") if isinstance(message, Telemetry)]
    compared = [(message.attitude_error, computed[message.tick]) for message in published if message.tick in computed]
    assert len(compared) > 10  # telemetry is published at 10 Hz
    assert all(mine == theirs for mine, theirs in compared)


def test_the_body_follows_a_file_and_a_live_stream_which_is_held_when_it_falls_silent(hil: Hil, tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    points.write_text("time,roll,pitch,yaw\n0,0,0,0\n1,0,5,10\n2,0,0,15\n")
    hil.start(settings={**PATIENT, "reference.kind": "hold"})
    done(hil, "track", str(points), "--in", "0.5")
    hil.eventually("the change", lambda: hil.happened("changed", "3 points"))
    hil.run(2.6)
    done(hil, "track", "stream", "--in", "0.5", "--timeout", "0.3")
    key = topics.key("reference", hil.settings.vehicle)
    for yaw in np.linspace(15, 25, 25):
        hil.processes.zenoh.put(key, Setpoint(attitude=(0.0, 0.0, float(yaw))).encode())
        time.sleep(0.02)
    hil.processes.zenoh.put(key, b"nonsense")
    hil.eventually("its silence", lambda: hil.happened("lost", "no set-point for 0.3 s"))
    hil.run(0.5)
    assert hil.happened("fault", "set-point refused")
    assert hil.state("plant") == "driven"
    log = hil.log
    truths = [truth for _, truth in log.messages("truth") if isinstance(truth, Truth)]
    yaw_now = degrees(to_euler(truths[-1].attitude)[2])
    assert yaw_now == pytest.approx(25.0, abs=4.0)  # it tracks to a few degrees, as in the paper's experiment
    changes = log.changes
    assert changes[0].tick == 0
    assert len(changes) > 10  # every set-point that a tick took


def test_a_released_vehicle_is_another_controllers_until_the_first_is_recalled(hil: Hil) -> None:
    hil.start(settings=PATIENT)
    done(hil, "release")
    hil.eventually("holding", lambda: hil.state("controller") == "holding" and hil.state("plant") == "idle")
    hil.run(0.6)
    assert hil.state("plant") == "idle"  # it claims four times a second where it does not hold
    status = json.loads(done(hil, "status", "--json"))
    assert status["aero"]["plant"]["state"] == "idle"
    assert status["aero"]["controller"]["state"] == "holding"
    why = "is holding: released by an operator; `aeroloop op arm` lets it claim aero again"
    assert why in refused(hil, "set-gains", "--C2", "0.2", "0.2", "0.2")
    done(hil, "arm")
    hil.eventually("driving", lambda: hil.state("controller") == "running" and hil.state("plant") == "driven")
    done(hil, "stop")
    hil.eventually("tripped", lambda: hil.state("plant") == "tripped")
    stopped = f"stopped by an operator ({getpass.getuser()}@{socket.gethostname()}): 0 V"
    assert hil.status("plant").cause == stopped
    hil.eventually("refused", lambda: "`aeroloop op arm` clears it" in refused(hil, "goto", "0", "0", "0"))
    since = hil.status("plant").since
    assert since is not None
    assert f"{stopped} ({since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC)" in done(hil, "status")
    assert hil.log.trips == [stopped]
