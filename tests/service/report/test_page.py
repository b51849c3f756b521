"""Page of a review, as text and in Chromium; without Chromium the browser tests are skipped outside CI."""

from __future__ import annotations

import os
import shutil
from base64 import b64decode
from collections.abc import Callable, Iterator
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from itertools import count
from json import loads
from math import inf
from pathlib import Path
from typing import Any, cast
from zlib import decompress

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from aeroloop.service.logs.files import ReviewError
from aeroloop.service.report.page.data import packed, page_data
from aeroloop.service.report.page.markup import tag
from aeroloop.service.report.page.page import page, write_page
from aeroloop.service.report.rows import figure_rows, micros, percent
from aeroloop.service.review.report import Band, Check, Line, Mark, Panel, Report
from tests.support.made_report import MARKS, made_report, made_theorem

HOSTILE = """</script><script>window.hit = 1</script><img src=x onerror="window.hit = 1">&amp;<!--"""
PATIENCE_MS = 120_000
"""Nothing here is about speed; a browser on a busy machine may take its time."""

HELD = Check(text="z_track ≤ 0.005 s", holds=True, found="0.00458 s")
BROKEN = Check(text="skipped_ticks ≤ 0", holds=False, found="50")


# without a browser


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


def test_the_page_states_what_was_asked_and_what_was_found() -> None:
    held = Texts(page([made_report(checks=[HELD])])).texts
    assert " Held" in held
    assert HELD.text in held
    broken = Texts(page([made_report(checks=[HELD, BROKEN])])).texts
    assert " Not held" in broken
    assert "does not hold: 50" in broken
    assert " Tripped" in Texts(page([made_report()])).texts
    assert " Tracked" in Texts(page([made_report(marks=())])).texts


def test_the_page_states_what_the_theorem_promises_and_which_inequality_was_broken() -> None:
    held = page([made_report(theorem=made_theorem())])
    texts = Texts(held).texts
    assert " Holds: once there, ‖z‖ stays within 0.2004." in texts
    assert " The run kept to all of it that could be judged." in texts
    assert {"0.0638", "0.1803", "0.2004", "31.0", "52.0", "(C.57)", "97.0"} <= set(texts)
    (judged,) = (text for text in texts if "belong to a tick" in text)
    assert "Judged until 8.5 s" in judged
    assert "Judged from" not in judged
    went = made_theorem().model_copy(update={"since_s": 2.1})
    assert any("Judged from 2.1 s" in text for text in Texts(page([made_report(theorem=went)])).texts)
    assert "At 120 the sensors of the rate err by more than the quantizer, against (C.29)." in judged
    assert judged.endswith("Lemma 1 is judged by the other 380.")
    broken = page([made_report(theorem=made_theorem(broken=7))])
    assert "Show 3.125 s: (C.57) ‖Φ − Φ^Q‖ first broken" in broken
    assert {"7", "125.0", " The run did not keep to it."} <= set(Texts(broken).texts)
    assert "first broken" not in held


def test_where_no_run_was_checked_against_the_theorem_the_page_leaves_it_out() -> None:
    assert 'id="theorem"' not in page([made_report()])
    several = page([made_report("a"), made_report("b", theorem=made_theorem())])
    assert " Holds: once there, ‖z‖ stays within 0.2004." in Texts(several).texts


def test_the_theorems_panels_stand_in_its_own_section_and_nowhere_else() -> None:
    text = page([made_report(theorem=made_theorem())])
    _, _, section = text.partition('<section id="theorem"')
    assert 'data-name="z_norm"' in section.partition("</section>")[0]
    assert text.count('data-name="z_norm"') == 1


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


def test_what_could_not_be_read_is_reported() -> None:
    damage = "a.mcap: cut at byte 1234"
    assert damage in Texts(page([made_report(damages=[damage])])).texts
    assert "What is missing from the log" not in Texts(page([made_report()])).texts


