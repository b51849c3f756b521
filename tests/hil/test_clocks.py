"""Wall clocks that are wrong, step, or run fast at either end: loop, watchdog, log, review and replay are as without.

libfaketime gives one process another clock. Offsets and steps leave the monotonic clock alone, as a wrong NTP server
does; a clock that runs fast is one that counts faster in all its readings.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from service.bench import Bench, free_rendezvous
from service.config import load
from tests.hil.test_processes import eventually
from tests.hil.test_recorder import PATIENT, Statuses, assert_whole

LIBRARIES = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))

pytestmark = pytest.mark.skipif(not LIBRARIES, reason="libfaketime is not installed")

RUN_S = 4.0


def clock(said: str, **more: str) -> dict[str, str]:
    """The environment of a process whose clock reads as libfaketime's `said`."""
    return {"LD_PRELOAD": str(LIBRARIES[0]), "FAKETIME": said, "FAKETIME_NO_CACHE": "1", **more}


WALL_ALONE = {"FAKETIME_DONT_FAKE_MONOTONIC": "1"}
CLOCKS = {
    "10 s ahead": clock("+10s", **WALL_ALONE),
    "10 s behind": clock("-10s", **WALL_ALONE),
    "400 ms ahead": clock("+0.4s", **WALL_ALONE),
    "1 % fast": clock("+0 x1.01"),
}


def run(tmp_path: Path, environments: Mapping[str, Mapping[str, str]], during: Path | None = None) -> None:
    """A loop of some seconds, of which nothing may be missing or unanswered for long, and its log."""
    settings = load(overrides=[
        *(f"{name}={value}" for name, value in PATIENT.items()),
        f"network.rendezvous={free_rendezvous()}", f"recorder.path={tmp_path / 'a.mcap'}", "controller.auto_arm=true",
        "controller.require_recorder=true",
    ])  # fmt: skip
    with Bench(settings) as bench:
        statuses = Statuses(bench, settings)
        for role in ("recorder", "plant", "controller"):
            bench.start(role, environment=environments.get(role))  # type: ignore[arg-type]  # a role
        eventually("driving", lambda: statuses.state("plant") == "driven")
        time.sleep(RUN_S / 2)
        if during is not None:
            during.write_text("+3600s")
        time.sleep(RUN_S / 2)
        assert statuses.state("plant") == "driven"
        for role in ("controller", "plant"):
            bench.stop(role)  # type: ignore[arg-type]  # a role
    judged = assert_whole(tmp_path, round(0.5 * RUN_S * 500))
    assert judged["sessions"] == 1
    assert judged["trips"] == []
    # A shared machine may miss ticks; a clock that decided anything would lose nearly all of them.
    assert judged["skipped_ticks"] < 0.2 * RUN_S * 500
    assert RUN_S - 1 <= judged["duration_s"] <= RUN_S + 4
    assert judged["z_track"] < 0.02
    assert judged["lapses"].get("stale", 0) == 0


@pytest.mark.parametrize("said", CLOCKS)
@pytest.mark.parametrize("role", ["controller", "plant"])
def test_a_clock_that_is_wrong_changes_nothing(tmp_path: Path, role: str, said: str) -> None:
    run(tmp_path, {role: CLOCKS[said]})


@pytest.mark.parametrize("role", ["controller", "plant", "recorder"])
def test_a_clock_that_steps_by_an_hour_in_mid_run_changes_nothing(tmp_path: Path, role: str) -> None:
    said = tmp_path / "clock"
    said.write_text("+0s")
    stepping = {"LD_PRELOAD": str(LIBRARIES[0]), "FAKETIME_TIMESTAMP_FILE": str(said), "FAKETIME_NO_CACHE": "1"}
    run(tmp_path, {role: {**stepping, **WALL_ALONE}}, said)


def test_the_watchdog_trips_as_soon_whatever_the_plants_clock_reads() -> None:
    """A killed controller is gone within the watchdog's 100 ms and what two busy cores add."""
    settings = load(overrides=[f"network.rendezvous={free_rendezvous()}", "controller.auto_arm=true"])
    with Bench(settings) as bench:
        statuses = Statuses(bench, settings)
        bench.start("plant", environment=CLOCKS["10 s behind"])
        bench.start("controller")
        eventually("driving", lambda: statuses.state("plant") == "driven")
        bench.stop("controller", how=9)  # type: ignore[arg-type]  # SIGKILL
        eventually("the trip", lambda: statuses.state("plant") == "tripped", 5.0)
