"""Observer of a session: gaps, timing, saturation and invalid frames, against the content of the log."""

from __future__ import annotations

from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Percentiles, Status
from aeroloop.service.config import load
from aeroloop.service.review.findings import LOCKSTEP
from aeroloop.service.review.report import Findings
from aeroloop.service.review.review import read
from tests.support.edited_log import Said, edited, message_of, observer_of, rewrite, ticks_of
from tests.support.made_log import SESSION, START_NS, make_log

TICKS = 500


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 500 ticks in real time, each answered after 300 µs."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    make_log(path, TICKS, settings=load())
    return path


def found(path: Path) -> Findings:
    return read(path).findings


# Gaps


def test_ticks_that_no_command_answered_are_gaps_whether_they_were_measured_or_not(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, settings=load(), lost=range(50, 53), skipped=range(200, 240))
    findings = found(tmp_path / "a.mcap")
    assert [(gap.tick, gap.ticks, gap.time_s) for gap in findings.gaps] == [(50, 3, 0.1), (200, 40, 0.4)]
    assert findings.gap_count == 2
    assert findings.skipped_ticks == 43
    assert findings.lapses == {"missed": 3}


def test_of_many_gaps_the_longest_hundred_are_kept_and_all_are_counted() -> None:
    observer = observer_of()
    k, lengths = 0, [1 + i * 7919 % 1000 for i in range(3000)]
    for i, length in enumerate(lengths):
        observer.answered(np.array([k]))
        k += 1 + length
        observer.ticks(ticks_of(i))
    observer.answered(np.array([k]))
    assert observer.gap_count == 3000
    assert sorted(gap.ticks for gap in observer.gaps) == sorted(lengths)[-100:]
    assert [gap.tick for gap in observer.gaps] == sorted(gap.tick for gap in observer.gaps)


def test_gaps_are_seen_where_sensors_give_no_valid_value() -> None:
    """Such measurements are answered, but there is no tick to judge."""
    observer = observer_of()
    for block in ([*range(7, 9), *range(12, 4010)], [*range(4014, 6000)]):  # with a gap where a block ends
        observer.answered(np.array(block))
    assert [(gap.tick, gap.ticks) for gap in observer.gaps] == [(9, 3), (4010, 4)]


# Timing


def test_latency_and_period_are_those_of_the_plants_own_clock(whole: Path, tmp_path: Path) -> None:
    """Ten late answers of 500, and one measurement 200 µs late: percentiles within a bin of 4.4 %, counts exactly."""

    def later(columns: Any) -> None:
        columns["received"][columns["answered"] % 50 == 7] += 1000
        columns["sent"][columns["session_tick"] == 300] += 200

    timing = found(rewrite(whole, tmp_path / "a.mcap", edited("plant", later))).timing
    latency, period = timing["latency"], timing["period"]
    assert (latency.count, period.count) == (TICKS - 1, TICKS - 1)  # nothing acts on the last command any more
    assert latency.p50 == pytest.approx(300, rel=0.044)
    assert latency.p99 == pytest.approx(1300, rel=0.044)
    assert (latency.max, period.max) == (1300, 2200)
    assert [period.p50, period.p99] == pytest.approx([2000, 2000], rel=0.044)
    assert period.p999 == pytest.approx(2200, rel=0.044)
    assert [count for edge, count in period.bins if edge < 1900 or edge > 2100] == [1, 1]
    slow = [count for edge, count in latency.bins if edge > 1000]
    assert (sum(slow), sum(count for _, count in latency.bins)) == (10, TICKS - 1)


def test_the_loop_latency_is_that_of_the_session_whatever_the_plant_counted_before(whole: Path, tmp_path: Path) -> None:
    """The plant's own status counts since its start; its sessions before may have been slower."""
    slow = Percentiles(count=90_000, p50=1919, p99=9000, p999=9000, max=9000)
    status = Status(
        role="plant", state="driven", session=SESSION, uptime_s=1, ticks=1, rate_hz=1, skipped=0, latency_us=slow
    )
    more = [message_of("status", status, START_NS + 100_000_000, role="plant")]
    findings = found(rewrite(whole, tmp_path / "a.mcap", more=more))
    assert findings.latency_us is not None
    assert findings.latency_us.count == TICKS - 1
    assert findings.latency_us.p50 == findings.timing["latency"].p50 == pytest.approx(300, rel=0.044)


