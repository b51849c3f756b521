"""Clocks that are wrong, run fast and step at either end: loop, watchdog, log, review and replay must not change.

A `sitecustomize.py` gives each process its own clocks: it patches Python's `time`, the only way in which this program
reads clocks.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path

from aeroloop.protocol.messages.trace import ENDS
from aeroloop.service.config import load
from aeroloop.service.testing.hil import HilLog
from aeroloop.service.testing.process_group import ProcessGroup, standalone
from tests.hil.test_recorder import RATE, assert_whole
from tests.support.processes import LONGEST_S, PATIENT

RUN_S = 4.0
STEP_S = 3600

CLOCKS = f"""
import os, time
wrong_s, rate = float(os.environ.get("CLOCK_WRONG", "0")), float(os.environ.get("CLOCK_RATE", "1"))
step = os.environ.get("CLOCK_STEP", "")
wall, monotonic, sleep = time.time_ns, time.monotonic_ns, time.sleep
began = monotonic()
gained = lambda: round((rate - 1) * (monotonic() - began))
time.time_ns = lambda: wall() + gained() + round(1e9 * wrong_s) + {STEP_S} * 10**9 * os.path.exists(step)
time.time = lambda: time.time_ns() * 1e-9
time.monotonic_ns = lambda: monotonic() + gained()
time.monotonic = lambda: time.monotonic_ns() * 1e-9
time.sleep = lambda seconds: sleep(seconds / rate)
"""  # clocks wrong by CLOCK_WRONG [s] that run at CLOCK_RATE; the wall clock steps once the file CLOCK_STEP is there


def python_clocks(tmp_path: Path, **environment: str) -> dict[str, str]:
    (tmp_path / "site").mkdir(exist_ok=True)
    (tmp_path / "site" / "sitecustomize.py").write_text(CLOCKS)
    return {"PYTHONPATH": str(tmp_path / "site"), **environment}


def test_clocks_that_are_wrong_run_fast_and_step_in_mid_run_change_nothing(tmp_path: Path) -> None:
    """From the start all three differ, so none can be compared with another unnoticed; then each steps by an hour.

    Slack: half the ticks may be missed on a shared machine; a clock that decided anything would lose nearly all. When
    the controller is halted, the watchdog trips after the 2 s of `PATIENT` and what two busy cores add.
    """
    steps = {role: str(tmp_path / role) for role in ("controller", "plant", "recorder")}
    environments = {
        "controller": python_clocks(tmp_path, CLOCK_WRONG="10", CLOCK_RATE="1.01", CLOCK_STEP=steps["controller"]),
        "plant": python_clocks(tmp_path, CLOCK_WRONG="-10", CLOCK_RATE="0.995", CLOCK_STEP=steps["plant"]),
        "recorder": python_clocks(tmp_path, CLOCK_WRONG="86400", CLOCK_STEP=steps["recorder"]),
    }
    overrides = [*(f"{key}={value}" for key, value in PATIENT.items()), f"loop.rate_hz={RATE}"]
    with ProcessGroup(standalone(load(overrides=overrides), tmp_path / "a.mcap", auto_arm=False)) as processes:
        for role in ("recorder", "plant", "controller"):
            processes.start(role, environment=environments[role])
        processes.eventually("driving", lambda: processes.state("plant") == "driven", LONGEST_S)  # new interpreters
        for step in steps.values():
            time.sleep(RUN_S / 4)
            Path(step).touch()
        time.sleep(RUN_S / 4)
        assert processes.state("plant") == "driven"
        processes.signal("controller", signal.SIGSTOP)
        processes.eventually("the trip", lambda: processes.state("plant") == "tripped", 7.0)
        processes.signal("controller", signal.SIGCONT)
        processes.eventually("its notice", lambda: processes.state("controller") != "running")
        processes.stop("controller")
        processes.stop("plant")
    judged = assert_whole(tmp_path, round(0.5 * RUN_S * RATE))
    assert judged.sessions == 1
    assert judged.lapses.get("stale", 0) == 0
    assert judged.z_track is not None
    assert judged.z_track < 0.02
    assert RUN_S - 1 <= judged.duration_s <= RUN_S + 7
    for end in ENDS:
        walls = [batch.header.wall_ns for batch in HilLog(tmp_path / "a.mcap").batches(end)]
        assert max(walls) - min(walls) > 0.9 * STEP_S * 1e9
