"""Page of a review in Chromium; without it these tests are skipped outside CI."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from html import escape
from itertools import count
from typing import Any, cast

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from aeroloop.service.report.page import page
from aeroloop.service.review.report import Band, Check, Line, Mark, Panel, Report
from tests.support.made_report import HELD, HOSTILE, MARKS, made_report

PATIENCE_MS = 120_000
"""Nothing here is about speed; a browser on a busy machine may take its time."""
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
        out.write_text(page(reports), encoding="utf-8")
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
def test_no_link_of_the_navigation_is_cut_off_and_nothing_scrolls_sideways_on_a_phone(two: Page, width: int) -> None:
    two.set_viewport_size({"width": width, "height": 900})
    edges = two.evaluate("""() => [...document.querySelectorAll("nav a")].map((link) => {
        const { left, right } = link.getBoundingClientRect();
        return [left, right];
    })""")
    assert len(edges) >= 8
    assert all(left >= 0 and right <= width for left, right in edges)
    nav = "(() => { const nav = document.querySelector('nav'); return nav.scrollWidth <= nav.clientWidth; })()"
    assert two.evaluate(nav)
    if width == 390:
        draw_all(two)
        assert two.evaluate("document.documentElement.scrollWidth") == width
        assert two.evaluate("document.querySelector('.group .plot').clientWidth") > 300
    two.set_viewport_size({"width": 1280, "height": 900})
