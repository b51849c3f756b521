"""Conformance suite of the plant end: the same assertions for every plant.

Against a real plant: `pytest --pyargs aeroloop.service.testing.conformance --hil-plant=can --hil-config=FILE`; against
one of your own, `--hil-plant=package.module:Class`, with its settings, wire and law in FILE. The plant moves: it turns
by some 20° in pitch and 30° in yaw, and runs at its voltage limit for half a second.

A node on a CAN bus (`--hil-plant=can`) keeps its own settings, which FILE states: the suite changes none of them. It
needs `plant.limits.max_saturated_s` of 0.5 at most, and skips the test of that limit otherwise.

Runs in real time on real processes. Bounds are the watchdog's time plus slack for a busy machine.
"""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.states import PlantState
from aeroloop.service.testing.hil import Hil, HilLog

SLACK_S = 0.3
LONGEST_SATURATED_S = 0.5  # the reference of that test keeps a motor at its limit for longer, at each half turn
pytestmark = pytest.mark.processes

PATIENT = {"plant.watchdog_s": 2, "controller.stale_s": 2, "wire.counter_bits": 11}
"""For tests of other things than the watchdog, where the plant end takes its settings from here."""


@pytest.fixture
def patient(hil_plant: str) -> dict[str, object]:
    """`PATIENT`; nothing for a node, which has its watchdog and its wire whatever the suite would like."""
    return {} if hil_plant == "can" else dict(PATIENT)


def times(log: HilLog, kind: str, role: str) -> list[int]:
    """Times at which a role published an event of this kind [ns]."""
    return [at for at, event in log.messages(Event) if event.kind == kind and event.role == role]


def test_it_measures_at_its_rate_counting_from_0_and_the_loop_tracks(hil: Hil, patient: dict[str, object]) -> None:
    hil.start(settings={**patient, "reference.amplitude": [0, 10, 20]}, drive=False)
    frames: list[tuple[int, bytes]] = []
    hil.processes.zenoh.declare_subscriber(
        topics.key("measurement", hil.settings.vehicle),
        lambda sample: frames.append((time.monotonic_ns(), sample.payload.to_bytes())),
    )
    hil.processes.start("controller")
    hil.eventually("driving", lambda: hil.state("plant") == PlantState.DRIVEN)
    hil.run(3.0)
    form, period_ns = hil.settings.wire.measurement, hil.settings.loop.period_ns
    counters = form.counters
    measured = [(at, counter) for at, frame in frames if (counter := form.counter(frame)) is not None]
    assert measured[0][1] == 0
    # The counter follows the time and counts skipped ticks too, so one offset fits all frames within their lateness. A
    # tick up to a period late is still taken; a stall or a bridge publishes it later. A counter of frames would slip at
    # each skipped tick, and no offset would fit.
    half = counters / 2
    behind = np.array([(counter - (at - measured[0][0]) / period_ns) % counters for at, counter in measured])
    fits = max(np.count_nonzero(np.abs((behind - offset + half) % counters - half) < 1.5) for offset in behind)
    assert fits > 0.8 * len(behind)
    steps = [(after - before) % counters for (_, before), (_, after) in itertools.pairwise(measured)]
    assert steps.count(1) > len(steps) / 2  # it counts by one; up to a fifth of the ticks was skipped here
    figures = hil.log.figures
    rate = hil.settings.loop.rate_hz
    # A plant end skips ticks in a stall and never makes up for them; how many depends on the machine: on two shared
    # cores 296 of 500 a second arrived once. Most measurements and commands must arrive, and none faster than the rate.
    assert rate / 2 < figures.measurement.frames_per_s < 1.01 * rate
    assert figures.command.frames_per_s > rate / 2
    assert figures.max_error_deg < 10
    assert figures.latency_us.count > 0


def test_without_commands_it_trips_within_the_watchdog_and_says_why(hil: Hil) -> None:
    hil.start(settings={"reference.amplitude": [0, 5, 5]})
    hil.run(2.0)  # until no motor is at its limit: the last command is held, and must trip nothing but the watchdog
    hil.pause("controller")
    hil.eventually("the trip", lambda: hil.state("plant") == "tripped")
    log = hil.log
    last_command = max(log.times("plant", "received"))
    assert (times(log, "tripped", "plant")[0] - last_command) * 1e-9 < hil.settings.plant.watchdog_s + SLACK_S
    assert "no fresh command" in log.trips[0] or "no command in time" in log.trips[0] or "is gone" in log.trips[0]


def test_an_operators_stop_acts_at_once_and_no_controller_drives_it_before_it_is_armed(
    hil: Hil, patient: dict[str, object]
) -> None:
    hil.start(settings=patient)
    stopped = time.time_ns()
    hil.stop()
    hil.eventually("tripped", lambda: hil.state("plant") == "tripped")
    hil.eventually("the refusal", lambda: hil.happened("refused", "stopped by an operator"))
    hil.run(0.5)
    assert hil.state("plant") == "tripped"
    hil.arm()
    hil.eventually("driving again", lambda: hil.state("plant") == "driven")
    assert (times(hil.log, "tripped", "plant")[0] - stopped) * 1e-9 < SLACK_S


def test_at_its_voltage_limit_for_too_long_it_trips(hil: Hil, hil_plant: str, patient: dict[str, object]) -> None:
    """A reference whose rate the motors cannot reach within the time allowed at the limit."""
    fast = {"reference.amplitude": [0, 0, 150], "reference.frequency": [0, 0, 4]}
    limit = {} if hil_plant == "can" else {"plant.limits.max_saturated_s": 0.3}
    hil.start(settings={**patient, **fast, **limit}, drive=False)
    if hil.settings.plant.limits.max_saturated_s > LONGEST_SATURATED_S:
        pytest.skip(f"the node's plant.limits.max_saturated_s is more than {LONGEST_SATURATED_S:g}: set it to 0.3")
    hil.processes.start("controller")
    hil.eventually("the trip", lambda: hil.happened("tripped"))
    assert "voltage" in hil.log.trips[0]


def test_without_a_valid_measurement_it_trips_and_says_so(hil: Hil, hil_plant: str, patient: dict[str, object]) -> None:
    if hil_plant in ("can", "can-node-c", "quanser"):
        pytest.skip("only an emulated plant's sensors fail on request")
    hil.start(settings={**patient, "plant.faults": ["rate:off@0.3"]}, drive=False)
    hil.processes.start("controller")
    hil.eventually("the trip", lambda: hil.happened("tripped"))
    assert "no valid" in hil.log.trips[0]


def test_when_its_process_stops_it_publishes_that_and_its_controller_searches_again(
    hil: Hil, patient: dict[str, object]
) -> None:
    hil.start(settings=patient)
    assert hil.processes.stop("plant") == 0
    hil.eventually("searching", lambda: hil.state("controller") == "searching")
    assert times(hil.log, "stopped", "plant")
