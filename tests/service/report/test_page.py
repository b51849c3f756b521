"""Page of a review, as text: verdict, figures, theorem, comparison, data of the drawings."""

from __future__ import annotations

import gzip
import re
from base64 import b64decode
from dataclasses import replace
from html import unescape
from json import loads
from math import inf
from typing import Any

import numpy as np
import pytest

from aeroloop.service.report.drawings import drawings, page_data
from aeroloop.service.report.page import largest_error, page
from aeroloop.service.review.report import Check, Line, Panel, Report
from tests.support.made_report import HELD, HOSTILE, MARKS, made_report, made_theorem

BROKEN = Check(text="skipped_ticks ≤ 0", holds=False, found="50")


def texts_of(*reports: Report) -> list[str]:
    texts = re.split(r"<(?:script|style)\b.*?</(?:script|style)>|<[^>]+>", page(reports), flags=re.DOTALL)
    return [" ".join(unescape(text).split()) for text in texts if text.strip()]


def with_findings(report: Report, **changes: Any) -> Report:
    return replace(report, findings=report.findings.model_copy(update=changes))


@pytest.mark.parametrize(
    ("report", "words"),
    [
        (made_report(checks=[HELD]), {"Held", HELD.text}),
        (made_report(checks=[HELD, BROKEN]), {"Not held", "does not hold: 50"}),
        (made_report(), {"Tripped"}),
        (made_report(marks=[MARKS[2].model_copy(update={"kind": "fault"})]), {"Faults"}),
        (made_report(marks=()), {"No trip, no fault"}),
    ],
)
def test_the_verdict_is_what_was_required_or_else_what_happened(report: Report, words: set[str]) -> None:
    assert words <= set(texts_of(report))


def test_the_theorem_has_a_section_with_what_it_promises_and_whether_it_held() -> None:
    held, broken = (texts_of(made_report(theorem=made_theorem(share=share))) for share in (0.52, 1.25))
    assert {"Holds: once there, ‖z‖ stays within 0.2004.", "The run kept to the bound."} <= {*held}
    (judged,) = (text for text in held if text.startswith("Judged"))
    for part in ("until 8.5 s", "by 450 of 500 true states", "52.0 % of its bound, at 1.5 s"):
        assert part in judged
    assert "The run broke the bound." in broken
    assert 'id="theorem"' not in page([made_report()])  # where no run was checked against it


def test_the_page_states_what_could_not_be_read_whether_lines_are_thinned_out_and_which_part_is_drawn() -> None:
    damage = "a.mcap: cut at byte 1234"
    assert damage in texts_of(made_report(damages=[damage]))
    assert "What is missing from the log" not in texts_of(made_report())
    assert "up to 64 ticks, 0.128 s" in page([made_report(thinned=64)])
    part = texts_of(replace(made_report(), part=(2.0, inf)))
    assert "Judged is the part from 2 s to 10 s alone; trips, events and what is missing are of the whole log." in part


def test_the_largest_error_that_is_drawn_is_named_with_its_time() -> None:
    made = made_report()
    angles = np.full(len(made.time), 0.5)
    angles[100:120] = 3.0
    angles[110], angles[0] = 4.25, np.nan
    error = Panel("error_angle", "Attitude error, as an angle", "angle", "°", [Line("measured", angles)])
    assert largest_error(replace(made, panels=[*made.panels, error])) == (made.time[110], 4.25)
    assert largest_error(made) is None


def test_a_comparison_has_differences_to_the_first_run() -> None:
    first = made_report("a")
    texts = texts_of(first, replace(with_findings(first, z_track=0.00916, max_error_deg=2.42, trips=[]), name="b"))
    at = texts.index("tracking error z_track")
    assert texts[at + 1 : at + 4] == ["45.80", "91.60", "+45.80 (+100.0 %)"]
    at = texts.index("final attitude error")
    assert texts[at + 1 : at + 4] == ["0.46", "0.46", "0"]
    assert "2 runs compared" in texts


def test_every_tick_is_in_the_data_and_a_text_in_it_cannot_end_its_script() -> None:
    panel = Panel("input", HOSTILE, HOSTILE, HOSTILE, [Line(HOSTILE, np.arange(501.0))])
    report = replace(made_report(), panels=[panel])
    text = page_data([report], drawings([report]))
    assert not set("<>") & set(text)
    data = loads(text)
    octets = gzip.decompress(b64decode(data["numbers"]))
    assert data["times"] == [501]
    np.testing.assert_array_equal(np.frombuffer(octets, "<f8", 501), report.time)
    np.testing.assert_array_equal(np.frombuffer(octets, "<f4", 501, 8 * 501), np.arange(501))


def test_a_run_without_values_has_a_page() -> None:
    bare = replace(made_report(marks=()), time=np.empty(0), panels=[], settings={}, facts={})
    assert "Nothing to judge" in texts_of(with_findings(bare, timing={}, gaps=[], gap_count=0, z_track=None))
