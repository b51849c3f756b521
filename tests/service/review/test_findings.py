"""Findings of a log against its content: events, gaps, timing and invalid frames; limits, JSON, terminal table."""

from __future__ import annotations

import json
import random
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Event, Loss, Percentiles, Status
from aeroloop.protocol.messages.operator import Hold
from aeroloop.protocol.messages.trace import Outcome, Received, read_batch
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.review.events import gaps
from aeroloop.service.review.report import Check, Findings
from aeroloop.service.review.requirements import Limit, LimitError
from aeroloop.service.review.review import LOCKSTEP, read
from tests.service.review.conftest import TICKS
from tests.support.edited_log import Said, edited, message_of, rewrite
from tests.support.made_log import AHEAD_NS, SESSION, START_NS, make_log


def found(path: Path) -> Findings:
    return read(path).findings


def event(at_s: float, role: str, kind: str, text: str, session: str | None = "s1", tick: int | None = None) -> Said:
    """An event, published so long after the session began by its role's own clock, and recorded at once."""
    message = Event.model_validate({"role": role, "kind": kind, "text": text, "session": session, "tick": tick})
    at_ns = START_NS + round(at_s * 1e9)
    published_ns = at_ns + (AHEAD_NS if role == "controller" else 0)
    return message_of("event", message, published_ns)._replace(recorded_ns=at_ns)


HAPPENED = [
    event(-7.0, "plant", "started", "waits", session=None),
    event(-0.2, "controller", "started", "looks for it", session=None),
    event(-0.1, "controller", "claimed", "has it"),
    event(0.21, "recorder", "changed", "the next file", session=None),
    event(0.52, "controller", "fault", "16 ticks missed", session=None),
    event(0.59, "controller", "fault", "5 ticks missed", tick=255),
    event(0.6, "controller", "fault", "of another vehicle")._replace(key="aeroloop/other/event/controller"),
    *[event(1.1, "plant", "tripped", "tilted", tick=499)] * 2,  # recorded twice
    event(1.12, "plant", "tripped", "never")._replace(key="aeroloop/aero/event/recorder"),  # forged
    event(1.3, "plant", "released", "at its end"),
    event(60.0, "plant", "stopped", "at 0 V", session=None),
]
SHOWN = [
    (None, "plant", "started", "waits"),
    (None, "controller", "started", "looks for it"),
    (0.0, "controller", "claimed", "has it"),
    (0.21, "recorder", "changed", "the next file"),
    (0.51, "controller", "fault", "5 ticks missed"),
    (0.52, "controller", "fault", "16 ticks missed"),
    (0.998, "plant", "tripped", "tilted"),
    (0.998, "recorder", "tripped", "never"),
    (0.998, "plant", "released", "at its end"),
    (None, "plant", "stopped", "at 0 V"),
]


def test_events_are_shown_once_at_their_sender_s_time_as_of_the_role_in_their_key(whole: Path, tmp_path: Path) -> None:
    """The clocks of both ends differ by 10 s; a recorder writes late what it recovers from a cache."""
    chance = random.Random(1)
    said = [one._replace(recorded_ns=START_NS + round(chance.uniform(-10, 70) * 1e9)) for one in HAPPENED]
    said.append(event(0.1, "controller", "changed", "gains set: C1 (by ann@lab, ann)", tick=0))
    findings = found(rewrite(whole, tmp_path / "a.mcap", more=said))
    marks = [mark for mark in findings.marks if mark.kind != "change"]
    assert [(mark.time_s and round(mark.time_s, 3), mark.role, mark.kind, mark.text) for mark in marks] == SHOWN
    assert findings.trips == ["tilted"]
    (change,) = (mark.text for mark in findings.marks if mark.kind == "change")
    assert change.endswith("follows a sinusoid of roll, pitch, yaw 0°, 40°, 100° (by ann@lab, ann)")


def test_what_happened_soon_after_the_session_has_no_time_in_it(whole: Path, tmp_path: Path) -> None:
    """The tick after the last one is still the session's: what it ended with."""
    said = [event(0.999, "recorder", "changed", "at the end", None), event(1.02, "recorder", "changed", "after", None)]
    marks = found(rewrite(whole, tmp_path / "a.mcap", more=said)).marks
    times = {mark.text: mark.time_s for mark in marks if mark.role == "recorder"}
    assert times == {"at the end": pytest.approx(0.999, abs=1e-3), "after": None}


@pytest.mark.parametrize(("tick", "at_s"), [(TICKS, 1.0), (TICKS + 1, 0.998)], ids=["the next", "a later"])
def test_an_event_just_after_the_last_tick_keeps_its_tick(whole: Path, tmp_path: Path, tick: int, at_s: float) -> None:
    """A plant trips before it measures: its tick is the one after the last. A later one is nobody's tick."""
    said = event(0.9, "plant", "tripped", "late", tick=tick)
    (mark,) = (one for one in found(rewrite(whole, tmp_path / "a.mcap", more=[said])).marks if one.text == "late")
    assert mark.time_s == (at_s if tick == TICKS else pytest.approx(0.9, abs=2e-3))


def test_a_gap_of_the_first_tick_alone_is_not_unseen_later(tmp_path: Path) -> None:
    changes = {1: (None, Hold(attitude=(0.0, 0.0, 0.0)))}
    make_log(path := tmp_path / "a.mcap", 1200, settings=load(), lost={0}, changes=changes)
    assert [(one.first_tick, one.last_tick) for one in found(path).unknown] == [(0, 0)]
    assert len(found(path).unseen["missing_ticks"]) == 1
    assert read(path, since_s=0.5).findings.unseen["missing_ticks"] == []


