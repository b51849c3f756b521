"""Lines of a report: every quantity of the controller, decimated with every extreme in its place."""

from __future__ import annotations

from math import cos, nan, radians, sin
from pathlib import Path

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.wire.attitude import Quaternion, to_euler
from aeroloop.service.config import load
from aeroloop.service.logs.files import ReviewError
from aeroloop.service.logs.table import euler_deg
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review.downsample import DownsampledLines
from aeroloop.service.review.observe import DrawnPart
from aeroloop.service.review.review import read, report
from tests.support.edited_log import LATENCY_NS, PERIOD_NS, message_of, observer_of, rewrite, ticks_of
from tests.support.made_log import SESSION, START_NS, make_log

TICKS = 500


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 500 ticks in real time, each answered after 300 µs."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    make_log(path, TICKS, settings=load())
    return path


def test_a_short_session_is_drawn_exactly(whole: Path) -> None:
    blocks: list[Ticks] = []
    judged = read(whole, watch=blocks.append)
    made, ticks = judged.report(), Ticks.joined(blocks)
    drawn = {(panel.group, panel.label, line.label): line.values for panel in made.panels for line in panel.lines}
    assert made.thinned == 1
    assert made.time.tolist() == (ticks.k * 0.002).tolist()
    assert drawn["rate", "ω₃", "measured"].tolist() == ticks.rate[:, 2].tolist()
    assert drawn["rate", "ω₃", "desired"].tolist() == ticks.desired_rate[:, 2].tolist()
    assert drawn["attitude", "ε₂", "desired"].tolist() == ticks.desired[:, 2].tolist()
    assert drawn["attitude_error", "ε̃₁", "measured"].tolist() == ticks.attitude_error[:, 0].tolist()
    assert drawn["rate_error", "ω_e2", "measured"].tolist() == ticks.rate_error[:, 1].tolist()
    assert drawn["input", "u₂", "commanded"].tolist() == ticks.voltages[:, 0].tolist()
    assert drawn["latency", "latency", "latency"][:-1].tolist() == [LATENCY_NS / 1e3] * (TICKS - 1)
    assert drawn["period", "period", "period"][1:].tolist() == [PERIOD_NS / 1e3] * (TICKS - 1)
    assert max(drawn["error_angle", "angle", "measured"]) == pytest.approx(judged.figures.max_error_deg)
    assert judged.figures.final_error_deg == pytest.approx(drawn["error_angle", "angle", "measured"][-1])


def test_panels_stand_in_the_order_of_the_papers_figures_and_are_named_after_them(whole: Path) -> None:
    made = report([whole])
    assert list(dict.fromkeys((panel.group, panel.title.partition(":")[0]) for panel in made.panels)) == [
        ("angles", "Roll, pitch and yaw"),
        ("attitude", "Figure C.7"),
        ("rate", "Figure C.8"),
        ("attitude_error", "Figure C.9"),
        ("rate_error", "Figure C.10"),
        ("input", "Figure C.11"),
        ("error_angle", "Attitude error, as an angle"),
        ("latency", "Loop latency"),
        ("period", "Period between measurements"),
        ("damping_estimate", "Damping estimate"),
        ("z_norm", "Error of Theorem 1"),
        ("lyapunov", "Lyapunov function"),
    ]
    assert [panel.label for panel in made.panels][:7] == ["roll", "pitch", "yaw", "η", "ε₁", "ε₂", "ε₃"]
    assert all(line.values.shape == made.time.shape for panel in made.panels for line in panel.lines)


def test_of_both_signs_the_attitude_is_drawn_with_that_beside_the_desired_one() -> None:
    observer = observer_of()
    observer.ticks(ticks_of(0, attitude=(-0.6, 0.0, -0.8, 0.0), desired=(0.6, 0.0, 0.8, 0.0)))
    observer.ticks(ticks_of(1, attitude=(0.6, 0.0, 0.8, 0.0), desired=(0.6, 0.0, 0.8, 0.0)))
    _, panels = observer.lines()
    (eta,) = (panel for panel in panels if panel.label == "η")
    assert eta.lines[0].values.tolist() == eta.lines[1].values.tolist() == [0.6, 0.6]