def test_the_page_states_whether_lines_are_thinned_out_and_which_part_is_drawn() -> None:
    thinned = page([made_report(thinned=64)])
    assert "up to 64 ticks, 0.128 s" in thinned
    assert "--from S --to S" in thinned
    assert 'id="drawn"' not in page([made_report(thinned=2)])
    part = replace(made_report(), part=(2.0, inf))
    assert "Drawn is the part from 2 s to 10 s" in page([part])


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
    data = page_data([report])
    assert not set("<>&") & set(data)
    assert loads(data)["runs"][0]["name"] == HOSTILE


def shortened(panel: Panel, n: int) -> Panel:
    return replace(panel, lines=[replace(line, values=line.values[:n]) for line in panel.lines])


def test_a_desired_line_that_runs_share_is_drawn_once() -> None:
    def desired(*reports: Report) -> list[dict[str, Any]]:
        (group,) = [group for group in loads(page_data(reports))["groups"] if group["id"] == "attitude"]
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
    with pytest.raises(ReviewError, match=r"cannot write .*: No such file or directory"):
        write_page([made_report()], tmp_path / "none" / "page.html")


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


# in a browser

Open = Callable[..., Page]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        assert "CI" not in os.environ, "CI has a Chromium"
        pytest.skip("no Chromium on PATH")
    arguments = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
                 "--disable-component-update", "--disable-sync"]  # fmt: skip
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=arguments, timeout=PATIENCE_MS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def open_page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Open]:
    """Opens the page of reports; in the end, none has asked for anything or complained of anything."""
    folder, numbers = tmp_path_factory.mktemp("pages"), count()
    contexts: list[BrowserContext] = []
    asked: list[str] = []
    complaints: list[str] = []

    def open_page(*reports: Report) -> Page:
        out = folder / f"{next(numbers)}.html"
        write_page(reports, out)
        context = browser.new_context(
            viewport={"width": 1280, "height": 900}, color_scheme="light", reduced_motion="reduce"
        )
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        opened = context.new_page()
        opened.on("request", lambda request: None if request.url == out.as_uri() else asked.append(request.url))
        opened.on("console", lambda message: complaints.append(message.text))
        opened.on("pageerror", lambda error: complaints.append(str(error)))
        opened.goto(out.as_uri())
        return opened

    yield open_page
    for context in contexts:
        context.close()
    assert asked == []
    assert complaints == []


@pytest.fixture(scope="module")
def one(open_page: Open) -> Page:
    """The page of one run; a test that moves its time or theme restores it."""
    return open_page(made_report(checks=[HELD]))


@pytest.fixture(scope="module")
def two(open_page: Open) -> Page:
    """The page of two runs, whose second has a log that means harm."""
    marks = [*MARKS, Mark(time_s=1.0, kind=HOSTILE, role=HOSTILE, text=HOSTILE)]
    settings = {"law": {"C2": [0.3, 0.3, 0.3]}, HOSTILE: {HOSTILE: HOSTILE}}
    checks = [Check(text=HOSTILE, holds=False, found=HOSTILE)]
    harmful = made_report(HOSTILE, phase=0.3, marks=marks, damages=[HOSTILE], settings=settings, checks=checks)
    return open_page(made_report("a"), replace(harmful, facts={HOSTILE: {HOSTILE: HOSTILE}}))


def draw_all(opened: Page) -> None:
    """Bring every drawing into sight, one after the other, until it is drawn."""
    for drawing in opened.locator(".drawing").all():
        drawing.scroll_into_view_if_needed()
        drawing.locator(".main-svg").first.wait_for(state="attached")


def ranges(opened: Page) -> dict[str, list[float]]:
    """What each time axis shows, of those that are drawn."""
    script = """() => Object.fromEntries([...document.querySelectorAll(".drawing.group")]
        .filter((figure) => figure.querySelector(".js-plotly-plot"))
        .map((figure) => [figure.dataset.name, figure.querySelector(".plot").layout.xaxis.range]))"""
    return cast(dict[str, list[float]], opened.evaluate(script))


