"""Clocks that are wrong, step or run fast at either end: loop, watchdog, log, review and replay must not change.

libfaketime gives one process another clock, with limits (0.9.10, Python 3.11). With a true monotonic clock it breaks
clock_nanosleep, in which plant and recorder sleep; with a false one it breaks sem_clockwait, in which a controller
waits. So the controller's clocks are false except for the monotonic one, and all of the plant's are false. The other
cases, steps of the plant's and the recorder's clocks and a fast clock of the controller, patch Python's `time`, the
only way in which this program reads clocks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from aeroloop.protocol.messages.trace import End
from aeroloop.service.config import load
from aeroloop.service.testing.hil import HilLog
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous
from tests.hil.test_recorder import PATIENT, RATE, Statuses, assert_whole
from tests.support.zenoh_network import eventually

LIBRARIES = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))

pytestmark = pytest.mark.skipif(not LIBRARIES, reason="libfaketime is not installed")

RUN_S = 3.0


def faketime(said: str, **more: str) -> dict[str, str]:
    """The environment of a process whose clock reads as libfaketime's `said`."""
    return {"LD_PRELOAD": str(LIBRARIES[0]), "FAKETIME": said, "FAKETIME_NO_CACHE": "1", **more}


WALL_ALONE = {"FAKETIME_DONT_FAKE_MONOTONIC": "1"}
STEP_S = 3600

CLOCKS = f"""
import os, time
rate, step = float(os.environ.get("CLOCK_RATE", "1")), os.environ.get("CLOCK_STEP", "")
wall, monotonic, sleep = time.time_ns, time.monotonic_ns, time.sleep
began = monotonic()
gained = lambda: round((rate - 1) * (monotonic() - began))
time.time_ns = lambda: wall() + gained() + {STEP_S} * 10**9 * os.path.exists(step)
time.monotonic_ns = lambda: monotonic() + gained()
time.monotonic = lambda: time.monotonic_ns() * 1e-9
time.sleep = lambda seconds: sleep(seconds / rate)
"""
"""A sitecustomize.py: clocks that run fast by CLOCK_RATE; a wall clock that steps once the file CLOCK_STEP is there."""


def python_clocks(tmp_path: Path, **environment: str) -> dict[str, str]:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(CLOCKS)
    return {"PYTHONPATH": str(tmp_path / "site"), **environment}


def run(
    tmp_path: Path, environments: Mapping[str, Mapping[str, str]], during: Sequence[Callable[[], object]] = ()
) -> None:
    """A loop of some seconds with events in it, of which nothing may be missing or unanswered for long, and its log."""
    settings = load(overrides=[
        *(f"{name}={value}" for name, value in PATIENT.items()),
        f"network.rendezvous={free_rendezvous()}", f"recorder.path={tmp_path / 'a.mcap'}", "controller.auto_arm=true",
        "controller.require_recorder=true",
    ])  # fmt: skip
    with ProcessGroup(settings) as processes:
        statuses = Statuses(processes, settings)
        for role in ("recorder", "plant", "controller"):
            processes.start(role, environment=environments.get(role))
        eventually("driving", lambda: statuses.state("plant") == "driven")
        for event in during:
            time.sleep(RUN_S / (len(during) + 1))
            event()
        time.sleep(RUN_S / (len(during) + 1))
        assert statuses.state("plant") == "driven"
        for role in ("controller", "plant"):
            processes.stop(role)  # type: ignore[arg-type]  # a role
    judged = assert_whole(tmp_path, round(0.5 * RUN_S * RATE))
    assert judged.sessions == 1
    assert judged.trips == []
    # A shared machine misses ticks, more so under libfaketime; a clock that decided anything would lose nearly all.
    assert judged.skipped_ticks is not None
    assert judged.skipped_ticks < 0.5 * RUN_S * RATE
    assert RUN_S - 1 <= judged.duration_s <= RUN_S + 4
    assert judged.z_track is not None
    assert judged.z_track < 0.02
    assert judged.lapses.get("stale", 0) == 0


@pytest.mark.parametrize(
    ("controller", "plant"), [("+10s", "-10s"), ("-10s", "+10s"), ("+0.4s", "+0 x1.01"), ("1 % fast", "+0.4s")]
)
def test_clocks_that_are_wrong_at_both_ends_change_nothing(tmp_path: Path, controller: str, plant: str) -> None:
    """The recorder's is right: all three differ, so none can be compared with another unnoticed."""
    fast = controller == "1 % fast"
    wrong = python_clocks(tmp_path, CLOCK_RATE="1.01") if fast else faketime(controller, **WALL_ALONE)
    run(tmp_path, {"controller": wrong, "plant": faketime(plant)})


def test_clocks_that_step_by_an_hour_in_mid_run_change_nothing(tmp_path: Path) -> None:
    """One after the other, so that after each of the first two steps two clocks differ by an hour."""
    said, plant, recorder = (tmp_path / name for name in ("said", "plant", "recorder"))
    said.write_text("+0s")
    controller = faketime("", FAKETIME_TIMESTAMP_FILE=str(said), **WALL_ALONE)
    del controller["FAKETIME"]
    site = python_clocks(tmp_path)
    environments = {
        "controller": controller,
        "plant": {**site, "CLOCK_STEP": str(plant)},
        "recorder": {**site, "CLOCK_STEP": str(recorder)},
    }
    run(tmp_path, environments, [lambda: said.write_text(f"+{STEP_S}s"), plant.touch, recorder.touch])
    assert_stepped(tmp_path, "controller")
    assert_stepped(tmp_path, "plant")


def assert_stepped(tmp_path: Path, end: End) -> None:
    walls = [batch.header.wall_ns for batch in HilLog(tmp_path / "a.mcap").batches(end)]
    assert max(walls) - min(walls) > 0.9 * STEP_S * 1e9


def test_the_watchdog_trips_as_soon_whatever_the_plants_clock_reads() -> None:
    """A killed controller is gone within the watchdog's 100 ms and what two busy cores add."""
    settings = load(overrides=[f"network.rendezvous={free_rendezvous()}", "controller.auto_arm=true"])
    with ProcessGroup(settings) as processes:
        statuses = Statuses(processes, settings)
        processes.start("plant", environment=faketime("-10s"))
        processes.start("controller")
        eventually("driving", lambda: statuses.state("plant") == "driven")
        processes.stop("controller", how=9)  # type: ignore[arg-type]  # SIGKILL
        eventually("the trip", lambda: statuses.state("plant") == "tripped", 5.0)
