"""Page of a review, as text: verdict, figures, theorem, comparison, data of the drawings."""

from __future__ import annotations

from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from json import loads
from math import inf
from typing import Any

import numpy as np

from aeroloop.service.report.drawings import drawings, page_data
from aeroloop.service.report.page import page
from aeroloop.service.review.report import Check, Line, Panel, Report
from tests.support.made_report import HELD, HOSTILE, made_report, made_theorem

BROKEN = Check(text="skipped_ticks ≤ 0", holds=False, found="50")


class Texts(HTMLParser):
    """The texts of a page, outside of scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.element = ""
        self.feed(text)

    def handle_starttag(self, tag: str, _attrs: object) -> None:
        self.element = tag

    def handle_data(self, data: str) -> None:
        if self.element not in {"script", "style"} and data.strip():
            self.texts.append(" ".join(data.split()))


def texts_of(*reports: Report) -> list[str]:
    return Texts(page(reports)).texts


def after(head: str, n: int, *reports: Report) -> list[str]:
    """The texts of a row after its head."""
    texts = texts_of(*reports)
    at = texts.index(head)
    return texts[at + 1 : at + 1 + n]


def with_findings(report: Report, **changes: Any) -> Report:
    return replace(report, findings=report.findings.model_copy(update=changes))


def data_of(*reports: Report) -> dict[str, Any]:
    found: dict[str, Any] = loads(page_data(reports, list(drawings(reports))))
    return found


def numbers(typed: dict[str, str]) -> Any:
    return np.frombuffer(b64decode(typed["bdata"]), typed["dtype"])


def test_the_page_states_what_was_required_and_what_was_found() -> None:
    assert {"Held", HELD.text} <= set(texts_of(made_report(checks=[HELD])))
    assert {"Not held", "does not hold: 50"} <= set(texts_of(made_report(checks=[HELD, BROKEN])))
    assert "Tripped" in texts_of(made_report())
    assert "Tracked" in texts_of(made_report(marks=()))


def test_the_verdict_has_its_times() -> None:
    error = Panel("error_angle", "Attitude error", "angle", "°", [Line("measured", np.linspace(4.84, 0, 501))])
    run = made_report()
    verdict = (
        page([replace(run, panels=[*run.panels, error])]).partition('class="verdict bad"')[2].partition("</ul>")[0]
    )
    for found in ("Show 7.250 s: tripped", "Largest attitude error: 4.84°", "Show 0.000 s: largest attitude error"):
        assert found in verdict


def test_the_theorem_has_a_section_with_what_it_promises_and_which_inequality_was_broken() -> None:
    held = page([made_report(theorem=made_theorem())])
    section = held.partition('<section id="theorem"')[2].partition("</section>")[0]
    assert section.count('data-name="z_norm"') == held.count('data-name="z_norm"') == 1
    texts = Texts(held).texts
    kept = "The run kept to Lemma 1 and the bound at every instant."
    assert {"Holds: once there, ‖z‖ stays within 0.2004.", kept, "(C.57)", "97.0"} <= set(texts)
    (judged,) = (text for text in texts if "belong to a tick" in text)
    assert judged == (
        "Judged until 8.5 s, where gains or reference changed. 500 true states belong to a tick. At 120 the sensors of "
        "the rate err by more than the quantizer, against (C.29). Lemma 1 is judged by the other 380. Closest is "
        "(C.57), 97.0 % of its bound. ‖z‖ is at most 52.0 % of its bound, at 1.5 s; the bound judges from 1 s and "
        "falls to 0.21."
    )
    broken = page([made_report(theorem=made_theorem(broken=7))])
    assert "Show 3.125 s: (C.57) ‖Φ − Φ^Q‖ first broken" in broken
    not_kept = "The run did not keep to all of Lemma 1 and the bound at every instant."
    assert {"7", "125.0", not_kept} <= set(Texts(broken).texts)
    assert "first broken" not in held
    assert 'id="theorem"' not in page([made_report()])  # where no run was checked against it
    several = texts_of(made_report("a"), made_report("b", theorem=made_theorem()))
    assert "Holds: once there, ‖z‖ stays within 0.2004." in several


def test_what_cannot_be_judged_is_one_line_with_its_reasons() -> None:
    none = {"judged": 0, "lemma": [], "broken": None, "pointwise_judged": 0, "pointwise_share": None, "held": None}
    theorem = made_theorem().model_copy(update=none)
    for reasons, line in (
        (("x", "y"), "Not judged: Lemma 1, since x; the bound at every instant, since y."),
        (("x", "x"), "Not judged: Lemma 1 and the bound at every instant, since x."),
    ):
        why = dict(zip(("theorem.broken", "theorem.pointwise_share"), reasons, strict=True))
        texts = texts_of(with_findings(made_report(theorem=theorem), reasons=why))
        assert {line, "Nothing could be judged."} <= set(texts)
        assert not any("is judged by" in text for text in texts)


def test_the_page_states_what_could_not_be_read_whether_lines_are_thinned_out_and_which_part_is_drawn() -> None:
    damage = "a.mcap: cut at byte 1234"
    assert damage in texts_of(made_report(damages=[damage]))
    assert "What is missing from the log" not in texts_of(made_report())
    thinned = page([made_report(thinned=64)])
    assert "up to 64 ticks, 0.128 s" in thinned
    assert "--from S --to S" in thinned
    assert 'id="drawn"' not in page([made_report(thinned=2)])
    part = texts_of(replace(made_report(), part=(2.0, inf)))
    assert "Judged is the part from 2 s to 10 s alone; trips, events and what is missing are of the whole log." in part


def test_the_tiles_are_words_before_symbols_each_defined_and_fill_their_rows() -> None:
    text = page([made_report()])
    cards = text.partition('<dl class="cards">')[2].partition("</dl>")[0].split('class="card"')[1:]
    assert len(cards) % 4 == 0
    for card in cards:
        name, what = (card.partition(f"<{tag}>")[2].partition(f"</{tag}>")[0] for tag in ("dt", "small"))
        assert name.split()[0] not in ("z_track", "u_total")
        assert len(what) > 10
    assert "tracking error z_track" in cards[0]
    assert "p99 2.4 ms" in text


def test_a_comparison_states_differences_to_the_first_run_in_words() -> None:
    first = made_report("a")
    changes: dict[str, Any] = {"z_track": 0.00916, "max_error_deg": 2.42, "trips": []}
    both = first, replace(with_findings(first, **changes), name="b")
    assert after("tracking error z_track", 4, *both) == ["45.80", "91.60", "+45.80 (+100.0 %)", "▲ worse"]
    assert after("largest attitude error", 4, *both) == ["4.84", "2.42", "−2.42 (−50.0 %)", "▼ better"]
    assert after("final attitude error", 4, *both) == ["0.46", "0.46", "0", "same"]
    assert after("trips", 4, *both)[2:] == ["−1 (−100.0 %)", "▼ better"]
    assert "Δ to a" in texts_of(*both)
    longer = first, replace(with_findings(first, **changes, duration_s=20.0), name="b")
    assert after("tracking error z_track", 4, *longer)[3] == "×10⁻⁴ s"  # a sum over twice the time is not worse
    assert after("largest attitude error", 4, *longer)[3] == "▼ better"


def test_every_tick_is_in_the_data_and_a_text_in_it_cannot_end_its_script() -> None:
    report = replace(
        made_report(), panels=[Panel("input", HOSTILE, HOSTILE, HOSTILE, [Line(HOSTILE, np.arange(501.0))])]
    )
    assert not set("<>") & set(page_data([report], list(drawings([report]))))
    data = data_of(report)
    np.testing.assert_array_equal(numbers(data["times"][0]), report.time)
    np.testing.assert_array_equal(numbers(data["drawings"]["input"]["data"][0]["y"]), np.arange(501.0))


def test_a_desired_line_that_runs_share_is_drawn_once() -> None:
    def desired(*reports: Report) -> list[int | None]:
        """The run of each desired line of one panel; None where it is shared."""
        traces = data_of(*reports)["drawings"]["attitude"]["data"]
        return [trace["run"] for trace in traces if "desired" in trace["name"] and trace["yaxis"] == "y"]

    one, later = made_report("a"), made_report("b", phase=0.3)
    short = replace(later, time=later.time[:300], panels=[_shortened(panel, 300) for panel in later.panels])
    assert desired(one, later) == desired(one, short) == [None]
    assert desired(one, made_report("c", turned=True)) == [0, 1]


def _shortened(panel: Panel, n: int) -> Panel:
    return replace(panel, lines=[replace(line, values=line.values[:n]) for line in panel.lines])


def test_a_run_without_values_has_a_page_and_one_log_may_be_compared_with_itself() -> None:
    bare = replace(made_report(marks=()), time=np.empty(0), panels=[], settings={}, facts={})
    assert "Nothing to judge" in texts_of(with_findings(bare, timing={}, gaps=[], gap_count=0, z_track=None))
    with_theorem = made_report(theorem=made_theorem())
    assert "2 runs compared" in texts_of(with_theorem, replace(with_theorem))
