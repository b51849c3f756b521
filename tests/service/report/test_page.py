"""Page of a review, as text: verdict, figures, theorem, comparison, packed data."""

from __future__ import annotations

from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from json import loads
from math import inf
from pathlib import Path
from typing import Any
from zlib import decompress

import numpy as np
import pytest

from aeroloop.service.cli.compare import write_html
from aeroloop.service.logs.outputs import OutputError
from aeroloop.service.report.drawings import drawings, page_data
from aeroloop.service.report.page import page
from aeroloop.service.report.rows import figure_rows, micros, percent
from aeroloop.service.review.report import Check, Line, Panel, Report
from tests.support.made_report import HELD, HOSTILE, made_report, made_theorem

BROKEN = Check(text="skipped_ticks ≤ 0", holds=False, found="50")


class Texts(HTMLParser):
    """The texts of a page, outside of scripts and styles, and its elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.elements = [""]
        self.feed(text)

    def handle_starttag(self, tag: str, _attrs: object) -> None:
        self.elements.append(tag)

    def handle_data(self, data: str) -> None:
        if self.elements[-1] not in {"script", "style"}:
            self.texts.append(data)


def test_text_and_attributes_are_escaped_and_markup_is_not() -> None:
    inner = tag("b", "a<b & c")
    assert tag("p", inner, "<i>", None, title='"x"', hidden=True) == (
        '<p title="&quot;x&quot;" hidden><b>a&lt;b &amp; c</b>&lt;i&gt;</p>'
    )


def texts_of(*reports: Report) -> list[str]:
    return Texts(page(reports)).texts


def test_the_page_states_what_was_asked_and_what_was_found() -> None:
    assert {" Held", HELD.text} <= set(texts_of(made_report(checks=[HELD])))
    assert {" Not held", "does not hold: 50"} <= set(texts_of(made_report(checks=[HELD, BROKEN])))
    assert " Tripped" in texts_of(made_report())
    assert " Tracked" in texts_of(made_report(marks=()))


def test_the_page_states_what_the_theorem_promises_and_which_inequality_was_broken_in_a_section_of_its_own() -> None:
    held = page([made_report(theorem=made_theorem())])
    section = held.partition('<section id="theorem"')[2].partition("</section>")[0]
    assert section.count('data-name="z_norm"') == held.count('data-name="z_norm"') == 1
    texts = Texts(held).texts
    assert " Holds: once there, ‖z‖ stays within 0.2004." in texts
    assert " The run kept to all of it that could be judged." in texts
    assert {"0.0638", "0.1803", "0.2004", "31.0", "52.0", "(C.57)", "97.0"} <= set(texts)
    (judged,) = (text for text in texts if "belong to a tick" in text)
    assert "Judged until 8.5 s" in judged
    assert "Judged from" not in judged
    assert "At 120 the sensors of the rate err by more than the quantizer, against (C.29)." in judged
    assert judged.endswith("Lemma 1 is judged by the other 380.")
    went = made_theorem().model_copy(update={"since_s": 2.1})
    assert any("Judged from 2.1 s" in text for text in texts_of(made_report(theorem=went)))
    broken = page([made_report(theorem=made_theorem(broken=7))])
    assert "Show 3.125 s: (C.57) ‖Φ − Φ^Q‖ first broken" in broken
    assert {"7", "125.0", " The run did not keep to it."} <= set(Texts(broken).texts)
    assert "first broken" not in held
    assert 'id="theorem"' not in page([made_report()])  # where no run was checked against it
    several = texts_of(made_report("a"), made_report("b", theorem=made_theorem()))
    assert " Holds: once there, ‖z‖ stays within 0.2004." in several


def test_the_wire_is_listed_with_each_signals_quantizer() -> None:
    signals = {
        "attitude": {"bits": 8, "limit": 1.0},  # of before there were kinds
        "rate": {"bits": 10, "limit": 2.0, "kind": "hysteresis-uniform"},
        "voltage": {"bits": None, "limit": 24.0, "kind": "logarithmic-uniform"},
    }
    texts = Texts(page([made_report(settings={"wire": signals})])).texts

    def row(head: str) -> list[str]:
        return texts[texts.index(head) :][1:4]

    assert row("attitude ε") == ["uniform", "8", "±1"]
    assert row("rate ω") == ["hysteresis-uniform", "10", "±2"]
    assert row("voltage u") == ["–", "cont", "±24"]


def test_the_page_states_what_could_not_be_read_whether_lines_are_thinned_out_and_which_part_is_drawn() -> None:
    damage = "a.mcap: cut at byte 1234"
    assert damage in texts_of(made_report(damages=[damage]))
    assert "What is missing from the log" not in texts_of(made_report())
    thinned = page([made_report(thinned=64)])
    assert "up to 64 ticks, 0.128 s" in thinned
    assert "--from S --to S" in thinned
    assert 'id="drawn"' not in page([made_report(thinned=2)])
    assert "Drawn is the part from 2 s to 10 s" in page([replace(made_report(), part=(2.0, inf))])


@pytest.mark.parametrize("levels", [1 << 22, 1 << 30])
def test_what_is_packed_comes_back_to_half_a_step(levels: int) -> None:
    """As data.js unpacks it."""
    rng = np.random.default_rng(1)
    for values in (
        np.sin(np.arange(5000) / 300) * 1e3 + rng.normal(size=5000),
        np.where(rng.random(5000) < 0.3, np.nan, rng.integers(-31, 32, 5000) * 0.77),
        np.full(10, 3.5),
        np.full(10, np.nan),
        np.empty(0),
    ):
        found = packed(values, levels)
        planes = np.frombuffer(decompress(b64decode(found["deltas"])), np.uint8).reshape(4, -1)
        zigzag = np.ascontiguousarray(planes.T).view("<u4")[:, 0].astype(np.int64)
        codes = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
        back = np.where(codes < 0, np.nan, found["least"] + found["step"] * codes)
        np.testing.assert_allclose(back, values, atol=0.51 * found["step"], rtol=0)
        assert found["step"] in (
            1.0,
            np.ptp(values[np.isfinite(values)]) / levels if np.isfinite(values).any() else 1.0,
        )


def test_thirty_seconds_of_a_run_take_two_megabytes_beside_the_library() -> None:
    """Forty lines at 500 Hz, half of them a quantizer's; without packing they took eight."""
    rng = np.random.default_rng(1)
    time = np.arange(15_000, dtype=np.float64) * 0.002
    smooth = [np.sin(time + i) for i in range(20)]
    coded = [np.round(63 * line + rng.normal(size=15_000)) / 63 for line in smooth]
    lines = [Line("measured", values) for values in [*smooth, *coded]]
    size = len(page_data([replace(made_report(), time=time, panels=[Panel("rate", "Rate", "ω", "rad/s", lines)])]))
    assert size < 2e6


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


