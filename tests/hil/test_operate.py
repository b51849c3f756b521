"""Operator's verbs on a running loop, by the command line, and their traces in the log."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from math import degrees
from pathlib import Path

import numpy as np
import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Telemetry, Truth
from aeroloop.protocol.messages.operator import Setpoint
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.service.config import Settings
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review.review import read
from aeroloop.service.testing.hil import Hil
from tests.hil.test_faults import PATIENT
from tests.support.certified import certified_settings

AEROLOOP = [sys.executable, "-P", "-m", "aeroloop"]


def op(hil: Hil, *arguments: str) -> subprocess.CompletedProcess[str]:
    """An operator's command on the loop's network."""
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


def test_an_operator_turns_the_body_and_changes_gains_and_the_log_is_computed_again_to_the_last_bit(hil: Hil) -> None:
    hil.start(settings={**PATIENT, "reference.kind": "hold", "controller.telemetry_rate_hz": 500})
    done(hil, "goto", "0", "-10", "20", "--in", "1")
    done(hil, "set-gains", "--C2", "0.2", "0.2", "0.2")
    assert "rad/s, more than" in refused(hil, "goto", "0", "0", "170", "--in", "0.5")
    assert "rolls" in refused(hil, "goto", "5", "0", "0", "--in", "3")
    assert "at most 20" in refused(hil, "set-gains", "--C1", "1", "1", "100")
    hil.run(2.0)
    log = hil.log
    last = [message for _, message in log.messages("telemetry") if isinstance(message, Telemetry)][-1]
    roll, pitch, yaw = (degrees(angle) for angle in to_euler(last.desired))
    assert (roll, pitch, yaw) == pytest.approx((0.0, -10.0, 20.0), abs=1e-6)  # quintics and quaternions, rounded
    # The review computes the errors again from frames and changes; the controller published what it had computed.
    blocks: list[Ticks] = []
    read(log.path, watch=blocks.append)
    computed = {
        k: tuple(error)
        for block in blocks
        for k, error in zip(block.k.tolist(), block.attitude_error.tolist(), strict=True)
    }
    published = [message for _, message in log.messages("telemetry") if isinstance(message, Telemetry)]
    compared = [(message.attitude_error, computed[message.tick]) for message in published if message.tick in computed]
    assert len(compared) > 500
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
    assert hil.status("plant").cause == "stopped by an operator: 0 V"
    assert hil.status("plant").since is not None
    assert hil.log.trips == ["stopped by an operator: 0 V"]


def test_a_configuration_read_again_changes_what_can_change_live_and_names_the_rest(hil: Hil, tmp_path: Path) -> None:
    config = tmp_path / "a.toml"
    config.write_text("[law]\nC2 = [0.15, 0.15, 0.15]\n")
    hil.start(settings=PATIENT, drive=False)
    ours = [f"network.rendezvous={hil.settings.network.rendezvous}", "controller.stale_s=2", "wire.counter_bits=11"]
    overrides = [word for setting in ours for word in ("--set", setting)]
    controller = subprocess.Popen([*AEROLOOP, "controller", "--config", str(config), *overrides])
    try:
        hil.eventually("driving", lambda: hil.state("plant") == "driven")
        config.write_text("[law]\nC2 = [0.2, 0.2, 0.2]\nmass = 2.0\n")
        os.kill(controller.pid, signal.SIGHUP)
        hil.eventually("the change", lambda: hil.happened("changed", "configuration read again"))
        config.write_text("[law]\nC2 = -1\n")
        os.kill(controller.pid, signal.SIGHUP)
        hil.eventually("its refusal", lambda: hil.happened("fault", "not reloaded: law.C2"))
    finally:
        controller.terminate()
        assert controller.wait(30) == 0
    log = hil.log
    text = next(event.text for event in log.events if event.kind == "changed" and "read again" in event.text)
    assert "law.C2: [0.15, 0.15, 0.15] → [0.2, 0.2, 0.2]" in text
    assert "law.mass: 1.075 → 2.0, after a restart" in text
    gains = [change.gains.C2 for change in log.changes if change.gains]
    assert gains[-1] == (0.2, 0.2, 0.2)
    assert not any(isinstance(event, Event) and event.kind == "lost" for event in log.events)


def test_a_controller_that_must_be_certified_claims_once_it_is_and_refuses_what_would_not_be(
    hil: Hil, tmp_path: Path
) -> None:
    config = tmp_path / "a.toml"

    def configured(C2: float) -> Settings:  # the paper's letter
        patient = [f"{key}={value}" for key, value in PATIENT.items()]
        required = ["controller.require_certificate=true", "controller.after_restart=configured"]
        return certified_settings(12, 12, f"law.C2=[{C2}, {C2}, {C2}]", *patient, *required)

    failing = configured(0.03)
    config.write_text(failing.toml())
    hil.start(settings={name: failing.description()[name] for name in ("wire", "plant")}, drive=False)
    network = f"network.rendezvous={hil.settings.network.rendezvous}"
    controller = subprocess.Popen([*AEROLOOP, "controller", "--config", str(config), "--set", network])
    try:
        hil.eventually("the verdict", lambda: hil.happened("fault", "claims no vehicle"))
        hil.run(0.6)  # it claims four times a second where it may
        assert hil.state("plant") == "idle"
        assert "the certificate does not hold" in (hil.status("controller").cause or "")
        config.write_text(configured(0.2).toml())
        os.kill(controller.pid, signal.SIGHUP)
        hil.eventually("driving", lambda: hil.state("plant") == "driven")
        assert "the certificate does not hold" in refused(hil, "set-gains", "--C2", "0.02", "0.02", "0.02")
        config.write_text(configured(0.025).toml())
        os.kill(controller.pid, signal.SIGHUP)
        hil.eventually("its refusal", lambda: hil.happened("fault", "not reloaded: controller.require_certificate"))
        assert hil.state("plant") == "driven"
    finally:
        controller.terminate()
        assert controller.wait(30) == 0
    log = hil.log
    said = [event for event in log.events if event.role == "controller" and "the certificate" in event.text]
    # It fails, it holds, and what is asked for beside that changes nothing.
    assert [event.kind for event in said] == ["fault", "changed", "fault"]
    assert "the certificate holds" in said[1].text
    gains_set = [change.gains.C2 for change in log.changes if change.gains]
    assert set(gains_set) == {(0.2, 0.2, 0.2)}
    judged = read(log.path).findings.theorem
    assert judged is not None
    assert judged.holds
    assert judged.samples > 0  # the emulator says of which tick its true states are


def test_a_controller_on_a_grid_of_its_own_drives_the_plant_too(hil: Hil) -> None:
    hil.start(settings={**PATIENT, "controller.pace": "clock"})
    hil.run(2.0)
    figures = hil.log.figures
    # Two grids side by side: a measurement waits for up to a period, and one is missed where they drift apart.
    assert figures.command.frames_per_s > 250
    assert figures.max_error_deg < 10