def test_in_lockstep_there_is_no_latency_and_no_age_and_the_reason_is_stated(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 100, settings=load(overrides=["loop.lockstep=true"]))
    findings = found(tmp_path / "a.mcap")
    assert (findings.latency_us, findings.age_us) == (None, None)
    assert findings.reasons["latency_us"] == findings.reasons["age_us"] == LOCKSTEP


def test_the_age_of_measurements_is_what_the_controller_said_worst_first(whole: Path, tmp_path: Path) -> None:
    def status(i: int, p50: float, p99: float, most: float, session: str | None = "s1") -> Said:
        age = Percentiles(count=9, p50=p50, p99=p99, p999=p99, max=most)
        message = Status(
            role="controller", state="running", session=session, uptime_s=1, ticks=1, rate_hz=1, skipped=0, age_us=age
        )
        return message_of("status", message, START_NS + i * 100_000_000)

    more = [status(1, 400, 900, 1000), status(2, 400, 700, 5000), status(3, 500, 800, 900), status(4, 1, 9999, 1, "s2")]
    age = found(rewrite(whole, tmp_path / "a.mcap", more=more)).age_us
    assert age is not None
    assert age["p50"] == pytest.approx(400, rel=0.044)
    assert (age["p99"], age["max"]) == (900, 5000)
    without = found(whole)
    assert without.age_us is None
    assert "controller" in without.reasons["age_us"]


# Saturation, and what is no value


def test_values_at_the_outermost_level_are_counted_by_signal(whole: Path, tmp_path: Path) -> None:
    """Of the last hundred ticks, a motor at its limit in one command, both in another, and a rate in ten frames."""
    wire = load().wire

    def commands(columns: Any) -> None:
        for k in (420, 421):
            frame = np.void(wire.command.pack(k % 256, (-31, 31 if k == 421 else 30)))
            columns["command"][columns["tick"] == k] = frame

    def measurements(columns: Any) -> None:
        for k in range(430, 440):
            frame = np.void(wire.measurement.pack(k % 256, (126, 0, 0, 0, 0, -127)))
            columns["measurement"][columns["session_tick"] == k] = frame

    path = rewrite(whole, tmp_path / "a.mcap", edited("controller", commands))
    clean, findings = found(whole), found(rewrite(path, tmp_path / "b.mcap", edited("plant", measurements)))
    more = {name: findings.saturated[name] - clean.saturated[name] for name in findings.saturated}
    assert more == pytest.approx({"attitude": 0.0, "rate": 10 / (3 * TICKS), "voltage": 3 / (2 * TICKS)}, abs=1e-12)
    assert findings.invalid == {"measurement": 0, "command": 0}


def test_frames_without_a_valid_value_are_counted_and_are_answered(tmp_path: Path) -> None:
    """The gyro fails for seven ticks; the controller answers with commands without a valid value."""
    faults = 'plant.faults=["rate.x:off@0.86..0.874"]'
    make_log(tmp_path / "a.mcap", TICKS, settings=load(overrides=[faults]))
    findings = found(tmp_path / "a.mcap")
    assert findings.invalid == {"measurement": 7, "command": 7}
    assert (findings.gap_count, findings.skipped_ticks) == (0, 0)


def test_without_quantization_a_value_at_the_limit_is_saturated() -> None:
    observer = observer_of("wire.attitude.bits=cont", "wire.rate.bits=cont", "wire.voltage.bits=cont")
    observer.frames(np.empty((0, 6)), np.array([[volts, 1.0] for volts in (24.0, -24.0, 23.9, nan)]))
    assert observer.saturated == {"voltage": 2 / 7}
    assert observer.invalid["command"] == 1