def shows(opened: Page, name: str, within: tuple[float, float]) -> None:
    """Wait until a group of panels shows a time within this span, and no more."""
    opened.locator(f".group[data-name={name}]").scroll_into_view_if_needed()
    opened.wait_for_function(
        """([name, [from, to]]) => {
            const range = document.querySelector(`.group[data-name=${name}] .plot`).layout?.xaxis.range;
            return range && range[0] >= from && range[1] <= to;
        }""",
        arg=[name, list(within)],
    )


def test_every_panel_is_drawn_with_its_lines(one: Page) -> None:
    draw_all(one)
    lines = """() => [...document.querySelectorAll(".drawing")].map((figure) => [
        figure.classList[1], figure.dataset.name,
        [...figure.querySelectorAll(".scatterlayer .js-line")].filter((path) => path.getTotalLength() > 100).length,
    ])"""
    assert one.evaluate(lines) == [
        ["group", "attitude", 4],
        ["group", "attitude_error", 1],
        ["group", "input", 1],
        ["group", "damping_estimate", 1],
        ["spread", "latency", 1],
        ["spread", "period", 1],
        ["group", "latency", 1],
    ]


def test_events_and_gaps_stand_across_every_panel(one: Page) -> None:
    draw_all(one)
    shapes = """(name) => document.querySelector(`.group[data-name=${name}] .plot`).layout.shapes
        .map((shape) => [shape.path, shape.yref])"""
    for name in ("attitude", "latency"):
        assert one.evaluate(shapes, name) == [
            ["M7.2,0 L7.3,0 L7.3,1 L7.2,1 Z", "paper"],
            ["M3,0 L3,1", "paper"],
            ["M7.25,0 L7.25,1", "paper"],
        ]


def test_zooming_one_panel_moves_every_other_and_a_double_click_shows_all_again(one: Page) -> None:
    draw_all(one)
    whole = ranges(one)["attitude"]
    panel = one.locator(".group[data-name=attitude] .nsewdrag").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    one.mouse.move(box["x"] + 0.25 * box["width"], middle)
    one.mouse.down()
    one.mouse.move(box["x"] + 0.5 * box["width"], middle, steps=4)
    one.mouse.up()
    for name in ("attitude", "input", "latency"):
        shows(one, name, (2.3, 5.1))
    assert len({tuple(ranges(one)[name]) for name in ("attitude", "input", "latency")}) == 1
    panel.dblclick()
    shows(one, "latency", (whole[0], whole[1]))
    one.wait_for_function(
        "(end) => document.querySelector('.group[data-name=latency] .plot').layout.xaxis.range[1] === end", arg=whole[1]
    )


def test_a_click_on_an_event_or_a_gap_shows_what_was_around_it(one: Page) -> None:
    one.locator(".verdict").get_by_role("button", name="tripped").click()
    shows(one, "attitude_error", (6.7, 7.8))
    one.get_by_role("button", name="gap of 50 ticks").click()
    shows(one, "attitude_error", (6.6, 7.75))
    one.get_by_role("button", name="Whole run").click()


def test_keys_move_the_time_that_is_shown(one: Page) -> None:
    drawing = one.locator(".group[data-name=input]")
    drawing.scroll_into_view_if_needed()
    drawing.locator(".main-svg").first.wait_for(state="attached")
    drawing.locator(".plot").focus()
    for key in ("+", "+", "ArrowRight"):
        one.keyboard.press(key)
    shows(one, "input", (4.3, 7.0))
    one.keyboard.press("0")
    assert one.locator("#shown").inner_text() == "−0.1 – 10.1 s"


def test_the_search_opens_what_it_finds(one: Page) -> None:
    one.locator("#search").fill("rate_hz")
    assert one.locator("#configuration tr[data-key]:visible").all_inner_texts() == ["rate_hz\t500.0"]
    one.locator("#search").fill("")
    assert one.locator("#configuration tr[data-key]:visible").count() == 0


