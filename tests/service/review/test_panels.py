"""Lines of a report: every quantity of the controller at every tick, or an outline with every extreme in its place."""

from __future__ import annotations

from math import nan
from pathlib import Path

import numpy as np
import pytest

from aeroloop.service.config import load
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.logs.session import Truths
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review.panels import NO_TRUTHS, outline, panels_of
from aeroloop.service.review.report import Line
from aeroloop.service.review.review import read
from aeroloop.service.review.theorem import check_theorem
from tests.service.review.conftest import TICKS
from tests.support.edited_log import LATENCY_NS, PERIOD_NS, at_rest

Drawn = dict[tuple[str, str], Line]  # lines by the label of their panel's axis, and their own


def drawn(ticks: Ticks, truths: Truths = NO_TRUTHS) -> Drawn:
    _, panels, _ = panels_of(load(), ticks, check_theorem(load(), ticks, truths))
    return {(panel.label, line.label): line for panel in panels for line in panel.lines}


def test_a_short_session_is_drawn_exactly_in_the_order_of_the_papers_figures(whole: Path) -> None:
    judged = read(whole)
    made, ticks = judged.report(), judged.ticks
    lines = {(panel.group, panel.label, line.label): line.values for panel in made.panels for line in panel.lines}
    assert made.thinned == 1
    assert made.time.tolist() == (ticks.k * 0.002).tolist()
    for key, values in {
        ("rate", "ω₃", "measured"): ticks.rate[:, 2],
        ("rate", "ω₃", "desired"): ticks.desired_rate[:, 2],
        ("attitude", "ε₂", "desired"): ticks.desired[:, 2],
        ("error", "ε̃₁", "measured"): ticks.attitude_error[:, 0],
        ("rate_error", "ω_e2", "measured"): ticks.rate_error[:, 1],
        ("input", "u₂", "commanded"): ticks.voltages[:, 0],
        ("damping_estimate", "θ̂₂", "estimated"): ticks.state[:, 1],
    }.items():
        np.testing.assert_array_equal(lines[key], values)
    assert lines["latency", "latency", "latency"][:-1].tolist() == [LATENCY_NS / 1e6] * (TICKS - 1)
    assert lines["period", "period", "period"][1:].tolist() == [PERIOD_NS / 1e6] * (TICKS - 1)
    assert max(lines["error_angle", "angle", "measured"]) == pytest.approx(judged.figures.max_error_deg)
    assert judged.figures.final_error_deg == pytest.approx(lines["error_angle", "angle", "measured"][-1])
    titles = dict.fromkeys((panel.group, panel.title.partition(":")[0]) for panel in made.panels)
    assert list(titles)[:6] == [
        ("angles", "Roll, pitch and yaw"),
        *((name, f"Figure C.{n}") for n, name in enumerate(("attitude", "rate", "error", "rate_error"), 7)),
        ("input", "Figure C.11"),
    ]
    groups = ["error_angle", "latency", "period", "damping_estimate"]
    assert [group for group, _ in titles][6:] == groups
    assert [panel.label for panel in made.panels][:7] == ["roll", "pitch", "yaw", "η", "ε₁", "ε₂", "ε₃"]


def test_yaw_runs_on_where_the_body_turns_past_half_a_turn_and_what_is_measured_and_true_stays_beside_it() -> None:
    """The reference turns about z at 10° a tick; the body lags by 4°, as measured, and by 5° truly."""

    def yawed(lag: float) -> np.ndarray:
        halves = np.radians(10.0 * np.arange(60) - lag) / 2
        return np.column_stack([np.cos(halves), np.zeros((60, 2)), np.sin(halves)])

    ticks = at_rest(range(60), attitude=yawed(4), desired=yawed(0))
    lines = drawn(ticks, Truths(ticks.k, yawed(5), np.zeros((60, 3)), np.zeros((60, 2))))
    for name, lag in (("desired", 0), ("measured", 4), ("true", 5)):
        np.testing.assert_allclose(lines["yaw", name].values, 10.0 * np.arange(60) - lag, atol=1e-6)


def test_a_part_is_all_that_is_read_and_the_findings_say_so(whole: Path) -> None:
    judged, entire = read(whole, since_s=0.2, until_s=0.3), read(whole)
    made, its = judged.report(), entire.ticks.where(slice(100, 151))
    assert made.time.tolist() == pytest.approx([0.002 * k for k in range(100, 151)])
    assert (made.thinned, made.part) == (1, (0.2, 0.3))
    for name in ("attitude_error", "voltages", "state", "latency_ns"):
        np.testing.assert_array_equal(getattr(judged.ticks, name), getattr(its, name))
    found = judged.findings
    assert (found.duration_s, found.timing["latency"].count, found.skipped_ticks) == (0.102, 51, 0)
    assert found.reasons["duration_s"] == "of the session only what is from 0.2 s to 0.3 s was read"
    assert found.z_track == pytest.approx(float((its.attitude_error**2).sum()) * 0.002)
    assert {mark.time_s for mark in found.marks} == {None}  # the session's first gains and reference, before it
    with pytest.raises(ReviewError, match="there is nothing from 2 s to 3 s: the session has 1 s"):
        read(whole, since_s=2, until_s=3)


@pytest.mark.parametrize("rows", [65, 127, 1000, 5003])
def test_an_outline_keeps_every_extreme_in_its_bucket_and_goes_the_way_of_its_line(rows: int) -> None:
    rng = np.random.default_rng(rows)
    values, starts = rng.normal(size=rows), np.linspace(0, rows, 32, endpoint=False).astype(np.int64)
    values[rng.random(rows) < 0.3] = nan
    drawn = outline(values, starts)
    assert drawn.shape == (64,)
    for bucket, points in zip(np.split(values, starts[1:]), drawn.reshape(-1, 2), strict=True):
        if not np.isnan(bucket).all():
            assert sorted(points) == [np.nanmin(bucket), np.nanmax(bucket)]
    k = np.arange(rows, dtype=float)
    assert (np.diff(outline(k, starts)) >= 0).all()
    assert (np.diff(outline(-k, starts)) <= 0).all()


def test_a_long_session_has_so_many_points_at_times_that_rise_through_all_of_it() -> None:
    ticks = at_rest(range(20_001))
    time, panels, thinned = panels_of(load(), ticks, check_theorem(load(), ticks, NO_TRUTHS), 4096)
    assert (len(time), thinned) == (4096, 10)
    assert (np.diff(time) > 0).all()
    assert (time[0] < 10 * 0.002, time[-1] > 19_990 * 0.002) == (True, True)
    assert all(len(line.values) == 4096 for panel in panels for line in panel.lines)
