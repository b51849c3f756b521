"""Whole system as a user starts it: real processes, real sockets, real logs.

Tests that need no clock run in lockstep. A test in real time states its slack: the suite must pass on a shared machine
with two cores, where a process may wait for hundreds of milliseconds.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Channel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Truth
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.config import load
from aeroloop.service.host.operator import gather
from aeroloop.service.logs.mcap_file import records
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.review.review import review
from aeroloop.service.testing.hil import HilLog
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous

AEROLOOP = [sys.executable, "-P", "-m", "aeroloop"]
FIGURES = ("duration_s", "z_track", "u_total", "max_error_deg", "final_error_deg", "measurement", "command")

START_S = 30.0
"""Slack for starting processes: each takes about 1 s of CPU here, and CI may have other work."""


PATIENT = ("--set", "plant.watchdog_s=2", "--set", "controller.stale_s=2", "--set", "wire.counter_bits=11")
"""For what does not try the watchdog: a machine that stalls for over 100 ms must not end a session meant to go on."""


def aeroloop(*arguments: str) -> dict[str, Any]:
    """Run a command with --json and return what it printed."""
    done = subprocess.run([*AEROLOOP, *arguments, "--json"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


def events(log: Path) -> list[Event]:
    """The events in a log, in order."""
    with log.open("rb") as file:
        return [
            Event.model_validate_json(message.data)
            for _, channel, message in make_reader(file).iter_messages()
            if channel.topic.startswith(topics.key("event", "aero", role=""))
        ]


def eventually(what: str, condition: Callable[[], bool], timeout_s: float = START_S) -> None:
    """Wait for a condition that another process brings about."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen within {timeout_s:g} s"
        time.sleep(0.05)


def test_a_demo_in_lockstep_gives_the_experiments_figures_to_the_last_bit_and_review_those_of_the_demo(
    tmp_path: Path,
) -> None:
    log, fault = tmp_path / "a.mcap", "rate:bias=0.01@0.5..1"
    cell = ("--duration", "2", "--set", f'plant.faults=["{fault}"]')
    demo = aeroloop("demo", "--lockstep", "--log", str(log), *cell)
    experiment = aeroloop("lab", "experiment", *cell)
    assert {name: demo[name] for name in FIGURES} == {name: experiment[name] for name in FIGURES}
    assert demo["skipped_ticks"] == 0
    assert [(one["fault"], one["begin_s"], one["end_s"]) for one in demo["faults"]] == [(fault, 0.5, 1.0)]
    judged = aeroloop("log", "review", str(log))
    figures = {name: judged[name] for name in demo}
    figures["reasons"] = {name: why for name, why in judged["reasons"].items() if name in demo}
    assert figures == demo  # which has no age and holds nothing against the theorem


def test_a_demo_in_lockstep_without_quantization_gives_the_experiments_figures_to_the_last_bit(tmp_path: Path) -> None:
    cell = ("--duration", "1", "--bits", "cont")
    demo = aeroloop("demo", "--lockstep", "--log", str(tmp_path / "a.mcap"), *cell)
    experiment = aeroloop("lab", "experiment", *cell)
    assert {name: demo[name] for name in FIGURES} == {name: experiment[name] for name in FIGURES}


def test_a_demo_in_real_time_tracks_and_two_run_beside_each_other(tmp_path: Path) -> None:
    command = [*AEROLOOP, "demo", "--duration", "4", "--json", *PATIENT]
    both = [
        subprocess.Popen([*command, "--log", str(tmp_path / f"{i}.mcap")], stdout=subprocess.PIPE, text=True)
        for i in range(2)
    ]
    ended = [(process.communicate(timeout=120)[0], process.returncode) for process in both]
    for out, code in ended:
        assert code == 0
        figures = json.loads(out)
        # 16 ticks short if the last frame was sent over 24 ms late: its four bits then stand for a later tick. Longer
        # if the last tick was missed, for then the next one that comes ends the run: by at most the watchdog's 100 ms.
        assert 4.0 - 16 * 0.002 <= figures["duration_s"] <= 4.0 + 0.1
        # Two demos want six processes on two cores, so a share of the ticks may be late. The plant holds its last
        # command meanwhile; the error stays that of the reference's start plus quantization, some 2.5 degrees. Half
        # the ticks and 10 degrees separate a loop that works from one that does not.
        assert figures["command"]["frames_per_s"] > 250
        assert figures["max_error_deg"] < 10
        assert figures["latency_us"]["count"] > 0


