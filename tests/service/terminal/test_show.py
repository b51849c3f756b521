"""Printer of results: the same rows for a terminal of any width, and as Markdown."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from io import StringIO
from pathlib import Path

import pytest
from rich.cells import cell_len
from rich.console import Console

from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.transport.certificate import SOON_DAYS
from aeroloop.service.config import load
from aeroloop.service.review.report import Mark
from aeroloop.service.review.review import read
from aeroloop.service.terminal import show as module
from aeroloop.service.terminal.log_sheets import review_sheets
from aeroloop.service.terminal.roles import role_sheets
from aeroloop.service.terminal.sheets import certificate_sheets
from aeroloop.service.terminal.show import Row, markdown, show, show_all
from aeroloop.service.theorem.certificate import certify
from tests.support.made_log import make_log

ROWS: list[Row] = [
    {"law": "adaptive", **{f"figure {i} of several": f"{i}.{i} (×1.0{i})" for i in range(8)}, "reason": ""},
    {"law": "pd", **{f"figure {i} of several": "–" for i in range(8)}, "reason": "the loop ended after 1 s, as it had"},
]


def screen(monkeypatch: pytest.MonkeyPatch, width: int) -> StringIO:
    console = Console(width=width, force_terminal=True, color_system=None, file=StringIO())
    monkeypatch.setattr(module, "Console", lambda: console)
    assert isinstance(console.file, StringIO)
    return console.file


@pytest.mark.parametrize("width", [60, 80, 120, 300])
def test_no_line_is_wider_than_the_terminal_and_every_figure_stands_whole_beside_its_key(
    monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    out = screen(monkeypatch, width)
    show(ROWS, "two laws")
    lines = out.getvalue().splitlines()
    assert lines[0].strip() == "two laws"
    assert max(map(cell_len, lines)) <= width
    for i in range(8):
        assert any("adaptive" in line and f"{i}.{i} (×1.0{i})" in line for line in lines)
    assert len([line for line in lines if "adaptive" in line]) == (1 if width == 300 else pytest.approx(3, abs=2))
    words = out.getvalue().split()
    assert all(word in words for word in ROWS[1]["reason"].split())


def test_rows_into_a_pipe_are_not_folded_at_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    show([{"law": "a", "kbit/s": "1.0", "what that is": "word " * 25}])
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_markdown_has_every_cell_and_numbers_but_no_sentences_to_the_right() -> None:
    rows = [{"law": "pd", "kbit/s": "1.0", "kind": "8 bits, uniform"}, {"law": "2", "kbit/s": "–", "kind": "2 samples"}]
    text = markdown([("laws", rows), ("a note", [])])
    table = ["| law | kbit/s | kind |", "|---|--:|---|", "| pd | 1.0 | 8 bits, uniform |", "| 2 | – | 2 samples |"]
    assert text.splitlines() == ["**laws**", "", *table, "", "a note"]


def test_the_first_column_names_a_row_and_stands_to_the_left_even_if_its_names_are_numbers() -> None:
    rows: list[Row] = [{"bits": "8", "z_track": "1.5"}, {"bits": "10", "z_track": "1.2"}]
    assert markdown([("", rows)]).splitlines()[1] == "|---|--:|"


def test_events_that_differ_in_numbers_only_are_one_with_count_and_time_of_the_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_log(log := tmp_path / "run.mcap", 100)
    times = {0.02: 3, 0.05: 7, 0.11: 9}
    faults = [Mark(time_s=at, kind="fault", role="controller", text=f"{n} ticks missed") for at, n in times.items()]
    trips = [Mark(time_s=at, kind="tripped", role="plant", text="no fresh command for 100 ms") for at in (0.06, 0.12)]
    found = read(log).findings.model_copy(update={"marks": sorted([*faults, *trips], key=lambda mark: mark.time_s)})
    show_all(review_sheets(found))
    shown = capsys.readouterr().out
    assert "3 ticks missed (3 such events in all, the last: 0.110 s)" in shown
    assert "7 ticks missed" not in shown
    assert shown.count("no fresh command for 100 ms") == 2  # each trip by itself


def test_a_certificate_that_expires_soon_is_a_note_and_one_that_lasts_is_none() -> None:
    notes = []
    for days in (SOON_DAYS - 1, SOON_DAYS + 1):
        until = datetime.now(UTC) + timedelta(days=days)
        status = Status(
            role="plant", state="idle", uptime_s=1, ticks=1, rate_hz=500, skipped=0, certificate_until=until
        )  # fmt: skip
        _, *more = role_sheets({"plant": status}, "aero")
        notes.append([row["note"] for _, rows in more for row in rows])
    assert notes[1] == []
    assert notes[0][0].startswith("its certificate expires at ")


def test_a_certificate_shows_its_verdict_and_what_decides_and_on_request_every_term(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = certify(load())
    show_all(certificate_sheets(found))
    short = capsys.readouterr().out
    assert short.startswith(found.verdict)
    assert f"--verbose prints all {len(found.terms)} terms" in short
    show_all(certificate_sheets(found, verbose=True))
    words = capsys.readouterr().out.split()
    assert len(words) > len(short.split())
    assert all(word in words for term in found.terms for word in f"{term.symbol} ({term.equation})".split())
