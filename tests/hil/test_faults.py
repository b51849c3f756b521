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
import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Telemetry, Truth
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.testing.hil import Hil, HilLog
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.cable import Cable
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


def test_a_controller_finds_a_plant_that_was_killed_and_came_back(hil: Hil) -> None:
    hil.start(settings=PATIENT)
    hil.run(0.3)
    hil.kill("plant")
    hil.eventually("searching", lambda: hil.state("controller") == "searching")
    hil.restart("plant")
    hil.eventually("driving again", lambda: hil.state("plant") == "driven" and hil.state("controller") == "running")
    assert hil.log.figures.z_track > 0


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


@pytest.mark.parametrize("how", ["kill", "pause"])
def test_the_loop_does_not_notice_what_happens_to_its_recorder(hil: Hil, how: str) -> None:
    hil.start(settings=PATIENT)
    hil.run(0.3)
    session = hil.status("plant").session
    if how == "kill":
        hil.kill("recorder")
    else:
        hil.pause("recorder")
    hil.run(2.5)
    assert hil.state("plant") == "driven"
    assert hil.status("plant").session == session
    if how == "kill":
        hil.restart("recorder")
    else:
        hil.resume("recorder")
    hil.run(1.5)
    assert hil.status("plant").session == session
    assert hil.log.figures.measurement.frames_per_s > 0


# ── the network ──


@pytest.fixture
def far_apart() -> Iterator[tuple[Cable, list[Event], list[Truth], list[subprocess.Popen[bytes]]]]:
    """An emulator and a controller with one cable between them, seen from the emulator's end."""
    rendezvous = free_rendezvous()
    common = ["--set", "network.gossip=false", "--set", "plant.truth_rate_hz=500"]
    emulator = subprocess.Popen([*AEROLOOP, "emulator", "--set", f"network.rendezvous={rendezvous}", *common])
    events: list[Event] = []
    truths: list[Truth] = []
    started = [emulator]
    deadline = time.monotonic() + 30  # for a process to start; about a second here
    while not _listens(rendezvous):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with (
        join(NetworkSettings(rendezvous=[rendezvous], gossip=False)) as session,
        Cable(int(rendezvous.rsplit(":", 1)[1])) as cable,
    ):
        for name, into, model in (("event", events, Event), ("truth", truths, Truth)):

            def receive(sample: zenoh.Sample, into: list = into, model: type = model) -> None:  # type: ignore[type-arg]
                into.append(model.model_validate_json(sample.payload.to_bytes()))  # type: ignore[attr-defined]

            session.declare_subscriber(topics.key(name, "aero"), receive)
        near = ["controller", "--auto-arm", "--set", f"network.rendezvous={cable.endpoint}"]
        near += ["--set", "controller.after_restart=configured"]  # it drives
        started.append(subprocess.Popen([*AEROLOOP, *near, *common]))
        yield cable, events, truths, started
    for process in started:
        process.kill()
        process.wait()


def _listens(endpoint: str) -> bool:
    import socket

    host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def test_a_cut_cable_brings_the_motors_to_rest_and_a_mended_one_the_controller_back(
    far_apart: tuple[Cable, list[Event], list[Truth], list[subprocess.Popen[bytes]]],
) -> None:
    cable, events, truths, _ = far_apart

    def eventually(condition: object, what: str) -> None:
        deadline = time.monotonic() + 30  # reconnecting takes under a second here; CI may be busy
        while not condition():  # type: ignore[operator]
            assert time.monotonic() < deadline, what
            time.sleep(0.02)

    def claims() -> int:
        return sum(event.kind == "claimed" for event in events)

    eventually(lambda: claims() == 1 and truths and any(truths[-1].voltages), "driving")
    cable.cut()
    cut_tick = truths[-1].tick
    eventually(lambda: any(event.kind == "tripped" for event in events), "the trip")
    time.sleep(0.2)
    driven_tick = max(truth.tick for truth in truths if any(truth.voltages))
    assert (driven_tick - cut_tick) * 0.002 < WATCHDOG_S + SLACK_S
    assert "no fresh command for" in next(event.text for event in events if event.kind == "tripped")
    assert not any(truths[-1].voltages)
    cable.mend()
    eventually(lambda: claims() == 2, "a second session")


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


def test_lost_and_repeated_commands_are_ridden_out(lockstep: Hil) -> None:
    """The watchdog's 50 ticks without a command do not come about by chance: 0.2⁵⁰. The plant holds what it has."""
    lockstep.start(settings={"plant.faults": ["command:drop=0.2", "command:duplicate=0.2"]})
    lockstep.run(5)
    assert lockstep.state("plant") == "driven"
    figures = lockstep.log.figures
    # 9.5e-4 without faults (5 s): the start's error, which no command can mend sooner. A fifth lost adds little.
    assert figures.z_track < 12e-4
    assert lockstep.log.trips == []


def test_commands_that_overtake_each_other_are_taken_in_order_or_not_at_all(lockstep: Hil) -> None:
    lockstep.start(settings={"plant.faults": ["command:reorder=0.1"]})
    lockstep.run(3)
    assert lockstep.state("plant") == "driven"
    assert lockstep.log.trips == []


def test_measurements_that_are_lost_are_ridden_out(lockstep: Hil) -> None:
    lockstep.start(settings={"plant.faults": ["measurement:drop=0.2"]})
    lockstep.run(5)
    assert lockstep.state("plant") == "driven"
    figures = lockstep.log.figures
    assert figures.z_track < 12e-4
    assert figures.skipped_ticks  # and the log shows them


def test_a_command_stream_that_ends_trips_the_watchdog_to_the_tick(lockstep: Hil) -> None:
    lockstep.start(settings={"plant.faults": ["command:off@1"]})
    lockstep.run(2)
    log = lockstep.log
    assert log.trips == ["no fresh command for 100 ms: 0 V"]


def test_a_command_repeated_for_ever_trips_the_watchdog(lockstep: Hil) -> None:
    """A stuck sender proves nothing about whether it still sees the plant."""
    lockstep.start(settings={"plant.faults": ["command:stuck@1"]})
    lockstep.run(2)
    assert lockstep.log.trips == ["no fresh command for 100 ms: 0 V"]


def test_corrupted_commands_end_in_a_trip_with_its_cause_and_do_no_harm(lockstep: Hil) -> None:
    """One bit in sixteen makes the code that says "no valid value" out of 0 V, so a trip is a matter of time."""
    lockstep.start(settings={"plant.faults": ["command:garble=0.3@0.5"]})
    lockstep.run(2.5)  # 300 corrupted frames, of which the first dozens do
    log = lockstep.log
    (trip,) = log.trips
    assert "no valid value" in trip or "no fresh command" in trip
    assert all(abs(u) <= 24 for _, truth in log.messages("truth") if isinstance(truth, Truth) for u in truth.voltages)


def test_commands_that_are_late_for_good_are_refused_although_their_echo_looks_fresh(hil: Hil) -> None:
    """300 ms are 150 ticks, of the 256 that the echo distinguishes."""
    hil.start(settings=FAST_TRUTH)
    hil.run(0.3)
    hil.inject("command:delay=0.3")
    hil.eventually("the trip", lambda: hil.happened("tripped"))
    hil.run(0.3)
    log = hil.log
    assert "no fresh command for" in log.trips[0]
    injected = next(at for at, e in log.messages("event") if isinstance(e, Event) and "fault injected" in e.text)
    assert seconds_driven_after(log, injected) < WATCHDOG_S + SLACK_S


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