CONTRASTS = """() => {
    const probe = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    const rgb = (colour) => {
        probe.fillStyle = colour;
        probe.fillRect(0, 0, 1, 1);
        return [...probe.getImageData(0, 0, 1, 1).data].slice(0, 3);
    };
    const light = (colour) => rgb(colour)
        .map((c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
        .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
    const behind = (element) => {
        const colour = getComputedStyle(element).backgroundColor;
        return colour === "rgba(0, 0, 0, 0)" && element.parentElement ? behind(element.parentElement) : colour;
    };
    const texts = [...document.querySelectorAll("body *")].filter((element) =>
        element.offsetParent && [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim()));
    return texts.map((element) => {
        const [one, other] = [light(getComputedStyle(element).color), light(behind(element))].sort((a, b) => b - a);
        return [(one + 0.05) / (other + 0.05), element.outerHTML.slice(0, 80)];
    });
}"""


def background(opened: Page) -> str:
    return str(opened.evaluate("getComputedStyle(document.body).backgroundColor"))


def test_light_and_dark_differ_and_both_can_be_read(one: Page) -> None:
    light = background(one)
    for scheme in ("light", "dark"):
        one.emulate_media(color_scheme=cast(Any, scheme))
        contrasts = one.evaluate(CONTRASTS)
        assert len(contrasts) > 50
        assert [text for contrast, text in contrasts if contrast < 4.5] == []  # WCAG 2, AA
    dark = background(one)
    assert dark != light
    one.locator("#theme").click()
    assert background(one) == light
    one.locator("#theme").click()
    assert background(one) == dark
    one.emulate_media(color_scheme="light")


def test_drawings_have_the_colours_of_the_theme(one: Page) -> None:
    drawing = one.locator(".group[data-name=attitude]")
    drawing.scroll_into_view_if_needed()
    label = drawing.locator(".annotation-text").first
    label.wait_for()
    light = label.evaluate("(text) => getComputedStyle(text).fill")

    def wait(same: bool) -> None:
        one.wait_for_function(
            """([light, same]) => {
                const label = document.querySelector(".group .annotation-text");
                return label && (getComputedStyle(label).fill === light) === same;
            }""",
            arg=[light, same],
        )

    one.emulate_media(color_scheme="dark")
    wait(same=False)
    one.locator("#theme").click()
    wait(same=True)
    one.locator("#theme").click()
    wait(same=False)
    one.emulate_media(color_scheme="light")


def test_hostile_text_of_a_log_is_text(two: Page) -> None:
    draw_all(two)
    assert two.evaluate("window.hit") is None
    assert two.locator("img").count() == 0
    assert HOSTILE in two.locator("#events td.text").all_inner_texts()
    name = two.locator(".group[data-name=input] .plot").evaluate("(plot) => plot.data[1].name")
    assert name == escape(HOSTILE, quote=False)


def test_a_comparison_shows_what_differs_and_draws_every_run(two: Page) -> None:
    rows = two.locator("#differences tbody tr").all_inner_texts()
    assert "law.C2\t[0.15, 0.15, 0.15]\t[0.3, 0.3, 0.3]" in rows
    draw_all(two)
    colours = """(name) => [...document.querySelectorAll(`.group[data-name=${name}] .js-line`)]
        .map((path) => path.style.stroke)"""
    first, second = two.evaluate(colours, "input")
    assert first != second
    assert {first, second} < set(two.evaluate(colours, "attitude"))  # the same everywhere, and what is desired


