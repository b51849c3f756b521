"""Faults on real processes: 0 V in time, the cause in the log, recovery, and a whole log.

The time to 0 V comes from the log: times of the last command and of the truth, which is published at every tick here.
Bounds are the watchdog's 100 ms plus slack for a shared machine with two cores.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Telemetry, Truth
from aeroloop.service.testing.hil import Hil, HilLog
from tests.support.own_laws import HERE

AEROLOOP = [sys.executable, "-P", "-m", "aeroloop"]
WATCHDOG_S = 0.1
SLACK_S = 0.15
"""For a loop that other work on the machine keeps waiting: it must run to notice anything."""
FAST_TRUTH = {"plant.truth_rate_hz": 500}
PATIENT = {"plant.watchdog_s": 2, "controller.stale_s": 2, "wire.counter_bits": 11}
"""For what does not try the watchdog: a machine that stalls for over 100 ms must not end a session meant to go on."""


def seconds_driven_after(log: HilLog, moment_ns: int) -> float:
    """How long after a moment the motors still had a voltage [s]; the plant must publish at least once after it."""
    truths = [(at, truth) for at, truth in log.messages("truth") if isinstance(truth, Truth)]
    driven = [at for at, truth in truths if any(truth.voltages)]
    assert driven, "the motors never had a voltage, so nothing is shown"
    assert not any(truths[-1][1].voltages), "the motors still have a voltage at the end of the log"
    return (max(driven) - moment_ns) * 1e-9


def last_command_ns(log: HilLog) -> int:
    """When the plant received its last command [ns]."""
    return max(log.times("plant", "received"))


# ── processes that die, stand still and come back ──
@pytest.mark.smoke
def test_the_motors_are_at_rest_in_time_when_the_controller_is_killed_and_a_new_one_takes_over(hil: Hil) -> None:
    hil.start(settings=FAST_TRUTH)
    hil.run(0.5)
    hil.kill("controller")
    hil.eventually("the trip", lambda: hil.happened("tripped", "is gone") or hil.happened("tripped", "no fresh"))
    hil.run(0.3)
    hil.arm()
    hil.restart("controller")
    hil.eventually("a second session", lambda: sum(event.kind == "claimed" for event in hil.events) == 4)
    hil.run(0.3)
    hil.kill("controller")
    hil.run(0.5)
    log = hil.log
    assert seconds_driven_after(log, last_command_ns(log)) < WATCHDOG_S + SLACK_S
    assert len({change.session for change in log.changes}) == 2


def test_a_restarted_controller_is_back_in_control_within_a_second_of_looking_for_the_plant(hil: Hil) -> None:
    hil.start(settings={**PATIENT, "controller.auto_arm": True})
    hil.run(0.5)
    hil.kill("controller")
    hil.restart("controller")
    hil.eventually("a second session", lambda: sum(event.kind == "claimed" for event in hil.events) == 4)
    events = [(at, event) for at, event in hil.log.messages("event") if isinstance(event, Event)]
    looks = [at for at, event in events if event.role == "controller" and event.kind == "started"][-1]
    has = [at for at, event in events if event.role == "controller" and event.kind == "claimed"][-1]
    # It claims four times a second, and the plant sees at once that its holder's token is gone.
    assert (has - looks) * 1e-9 < 1.0


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
    trip = [at for at, event in log.messages("event") if isinstance(event, Event) and event.kind == "tripped"]
    assert len(trip) == 1
    assert seconds_driven_after(log, trip[0]) < SLACK_S  # nothing that it said after the trip moved a motor


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
    events = [(at, event) for at, event in log.messages("event") if isinstance(event, Event)]
    ended = next(at for at, event in events if event.kind in ("released", "tripped") and event.session == old)
    lost = next(at for at, event in events if event.kind == "lost")
    truths = [(at, truth) for at, truth in log.messages("truth") if isinstance(truth, Truth) and at > lost]
    # One tick at the most: the one that it was waiting for when it was stopped.
    assert sum(any(truth.voltages) for at, truth in truths if at < ended) <= 1


# ── strangers ──


@pytest.mark.smoke
def test_without_the_session_a_stranger_moves_nothing(hil: Hil) -> None:
    """A stranger that publishes on every likely key; the plant subscribes to its own session's only."""
    hil.start(settings={"controller.require_recorder": True}, drive=False)
    vehicle, wire = hil.settings.vehicle, hil.settings.wire
    full = wire.command.pack(0, [31, 31])
    deadline = time.monotonic() + 1.0
    while time.monotonic() < deadline:
        for session in ("stranger", "*", "**", "00000000"):
            hil.processes.zenoh.put(topics.key("command", vehicle, session=session), full)
        time.sleep(0.01)
    log = hil.log
    assert not any(any(truth.voltages) for _, truth in log.messages("truth") if isinstance(truth, Truth))