def test_the_verdict_has_its_times() -> None:
    error = Panel("error_angle", "Attitude error", "angle", "°", [Line("measured", np.linspace(4.84, 0, 501))])
    run = made_report()
    (card,) = page([replace(run, panels=[*run.panels, error])]).partition('class="verdict bad"')[2].split("</ul>")[:1]
    assert "Show 7.250 s: tripped" in card
    assert "Largest attitude error: 4.84°" in card
    assert "Show 0.000 s: largest attitude error" in card


def test_a_comparison_states_differences_to_the_first_run_in_words() -> None:
    first = made_report("a")
    update = {"z_track": 0.00916, "max_error_deg": 2.42, "trips": []}
    findings = first.findings.model_copy(update=update)
    texts = Texts(page([first, replace(first, name="b", findings=findings)])).texts

    def row(name: str) -> list[str]:
        at = texts.index(name)
        return [text.strip() for text in texts[at + 1 : at + 5]]

    assert row("tracking error z_track") == ["45.80", "91.60", "+45.80 (+100.0 %)", "▲ worse"]
    assert row("largest attitude error") == ["4.84", "2.42", "−2.42 (−50.0 %)", "▼ better"]
    assert row("final attitude error") == ["0.46", "0.46", "0", "same"]
    assert row("trips")[2:] == ["−1 (−100.0 %)", "▼ better"]
    assert "Δ to a" in texts
    longer = first.findings.model_copy(update={**update, "duration_s": 20.0})
    texts = Texts(page([first, replace(first, name="b", findings=longer)])).texts
    assert row("tracking error z_track")[2:] == ["+45.80 (+100.0 %)", "×10⁻⁴ s"]  # a sum over twice the time
    assert row("largest attitude error")[3] == "▼ better"


def test_a_missing_figure_states_why() -> None:
    run = made_report()
    why = "the plant reported no latency"
    findings = run.findings.model_copy(update={"latency_us": None, "reasons": {"latency_us": why}})
    assert Texts(page([replace(run, findings=findings)])).texts.count(why) >= 2  # p50 and p99


def test_data_cannot_end_its_script_and_comes_back_as_it_was() -> None:
    report = made_report(HOSTILE)
    data = data_of(report)
    assert not set("<>&") & set(data)
    assert loads(data)["runs"][0]["name"] == HOSTILE


def shortened(panel: Panel, n: int) -> Panel:
    return replace(panel, lines=[replace(line, values=line.values[:n]) for line in panel.lines])


def test_a_desired_line_that_runs_share_is_drawn_once() -> None:
    def desired(*reports: Report) -> list[dict[str, Any]]:
        (group,) = [group for group in loads(data_of(*reports))["groups"] if group["id"] == "attitude"]
        return [line for line in group["panels"][0]["lines"] if line["desired"]]

    one, later = made_report("a"), made_report("b", phase=0.3)
    assert [line["shared"] for line in desired(one, later)] == [True]
    other = made_report("c", turned=True)
    assert [line["shared"] for line in desired(one, other)] == [False, False]
    short = replace(later, time=later.time[:300], panels=[shortened(panel, 300) for panel in later.panels])
    assert [line["shared"] for line in desired(one, short)] == [True]


def test_a_run_without_values_has_a_page() -> None:
    bare = replace(made_report(marks=()), time=np.empty(0), panels=[], settings={}, facts={})
    findings = bare.findings.model_copy(update={"timing": {}, "gaps": [], "gap_count": 0, "z_track": None})
    assert " Nothing to judge" in Texts(page([replace(bare, findings=findings)])).texts


def test_a_page_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*: No such file or directory"):
        write_html([made_report()], tmp_path / "none" / "page.html", [], force=False)


def test_numbers_have_sensible_digits() -> None:
    assert [micros(us) for us in (0.25, 42.4, 640.2, 2400, 1.25e6)] == [
        "0.25 µs",
        "42.4 µs",
        "640 µs",
        "2.4 ms",
        "1.25 s",
    ]
    assert [percent(share) for share in (0, 0.00012, 0.0345, 1)] == ["0", "0.012", "3.5", "100.0"]
    (z_track,) = [row for row in figure_rows([made_report().findings]) if row.key == "z_track"]
    assert (z_track.values[0].text, z_track.unit) == ("45.80", "×10⁻⁴ s")
