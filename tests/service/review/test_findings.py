"""Findings of a log: events in order on the session's clock, limits, JSON and terminal table."""

from __future__ import annotations

import json
import random
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Event, Loss
from aeroloop.protocol.messages.trace import Outcome, Received, read_batch
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.review.report import Check, Findings
from aeroloop.service.review.requirements import Limit, LimitError
from aeroloop.service.review.review import read
from tests.service.review.conftest import TICKS
from tests.support.edited_log import Said, edited, message_of, rewrite
from tests.support.made_log import AHEAD_NS, AN_OPERATORS_WORDS, START_NS, make_log


def found(path: Path) -> Findings:
    return read(path).findings


# What happened


def event(at_s: float, role: str, kind: str, text: str, session: str | None = "s1", tick: int | None = None) -> Said:
    """An event, published so long after the session began by its role's own clock, and recorded at once."""
    message = Event.model_validate({"role": role, "kind": kind, "text": text, "session": session, "tick": tick})
    at_ns = START_NS + round(at_s * 1e9)
    published_ns = at_ns + (AHEAD_NS if role == "controller" else 0)
    return message_of("event", message, published_ns)._replace(recorded_ns=at_ns)


def test_what_an_operator_changed_is_a_mark_at_its_tick(tmp_path: Path) -> None:
    """The controller reports it in words, too, but only the change itself has the tick."""
    make_log(tmp_path / "a.mcap", TICKS, changes=AN_OPERATORS_WORDS)
    more = [event(0.24, "controller", "changed", "gains set")]
    happened = found(rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", more=more)).marks
    assert [mark.text for mark in happened if mark.kind == "changed"] == []
    marks = [(mark.time_s, mark.text) for mark in happened if mark.kind == "change"]
    assert [time for time, _ in marks] == [0.0, 0.24, 0.5, 0.8]
    assert "C2 = [0.2, 0.2, 0.2]" in marks[1][1]
    assert "0°, 5°, -10°" in marks[2][1]
    assert "Gamma = [0.01, 0.01, 0.01]" in marks[3][1]
    assert "sinusoid" in marks[3][1]


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


def test_events_are_shown_at_their_sender_s_time_wherever_they_stand_in_the_file(whole: Path, tmp_path: Path) -> None:
    """The clocks of both ends differ by 10 s; a recorder writes late what it recovers from a cache."""
    chance = random.Random(1)
    said = [one._replace(recorded_ns=START_NS + round(chance.uniform(-10, 70) * 1e9)) for one in HAPPENED]
    findings = found(rewrite(whole, tmp_path / "a.mcap", more=said))
    marks = [mark for mark in findings.marks if mark.kind != "change"]
    assert [(mark.time_s and round(mark.time_s, 3), mark.role, mark.kind, mark.text) for mark in marks] == SHOWN
    assert findings.trips == ["tilted"]


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


# The whole


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


def test_the_account_lists_timing_gaps_what_happened_and_what_does_not_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_log(tmp_path / "whole.mcap", TICKS, settings=load(), lost=range(50, 53))
    more = [event(0.5, "plant", kind, f"no {i} {kind}") for i in range(15) for kind in ("refused", "armed")]
    path = rewrite(
        tmp_path / "whole.mcap", tmp_path / "a.mcap", more=[*more, event(0.41, "plant", "tripped", "the [red] limit")]
    )
    assert execute(["log", "review", str(path), "--require", "gap_count=0"]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "gaps 1, the longest 3 ticks at 0.100 s" in out
    assert "latency 300 µs 300 µs 300 µs 300 µs 300 µs" in out
    assert out.startswith(
        "time role event what 0.410 s plant tripped the [red] limit 0.500 s plant refused no 0 refused"
    )
    assert out.index("no 0 refused") < out.index(" z_track ") < out.index("no 0 armed")
    assert "✗ gap_count ≤ 0 1" in out