def test_runs_can_be_told_apart_without_colour_and_one_can_be_hidden(two: Page) -> None:
    draw_all(two)
    strokes = """() => document.querySelector(".group[data-name=input] .plot").data
        .map(({ line, visible }) => [line.dash, line.width, visible])"""
    (dash, width, seen), (other_dash, other_width, other_seen) = two.evaluate(strokes)
    assert dash != other_dash
    assert width > other_width  # the first lies below, and shows beside the second
    assert seen is other_seen is True
    entry = two.locator(".group[data-name=input] .key button").first
    entry.click()
    two.wait_for_function("""() => !document.querySelector(".group[data-name=input] .plot").data[0].visible""")
    assert [visible for _, _, visible in two.evaluate(strokes)] == [False, True]
    entry.click()
    two.wait_for_function("""() => document.querySelector(".group[data-name=input] .plot").data[0].visible""")


def test_zooming_in_shows_every_tick_as_a_step_and_all_of_it_every_extreme_where_it_was(open_page: Open) -> None:
    """Thirty seconds of a quantizer that dithers between two levels, with one spike."""
    time = np.arange(15_000, dtype=np.float64) * 0.002
    values = np.where(np.arange(15_000) % 3 == 0, 0.5, 0.25)
    values[7_777] = 9.0
    panel = Panel("input", "Input", "u₁", "V", [Line("commanded", values)])
    opened = open_page(replace(made_report(), time=time, panels=[panel]))
    draw_all(opened)
    drawn = """() => {
        const [{ x, y, line }] = document.querySelector(".group[data-name=input] .plot").data;
        return { x: [...x], y: [...y], shape: line.shape };
    }"""
    whole = opened.evaluate(drawn)
    assert len(whole["x"]) < 8_000
    assert whole["x"][int(np.argmax(whole["y"]))] == pytest.approx(7_777 * 0.002, abs=1e-6)
    opened.evaluate("showTime(15.5, 15.6)")
    opened.wait_for_function("() => document.querySelector('.group[data-name=input] .plot').layout.xaxis.range[0] > 15")
    close = opened.evaluate(drawn)
    ticks = list(range(7_750, 7_801))
    assert close["shape"] == "hv"
    at = int(np.argmin(np.abs(np.array(close["x"]) - 15.5)))
    assert close["x"][at : at + 51] == pytest.approx(time[ticks], abs=1e-6)
    assert close["y"][at : at + 51] == pytest.approx(values[ticks], abs=1e-5)


def test_bands_are_shaded_with_their_label_on_every_drawing_over_time(open_page: Open) -> None:
    opened = open_page(replace(made_report(), bands=[Band(2.0, 4.0, "gyro off"), Band(9.0, None, "wind")]))
    draw_all(opened)
    found = opened.evaluate("""() => [...document.querySelectorAll(".drawing.group .plot")].map(({ layout }) => [
        layout.shapes.filter(({ path, yref }) => yref === "paper" && /^M(2,0 L4|9,0 L10),0/.test(path)).length,
        layout.annotations.map(({ text }) => text).filter((text) => ["gyro off", "wind"].includes(text)).length,
    ])""")
    assert found == [[2, 2]] * 5


@pytest.mark.parametrize("width", [390, 700, 1280, 1920])
def test_no_link_of_the_navigation_is_cut_off(one: Page, width: int) -> None:
    one.set_viewport_size({"width": width, "height": 900})
    edges = one.evaluate("""() => [...document.querySelectorAll("nav a")].map((link) => {
        const { left, right } = link.getBoundingClientRect();
        return [left, right];
    })""")
    assert len(edges) >= 8
    assert all(left >= 0 and right <= width for left, right in edges)
    assert one.evaluate(
        "(() => { const nav = document.querySelector('nav'); return nav.scrollWidth <= nav.clientWidth; })()"
    )
    one.set_viewport_size({"width": 1280, "height": 900})


def test_nothing_scrolls_sideways_on_a_phone(two: Page) -> None:
    two.set_viewport_size({"width": 390, "height": 844})
    draw_all(two)
    assert two.evaluate("document.documentElement.scrollWidth") == 390
    assert two.evaluate("document.querySelector('.group .plot').clientWidth") > 300