@pytest.mark.smoke
def test_interrupting_the_demo_ends_it_cleanly_with_a_readable_log(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    demo = subprocess.Popen(
        [*AEROLOOP, "demo", "--duration", "60", "--json", "--log", str(log), *PATIENT],
        stdout=subprocess.PIPE,
        text=True,
    )
    eventually("recording", grown(log))
    demo.send_signal(signal.SIGINT)
    out, _ = demo.communicate(timeout=30)
    assert demo.returncode == 130
    assert json.loads(out)["z_track"] == review(log).z_track
    last = {event.role: event.kind for event in events(log)}
    assert last == {"plant": "stopped", "controller": "stopped", "recorder": "started"}


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Start a part by itself, as a user would, on a network of this test's own. Killed at the end if it still runs."""
    rendezvous = free_rendezvous()
    started: list[subprocess.Popen[bytes]] = []

    def start(part: str, *arguments: str) -> subprocess.Popen[bytes]:
        command = [*AEROLOOP, part, "--set", f"network.rendezvous={rendezvous}", *PATIENT, *arguments]
        with (tmp_path / f"{part}-{len(started)}.stderr").open("wb") as stderr:
            started.append(subprocess.Popen(command, stderr=stderr))
        return started[-1]

    start.rendezvous = rendezvous  # type: ignore[attr-defined]
    yield start
    for process in started:
        process.kill()
        process.wait()


def stop(process: subprocess.Popen[bytes]) -> None:
    """SIGTERM, and the clean end that must follow within 10 s (closing Zenoh and the log takes well under one)."""
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0


def grown(log: Path) -> Callable[[], bool]:
    """Whether a log holds a controller's trace; a chunk is closed every second."""

    def holds_ticks() -> bool:
        if not log.exists() or not log.stat().st_size:
            return False
        topics_in_it = {record.topic for record in records(log) if isinstance(record, Channel)}
        return any(topic.startswith("aeroloop/") and topic.endswith("/trace/controller") for topic in topics_in_it)

    return holds_ticks


def said(folder: Path, part: str, text: str) -> Callable[[], bool]:
    """Whether any process of this kind has said something on stderr."""
    return lambda: any(text in path.read_text() for path in folder.glob(f"{part}-*.stderr"))


def test_parts_start_in_any_order_and_find_each_other_after_each_is_restarted(
    tmp_path: Path, parts: Callable[..., subprocess.Popen[bytes]]
) -> None:
    def times_granted() -> int:
        return sum(path.read_text().count("granted to") for path in tmp_path.glob("emulator-*.stderr"))

    controller = parts("controller")
    eventually("the controller", said(tmp_path, "controller", "looks for aero"))
    emulator = parts("emulator")
    eventually("a first session", lambda: times_granted() == 1)
    recorder = parts("recorder", "--log", str(tmp_path / "a.mcap"))
    eventually("the recorder", said(tmp_path, "recorder", "recording to"))

    stop(emulator)
    eventually("the controller's notice", said(tmp_path, "controller", "stopped commanding, looking for aero"))
    emulator = parts("emulator")
    eventually("a session with the new emulator", lambda: times_granted() == 2)

    controller.kill()
    controller.wait()
    eventually("0 V", said(tmp_path, "emulator", "0 V"))
    controller = parts("controller", "--auto-arm")
    eventually("a session with the new controller", lambda: times_granted() == 3)

    stop(recorder)
    recorder = parts("recorder", "--log", str(tmp_path / "b.mcap"))
    eventually("frames in the new log", grown(tmp_path / "b.mcap"))
    for process in (controller, emulator, recorder):
        stop(process)
    assert review(tmp_path / "b.mcap").z_track is not None
    for path in tmp_path.glob("*.stderr"):
        assert "Traceback" not in path.read_text()


def test_a_loop_runs_over_unix_sockets(tmp_path: Path, parts: Callable[..., subprocess.Popen[bytes]]) -> None:
    """Slack: in lockstep, and 30 s for two processes to start."""
    network = "network.rendezvous=" + json.dumps([f"unixsock-stream/{tmp_path}/{i}" for i in range(2)])
    words = ("--set", network, "--set", "loop.lockstep=true")
    parts("emulator", *words)
    controller = parts("controller", "--auto-arm", "--duration", "0.5", *words)
    assert controller.wait(START_S) == 0


def test_a_second_controller_is_refused_by_name_and_a_controller_of_another_wire_by_field(
    tmp_path: Path, parts: Callable[..., subprocess.Popen[bytes]]
) -> None:
    parts("emulator")
    parts("controller", "--auto-arm")
    eventually("a session", said(tmp_path, "emulator", "granted to"))
    parts("controller", "--auto-arm")
    eventually("refusal by name", said(tmp_path, "controller", "the plant is held by controller-"))
    parts("controller", "--auto-arm", "--set", "wire.rate.bits=10")
    eventually("refusal by field", said(tmp_path, "controller", "rate.bits: 8, not 10"))


def test_a_plant_whose_controller_is_killed_goes_to_zero_volts_within_the_watchdog(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    settings = load(
        overrides=[
            f"network.rendezvous={free_rendezvous()}",
            f"recorder.path={log}",
            "controller.require_recorder=true",
            "controller.auto_arm=true",
            "controller.after_restart=configured",
            "plant.truth_rate_hz=500",
        ]
    )
    with ProcessGroup(settings) as processes:
        processes.start("recorder")
        processes.start("plant")
        processes.await_role("recorder")
        processes.await_role("plant")
        commands: list[bytes] = []
        processes.zenoh.declare_subscriber(
            topics.key("command", settings.vehicle), lambda sample: commands.append(sample.payload.to_bytes())
        )
        processes.start("controller")
        eventually("driving", lambda: len(commands) > 200)
        processes.stop("controller", signal.SIGKILL)
        time.sleep(0.5)  # five watchdogs, and all the time there is for a wrong plant to go on at its last command
    last_command = max(HilLog(log).times("plant", "received"))
    truths = [(at_ns, truth) for at_ns, truth in HilLog(log).messages("truth") if isinstance(truth, Truth)]
    driven = [at_ns for at_ns, truth in truths if any(truth.voltages)]
    # The watchdog's 100 ms; 100 ms of slack for a grid that is kept waiting by other work on the machine.
    assert driven
    assert max(driven) - last_command < 200_000_000
    assert truths[-1][0] > max(driven)
    assert any(event.kind == "tripped" for event in events(log))


def test_an_operator_arms_looks_and_stops_and_no_controller_drives_before_the_plant_is_armed_again(
    tmp_path: Path, parts: Callable[..., subprocess.Popen[bytes]]
) -> None:
    parts("emulator", "--set", "plant.armed_at_start=false")
    eventually("the emulator", said(tmp_path, "emulator", "waits for a claim"))
    rendezvous = parts.rendezvous  # type: ignore[attr-defined]  # set by the fixture

    def op(verb: str) -> str:
        command = [*AEROLOOP, "op", verb, "--set", f"network.rendezvous={rendezvous}"]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout

    def states() -> dict[str, str]:
        statuses = gather(NetworkSettings(rendezvous=[rendezvous])).statuses["aero"]
        return {role: status.state for role, status in statuses.items()}

    parts("controller")
    eventually("a refusal", said(tmp_path, "controller", "`aeroloop op arm` clears it"))
    printed = aeroloop("op", "status", "--set", f"network.rendezvous={rendezvous}")["aero"]
    assert {role: status["state"] for role, status in printed.items()} == {"plant": "idle", "controller": "searching"}
    op("arm")
    eventually("a session", said(tmp_path, "emulator", "granted to"))
    eventually("driving", lambda: states() == {"plant": "driven", "controller": "running"})

    op("stop")
    eventually("0 V", said(tmp_path, "emulator", "stopped by an operator ("))
    parts("controller", "--auto-arm")  # even one that may arm a plant does not arm this one
    eventually("its refusal", said(tmp_path, "controller", "stopped by an operator"))
    eventually("still", lambda: states()["plant"] == "tripped")
    op("arm")
    eventually("driving again", lambda: states()["plant"] == "driven")


def test_what_is_not_a_log_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for content in (b"", b"not a log", b"\x89MCAP0\r\n" * 3):
        path.write_bytes(content)
        with pytest.raises(ReviewError) as refused:
            review(path)
        assert "\n" not in str(refused.value)
        assert str(path) in str(refused.value)