def test_a_controller_of_another_wire_is_refused_by_field_and_moves_nothing(hil: Hil) -> None:
    hil.start(settings=FAST_TRUTH, drive=False)
    other = ["--set", "wire.voltage.bits=8", "--set", f"network.rendezvous={hil.settings.network.rendezvous}"]
    stranger = subprocess.Popen([*AEROLOOP, "controller", "--auto-arm", *other])
    try:
        hil.eventually("the refusal", lambda: hil.happened("refused", "voltage.bits: 6, not 8"))
    finally:
        stranger.terminate()
        stranger.wait(30)
    assert not any(any(truth.voltages) for _, truth in hil.log.messages("truth") if isinstance(truth, Truth))


# ── frames, in lockstep where the clock does not matter ──


@pytest.fixture
def lockstep(tmp_path: Path) -> Iterator[Hil]:
    """As `hil`, always in lockstep."""
    with Hil(tmp_path, lockstep=True) as loop:
        yield loop


RIDDEN_OUT: list[str] = []
WATCHDOG = ["no fresh command for 100 ms: 0 V"]


@pytest.mark.parametrize(
    ("faults", "trips"),
    [
        (["command:drop=0.2", "command:duplicate=0.2"], RIDDEN_OUT),  # 50 in a row do not get lost by chance: 0.2⁵⁰
        (["command:reorder=0.1"], RIDDEN_OUT),
        (["measurement:drop=0.2"], RIDDEN_OUT),
        (["command:off@1"], WATCHDOG),
        (["command:stuck@1"], WATCHDOG),  # a stuck sender proves nothing about whether it still sees the plant
    ],
)
def test_lost_repeated_and_overtaking_frames_are_ridden_out_and_a_stream_that_ends_trips_the_watchdog(
    lockstep: Hil, faults: list[str], trips: list[str]
) -> None:
    lockstep.start(settings={"plant.faults": faults})
    lockstep.run(3)
    log = lockstep.log
    assert log.trips == trips
    if trips == RIDDEN_OUT:
        assert log.figures.duration_s > 2.9
        # 7.2e-4 without faults: the start's error, which no command can mend sooner. A fifth lost adds little.
        assert log.figures.z_track < 8e-4


# ── sensors and motors: the processes do what the experiment does, whose tests have the bounds ──


@pytest.mark.parametrize("fault", ["rate:noise=0.1@0.5", "attitude:drop=0.1@0.5", "motors:garble=0.05@0.5"])
def test_a_fault_does_over_the_network_what_it_does_in_one_process(lockstep: Hil, fault: str) -> None:
    from aeroloop.service.config import load
    from aeroloop.service.lab.experiment import run_experiment

    lockstep.start(settings={"plant.faults": [fault]})
    lockstep.run(2)
    figures = lockstep.log.figures
    alone = run_experiment(load(overrides=[f'plant.faults=["{fault}"]']), figures.duration_s)
    assert figures.z_track == alone.z_track
    assert figures.u_total == alone.u_total


# ── what a user's code leaves behind ──


def test_the_cycles_that_a_law_in_python_drops_at_every_tick_are_collected_while_it_drives(hil: Hil) -> None:
    """20 000 objects in 4 s, of which it keeps 1 000. A machine that stalls makes fewer ticks, and as many to keep."""
    hil.start(settings={**PATIENT, "law.kind": f"{HERE}:Cyclic"})
    hil.run(4.0)
    assert hil.state("controller") == "running"
    alive = [sample.state["alive"][0] for _, sample in hil.log.messages("telemetry") if isinstance(sample, Telemetry)]
    assert len(alive) > 20
    assert max(alive) < 7_000
