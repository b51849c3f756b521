"""Faults on real processes: 0 V in time, the cause in the log, recovery, and a whole log.

The time to 0 V comes from the log: times of the last command and of the truth, which is published at every tick here.
Bounds are the watchdog's 100 ms plus slack for a shared machine with two cores.
"""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Truth
from aeroloop.service.testing.hil import Hil, HilLog
from tests.support.processes import AEROLOOP, PATIENT

WATCHDOG_S = 0.1
SLACK_S = 0.15  # for a loop that other work on the machine keeps waiting: it must run to notice anything
FAST_TRUTH = {"plant.truth_rate_hz": 500}


def seconds_driven_after(log: HilLog, moment_ns: int) -> float:
    """How long after a moment the motors still had a voltage [s]; the plant must publish at least once after it."""
    truths = log.messages(Truth)
    driven = [at for at, truth in truths if any(truth.voltages)]
    assert driven, "the motors never had a voltage, so nothing is shown"
    assert not any(truths[-1][1].voltages), "the motors still have a voltage at the end of the log"
    return (max(driven) - moment_ns) * 1e-9


def events(log: HilLog, *kinds: str) -> list[tuple[int, Event]]:
    return [(at, event) for at, event in log.messages(Event) if event.kind in kinds]


@pytest.mark.smoke
@pytest.mark.parametrize("transmit", ["periodic", "on_change"])
def test_when_the_controller_is_killed_the_motors_rest_in_time_and_a_new_one_takes_over(
    hil: Hil, transmit: str
) -> None:
    """Takes over within a second: it claims four times a second, and the plant sees that its holder's token is gone."""
    hil.start(settings={**FAST_TRUTH, "wire.transmit": transmit})
    hil.run(0.5)
    hil.kill("controller")
    hil.eventually("the trip", lambda: hil.happened("tripped", "is gone") or hil.happened("tripped", "no fresh"))
    hil.arm()
    hil.restart("controller")
    hil.eventually("a second session", lambda: sum(event.kind == "claimed" for event in hil.events) == 4)
    hil.run(0.3)
    hil.kill("controller")
    hil.run(0.5)
    log = hil.log
    assert seconds_driven_after(log, max(log.times("plant", "received"))) < WATCHDOG_S + SLACK_S
    (_, looks), (_, has) = (
        [(event.kind, at) for at, event in events(log, kind) if event.role == "controller"][-1]
        for kind in ("started", "claimed")
    )
    assert (has - looks) * 1e-9 < 1.0
    second = log.figures_of(2)
    assert (second.sessions, second.session) == (2, log.changes[-1].session)
    assert log.figures.session in {change.session for change in log.changes}


@pytest.mark.smoke
def test_a_controller_that_stands_still_loses_the_plant_and_its_later_commands_have_no_effect(hil: Hil) -> None:
    hil.start(settings=FAST_TRUTH)
    hil.run(0.5)
    hil.pause("controller")
    hil.eventually("the trip", lambda: hil.happened("tripped"))
    hil.run(0.5)
    hil.resume("controller")
    hil.eventually(
        "its refusal", lambda: hil.happened("refused", "no fresh command") or hil.happened("refused", "gone")
    )
    hil.run(0.3)
    assert hil.state("plant") == "tripped"
    log = hil.log
    ((trip, _),) = events(log, "tripped")
    assert seconds_driven_after(log, trip) < SLACK_S  # no command after the trip moved a motor


def test_a_plant_that_stood_still_ends_the_old_session_before_anything_else(hil: Hil) -> None:
    """Its controller has given up meanwhile; its release is the first thing the plant finds, and it is at 0 V then."""
    hil.start(settings=FAST_TRUTH)
    hil.run(0.3)
    old = hil.status("plant").session
    hil.pause("plant")
    hil.eventually("the controller's notice", lambda: hil.happened("lost", "no measurement for"))
    hil.run(0.5)
    hil.resume("plant")
    hil.eventually("its end", lambda: hil.happened("released") or hil.happened("tripped"))
    log = hil.log
    ended = next(at for at, event in events(log, "released", "tripped") if event.session == old)
    ((lost, _), *_) = events(log, "lost")
    truths = [(at, truth) for at, truth in log.messages(Truth) if at > lost]
    # One tick at the most: the one that it was waiting for when it was stopped.
    assert sum(any(truth.voltages) for at, truth in truths if at < ended) <= 1


@pytest.mark.smoke
def test_without_the_session_a_stranger_moves_nothing(hil: Hil) -> None:
    """Commands on every likely key: the plant subscribes to its session's only. And a controller of another wire."""
    hil.start(settings=FAST_TRUTH, drive=False)
    full = hil.settings.wire.command.pack(0, [31, 31])
    rendezvous = f"network.rendezvous={hil.settings.network.rendezvous}"
    stranger = subprocess.Popen(
        [*AEROLOOP, "controller", "--auto-arm", "--set", "wire.voltage.bits=8", "--set", rendezvous]
    )
    deadline = time.monotonic() + 1.0
    try:
        while time.monotonic() < deadline:
            for session in ("stranger", "*", "**", "00000000"):
                hil.processes.zenoh.put(topics.key("command", hil.settings.vehicle, session=session), full)
            time.sleep(0.01)
        hil.eventually("the refusal", lambda: hil.happened("refused", "voltage.bits: 6, not 8"))
    finally:
        stranger.terminate()
        stranger.wait(30)
    truths = [truth for _, truth in hil.log.messages(Truth)]
    assert truths
    assert not any(any(truth.voltages) for truth in truths)


def test_frames_of_a_wrong_length_displace_no_good_one_and_are_counted(hil: Hil) -> None:
    """Some thousands a second on both keys of an open loopback. Slack: the watchdog and patience of `PATIENT`."""
    hil.start(settings=PATIENT)
    statuses = hil.processes.statuses
    hil.eventually("a session", lambda: "controller" in statuses and statuses["controller"].session is not None)
    running = hil.status("controller").session or ""
    keys = [topics.key(name, "aero", session=running) for name in ("measurement", "command")]
    puts = [hil.processes.zenoh.declare_publisher(key, express=True).put for key in keys]
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        for payload in (b"", b"\1", os.urandom(20), bytes(200)):
            for put in puts:
                put(payload)
        time.sleep(0.0005)
    hil.eventually("counted", lambda: min(hil.status(end).refused for end in ("plant", "controller")) > 1000)
    assert (hil.state("plant"), hil.state("controller")) == ("driven", "running")
    assert hil.status("plant").session == running
    assert not hil.happened("tripped")


# ── faults of frames, sensors and motors, in lockstep: their bounds are tested in tests/service/test_faults.py ──


@pytest.mark.parametrize(
    ("faults", "trips"),
    [
        (["command:drop=0.2", "command:duplicate=0.2"], []),  # 50 in a row are not lost by chance: 0.2⁵⁰
        (["command:stuck@1"], ["no fresh command for 100 ms: 0 V"]),  # it does not show that it still sees the plant
    ],
)
def test_lost_frames_are_ridden_out_and_a_stream_that_ends_trips_the_watchdog(
    tmp_path: Path, faults: list[str], trips: list[str]
) -> None:
    with Hil(tmp_path, lockstep=True) as hil:
        hil.start(settings={"plant.faults": faults})
        hil.run(3)
        assert hil.log.trips == trips
        assert trips or hil.log.figures.z_track < 8e-4  # 7.2e-4 without faults: the start's error