def test_roll_pitch_and_yaw_are_the_angles_of_each_quaternion() -> None:
    q = np.random.default_rng(1).normal(size=(200, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(euler_deg(q), np.degrees([to_euler(tuple(one)) for one in q.tolist()]), atol=1e-9)


def test_yaw_runs_on_where_the_body_turns_past_half_a_turn_and_what_is_measured_and_true_stays_beside_it() -> None:
    """The reference turns about z at 10° a tick; the body lags by 4°, as measured, and by 5° truly."""
    observer = observer_of()
    for k in range(60):
        desired, measured, true = (
            (cos(radians(10 * k - lag) / 2), 0.0, 0.0, sin(radians(10 * k - lag) / 2)) for lag in (0, 4, 5)
        )
        observer.check.truth(k, true, (0.0, 0.0, 0.0))
        observer.ticks(ticks_of(k, attitude=measured, desired=desired))
    _, panels = observer.lines()
    (yaw,) = (panel for panel in panels if panel.label == "yaw")
    lines = {line.label: line.values for line in yaw.lines}
    np.testing.assert_allclose(lines["desired"], 10.0 * np.arange(60), atol=1e-6)
    np.testing.assert_allclose(lines["measured"], lines["desired"] - 4, atol=1e-6)
    np.testing.assert_allclose(lines["true"], lines["desired"] - 5, atol=1e-6)


def test_of_a_part_every_tick_is_drawn_however_long_the_session_is(whole: Path) -> None:
    made = report([whole], part=DrawnPart(0.2, 0.3, points=60))
    assert made.time.tolist() == pytest.approx([0.002 * k for k in range(100, 151)])
    assert (made.thinned, made.part) == (1, (0.2, 0.3))
    assert made.findings == report([whole]).findings  # of the whole session
    with pytest.raises(ReviewError, match=r"nothing to draw after 2 s and before 3 s: the session has 1 s"):
        report([whole], part=DrawnPart(2, 3))


def test_the_true_error_is_drawn_where_the_log_has_the_truth(whole: Path, tmp_path: Path) -> None:
    """The truth, sent at every tenth tick, is the desired attitude turned by 10°: the angle between them is that."""
    turn = cos(radians(5)), 0.0, sin(radians(5)), 0.0
    blocks: list[Ticks] = []
    read(whole, watch=blocks.append)
    ticks = Ticks.joined(blocks)
    more = [
        message_of(
            "truth",
            Truth(tick=k, session=SESSION, session_tick=k, attitude=product(tuple(desired), turn), rate=(0, 0, 0),
                  voltages=(0, 0)),
            START_NS + k * PERIOD_NS + 1000,
        )
        for k, desired in list(zip(ticks.k.tolist(), ticks.desired.tolist(), strict=True))[::10]
    ]  # fmt: skip
    made = report([rewrite(whole, tmp_path / "a.mcap", more=more)])
    (panel,) = (panel for panel in made.panels if panel.group == "error_angle")
    assert [line.label for line in panel.lines] == ["measured", "true"]
    assert panel.lines[1].values[1:-10] == pytest.approx(10.0, abs=0.05)  # interpolated while q_d turns


def test_the_true_error_is_that_of_the_law_however_far_the_body_is_turned() -> None:
    desired = 0.5, -0.5, 0.5, 0.5
    observer = observer_of()
    for k in range(3):
        turned = product(desired, (cos(radians(15)), sin(radians(15)), 0.0, 0.0))
        observer.check.truth(k, turned, (0.0, 0.0, 0.0))
        observer.ticks(ticks_of(k, desired=desired))
    _, panels = observer.lines()
    (true,) = (
        line.values for panel in panels for line in panel.lines if (panel.group, line.label) == ("error_angle", "true")
    )
    assert true == pytest.approx([30.0] * 3)


def test_the_damping_estimate_is_that_of_every_tick(whole: Path) -> None:
    values = {
        panel.label: panel.lines[0].values for panel in report([whole]).panels if panel.group == "damping_estimate"
    }
    assert values["θ̂₂"][0] == pytest.approx(0.007, abs=1e-4)  # as Table C.1 has it, before it adapts
    assert len(np.unique(values["θ̂₂"])) > 0.9 * TICKS


@pytest.mark.parametrize("rows", [1, 2, 63, 64, 65, 127, 1000, 5003])
@pytest.mark.parametrize("block", [16, 64, 1000])
def test_thinned_lines_keep_every_extreme_at_its_place_and_are_exact_while_short(rows: int, block: int) -> None:
    rng = np.random.default_rng(rows)
    data = np.column_stack([np.arange(rows, dtype=float), rng.normal(size=(rows, 2))])
    data[rng.random(rows) < 0.3, 2] = nan
    lines = DownsampledLines(3, max_points=64)
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
    lines = DownsampledLines(3, max_points=100)
    for part in np.array_split(np.column_stack([k, 2 * k, -k]), 30):
        lines.add(part)
    points = lines.points()
    assert (np.diff(points[:, 1]) > 0).all()
    assert (np.diff(points[:, 2]) < 0).all()


def test_buckets_are_alike_however_long_it_runs() -> None:
    """Old ones must not grow coarser than new ones: each spans the same, but for the last."""
    lines = DownsampledLines(1, max_points=64)
    for start in range(0, 64 * 1024, 16):
        lines.add(np.arange(start, start + 16, dtype=float)[:, np.newaxis])
        assert len(lines.points()) <= 64
    spans = np.diff(lines.points()[::2, 0])
    assert spans.min() == spans.max() == lines.per_bucket


def test_an_observer_holds_a_bounded_number_of_points_however_many_ticks_come() -> None:
    observer = observer_of(part=DrawnPart(points=4096))
    ticks = Ticks.joined([ticks_of(k) for k in range(20_000)])
    for k in range(0, 20_000, 50):
        observer.ticks(ticks.where(slice(k, k + 50)))
    time, panels = observer.lines()
    assert 1024 < len(time) <= 4096
    assert observer.thinned == 16
    assert observer.timing["period"].count == 20_000 - 1
    assert len(panels[0].lines[0].values) == len(time)


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
