"""Recorder process beside a running loop: rotated, late, killed and started again.

Each end caches its last minute of trace, so a log lacks no tick of either end; `log review` and `log replay` confirm
it. Disks that are full are in tests/service/recording, links that are cut in `test_deployments.py`.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from aeroloop.service.config import load
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.report import Findings
from aeroloop.service.review.review import read, review
from aeroloop.service.testing.hil import Hil
from aeroloop.service.testing.process_group import ProcessGroup, standalone
from tests.support.processes import PATIENT

RATE = 100  # slow, so that several of these tests run beside each other: most of their time they wait


def assert_whole(logs: Path, at_least: int) -> Findings:
    """No tick of either end is missing, and both ends replay byte for byte. Returns what the review finds."""
    findings = read(logs).findings
    assert findings.missing_ticks == {"controller": 0, "plant": 0}, findings.missing
    replayed = replay([logs])
    for end in (replayed.controller, replayed.plant):
        assert end is not None, replayed.reasons
        assert end.differ == 0
        assert end.ticks >= at_least
    return findings


def test_a_rotated_run_in_lockstep_holds_every_tick_and_is_reviewed_and_replayed_as_a_whole(tmp_path: Path) -> None:
    """8 seconds of the law take more than a file, with the specification in it, may."""
    with Hil(tmp_path, lockstep=True) as hil:
        hil.start(settings={"recorder.max_file_mb": 0.1})
        hil.run(8.0)
    files = Recording([tmp_path]).paths
    assert len(files) >= 2
    found = assert_whole(tmp_path, 4_000)
    assert (found.skipped_ticks, found.duration_s) == (0, 8.0)
    assert found.z_track == review(*files).z_track


@pytest.mark.smoke
def test_a_recorder_that_starts_late_and_one_that_was_killed_and_comes_back_have_it_from_the_first_tick(
    tmp_path: Path,
) -> None:
    """The time away is the promise itself, so it is waited for; that the caches keep a minute: test_history.py.

    Slack of a second before the kill: messages wait for up to 0.3 s before they are in a chunk, and a machine with two
    cores and other work keeps a process waiting for some hundred milliseconds.
    """
    away_s, logs = 5, [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    overrides = [*(f"{key}={value}" for key, value in PATIENT.items()), f"loop.rate_hz={RATE}"]
    settings = standalone(load(overrides=overrides), logs[0], require_recorder=False)
    with ProcessGroup(settings) as processes:
        processes.start("plant")
        processes.start("controller")
        processes.eventually("driving", lambda: processes.state("plant") == "driven")
        for log in logs:
            time.sleep(away_s)
            processes.start("recorder", "--log", str(log))
            processes.await_role("recorder")
            processes.eventually("ticks in the log", lambda log=log: log.exists() and log.stat().st_size > 10_000)  # type: ignore[misc]
            time.sleep(1.0)
            if log == logs[0]:
                processes.stop("recorder", signal.SIGKILL)
        assert processes.state("plant") == "driven"
    assert read(logs[0]).findings.damages, "it was killed, and left no whole file"
    for path in (logs[1], tmp_path):  # the second recorder needs nothing of the first, and is not disturbed by it
        judged = assert_whole(path, round(0.5 * RATE * 2 * away_s))
        assert judged.sessions == 1
        assert judged.duration_s >= 2 * away_s
