"""Set-points from a CSV file: what is read, and the line of what is not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from aeroloop.protocol.messages.operator import Points
from aeroloop.service.points_file import PointsError, read_points

ROWS = "0,0,0,0\n1.5,0,10,-20.5\n3e0,0,0,1\n"
POINTS = Points(times=[0.0, 1.5, 3.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 10.0, -20.5), (0.0, 0.0, 1.0)])

File = Callable[[str | bytes], Path]


@pytest.fixture
def file(tmp_path: Path) -> File:
    """Write a file, to the byte."""

    def write(content: str | bytes) -> Path:
        path = tmp_path / "points.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize(
    "content",
    [
        ROWS,
        f"time,roll,pitch,yaw\n{ROWS}",
        f'"time [s]","roll [deg]","pitch [deg]","yaw [deg]"\n{ROWS}',
        f"t\n{ROWS}",
        ROWS.replace("\n", "\r\n"),
        ROWS.rstrip("\n"),
        ROWS.replace("\n", "\n\n"),
        ROWS.replace(",", ", "),
        ROWS.replace("1.5", '"1.5"'),
    ],
    ids=["bare", "heading", "quoted heading", "short heading", "CRLF", "no last newline", "gaps", "spaces", "quotes"],
)
def test_a_table_of_points_is_read_with_or_without_a_heading(file: File, content: str) -> None:
    assert read_points(file(content)) == POINTS


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("0,0,0,0\n1,0,0\n", 2),
        ("0,0,0,0\n1,0,0,0,0\n", 2),
        ("0,0,0,0\n1,0,up,0\n2,0,0,0\n", 2),
        ("time,roll,pitch,yaw\n0,0,0,0\n\n1,0,,0\n", 4),
        ("time,roll,pitch,yaw\nseconds,degrees,degrees,degrees\n0,0,0,0\n", 2),
        ("0;0;0;0\n1;0;0;0\n", 2),
        ("0,0,0\n1,0,0,0\n", 1),
        ("0,0,0,0\n   \n1,0,0,0\n", 2),
        ("0,0,0,0\n1,0,0,1'234\n", 2),
    ],
)
def test_a_row_that_is_none_is_reported_with_file_and_line(file: File, content: str, line: int) -> None:
    path = file(content)
    with pytest.raises(PointsError) as refused:
        read_points(path)
    text = str(refused.value)
    assert text.startswith(f"{path}, line {line}: expected four numbers (time [s], roll, pitch, yaw [deg])")
    assert len(text.splitlines()) == 1


BAD_TABLES = [
    pytest.param("", "has 0 points, and a reference 2 to", None, id="empty"),
    pytest.param("time,roll,pitch,yaw\n", "has 0 points, and a reference 2 to", None, id="a heading and no more"),
    pytest.param("0,0,0,0\n", "has 1 points, and a reference 2 to", None, id="one point"),
    pytest.param("1,0,0,0\n2,0,0,0\n", "the first time must be 0", 1, id="begins later"),
    pytest.param("0,0,0,0\n2,0,0,0\n1,0,0,0\n", "must rise", 3, id="falls"),
    pytest.param("0,0,0,0\n0,0,0,0\n", "must rise", 2, id="stands still"),
    pytest.param("0,0,0,0\nnan,0,0,0\n", "number", 2, id="a time that is no number"),
    pytest.param("0,0,0,0\n1,0,inf,0\n", "number", 2, id="an angle that is none"),
    pytest.param(
        "".join(f"{n},0,0,0\n" for n in range(10_001)),
        "has 10001 points, and a reference 2 to 10000",
        None,
        id="too many",
    ),
]


@pytest.mark.parametrize(("content", "why", "_line"), BAD_TABLES)
def test_a_table_that_makes_no_sense_is_reported_with_file_and_reason(
    file: File, content: str, why: str, _line: int | None
) -> None:
    path = file(content)
    with pytest.raises(PointsError, match=why) as refused:
        read_points(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(("content", "why", "line"), [case for case in BAD_TABLES if case.values[2] is not None])
def test_a_table_that_makes_no_sense_is_reported_with_its_line(file: File, content: str, why: str, line: int) -> None:
    with pytest.raises(PointsError, match=f"line {line}: .*{why}"):
        read_points(file(content))


def test_a_file_that_is_not_there_or_cannot_be_read_is_named(tmp_path: Path, file: File) -> None:
    missing = tmp_path / "missing.csv"
    for path, why in [(missing, "No such file"), (tmp_path, "directory"), (file(b"0,0,0,0\n\xff\xfe,0,0,0\n"), "text")]:
        with pytest.raises(PointsError, match=why) as refused:
            read_points(path)
        assert str(path) in str(refused.value)
        assert len(str(refused.value).splitlines()) == 1


def test_a_cell_without_end_is_reported(file: File) -> None:
    with pytest.raises(PointsError, match="line 2"):
        read_points(file("0,0,0,0\n1,0,0," + "1" * 200_000 + "\n"))


def test_a_row_is_named_by_its_line_in_the_file(file: File) -> None:
    with pytest.raises(PointsError, match="line 4"):
        read_points(file('"time\n[s]",roll,pitch,yaw\n0,0,0,0\n1,0,0\n'))


def test_a_table_saved_by_a_spreadsheet_is_read(file: File) -> None:
    assert read_points(file("\ufeff" + ROWS)) == POINTS
