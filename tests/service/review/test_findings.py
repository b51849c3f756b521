"""Findings of a log: events in order on the session's clock, limits, JSON and terminal table."""

from __future__ import annotations

import json
import random
import struct
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Event, Loss
from aeroloop.protocol.messages.trace import Outcome, Received, read_batch, read_header
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.review.report import Check, Findings
from aeroloop.service.review.requirements import Limit, LimitError
from aeroloop.service.review.review import read
from tests.service.review.conftest import TICKS
from tests.support.edited_log import Said, edited, message_of, rewrite
from tests.support.made_log import AHEAD_NS, AN_OPERATORS_WORDS, START_NS, lockstep, make_log


def found(path: Path) -> Findings:
    return read(path).findings


# What happened


def test_what_an_operator_changed_is_a_mark_at_its_tick(tmp_path: Path) -> None:
    """The controller reports it in words, too, but only the change itself has the tick."""
    make_log(tmp_path / "a.mcap", TICKS, changes=AN_OPERATORS_WORDS)
    more = [
        message_of(
            "event", Event(role="controller", kind="changed", text=text, session=session), START_NS + 240_000_000
        )
        for text, session in (("gains set", "s1"), ("configuration read again", None))
    ]
    happened = found(rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", more=more)).marks
    assert [mark.text for mark in happened if mark.kind == "changed"] == ["configuration read again"]
    marks = [(mark.time_s, mark.text) for mark in happened if mark.kind == "change"]
    assert [time for time, _ in marks] == [0.0, 0.24, 0.5, 0.8]
    assert "C2 = [0.2, 0.2, 0.2]" in marks[1][1]
    assert "0°, 5°, -10°" in marks[2][1]
    assert "Gamma = [0.01, 0.01, 0.01]" in marks[3][1]
    assert "sinusoid" in marks[3][1]


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
    event(1.1, "plant", "tripped", "tilted", tick=499),
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
    (0.998, "plant", "released", "at its end"),
    (None, "plant", "stopped", "at 0 V"),
]


@pytest.mark.parametrize("recorded", ["at once", "after the session", "in any order"])
def test_events_are_shown_at_their_sender_s_time_wherever_they_stand_in_the_file(
    whole: Path, tmp_path: Path, recorded: str
) -> None:
    """The clocks of both ends differ by 10 s; a recorder writes late what it recovers from a cache."""
    chance = random.Random(1)

    def place(one: Said) -> Said:
        if recorded == "at once":
            return one
        at_s = 99.0 if recorded == "after the session" else chance.uniform(-10, 70)
        return one._replace(recorded_ns=START_NS + round(at_s * 1e9))

    findings = found(rewrite(whole, tmp_path / "a.mcap", more=[place(one) for one in HAPPENED]))
    marks = [mark for mark in findings.marks if mark.kind != "change"]
    assert [(mark.time_s and round(mark.time_s, 3), mark.role, mark.kind, mark.text) for mark in marks] == SHOWN
    assert findings.trips == ["tilted"]


