"""A process that was killed and is started again: nothing moves that was not asked for."""

from __future__ import annotations

import getpass
import signal
from datetime import UTC, datetime
from math import degrees
from pathlib import Path

import pytest
import zenoh

from aeroloop.plant_emulator.hosts.latch_file import Latch
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import SessionRecord, Truth
from aeroloop.protocol.messages.operator import Gains, Hold, Request, Sinusoid
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.transport.network import command_session
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.service.config import load
from aeroloop.service.lab.demo import run_demo
from aeroloop.service.logs.replay import replay
from aeroloop.service.testing.hil import Hil
from tests.support.processes import PATIENT

TARGET = Hold(attitude=(0.0, -10.0, 30.0))
SET = Gains(C1=(0.4, 0.4, 0.4), C2=(0.2, 0.2, 0.2), Gamma=(0.02, 0.02, 0.02))
CONFIGURED = Gains(C1=(0.3, 0.3, 0.3), C2=(0.15, 0.15, 0.15), Gamma=(0.02, 0.02, 0.02))


SWING = Sinusoid(amplitude=(0.0, 10.0, 20.0))


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


def shown(hil: Hil, *, last: bool = False) -> SessionRecord:
    """What the controller follows; with `last` the plant's record of the session that ended."""
    with command_session(hil.settings.network) as here:
        here.wait_for_links()
        replies = here.session.get(
            topics.key("show", "aero"),
            payload=Request().encode(),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        payloads = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
    records = [SessionRecord.model_validate_json(each) for each in payloads if b'"controller"' in each]
    return next(record for record in records if (record.ended is not None) == last)


@pytest.mark.parametrize("after_restart", ["hold", "resume", "configured"])
def test_what_a_controller_that_was_killed_does_when_it_is_started_again(hil: Hil, after_restart: str) -> None:
    """Slack: `PATIENT`'s. 8 bits of ε are 0.9°, and a hold begins while the body still swings a little."""
    mode = {"controller.auto_arm": True, "controller.after_restart": after_restart}
    hil.start(settings={**PATIENT, **mode, "reference.amplitude": SWING.amplitude})
    hil.track(TARGET, in_s=1.5)
    hil.set_gains(C1=(0.4, 0.4, 0.4), C2=(0.2, 0.2, 0.2))
    hil.run(1.0)
    before = shown(hil)
    assert (before.reference, before.reference_from) == (TARGET, "operator")
    assert (before.gains, before.gains_from) == (SET, "operator")
    hil.kill("controller")
    hil.eventually("the trip", lambda: hil.state("plant") == "tripped")
    hil.run(0.5)  # the body swings at 0 V
    left = shown(hil, last=True)
    assert (left.session, left.reference, left.gains) == (before.session, TARGET, SET)
    hil.restart("controller")
    hil.eventually("another session", lambda: hil.status("controller").session not in (None, before.session))
    hil.eventually("driving", lambda: hil.state("controller") == "running")
    hil.run(2.5)
    status, after = hil.status("controller"), shown(hil)
    assert (status.reference_from, status.gains_from) == (after.reference_from, after.gains_from)
    assert after.session == status.session != before.session
    log = hil.log
    truths = [truth for _, truth in log.messages(Truth)]
    driven = [truth for truth in truths if truth.session == after.session]
    first, last = ([degrees(angle) for angle in to_euler(truth.attitude)] for truth in (driven[0], driven[-1]))
    match after_restart:
        case "hold":
            assert (after.reference_from, after.gains, after.gains_from) == ("held", CONFIGURED, "configured")
            assert isinstance(after.reference, Hold)
            assert last == pytest.approx(first, abs=6.0)
            assert last == pytest.approx(after.reference.attitude, abs=4.0)
        case "resume":
            assert (after.reference, after.reference_from) == (TARGET, "resumed")
            assert (after.gains, after.gains_from) == (SET, "resumed")
            assert last == pytest.approx(TARGET.attitude, abs=6.0)
        case _:
            assert (after.reference, after.gains) == (SWING, CONFIGURED)
    again = replay([log.path])
    assert again.controller is not None
    assert (again.controller.differ, len(again.sessions)) == (0, 2)
    assert again.plant is not None
    assert again.plant.differ == 0
