"""Gaps, timing, saturation and invalid frames of a session, against the content of the log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aeroloop.protocol.messages.models import Percentiles, Status
from aeroloop.service.config import load
from aeroloop.service.review.observations import gaps
from aeroloop.service.review.report import Findings
from aeroloop.service.review.review import LOCKSTEP, read
from tests.service.review.conftest import TICKS
from tests.support.edited_log import Said, edited, message_of, rewrite
from tests.support.made_log import SESSION, START_NS, make_log


def found(path: Path) -> Findings:
    return read(path).findings


# Gaps


def test_ticks_that_no_command_answered_are_gaps_whether_they_were_measured_or_not(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, settings=load(), lost=range(50, 53), skipped=range(200, 240))
    findings = found(tmp_path / "a.mcap")
    assert [(gap.tick, gap.ticks, gap.time_s) for gap in findings.gaps] == [(50, 3, 0.1), (200, 40, 0.4)]
    assert (findings.gap_count, findings.skipped_ticks, findings.lapses) == (2, 43, {"missed": 3})


def test_of_many_gaps_the_longest_hundred_are_kept_and_all_are_counted() -> None:
    lengths = [1 + i * 7919 % 1000 for i in range(3000)]
    count, longest = gaps(np.cumsum([0, *(1 + length for length in lengths)]), 0.002)
    assert count == 3000
    assert sorted(gap.ticks for gap in longest) == sorted(lengths)[-100:]
    assert [gap.tick for gap in longest] == sorted(gap.tick for gap in longest)


# Timing


def test_latency_and_period_are_those_of_the_plants_own_clock(whole: Path, tmp_path: Path) -> None:
    """Ten late answers of 500, and one measurement 200 µs late; the plant's own status counts other sessions, too."""

    def later(columns: Any) -> None:
        columns["received"][columns["answered"] % 50 == 7] += 1000
        columns["sent"][columns["session_tick"] == 300] += 200

    slow = Percentiles(count=90_000, p50=1919, p99=9000, p999=9000, max=9000)
    status = Status(
        role="plant", state="driven", session=SESSION, uptime_s=1, ticks=1, rate_hz=1, skipped=0, latency_us=slow
    )
    more = [message_of("status", status, START_NS + 100_000_000, role="plant")]
    findings = found(rewrite(whole, tmp_path / "a.mcap", edited("plant", later), more))
    latency, period = findings.timing["latency"], findings.timing["period"]
    assert (latency.count, period.count) == (TICKS - 1, TICKS - 1)  # nothing acts on the last command any more
    assert (latency.p50, latency.p90, latency.p99, latency.max) == (300, 300, 1300, 1300)
    assert (period.p50, period.p99, period.max) == (2000, 2000, 2200)
    assert findings.latency_us == Percentiles(count=TICKS - 1, p50=300, p99=1300, p999=latency.p999, max=1300)
    slow_bins = [count for edge, count in latency.bins if edge > 1000]
    assert (sum(slow_bins), sum(count for _, count in latency.bins)) == (10, TICKS - 1)


def test_in_lockstep_there_is_no_latency_and_no_age_and_the_reason_is_stated(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 100, settings=load(overrides=["loop.lockstep=true"]))
    findings = found(tmp_path / "a.mcap")
    assert (findings.latency_us, findings.timing, findings.age_us) == (None, {}, None)
    for name in ("latency_us", "age_us", "timing.latency", "timing.period", "clock_offset_us"):
        assert findings.reasons[name] == LOCKSTEP
    assert not {"latency", "period"} & {panel.group for panel in read(tmp_path / "a.mcap").report().panels}


def test_the_age_of_measurements_is_what_the_controller_said_worst_first(whole: Path, tmp_path: Path) -> None:
    def status(i: int, p50: float, p99: float, most: float, session: str | None = "s1") -> Said:
        age = Percentiles(count=9, p50=p50, p99=p99, p999=p99, max=most)
        message = Status(
            role="controller", state="running", session=session, uptime_s=1, ticks=1, rate_hz=1, skipped=0, age_us=age
        )
        return message_of("status", message, START_NS + i * 100_000_000)

    more = [status(1, 400, 900, 1000), status(2, 400, 700, 5000), status(3, 500, 800, 900), status(4, 1, 9999, 1, "s2")]
    assert found(rewrite(whole, tmp_path / "a.mcap", more=more)).age_us == {"p50": 400, "p99": 900, "max": 5000}
    assert found(whole).age_us is None
    assert "controller" in found(whole).reasons["age_us"]


# Saturation, and what is no value


def test_frames_without_a_valid_value_are_counted_and_are_answered(tmp_path: Path) -> None:
    """The gyro fails for seven ticks; the controller answers with commands without a valid value."""
    faults = 'plant.faults=["rate.x:off@0.86..0.874"]'
    make_log(tmp_path / "a.mcap", TICKS, settings=load(overrides=[faults]))
    findings = found(tmp_path / "a.mcap")
    assert findings.invalid == {"measurement": 7, "command": 7}
    assert (findings.gap_count, findings.skipped_ticks) == (0, 0)
