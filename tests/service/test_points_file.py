"""Points from a CSV file: what is read, and in one line what is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeroloop.protocol.errors import ConfigError
from aeroloop.protocol.messages.operator import Points
from aeroloop.service.settings import read_points

ROWS = "0,0,0,0\n1.5,0,10,-20.5\n3e0,0,0,1\n"
POINTS = Points(times=[0.0, 1.5, 3.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 10.0, -20.5), (0.0, 0.0, 1.0)])


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(ROWS, id="bare"),
        pytest.param(f'"time [s]","roll\n[deg]",pitch,yaw\n{ROWS}', id="quoted heading of two lines"),
        pytest.param(ROWS.replace(",", ", ").replace("1.5", '"1.5"'), id="spaces and quotes"),
        pytest.param("\ufeff" + ROWS, id="saved by a spreadsheet"),
    ],
)
def test_a_table_of_points_is_read_with_or_without_a_heading(tmp_path: Path, content: str) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(content.encode())
    assert read_points(path) == POINTS


@pytest.mark.parametrize(
    ("content", "why"),
    [
        pytest.param("0,0,0,0\n1,0,0\n", r"attitudes\[1\]", id="three"),
        pytest.param("time,roll,pitch,yaw\n0,0,0,0\n\n1,0,,0\n", r"attitudes\[1\]\[1\]: .*number", id="an empty cell"),
        pytest.param("time,roll,pitch,yaw\n", "at least 2", id="no point"),
        pytest.param("1,0,0,0\n2,0,0,0\n", "the first time must be 0", id="begins later"),
        pytest.param("0,0,0,0\n0.0001,0,0,0\n", "must rise by at least a millisecond", id="hardly rises"),
        pytest.param("0,0,0,0\nnan,0,0,0\n", "number", id="no time"),
        pytest.param(b"0,0,0,0\n\xff\xfe,0,0,0\n", "it is not text", id="bytes"),
        pytest.param(None, "directory", id="a folder"),
    ],
)
def test_what_is_no_table_of_points_is_reported_in_one_line_with_the_file(
    tmp_path: Path, content: str | bytes | None, why: str
) -> None:
    path = tmp_path if content is None else tmp_path / "points.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ConfigError, match=why) as refused:
        read_points(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1
