"""A log's findings are what was put into it: timing, gaps, saturation, what happened, and lines with every extreme."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import cos, nan, radians, sin
from pathlib import Path

import numpy as np
import pytest

from protocol.attitude import Quaternion
from protocol.messages import Event, Loss, Percentiles, Status, Truth
from service.cli import execute
from service.config import load
from service.log.display import sparkline
from service.log.limits import Limit
from service.log.observe import Observer
from service.log.report import Check, Findings, Mark, Spread
from service.log.review import Kept, Tick, read, report, review
from service.log.tallies import BLOCK, Told
from service.log.thin import ThinnedLines
from tests.service.log.made_log import AN_OPERATORS_WORDS, START_NS, make_log
from tests.service.log.retold import Said, retell, told

TICKS = 500
PERIOD_NS = 2_000_000
LATENCY_NS = 300_000  # in the bin from 291.7 to 304.4 µs, whose middle is 297.9

Retold = Callable[..., Path]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 500 ticks in real time, each answered after 300 µs."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    make_log(path, TICKS, settings=load())
    return path


def tick_of(one: Said) -> int:
    return (one.published_ns - START_NS) // PERIOD_NS


def found(path: Path) -> Findings:
    return read(path).findings


# Gaps


def test_ticks_that_no_command_answered_are_gaps_whether_they_were_measured_or_not(whole: Path, tmp_path: Path) -> None:
    def lost(one: Said) -> Said | None:
        passed_over = one.topic == "command" and 50 <= tick_of(one) < 53
        missed = one.topic in ("measurement", "command") and 200 <= tick_of(one) < 240
        return None if passed_over or missed else one

    findings = found(retell(whole, tmp_path / "a.mcap", lost))
    assert [(gap.tick, gap.ticks, gap.time_s) for gap in findings.gaps] == [(50, 3, 0.1), (200, 40, 0.4)]
    assert findings.gap_count == 2
    assert findings.skipped_ticks == 43


def test_of_many_gaps_the_longest_hundred_are_kept_and_all_are_counted() -> None:
    observer = Observer(load())
    k, lengths = 0, [1 + i * 7919 % 1000 for i in range(3000)]
    for i, length in enumerate(lengths):
        observer.answered(k)
        k += 1 + length
        feed(observer, i)
    observer.answered(k)
    observer.finish()
    assert observer.gap_count == 3000
    assert sorted(gap.ticks for gap in observer.gaps) == sorted(lengths)[-100:]
    assert [gap.tick for gap in observer.gaps] == sorted(gap.tick for gap in observer.gaps)


def test_gaps_are_seen_where_sensors_give_no_valid_value() -> None:
    """Such measurements are answered, but there is no tick to judge."""
    observer = Observer(load())
    for k in (*range(7, 9), *range(12, BLOCK + 10), *range(BLOCK + 14, 6000)):  # with a gap where a block ends
        observer.answered(k)
    observer.finish()
    assert [(gap.tick, gap.ticks) for gap in observer.gaps] == [(9, 3), (BLOCK + 10, 4)]


def test_what_is_told_while_there_are_no_ticks_is_forgotten_but_for_the_last() -> None:
    last = Told(1)
    for i in range(50_000):
        last.add(i, (10.0 * i,))
    values = last.on(np.array([0.0, 40_000.0, 49_998.5, 60_000.0]))[:, 0]
    assert np.isnan(values[:2]).all()
    assert values[2:].tolist() == [499_985.0, 499_990.0]


# Timing


def test_latency_and_period_are_those_of_the_times_of_publication(whole: Path, tmp_path: Path) -> None:
    """Ten late answers of 500, and one measurement 500 µs late: percentiles within a bin of 4.4 %, counts exactly."""

    def later(one: Said) -> Said:
        k = tick_of(one)
        if one.topic == "command" and k % 50 == 7:
            return one._replace(published_ns=one.published_ns + 1_000_000)
        if one.topic == "measurement" and k == 300:
            return one._replace(published_ns=one.published_ns + 200_000)
        return one

    timing = found(retell(whole, tmp_path / "a.mcap", later)).timing
    latency, period = timing["latency"], timing["period"]
    assert (latency.count, period.count) == (TICKS, TICKS - 1)
    assert latency.p50 == pytest.approx(300, rel=0.044)
    assert latency.p99 == pytest.approx(1300, rel=0.044)
    assert (latency.max, period.max) == (1300, 2200)
    assert [period.p50, period.p99] == pytest.approx([2000, 2000], rel=0.044)
    assert period.p999 == pytest.approx(2200, rel=0.044)
    assert [count for edge, count in period.bins if edge < 1900 or edge > 2100] == [1, 1]
    slow = [count for edge, count in latency.bins if edge > 1000]
    assert (sum(slow), sum(count for _, count in latency.bins)) == (10, TICKS)


def test_the_age_of_measurements_is_what_the_controller_said_worst_first(whole: Path, tmp_path: Path) -> None:
    def status(i: int, p50: float, p99: float, most: float, session: str | None = "s1") -> Said:
        age = Percentiles(count=9, p50=p50, p99=p99, p999=p99, max=most)
        message = Status(
            role="controller", state="running", session=session, uptime_s=1, ticks=1, rate_hz=1, skipped=0, age_us=age
        )
        return told("status", message, START_NS + i * 100_000_000)

    more = [status(1, 400, 900, 1000), status(2, 400, 700, 5000), status(3, 500, 800, 900), status(4, 1, 9999, 1, "s2")]
    age = found(retell(whole, tmp_path / "a.mcap", more=more)).age_us
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

    def full(one: Said) -> Said:
        k = tick_of(one)
        if one.topic == "command" and k in (420, 421):
            return one._replace(data=wire.command.pack(k % 16, (-31, 31 if k == 421 else 30)))
        if one.topic == "measurement" and 430 <= k < 440:
            return one._replace(data=wire.measurement.pack(k % 16, (126, 0, 0, 0, 0, -127)))
        return one

    clean, findings = found(whole), found(retell(whole, tmp_path / "a.mcap", full))
    more = {name: findings.saturated[name] - clean.saturated[name] for name in findings.saturated}
    assert more == pytest.approx({"attitude": 0.0, "rate": 10 / (3 * TICKS), "voltage": 3 / (2 * TICKS)}, abs=1e-12)
    assert findings.invalid == {"measurement": 0, "command": 0}


def test_frames_without_a_valid_value_are_counted_and_are_answered(whole: Path, tmp_path: Path) -> None:
    wire = load().wire

    def dead(one: Said) -> Said:
        k = tick_of(one)
        if 430 <= k < 437 and one.topic == "measurement":
            return one._replace(data=wire.measurement.pack(k % 16, (0, 0, 0, 0, -128, 0)))
        if 430 <= k < 437 and one.topic == "command":
            return one._replace(data=wire.command.pack(k % 16, (-32, -32)))
        return one

    findings = found(retell(whole, tmp_path / "a.mcap", dead))
    assert findings.invalid == {"measurement": 7, "command": 7}
    assert (findings.gap_count, findings.skipped_ticks) == (0, 0)


def test_without_quantization_a_value_at_the_limit_is_saturated() -> None:
    settings = load(overrides=["wire.attitude.bits=cont", "wire.rate.bits=cont", "wire.voltage.bits=cont"])
    observer = Observer(settings)
    for volts in (24.0, -24.0, 23.9, nan):
        observer.command((volts, 1.0))
    observer.finish()
    assert observer.saturated == {"voltage": 2 / 7}
    assert observer.invalid["command"] == 1


# What happened


def test_what_an_operator_changed_is_a_mark_at_its_tick(tmp_path: Path) -> None:
    """The controller tells of it in words, too, but only the change itself has the tick."""
    make_log(tmp_path / "a.mcap", TICKS, changes=AN_OPERATORS_WORDS)
    more = [
        told("event", Event(role="controller", kind="changed", text=text, session=session), START_NS + 240_000_000)
        for text, session in (("gains set", "s1"), ("configuration read again", None))
    ]
    happened = found(retell(tmp_path / "a.mcap", tmp_path / "b.mcap", more=more)).marks
    assert [mark.text for mark in happened if mark.kind == "changed"] == ["configuration read again"]
    marks = [(mark.time_s, mark.text) for mark in happened if mark.kind == "change"]
    assert [time for time, _ in marks] == [0.0, 0.24, 0.5, 0.8]
    assert "C2 = diag(0.2, 0.2, 0.2)" in marks[1][1]
    assert "0°, 5°, -10°" in marks[2][1]
    assert "Gamma = diag(0.01, 0.01, 0.01)" in marks[3][1]
    assert "sinusoid" in marks[3][1]


def test_events_are_marks_in_order_on_the_sessions_clock_by_their_times_of_publication(
    whole: Path, tmp_path: Path
) -> None:
    def event(at_s: float, role: str, kind: str, text: str) -> Said:
        message = Event.model_validate({"role": role, "kind": kind, "text": text, "session": "s1"})
        return told("event", message, START_NS + round(at_s * 1e9))

    more = [
        event(0.9995, "plant", "tripped", "tilted"),
        event(-0.3, "controller", "claimed", "has it"),
        event(-7.0, "plant", "started", "waits"),
        event(60.0, "plant", "stopped", "at 0 V"),
        event(0.5, "controller", "fault", "16 ticks missed"),
        event(0.6, "controller", "fault", "of another vehicle")._replace(key="aeroloop/other/event"),
    ]
    findings = found(retell(whole, tmp_path / "a.mcap", more=more))
    marks = [mark for mark in findings.marks if mark.kind != "change"]
    assert [(mark.time_s, mark.role, mark.kind, mark.text) for mark in marks] == [
        (None, "plant", "started", "waits"),
        (-0.3, "controller", "claimed", "has it"),
        (0.5, "controller", "fault", "16 ticks missed"),
        (0.9995, "plant", "tripped", "tilted"),
        (None, "plant", "stopped", "at 0 V"),
    ]
    assert findings.trips == ["tilted"]


def test_in_lockstep_an_event_stands_between_the_ticks_that_it_came_between(tmp_path: Path) -> None:
    """The wall clock says nothing of the law's there: here every tick takes a fifth of its period, then five."""
    make_log(tmp_path / "a.mcap", TICKS)

    def squeezed(at_ns: int) -> int:
        since = at_ns - START_NS
        half = TICKS // 2 * PERIOD_NS
        return START_NS + (since // 5 if since < half else half // 5 + (since - half) * 5)

    event = told("event", Event(role="plant", kind="fault", text="x"), squeezed(START_NS + 400 * PERIOD_NS + 1000))
    path = retell(
        tmp_path / "a.mcap",
        tmp_path / "b.mcap",
        lambda one: one._replace(published_ns=squeezed(one.published_ns)),
        [event],
    )
    (mark,) = (mark for mark in found(path).marks if mark.kind == "fault")
    assert mark.time_s == pytest.approx(400 * PERIOD_NS * 1e-9, abs=1e-5)


def test_what_the_recorder_has_lost_is_counted_by_topic_and_marked(whole: Path, tmp_path: Path) -> None:
    def loss(key: str, count: int, at_s: float) -> Said:
        at = START_NS + round(at_s * 1e9)
        return told("loss", Loss(key=key, count=count, reason="queue", until_ns=at), at + 10_000_000)

    more = [
        loss("aeroloop/aero/s1/measurement", 3, 0.2),
        loss("aeroloop/aero/s1/measurement", 4, 0.4),
        loss("aeroloop/aero/event", 1, 0.5),
    ]
    findings = found(retell(whole, tmp_path / "a.mcap", more=more))
    assert findings.losses == {"measurement": 7, "event": 1}
    marks = [(mark.time_s, mark.role, mark.text[:17]) for mark in findings.marks if mark.kind == "lost"]
    assert marks == [
        (0.2, "recorder", "3 of measurement "),
        (0.4, "recorder", "4 of measurement "),
        (0.5, "recorder", "1 of event lost: "),
    ]


def test_a_storm_of_events_is_told_in_a_bounded_number_of_marks(whole: Path, tmp_path: Path) -> None:
    storm = [
        told("event", Event(role="plant", kind="refused", text=f"no {i}"), START_NS + i * 1_000_000) for i in range(900)
    ]
    marks = [mark for mark in found(retell(whole, tmp_path / "a.mcap", more=storm)).marks if mark.kind == "refused"]
    assert len(marks) == 301
    assert marks[-1].text == "600 more, the last: no 899"


# Lines


def test_a_short_session_is_drawn_exactly(whole: Path) -> None:
    kept = Kept()
    judged = read(whole, watch=kept.watch)
    made, ticks = judged.report(), kept[judged.which]
    drawn = {(panel.group, panel.label, line.label): line.values for panel in made.panels for line in panel.lines}
    assert made.thinned == 1
    assert made.time.tolist() == [tick.k * 0.002 for tick in ticks]
    assert drawn["rate", "ω₃", "measured"].tolist() == [tick.rate[2] for tick in ticks]
    assert drawn["rate", "ω₃", "desired"].tolist() == [tick.desired_rate[2] for tick in ticks]
    assert drawn["attitude", "ε₂", "desired"].tolist() == [tick.desired[2] for tick in ticks]
    assert drawn["attitude_error", "ε̃₁", "measured"].tolist() == [tick.attitude_error[0] for tick in ticks]
    assert drawn["rate_error", "ω_e2", "measured"].tolist() == [tick.rate_error[1] for tick in ticks]
    assert drawn["input", "u₂", "commanded"].tolist() == [tick.voltages[0] for tick in ticks]
    assert drawn["latency", "latency", "latency"].tolist() == [LATENCY_NS / 1e3] * TICKS
    assert drawn["period", "period", "period"][1:].tolist() == [PERIOD_NS / 1e3] * (TICKS - 1)
    assert max(drawn["error_angle", "angle", "measured"]) == pytest.approx(judged.figures.max_error_deg)
    assert judged.figures.final_error_deg == pytest.approx(drawn["error_angle", "angle", "measured"][-1])


def test_panels_stand_in_the_order_of_the_papers_figures_and_are_named_after_them(whole: Path) -> None:
    made = report([whole])
    assert list(dict.fromkeys((panel.group, panel.title.partition(":")[0]) for panel in made.panels)) == [
        ("attitude", "Figure C.7"),
        ("rate", "Figure C.8"),
        ("attitude_error", "Figure C.9"),
        ("rate_error", "Figure C.10"),
        ("input", "Figure C.11"),
        ("error_angle", "Attitude error, as an angle"),
        ("latency", "Loop latency"),
        ("period", "Period between measurements"),
        ("damping_estimate", "Damping estimate"),
    ]
    assert [panel.label for panel in made.panels][:4] == ["η", "ε₁", "ε₂", "ε₃"]
    assert all(line.values.shape == made.time.shape for panel in made.panels for line in panel.lines)


def test_of_both_signs_the_attitude_is_drawn_with_that_beside_the_desired_one() -> None:
    observer = Observer(load())
    feed(observer, 0, attitude=(-0.6, 0.0, -0.8, 0.0), desired=(0.6, 0.0, 0.8, 0.0))
    feed(observer, 1, attitude=(0.6, 0.0, 0.8, 0.0), desired=(0.6, 0.0, 0.8, 0.0))
    observer.finish()
    _, panels = observer.lines()
    assert panels[0].lines[0].values.tolist() == panels[0].lines[1].values.tolist() == [0.6, 0.6]


def test_the_true_error_is_drawn_where_the_log_has_the_truth(whole: Path, tmp_path: Path) -> None:
    """The truth, told at every tenth tick, is the desired attitude turned by 10°: the angle between them is that."""
    kept = Kept()
    judged = read(whole, watch=kept.watch)
    turn = cos(radians(5)), 0.0, sin(radians(5)), 0.0
    more = [
        told(
            "truth",
            Truth(tick=tick.k, attitude=product(tick.desired, turn), rate=(0, 0, 0), voltages=(0, 0)),
            tick.published_ns + 1000,
        )
        for tick in kept[judged.which][::10]
    ]
    made = report([retell(whole, tmp_path / "a.mcap", more=more)])
    (panel,) = (panel for panel in made.panels if panel.group == "error_angle")
    assert [line.label for line in panel.lines] == ["measured", "true"]
    assert panel.lines[1].values[1:-10] == pytest.approx(10.0, abs=0.05)  # interpolated while q_d turns


def test_the_true_error_is_that_of_the_law_however_far_the_body_is_turned() -> None:
    desired = 0.5, -0.5, 0.5, 0.5
    observer = Observer(load())
    for k in range(3):
        feed(observer, k, desired=desired)
        observer.truth(product(desired, (cos(radians(15)), sin(radians(15)), 0.0, 0.0)), START_NS + k * PERIOD_NS)
    observer.finish()
    _, panels = observer.lines()
    (true,) = (line.values for panel in panels for line in panel.lines if line.label == "true")
    assert true == pytest.approx([30.0] * 3)


def test_the_damping_estimate_is_what_telemetry_told(whole: Path) -> None:
    values = {
        panel.label: panel.lines[0].values for panel in report([whole]).panels if panel.group == "damping_estimate"
    }
    assert values["θ̂₂"][0] == pytest.approx(0.007, abs=1e-4)  # as Table C.1 has it, before it adapts
    assert len(np.unique(values["θ̂₂"])) > TICKS / 2  # between two telemetries it is interpolated


@pytest.mark.parametrize("rows", [1, 2, 63, 64, 65, 127, 1000, 5003])
@pytest.mark.parametrize("block", [16, 64, 1000])
def test_thinned_lines_keep_every_extreme_at_its_place_and_are_exact_while_short(rows: int, block: int) -> None:
    rng = np.random.default_rng(rows)
    data = np.column_stack([np.arange(rows, dtype=float), rng.normal(size=(rows, 2))])
    data[rng.random(rows) < 0.3, 2] = nan
    lines = ThinnedLines(3, max_points=64)
    for start in range(0, rows, block):
        lines.add(data[start : start + block])
    points = lines.points()
    assert len(points) <= 64
    if rows <= 64:
        assert lines.per_bucket == 1
        np.testing.assert_array_equal(points, data)
        return
    assert len(points) > 16
    assert (np.diff(points[:, 0]) > 0).all()
    for column in (1, 2):
        for extreme in (np.nanargmin(data[:, column]), np.nanargmax(data[:, column])):
            kept = np.flatnonzero(points[:, column] == data[extreme, column])
            assert abs(points[kept, 0] - data[extreme, 0]).min() <= lines.per_bucket


def test_a_line_that_rises_or_falls_still_does_so_when_it_is_thinned_out() -> None:
    k = np.arange(10_000, dtype=float)
    lines = ThinnedLines(3, max_points=100)
    for part in np.array_split(np.column_stack([k, 2 * k, -k]), 30):
        lines.add(part)
    points = lines.points()
    assert (np.diff(points[:, 1]) > 0).all()
    assert (np.diff(points[:, 2]) < 0).all()


def test_buckets_are_alike_however_long_it_runs() -> None:
    """Old ones must not grow coarser than new ones: each spans the same, but for the last."""
    lines = ThinnedLines(1, max_points=64)
    for start in range(0, 64 * 1024, 16):
        lines.add(np.arange(start, start + 16, dtype=float)[:, np.newaxis])
        assert len(lines.points()) <= 64
    spans = np.diff(lines.points()[::2, 0])
    assert spans.min() == spans.max() == lines.per_bucket


def test_an_observer_holds_a_bounded_number_of_points_however_many_ticks_come() -> None:
    observer = Observer(load())
    for k in range(20_000):
        feed(observer, k)
    observer.finish()
    time, panels = observer.lines()
    assert 1024 < len(time) <= 4096
    assert observer.thinned == 16
    assert observer.timing["period"].count == 20_000 - 1
    assert len(panels[0].lines[0].values) == len(time)


def feed(
    observer: Observer,
    k: int,
    attitude: Quaternion = (1.0, 0.0, 0.0, 0.0),
    desired: Quaternion = (1.0, 0.0, 0.0, 0.0),
) -> None:
    """Let an observer see a tick, with its measurement."""
    at = START_NS + k * PERIOD_NS
    zero = (0.0, 0.0, 0.0)
    observer.measurement((0, 0, 0, 0, 0, 0), at)
    observer.tick(Tick(k, at, LATENCY_NS, attitude, desired, zero, zero, zero, zero, (0.0, 0.0)))


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


# The whole


def test_findings_are_the_figures_and_more(whole: Path) -> None:
    figures, findings = review(whole), found(whole)
    assert {name: getattr(findings, name) for name in type(figures).model_fields if name != "reasons"} == {
        name: getattr(figures, name) for name in type(figures).model_fields if name != "reasons"
    }
    assert figures.reasons.items() <= findings.reasons.items()
    assert (findings.vehicle, findings.session, findings.sessions) == ("aero", "s1", 1)
    assert findings.started == "2027-01-15T08:00:00.000+00:00"


def test_a_report_has_the_configuration_and_what_is_known_of_software_and_host(whole: Path, tmp_path: Path) -> None:
    facts = {"git": "abc", "cpu": "two cores"}
    path = retell(whole, tmp_path / "night.mcap", metadata=[("aeroloop.recorder", {"json": json.dumps(facts)})])
    made = report([path], [Limit.parse("skipped=0"), Limit.parse("latency.p99=100")])
    assert made.name == "night"
    assert made.settings["wire"]["voltage"]["bits"] == 6
    assert made.facts == {"controller": {"host": "h", "versions": {}}, "recorder": facts}
    assert made.findings.checks == [
        Check(text="skipped ≤ 0", holds=True, found="0"),
        Check(text="latency.p99 ≤ 100 µs", holds=False, found="297.9 µs"),
    ]


@pytest.mark.parametrize(
    ("limit", "value"),
    [
        ("skipped=0", 3),
        ("gaps=0", 2),
        ("losses=0", 7),
        ("latency.p99=0", 4.0),
        ("period.p999=0", 5.0),
        ("age.max=0", 3.0),
        ("saturated.voltage=0", 0.25),
        ("invalid=0", 9),
        ("trips=0", 1),
    ],
)
def test_short_names_of_limits_mean_what_they_say(whole: Path, limit: str, value: float) -> None:
    clean = found(whole)
    timing = {
        "latency": clean.timing["latency"].model_copy(update={"p99": 4.0}),
        "period": clean.timing["period"].model_copy(update={"p999": 5.0}),
    }
    findings = clean.model_copy(
        update={
            "skipped_ticks": 3, "gap_count": 2, "losses": {"event": 5, "truth": 2}, "timing": timing, "trips": ["x"],
            "age_us": {"p50": 1.0, "p99": 2.0, "max": 3.0}, "saturated": {"voltage": 0.25},
            "invalid": {"measurement": 4, "command": 5},
        }
    )  # fmt: skip
    assert Limit.parse(limit).value(findings) == value


def test_what_could_not_be_had_breaks_its_limit_and_says_why(whole: Path) -> None:
    check = Limit.parse("age.p99=5000").check(found(whole))
    assert not check.holds
    assert "controller" in check.found


KEYS = {
    "duration_s", "z_track", "u_total", "max_error_deg", "final_error_deg", "measurement", "command", "skipped_ticks",
    "latency_us", "log", "trips", "damages", "reasons", "vehicle", "session", "sessions", "started", "timing", "age_us",
    "gaps", "gap_count", "saturated", "invalid", "losses", "marks", "checks",
}  # fmt: skip


def test_the_keys_of_the_json_are_stable_and_the_exit_code_says_whether_limits_hold(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["log", "review", str(whole), "--json", "--require", "z_track=50e-4", "--require", "skipped=0"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed.keys() == KEYS
    assert printed["timing"]["latency"].keys() == {"count", "p50", "p90", "p99", "p999", "max", "bins"}
    assert printed["marks"][0].keys() == set(Mark.model_fields)
    assert [check["holds"] for check in printed["checks"]] == [True, True]
    assert execute(["log", "review", str(whole), "--json", "--require", "latency.p50=1"]) == 1
    output = capsys.readouterr()
    assert json.loads(output.out)["checks"][0]["holds"] is False
    assert output.err == "aeroloop: latency.p50 is 297.9, more than 1\n"


def test_a_single_late_tick_in_a_million_is_seen_in_the_bars_and_how_late_it_was() -> None:
    bins = [(1000.0, 500_000), (1044.0, 500_000), (64_000.0, 1)]
    bars = sparkline(Spread(count=1_000_001, p50=1000, p90=1000, p99=1000, p999=1000, max=64_000, bins=bins), width=12)
    assert bars == "█          ▁"
    assert sparkline(Spread(count=1, p50=9, p90=9, p99=9, p999=9, max=9, bins=[(9.0, 1)])) == "█"


def test_the_account_tells_timing_gaps_what_happened_and_what_does_not_hold(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def lost(one: Said) -> Said | None:
        return None if one.topic == "command" and 50 <= tick_of(one) < 53 else one

    more = [
        told("event", Event(role="plant", kind="refused", text=f"no {i}"), START_NS + 500_000_000 + i)
        for i in range(15)
    ]
    more.append(told("event", Event(role="plant", kind="tripped", text="the [red] limit"), START_NS + 400_000_000))
    path = retell(whole, tmp_path / "a.mcap", lost, more)
    assert execute(["log", "review", str(path), "--require", "gaps=0"]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "gaps 1, the longest 3 ticks at 0.100 s" in out
    assert "latency as published 298 298 298 300 µs" in out
    assert "0.400 s plant tripped the [red] limit" in out
    assert "… and 5 more" in out
    assert "✗ gaps ≤ 0 1" in out