def test_in_lockstep_an_event_is_shown_at_the_tick_that_ran_when_it_was_published(tmp_path: Path) -> None:
    """A session in lockstep runs faster or slower than any clock; this one takes ten times as long as its ticks say."""

    def longer(columns: Any) -> None:
        for name in ("received", "sent"):
            columns[name] *= 10

    def slower(one: Said) -> Said:
        one = edited("plant", longer)(one)
        if one.topic != "trace" or not one.key.endswith("plant") or (header := read_header(one.data)) is None:
            return one
        later = 9 * (header.wall_ns - START_NS)
        clocks = struct.pack("<qq", header.monotonic_ns + later, header.wall_ns + later)
        return one._replace(data=one.data[:32] + clocks + one.data[48:])

    make_log(tmp_path / "a.mcap", TICKS, settings=lockstep())
    more = [event(5.0, "plant", "fault", "halfway", session=None)]
    marks = found(rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", slower, more)).marks
    (mark,) = (mark for mark in marks if mark.kind == "fault")
    assert mark.time_s == pytest.approx(0.5, abs=0.002)


def test_a_trip_is_the_plants_by_the_key_of_its_event_and_counts_once_however_often_recorded(
    whole: Path, tmp_path: Path
) -> None:
    trip, forged = (Event(role="plant", kind="tripped", text=text) for text in ("tilted", "never"))
    once = message_of("event", trip, START_NS + 5 * 10**8)
    more = [once, once, message_of("event", forged, START_NS + 5 * 10**8, "recorder")]
    findings = found(rewrite(whole, tmp_path / "a.mcap", more=more))
    assert findings.trips == ["tilted"]
    marks = [(mark.role, mark.text) for mark in findings.marks if mark.kind == "tripped"]
    assert marks == [("plant", "tilted"), ("recorder", "never")]


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
        assert Limit.parse("gaps=100").check(part).holds == (lines == 0)


def test_what_the_recorder_has_lost_is_counted_by_topic_and_marked(whole: Path, tmp_path: Path) -> None:
    losses = (("s1/measurement", 3, 0.21), ("s1/measurement", 4, 0.41), ("event/plant", 1, 0.51))
    more = [
        message_of("loss", Loss(key=f"aeroloop/aero/{key}", count=n, reason="disk"), START_NS + round(at_s * 1e9))
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
    storm = [
        message_of("event", Event(role="plant", kind="refused", text=f"no {i}"), START_NS + i * 1_000_000)
        for i in range(900)
    ]
    marks = [mark for mark in found(rewrite(whole, tmp_path / "a.mcap", more=storm)).marks if mark.kind == "refused"]
    assert len(marks) == 301
    assert marks[-1].text == "600 more, the last: no 899"


# The whole


def test_a_report_has_the_configuration_and_what_is_known_of_software_and_host(whole: Path, tmp_path: Path) -> None:
    facts = {"git": "abc", "cpu": "two cores"}
    path = rewrite(whole, tmp_path / "night.mcap", metadata=[("aeroloop.recorder", {"json": json.dumps(facts)})])
    made = read(path).report([Limit.parse("skipped=0"), Limit.parse("latency.p99=100")])
    assert made.name == "night"
    assert made.settings["wire"]["voltage"]["bits"] == 6
    host = {"host": "h", "versions": {}}
    assert made.facts == {"controller": host, "plant": host, "recorder": facts}
    assert made.findings.checks == [
        Check(text="skipped ≤ 0", holds=True, found="0"),
        Check(text="latency.p99 ≤ 100 µs", holds=False, found="300 µs"),
    ]


def test_the_exit_code_reports_whether_limits_hold(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Which keys the JSON has is what the stored logs say (tests/golden)."""
    assert execute(["log", "review", str(whole), "--json", "--require", "z_track=50e-4", "--require", "skipped=0"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["timing"]["latency"].keys() == {"count", "p50", "p90", "p99", "p999", "max", "bins"}
    assert [check["holds"] for check in printed["checks"]] == [True, True]
    assert execute(["log", "review", str(whole), "--json", "--require", "latency.p50=1"]) == 1
    output = capsys.readouterr()
    assert json.loads(output.out)["checks"][0]["holds"] is False
    assert output.err == "aeroloop: latency.p50 ≤ 1 µs does not hold: 300 µs\n"


@pytest.mark.parametrize("text", ["", "z_track", "z_track=", "z_track=x", "speed=1", "=1"])
def test_what_is_no_limit_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(LimitError) as refused:
        Limit.parse(text)
    assert len(str(refused.value).splitlines()) == 1


def test_the_account_lists_timing_gaps_what_happened_and_what_does_not_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_log(tmp_path / "whole.mcap", TICKS, settings=load(), lost=range(50, 53))
    more = [
        message_of("event", Event(role="plant", kind=kind, text=f"no {i} {kind}"), START_NS + 500_000_000 + i)
        for i in range(15)
        for kind in ("refused", "armed")
    ]
    more += [
        message_of("event", Event(role="plant", kind="tripped", text=f"the [red] limit {i}"), START_NS + at_ns)
        for i, at_ns in enumerate((410_000_000, 420_000_000))
    ]
    path = rewrite(tmp_path / "whole.mcap", tmp_path / "a.mcap", more=more)
    assert execute(["log", "review", str(path), "--require", "gaps=0"]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "gaps 1, the longest 3 ticks at 0.100 s" in out
    assert "latency 300 µs 300 µs 300 µs 300 µs 300 µs" in out
    assert out.startswith(
        "time role event what 0.410 s plant tripped the [red] limit 0 0.420 s plant tripped the [red] limit 1 0.500 s"
    )
    assert out.index("no 0 refused") < out.index(" z_track ") < out.index("no 0 armed")
    assert "plant refused no 0 refused (and 14 more like it, the last: 0.500 s)" in out
    assert "… and 4 more such events" in out  # beside what the session began with
    assert "✗ gaps ≤ 0 1" in out
