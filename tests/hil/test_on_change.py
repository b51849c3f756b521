"""On-change policy on real processes: frames sent, an operator's verbs, and the log.

Most tests share one run in real time of a body at rest that an operator turns and that rests again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from aeroloop.protocol.messages.models import Event, Status
from aeroloop.service.logs.replay import replay
from aeroloop.service.testing.hil import Hil, HilLog
from aeroloop.service.testing.hil_log import RunFigures
from tests.hil.test_faults import FAST_TRUTH, PATIENT, SLACK_S, WATCHDOG_S, last_command_ns, seconds_driven_after
from tests.hil.test_operate import done
from tests.hil.test_processes import aeroloop

ON_CHANGE = {"wire.transmit": "on_change"}
RATE = 500


class Run(NamedTuple):
    """A run in real time that is over."""

    log: HilLog
    figures: RunFigures
    plant: Status
    controller: Status


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Hold, turn by 8 degrees in half a second, other gains, hold."""
    with Hil(tmp_path_factory.mktemp("run")) as hil:
        hil.start(settings={**PATIENT, **ON_CHANGE, "reference.kind": "hold"})
        hil.run(0.3)
        done(hil, "goto", "0", "-5", "8", "--in", "0.5")
        done(hil, "set-gains", "--C2", "0.2", "0.2", "0.2")
        hil.run(1.0)
        reported = hil.status("plant").ticks
        hil.eventually("a status", lambda: hil.status("plant").ticks > reported)
        plant, controller = hil.status("plant"), hil.status("controller")
        log = hil.log
        yield Run(log, log.figures, plant, controller)


def assert_replays(log: Path, at_least: int) -> None:
    replayed = replay([log])
    for end in (replayed.controller, replayed.plant):
        assert end is not None, replayed.reasons
        assert end.differ == 0
        assert end.ticks >= at_least


def test_in_lockstep_frames_that_are_lost_or_late_end_no_session_and_the_log_is_computed_again(tmp_path: Path) -> None:
    faults = ["measurement:drop=0.1", "command:drop=0.1", "measurement:delay=0.006@0.5", "command:garble=0.02"]
    log = tmp_path / "a.mcap"
    demo = aeroloop(
        "demo", "--lockstep", "--log", str(log), "--duration", "1.5",
        "--set", "wire.transmit=on_change", "--set", f"plant.faults={json.dumps(faults)}",
    )  # fmt: skip
    assert demo["trips"] == []
    assert demo["duration_s"] == pytest.approx(1.5, abs=0.04)  # the last ones may be among those that were lost
    assert demo["final_error_deg"] < 10
    assert_replays(log, RATE)


def test_in_real_time_fewer_frames_do_and_every_tick_is_judged(run: Run) -> None:
    figures = run.figures
    for stream in (figures.measurement, figures.command):
        assert stream.frames_per_s is not None
        assert RATE / 15 * 0.9 < stream.frames_per_s < 0.7 * RATE  # at rest it is the heartbeat's
    assert figures.trips == []
    assert figures.skipped_ticks < 0.5 * RATE * figures.duration_s
    assert figures.final_error_deg < 3


def test_a_log_of_a_loop_that_was_silent_while_an_operator_spoke_is_computed_again_byte_for_byte(run: Run) -> None:
    assert_replays(run.log.path, round(0.5 * RATE * run.figures.duration_s))


def test_status_counts_the_frames_and_the_ticks_apart(run: Run) -> None:
    assert 0 < run.plant.sent < 0.7 * run.plant.ticks
    assert 0 < run.controller.sent < 0.7 * run.controller.ticks
    assert run.controller.rate_hz > 0.5 * RATE
    assert run.plant.received <= run.controller.sent + RATE  # reported up to a second apart
    assert run.plant.refused == run.controller.refused == 0


def moments(log: HilLog, kind: str) -> list[int]:
    """When events of a kind were published [ns]."""
    return [at for at, event in log.messages("event") if isinstance(event, Event) and event.kind == kind]


@pytest.mark.smoke
def test_the_motors_are_at_rest_in_time_when_a_controller_dies_that_was_silent_anyway(hil: Hil) -> None:
    hil.start(settings={**FAST_TRUTH, **ON_CHANGE})
    hil.run(0.5)
    hil.kill("controller")
    hil.eventually("the trip", lambda: hil.happened("tripped", "is gone") or hil.happened("tripped", "no fresh"))
    hil.run(0.3)
    log = hil.log
    assert seconds_driven_after(log, last_command_ns(log)) < WATCHDOG_S + SLACK_S


def test_a_plant_that_stands_still_is_given_up_as_soon_as_it_is_stale_and_not_taken_for_silent(hil: Hil) -> None:
    hil.start(settings={**PATIENT, **ON_CHANGE, "controller.stale_s": 0.1, "reference.kind": "hold"})
    hil.run(0.5)
    hil.pause("plant")
    hil.eventually("the controller's notice", lambda: hil.happened("lost", "no measurement for"))
    hil.resume("plant")
    hil.eventually("a new session", lambda: sum(event.kind == "claimed" for event in hil.events) >= 3)
    log = hil.log
    lost = moments(log, "lost")[0]
    last = max(at for at in log.times("plant", "sent") if at < lost)
    assert 0.1 - 1e-3 < (lost - last) * 1e-9 < 0.1 + SLACK_S