def test_what_went_otherwise_is_counted_by_kind(whole: Path, tmp_path: Path) -> None:
    def late(columns: Any) -> None:
        columns["received_as"][np.isin(columns["tick"], (100, 200))] = Received.LATE

    def stale(columns: Any) -> None:
        columns["outcome"][columns["session_tick"] == 300] = Outcome.STALE

    path = rewrite(whole, tmp_path / "a.mcap", edited("controller", late))
    findings = found(rewrite(path, tmp_path / "b.mcap", edited("plant", stale)))
    assert findings.lapses == {"late": 2, "missed": 2, "stale": 1}
    assert Limit.parse("lapses=2").check(findings) == Check(text="lapses ≤ 2", holds=False, found="5")


def test_rows_that_the_log_lacks_are_no_missed_ticks_and_are_unseen_where_they_are(tmp_path: Path) -> None:
    """A batch of the controller is not there; and none of the controller of another vehicle."""
    others: list[Said] = []

    def lacking(one: Said) -> Said | None:
        if one.topic != "trace" or not one.key.endswith("controller"):
            others.append(one._replace(key=one.key.replace("/aero/", "/beta/")))
            return one
        batch = read_batch(one.data)
        return None if batch is not None and 200 in batch.columns["tick"] else one

    make_log(tmp_path / "a.mcap", 1200, settings=load())
    path = rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", lacking, others)
    findings = read(path, vehicle="aero").findings
    lacks = findings.missing_ticks["controller"]
    assert 40 < lacks < 60
    assert (findings.lapses, findings.missing_ticks["plant"], len(findings.missing)) == ({}, 0, 1)
    for since_s, until_s, lines in ((-inf, inf, 1), (0.35, 0.8, 1), (0.6, inf, 0), (-inf, 0.2, 0)):
        part = read(path, vehicle="aero", since_s=since_s, until_s=until_s).findings
        assert len(part.unseen["missing_ticks"]) == lines
        assert Limit.parse("gap_count=100").check(part).holds == (lines == 0)


def test_what_the_recorder_has_lost_is_counted_by_topic_and_marked(whole: Path, tmp_path: Path) -> None:
    losses = (("s1/measurement", 3, 0.21), ("s1/measurement", 4, 0.41), ("event/plant", 1, 0.51))
    more = [
        message_of("loss", Loss(key=f"aeroloop/aero/{key}", count=n, reason="cache"), START_NS + round(at_s * 1e9))
        for key, n, at_s in losses
    ]
    findings = found(rewrite(whole, tmp_path / "a.mcap", more=more))
    assert findings.losses == {"measurement": 7, "event": 1}
    marks = [(mark.time_s, mark.role, mark.text[:17]) for mark in findings.marks if mark.kind == "lost"]
    assert marks == [
        (0.21, "recorder", "3 of measurement "),
        (0.41, "recorder", "4 of measurement "),
        (0.51, "recorder", "1 of event lost: "),
    ]


def test_a_storm_of_events_is_shown_in_a_bounded_number_of_marks(whole: Path, tmp_path: Path) -> None:
    storm = [event(i * 1e-3, "plant", "refused", f"no {i}", session=None) for i in range(900)]
    marks = [mark for mark in found(rewrite(whole, tmp_path / "a.mcap", more=storm)).marks if mark.kind == "refused"]
    assert len(marks) == 301
    assert marks[-1].text == "600 more, the last: no 899"


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


def test_in_lockstep_there_is_no_latency_and_the_reason_is_stated(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 100, settings=load(overrides=["loop.lockstep=true"]))
    findings = found(tmp_path / "a.mcap")
    assert (findings.latency_us, findings.timing) == (None, {})
    for name in ("latency_us", "timing.latency", "timing.period", "clock_offset_us"):
        assert findings.reasons[name] == LOCKSTEP
    assert not {"latency", "period"} & {panel.group for panel in read(tmp_path / "a.mcap").report().panels}


def test_frames_without_a_valid_value_are_counted_and_are_answered(tmp_path: Path) -> None:
    """The gyro fails for seven ticks; the controller answers with commands without a valid value."""
    faults = 'plant.faults=["rate.x:off@0.86..0.874"]'
    make_log(tmp_path / "a.mcap", TICKS, settings=load(overrides=[faults]))
    findings = found(tmp_path / "a.mcap")
    assert findings.invalid == {"measurement": 7, "command": 7}
    assert (findings.gap_count, findings.skipped_ticks) == (0, 0)


def test_the_exit_code_reports_whether_limits_hold(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["log", "review", str(whole), "--json", "--require", "z_track=50e-4"]) == 0
    assert [check["holds"] for check in json.loads(capsys.readouterr().out)["checks"]] == [True]
    assert execute(["log", "review", str(whole), "--json", "--require", "latency_us.p50=1"]) == 1
    output = capsys.readouterr()
    assert json.loads(output.out)["checks"][0]["holds"] is False
    assert output.err == "aeroloop: latency_us.p50 ≤ 1 µs does not hold: 300 µs\n"


@pytest.mark.parametrize("text", ["", "z_track", "z_track=x", "speed=1"])
def test_what_is_no_limit_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(LimitError) as refused:
        Limit.parse(text)
    assert len(str(refused.value).splitlines()) == 1
