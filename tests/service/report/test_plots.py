"""Figures for a paper: their files, sizes, axes, shading, and what of a session they draw."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.axes import Axes

from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.report import plots
from aeroloop.service.report.plots import FORMATS, draw_figures
from aeroloop.service.review.report import Report
from aeroloop.service.review.review import read
from tests.support.made_log import make_log
from tests.support.made_report import with_faults


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    make_log(path, 200, settings=load(overrides=["loop.lockstep=true"]), truth_every=1)
    return path


@pytest.fixture(scope="module")
def quantized(log: Path) -> Report:
    return read(log).report()


@pytest.fixture
def svg_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures in the one format that can be read here: each takes a while to draw."""
    monkeypatch.setattr(plots, "FORMATS", {"svg": FORMATS["svg"]})


def only(made: Report, group: str) -> Report:
    return replace(made, panels=[panel for panel in made.panels if panel.group == group])


def texts(svg: Path) -> list[str]:
    """Texts of an SVG file, which matplotlib writes as comments beside their outlines."""
    return [line.partition("<!-- ")[2].partition(" -->")[0] for line in svg.read_text().splitlines() if "<!-- " in line]


@pytest.mark.usefixtures("svg_only")
def test_every_figure_has_the_papers_number_letters_and_units_and_faults_are_shaded(
    quantized: Report, tmp_path: Path
) -> None:
    faulty = with_faults(quantized, ("gyro off", 0.1, None))
    found = {path.stem: texts(path) for path in draw_figures(faulty, load(), tmp_path)}
    names = ["angles", "C.7-attitude", "C.8-rate", "C.9-error", "C.10-rate_error", "C.11-input", "theorem"]
    assert list(found) == names
    assert all({"time [s]", "gyro off"} <= set(text) for text in found.values())
    assert not any("[1]" in line or "quantiz" in line for text in found.values() for line in text)
    assert {r"$\epsilon_1^Q$", "measured", "desired"} <= set(found["C.7-attitude"])
    assert r"$\omega_{e,2}^Q$ [rad/s]" in found["C.10-rate_error"]
    assert {"roll [°]", "pitch [°]", "yaw [°]", "true"} <= set(found["angles"])
    windy = load(overrides=["plant.wind.blowing=true"])
    (path,) = draw_figures(only(quantized, "error"), windy, tmp_path)
    assert path.stem == "C.12-error"  # the number is that of the case


@pytest.mark.usefixtures("svg_only")
def test_a_fault_is_shaded_from_its_begin_to_its_end_or_to_that_of_the_session(
    quantized: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shaded: list[tuple[float, float]] = []
    monkeypatch.setattr(Axes, "axvspan", lambda _, begin_s, end_s, **_style: shaded.append((begin_s, end_s)))
    faults: list[tuple[str, float, float | None]] = [("gyro off", 0.1, None), ("motor off", 0.05, 0.2)]
    draw_figures(with_faults(only(quantized, "error_angle"), *faults), load(), tmp_path)
    assert shaded == []  # a group that no figure draws
    draw_figures(with_faults(only(quantized, "input"), *faults), load(), tmp_path)
    assert shaded == [(0.1, quantized.time[-1]), (0.05, 0.2)] * 2  # of two motors


def test_a_figure_has_every_format_the_width_of_a_column_and_always_the_same_bytes(
    quantized: Report, tmp_path: Path
) -> None:
    (tmp_path / "again").mkdir()
    error = only(quantized, "error")
    pdf, svg, png = (path.read_bytes() for path in draw_figures(error, load(), tmp_path))
    assert (pdf[:4], svg[:5], png[1:4]) == (b"%PDF", b"<?xml", b"PNG")
    assert struct.unpack(">I", png[16:20])[0] == pytest.approx(600 * 3.5, abs=1)
    assert [pdf, svg, png] == [path.read_bytes() for path in draw_figures(error, load(), tmp_path / "again")]


def test_what_cannot_be_drawn_or_written_is_refused_in_one_line(
    log: Path, quantized: Report, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ReviewError, match="no answered measurement"):
        draw_figures(replace(quantized, time=quantized.time[:0]), load(), tmp_path)
    (tmp_path / "file").write_text("")
    for arguments, status, line in (
        (["--figures", str(tmp_path / "file")], 1, f"cannot write into {tmp_path / 'file'}: File exists"),
        (["--from", "2", "--to", "1"], 2, "--from 2 is not before --to 1"),
    ):
        assert execute(["log", "review", str(log), *arguments]) == status
        (found,) = capfd.readouterr().err.splitlines()
        assert found.startswith(f"aeroloop: {line}")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
