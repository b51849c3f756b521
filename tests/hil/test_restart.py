"""A process that was killed and is started again: nothing moves that was not asked for."""

from __future__ import annotations

import getpass
import signal
from datetime import UTC, datetime
from math import degrees
from pathlib import Path

import pytest

from aeroloop.plant_emulator.hosts.latch_file import Latch
from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.operator import Gains, Hold
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.service.config import load
from aeroloop.service.lab.demo import run_demo
from aeroloop.service.logs.replay import replay
from aeroloop.service.testing.hil import Hil
from tests.support.processes import PATIENT

TARGET = Hold(attitude=(0.0, -10.0, 30.0))
SET = Gains(C1=(0.4, 0.4, 0.4), C2=(0.2, 0.2, 0.2), Gamma=(0.02, 0.02, 0.02))


@pytest.mark.smoke
def test_a_stop_holds_however_the_plants_process_ends_and_the_log_replays(hil: Hil) -> None:
    """No slack: what must not happen is waited for over more than one period of the controller's claims, 0.25 s."""
    hil.start(settings={**PATIENT, "controller.auto_arm": True})
    hil.stop()
    hil.eventually("the stop", lambda: hil.state("plant") == "tripped")
    since, stopped = hil.status("plant").since, f"stopped by an operator ({getpass.getuser()}@"
    for how in (signal.SIGKILL, signal.SIGTERM):
        hil.events.clear()
        hil.processes.stop("plant", how)
        hil.restart("plant")
        hil.eventually("what it says", lambda: hil.happened("started", f"aero is still tripped: {stopped}"))
        hil.eventually("a refusal", lambda: hil.happened("refused", stopped))
        hil.run(0.6)
        assert (hil.state("plant"), hil.status("plant").since) == ("tripped", since)
        assert not hil.happened("claimed")
    hil.arm()
    hil.eventually("driving", lambda: hil.state("plant") == "driven")
    hil.run(0.3)
    plants = replay([hil.log.path]).plants
    assert [(plant.differ, plant.stopped) for plant in plants if plant.ticks] == [(0, None)] * 2


def test_yesterdays_stop_surprises_no_demo(tmp_path: Path) -> None:
    """In lockstep, so without slack."""
    latch = Latch(cause=TripCause.OPERATOR, text="stopped: 0 V", operator_only=True, since=datetime.now(UTC))
    kept = tmp_path / "aero.json"
    kept.write_text(latch.model_dump_json())
    settings = load(overrides=["loop.lockstep=true", f"plant.state_directory={tmp_path}"])
    for name in ("a", "b"):
        figures, complete = run_demo(settings, 0.2, tmp_path / f"{name}.mcap")
        assert complete
        assert figures.duration_s > 0.1
    assert kept.exists()


def test_a_controller_that_was_killed_resumes_what_an_operator_asked_for_and_the_log_replays(hil: Hil) -> None:
    """Slack: `PATIENT`'s. 8 bits of ε are 0.9°. Other modes of `after_restart`: tests/service/daemon."""
    hil.start(settings={**PATIENT, "controller.auto_arm": True, "controller.after_restart": "resume"})
    hil.track(TARGET, in_s=1.5)
    hil.set_gains(C1=(0.4, 0.4, 0.4), C2=(0.2, 0.2, 0.2))
    hil.run(1.0)
    before = hil.status("controller")
    assert (before.gains, before.gains_from, before.reference_from) == (SET, "operator", "operator")
    hil.kill("controller")
    hil.eventually("the trip", lambda: hil.state("plant") == "tripped")
    hil.run(0.5)  # the body swings at 0 V
    hil.restart("controller")
    hil.eventually("another session", lambda: hil.status("controller").session not in (None, before.session))
    hil.eventually("driving", lambda: hil.state("controller") == "running")
    hil.run(2.5)
    after = hil.status("controller")
    assert (after.gains, after.gains_from, after.reference_from) == (SET, "resumed", "resumed")
    assert after.reference == before.reference
    truths = [truth for _, truth in hil.log.messages(Truth)]
    assert [degrees(angle) for angle in to_euler(truths[-1].attitude)] == pytest.approx(TARGET.attitude, abs=6.0)
    again = replay([hil.log.path])
    assert again.controller is not None
    assert (again.controller.differ, len(again.sessions)) == (0, 2)
    assert again.plant is not None
    assert again.plant.differ == 0
