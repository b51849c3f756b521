"""Figures for a paper: their files, sizes, axes, shading, and what of a session they draw."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.report import figure_style
from aeroloop.service.report.figure_style import FORMATS
from aeroloop.service.report.plots import draw_figures
from aeroloop.service.review.report import Band, Report
from aeroloop.service.review.review import report
from tests.support.made_log import make_log

CASES = {
    "continuous": ["wire.attitude.bits=cont", "wire.rate.bits=cont", "wire.voltage.bits=cont"],
    "quantized": [],
    "wind": ["plant.wind.blowing=true"],
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A short log of each of the paper's cases."""
    folder = tmp_path_factory.mktemp("logs")
    for case, overrides in CASES.items():
        settings = load(overrides=["loop.lockstep=true", *overrides])
        make_log(folder / f"{case}.mcap", 200, settings=settings, truth_every=1)
    return {case: folder / f"{case}.mcap" for case in CASES}


@pytest.fixture(scope="module")
def quantized(logs: dict[str, Path]) -> Report:
    return report([logs["quantized"]])


@pytest.fixture
def svg_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures in the one format that can be read here: each takes a while to draw."""
    monkeypatch.setattr(figure_style, "FORMATS", {"svg": FORMATS["svg"]})


@pytest.fixture(scope="module")
def drawn(quantized: Report, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every figure of the quantized case, by name; one of them in every format."""
    folder = tmp_path_factory.mktemp("figures")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figure_style, "FORMATS", {"svg": FORMATS["svg"]})
        paths = draw_figures(quantized, load(), folder)
    paths += draw_figures(only(quantized, "attitude_error"), load(), folder)
    return {path.name: path for path in paths}


def only(made: Report, *groups: str) -> Report:
    """A report with these groups alone: each figure takes a while to draw."""
    return replace(made, panels=[panel for panel in made.panels if panel.group in groups])


def texts(svg: Path) -> list[str]:
    """Texts of an SVG file, which matplotlib writes as comments beside their outlines."""
    return [line.partition("<!-- ")[2].partition(" -->")[0] for line in svg.read_text().splitlines() if "<!-- " in line]


def test_every_figure_is_there_in_every_format_under_the_papers_number(drawn: dict[str, Path]) -> None:
    names = ["angles", "C.7-attitude", "C.8-rate", "C.9-error", "C.10-rate_error", "C.11-input", "theorem"]
    assert list(drawn) == [f"{name}.svg" for name in names] + ["C.9-error.pdf", "C.9-error.png"]
    begin = {".pdf": b"%PDF", ".svg": b"<?xml", ".png": b"\x89PNG"}
    assert all(path.read_bytes().startswith(begin[path.suffix]) for path in drawn.values())


@pytest.mark.usefixtures("svg_only")
@pytest.mark.parametrize(("case", "name"), [("continuous", "C.4-error"), ("wind", "C.12-error")])
def test_the_number_is_that_of_the_case(logs: dict[str, Path], tmp_path: Path, case: str, name: str) -> None:
    paths = draw_figures(only(report([logs[case]]), "attitude_error"), load(overrides=CASES[case]), tmp_path)
    assert {path.stem for path in paths} == {name}


def test_a_figure_is_as_wide_as_a_column_of_a_journal(drawn: dict[str, Path]) -> None:
    (pixels,) = struct.unpack(">I", drawn["C.9-error.png"].read_bytes()[16:20])
    assert pixels == pytest.approx(600 * 3.5, abs=1)


def test_axes_have_letters_and_units_and_there_is_no_title_and_no_unit_of_1(drawn: dict[str, Path]) -> None:
    found = {path.stem: texts(path) for path in drawn.values() if path.suffix == ".svg"}
    assert all("time [s]" in text for text in found.values())
    assert not any("[1]" in line or "quantiz" in line for text in found.values() for line in text)
    assert {r"$\epsilon_1^Q$", "measured", "desired"} <= set(found["C.7-attitude"])
    assert r"$\omega_{e,2}^Q$ [rad/s]" in found["C.10-rate_error"]
    assert {"roll [°]", "pitch [°]", "yaw [°]", "true"} <= set(found["angles"])


def test_the_same_session_gives_the_same_bytes(drawn: dict[str, Path], quantized: Report, tmp_path: Path) -> None:
    for path in draw_figures(only(quantized, "attitude_error"), load(), tmp_path):
        assert path.read_bytes() == drawn[path.name].read_bytes(), path.name


@pytest.mark.usefixtures("svg_only")
def test_bands_are_shaded_with_their_labels(quantized: Report, tmp_path: Path) -> None:
    draw_figures(replace(only(quantized, "input"), bands=[Band(0.1, None, "gyro off")]), load(), tmp_path)
    assert "gyro off" in texts(tmp_path / "C.11-input.svg")


def test_without_ticks_there_is_nothing_to_draw_and_a_file_for_a_folder_is_one_line(
    logs: dict[str, Path], quantized: Report, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ReviewError, match="no answered measurement"):
        draw_figures(replace(quantized, time=quantized.time[:0]), load(), tmp_path)
    (tmp_path / "file").write_text("")
    assert execute(["log", "review", str(logs["quantized"]), "--figures", str(tmp_path / "file")]) == 1
    assert capfd.readouterr().err.splitlines() == [f"aeroloop: cannot write into {tmp_path / 'file'}: File exists"]


def test_a_part_without_ticks_or_of_no_length_is_refused(
    logs: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = str(logs["quantized"])
    assert execute(["log", "review", log, "--figures", str(tmp_path / "none"), "--from", "7"]) == 1
    assert capfd.readouterr().err.startswith("aeroloop: there is nothing from 7 s on: the session has 0.4 s")
    assert execute(["log", "review", log, "--from", "2", "--to", "1"]) == 2
    assert list(tmp_path.iterdir()) == []
