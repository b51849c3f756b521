"""File of rows: torn lines, foreign files, two sweeps at once."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aeroloop.service.sweep.rows import Key, Measured, Rows, SweepError

ROWS = {
    Key("a" * 64, 0, "0.2.0+1"): Measured(z_track=0.1 + 0.2, u_total=5e-324, skipped_ticks=3),
    Key("a" * 64, 1, "0.2.0+1"): Measured(reason="the loop ended after 1 s: tilt of 91° – “limit”"),
    Key("b" * 64, 0, "0.2.0+1"): Measured(z_track=float("inf"), command_bits_per_s=1 / 3),
}


def whole(path: Path) -> bytes:
    """A file of ROWS."""
    with Rows(path) as rows:
        for row in ROWS.items():
            rows.append([row])
    return path.read_bytes()


def found(path: Path) -> dict[Key, Measured]:
    """The rows in a file."""
    with Rows(path) as rows:
        return rows.found


def test_rows_are_read_as_they_were_written_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    whole(path)
    assert found(path) == ROWS


@given(st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_cut_off_anywhere_keeps_its_whole_lines_and_takes_the_others_again(
    tmp_path: Path, data: st.DataObject
) -> None:
    path = tmp_path / "a.jsonl"
    path.unlink(missing_ok=True)
    complete = whole(path)
    length = data.draw(st.integers(0, len(complete)))
    path.write_bytes(complete[:length])
    kept = complete[:length].count(b"\n") - 1  # without the head
    with Rows(path) as rows:
        assert list(rows.found.items()) == list(ROWS.items())[: max(0, kept)]
        rows.append((key, row) for key, row in ROWS.items() if key not in rows.found)
    assert path.read_bytes() == complete


@pytest.mark.parametrize("text", ["hello", "hello\n", '{"seed": 0}\n', '{"aeroloop": "diary"}\n'])
def test_a_file_of_something_else_is_refused_and_left_alone(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text(text)
    with pytest.raises(SweepError, match="does not hold a sweep"):
        Rows(path)
    assert path.read_text() == text


@pytest.mark.parametrize("line", [b"{}", b"[1]", b"0", b'{"configuration": "a"', b"\x00\x00\xff"])
def test_a_damaged_line_is_named(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "a.jsonl"
    lines = whole(path).splitlines()
    path.write_bytes(b"\n".join([*lines[:2], line, *lines[2:], b""]))
    with pytest.raises(SweepError, match="line 3"):
        Rows(path)


def test_a_file_serves_one_sweep_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    with Rows(path), pytest.raises(SweepError, match="in use by another sweep"):
        Rows(path)
    assert found(path) == {}


def test_a_disk_that_takes_half_a_row_ends_the_sweep_and_the_half_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    whole(path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with Rows(path) as rows:
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 10, before[1]))
        try:
            with pytest.raises(SweepError, match="cannot be written"):
                rows.append([(Key("c", 0, "0.2.0+1"), Measured())])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert found(path) == ROWS
