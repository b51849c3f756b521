"""Operator's verbs on a running loop, by the command line, and their traces in the log."""

from __future__ import annotations

import getpass
import json
import re
import socket
import subprocess
import time
from datetime import UTC
from math import degrees
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Telemetry, Truth
from aeroloop.protocol.messages.operator import Setpoint
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.service.review.review import read
from aeroloop.service.testing.hil import Hil
from tests.hil.test_recorder import assert_whole
from tests.support.processes import AEROLOOP, LONGEST_S, PATIENT, aeroloop


def op(hil: Hil, *words: str, code: int = 0) -> str:
    """What a verb prints: of one that is refused, with code 1, a line."""
    said = aeroloop("op", *words, "--set", f"network.rendezvous={hil.settings.network.rendezvous}", code=code)
    assert not code or len(said.splitlines()) == 1
    return said


@pytest.mark.parametrize("transmit", ["periodic", "on_change"])
def test_an_operator_turns_the_body_and_changes_gains_and_the_log_is_computed_again_to_the_last_bit(
    hil: Hil, transmit: str
) -> None:
    """Slack: `PATIENT`'s. On change, most ticks of a body that rests again need no frame, and every tick is judged."""
    hil.start(settings={**PATIENT, "wire.transmit": transmit, "reference.kind": "hold"})
    op(hil, "goto", "0", "-10", "20", "--in", "1")
    op(hil, "set-gains", "--C2", "0.2", "0.2", "0.2")
    assert " would do" in op(hil, "goto", "0", "0", "170", "--in", "0.5", code=1)  # the first may still have to brake
    assert "rolls" in op(hil, "goto", "5", "0", "0", "--in", "3", code=1)
    assert "law.C1[2]: should be less than or equal to 20" in op(hil, "set-gains", "--C1", "1", "1", "100", code=1)
    hil.run(2.0)
    log, plant, controller = hil.log, hil.status("plant"), hil.status("controller")
    published = [message for _, message in log.messages(Telemetry)]
    roll, pitch, yaw = (degrees(angle) for angle in to_euler(published[-1].desired))
    assert (roll, pitch, yaw) == pytest.approx((0.0, -10.0, 20.0), abs=1e-6)  # quintics and quaternions, rounded
    # The review computes the errors again from frames and changes; the controller published what it had computed.
    ticks = read(log.path).ticks
    computed = dict(zip(ticks.k.tolist(), map(tuple, ticks.attitude_error.tolist()), strict=True))
    compared = [(message.attitude_error, computed[message.tick]) for message in published if message.tick in computed]
    assert len(compared) > 10  # telemetry is published at 10 Hz
    assert all(mine == theirs for mine, theirs in compared)
    assert_whole(log.path, 500)
    if transmit == "on_change":
        assert 0 < plant.sent < 0.7 * plant.ticks
        assert 0 < controller.sent < 0.7 * controller.ticks
        assert log.figures.final_error_deg < 3


def test_prometheus_scrapes_a_running_loop_and_the_stop_that_ends_it(hil: Hil) -> None:
    """Slack: `PATIENT`'s."""
    hil.start(settings=PATIENT)
    network = f"network.rendezvous={hil.settings.network.rendezvous}"
    command = [*AEROLOOP, "op", "metrics", "--port", "0", "--set", network]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            url = next(word for word in server.stdout.readline().split() if word.startswith("http://127.0.0.1:"))

            def scraped(pattern: str) -> float:
                with urlopen(url, timeout=LONGEST_S) as answer:  # noqa: S310  # as printed
                    found = re.search(rf"^{pattern} (\S+)$", answer.read().decode(), re.MULTILINE)
                return float(found[1]) if found else -1.0

            of_plant = r'\{role="plant",vehicle="aero"\}'
            hil.eventually("latencies", lambda: scraped(f"aeroloop_latency_seconds_count{of_plant}") > 250)
            assert scraped(f"aeroloop_latency_seconds_sum{of_plant}") > 0
            error = r"aeroloop_attitude_error_radians\{.*\}"  # of telemetry, which begins after the first statuses
            hil.eventually("telemetry", lambda: scraped(error) >= 0)
            assert scraped(error) < 0.5
            assert scraped(r'aeroloop_state\{.*state="running".*\}') == 1
            stops = r"aeroloop_trips_total\{cause=\"operator's stop\".*\}"
            assert scraped(stops) == 0
            op(hil, "stop")
            hil.eventually("the stop", lambda: scraped(stops) == 1)
            assert scraped(r'aeroloop_state\{.*state="tripped".*\}') == 1
            server.terminate()
            assert (server.communicate(timeout=LONGEST_S), server.returncode) == (("", ""), 0)
        finally:
            server.kill()


def test_the_body_follows_a_file_and_a_live_stream_which_is_held_when_it_falls_silent(hil: Hil, tmp_path: Path) -> None:
    """Slack: `PATIENT`'s; it tracks to a few degrees, as in the paper's experiment."""
    points = tmp_path / "points.csv"
    points.write_text("time,roll,pitch,yaw\n0,0,0,0\n1,0,5,10\n2,0,0,15\n")
    hil.start(settings={**PATIENT, "reference.kind": "hold"})
    op(hil, "track", str(points), "--in", "0.5")
    hil.eventually("the change", lambda: hil.happened("changed", "3 points"))
    hil.run(2.6)
    op(hil, "track", "stream", "--in", "0.5")
    key = topics.key("reference", hil.settings.vehicle)
    for yaw in np.linspace(15, 25, 25):
        hil.processes.zenoh.put(key, Setpoint(attitude=(0.0, 0.0, float(yaw))).encode())
        time.sleep(0.02)
    hil.processes.zenoh.put(key, b"nonsense")
    hil.eventually("its silence", lambda: hil.happened("lost", "no set-point for 0.5 s"))
    hil.run(0.5)
    assert hil.happened("fault", "set-point refused")
    assert hil.state("plant") == "driven"
    log = hil.log
    truths = [truth for _, truth in log.messages(Truth)]
    assert degrees(to_euler(truths[-1].attitude)[2]) == pytest.approx(25.0, abs=4.0)
    assert len(log.changes) > 10  # every set-point that a tick took


def test_a_released_vehicle_is_another_controllers_until_the_first_is_recalled(hil: Hil) -> None:
    """Slack: `PATIENT`'s; a second claim is waited for over two periods of claims, 0.25 s each."""
    hil.start(settings=PATIENT)
    op(hil, "release")
    hil.eventually("holding", lambda: hil.state("controller") == "holding" and hil.state("plant") == "idle")
    hil.run(0.6)
    status = json.loads(op(hil, "status", "--json"))["aero"]
    assert (status["plant"]["state"], status["controller"]["state"]) == ("idle", "holding")
    why = "is holding: released by an operator; `aeroloop op arm` lets it claim aero again"
    assert why in op(hil, "set-gains", "--C2", "0.2", "0.2", "0.2", code=1)
    op(hil, "arm")
    hil.eventually("driving", lambda: hil.state("controller") == "running" and hil.state("plant") == "driven")
    op(hil, "stop")
    hil.eventually("tripped", lambda: hil.state("plant") == "tripped")
    stopped = f"stopped by an operator ({getpass.getuser()}@{socket.gethostname()}): 0 V"
    assert hil.status("plant").cause == stopped
    hil.eventually("its notice", lambda: hil.happened("refused", stopped))
    assert "`aeroloop op arm` clears it" in op(hil, "goto", "0", "0", "0", code=1)
    since = hil.status("plant").since
    assert since is not None
    assert f"{stopped} ({since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC)" in op(hil, "status")
    assert hil.log.trips == [stopped]
