"""Page of a review in Chromium; without it these tests are skipped outside CI."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from html import escape
from itertools import count
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from aeroloop.service.report.page import page
from aeroloop.service.review.report import Check, Line, Mark, Panel
from tests.support.browser import PATIENCE_MS, chromium
from tests.support.made_report import HELD, HOSTILE, MARKS, made_report, with_faults

Open = Callable[[str], Page]


@pytest.fixture(scope="module")
def open_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Open]:
    """Opens a page; in the end, none has requested anything or complained of anything."""
    folder, numbers, complaints = tmp_path_factory.mktemp("pages"), count(), list[str]()
    with chromium() as browser:

        def open_page(html: str) -> Page:
            out = folder / f"{next(numbers)}.html"
            out.write_text(html, encoding="utf-8")
            opened = browser.new_page(
                viewport={"width": 1280, "height": 900}, color_scheme="light", reduced_motion="reduce"
            )
            opened.set_default_timeout(PATIENCE_MS)
            opened.on(
                "request", lambda request: complaints.append(request.url) if request.url != out.as_uri() else None
            )
            opened.on("console", lambda message: complaints.append(message.text))
            opened.on("pageerror", lambda error: complaints.append(str(error)))
            opened.goto(out.as_uri())
            opened.wait_for_selector("body[data-drawn]")
            return opened

        yield open_page
    assert complaints == []


@pytest.fixture(scope="module")
def one(open_page: Open) -> Page:
    """The page of one run; a test that moves its time or theme restores it."""
    return open_page(page([made_report(checks=[HELD])]))


@pytest.fixture(scope="module")
def two(open_page: Open) -> Page:
    """The page of two runs, whose second has a log that means harm."""
    marks = [*MARKS, Mark(time_s=1.0, kind=HOSTILE, role=HOSTILE, text=HOSTILE)]
    settings = {"law": {"C2": [0.3, 0.3, 0.3]}, HOSTILE: {HOSTILE: HOSTILE}}
    checks = [Check(text=HOSTILE, holds=False, found=HOSTILE)]
    harmful = made_report(HOSTILE, phase=0.3, marks=marks, damages=[HOSTILE], settings=settings, checks=checks)
    return open_page(page([made_report("a"), replace(harmful, facts={HOSTILE: {HOSTILE: HOSTILE}})]))


def plot(opened: Page, name: str, expression: str) -> Any:
    return opened.locator(f".plot[data-name={name}]").evaluate(f"(plot) => {expression}")


def wait_for(opened: Page, name: str, condition: str) -> None:
    plot = f"const plot = document.querySelector('.plot[data-name={name}]');"
    opened.wait_for_function(f"() => {{ {plot} return {condition}; }}")


def shows(opened: Page, name: str, within: tuple[float, float]) -> None:
    """Wait until a group of panels shows a time within this span, and no more."""
    wait_for(opened, name, f"plot.layout.xaxis.range[0] >= {within[0]} && plot.layout.xaxis.range[1] <= {within[1]}")


def test_every_panel_is_drawn_when_the_page_opens_so_that_a_saved_page_has_its_drawings(
    one: Page, open_page: Open
) -> None:
    lines = """() => [...document.querySelectorAll(".plot")].map((plot) => [
        plot.dataset.name,
        [...plot.querySelectorAll(".scatterlayer .js-line")].filter((path) => path.getTotalLength() > 100).length,
    ])"""
    drawn = [["attitude", 8], ["error", 1], ["input", 1], ["damping_estimate", 1], ["latency", 1]]
    assert one.evaluate(lines) == drawn
    opened = open_page(f"<!doctype html>{one.evaluate('document.documentElement.outerHTML')}")
    assert opened.evaluate(lines) == drawn
    opened.get_by_role("button", name="gap of 50 ticks").click()
    shows(opened, "error", (6.6, 7.75))


def test_events_gaps_and_bands_stand_across_every_drawing_over_time(open_page: Open) -> None:
    opened = open_page(page([with_faults(made_report(), ("gyro off", 2.0, 4.0), ("wind", 9.0, None))]))
    for name in ("attitude", "latency"):
        assert plot(opened, name, "plot.layout.shapes.map(({ path, yref }) => [path, yref])") == [
            ["M2,0 L4,0 L4,1 L2,1 Z M9,0 L10,0 L10,1 L9,1 Z", "paper"],
            ["M7.2,0 L7.3,0 L7.3,1 L7.2,1 Z", "paper"],
            ["M3,0 L3,1", "paper"],
            ["M7.25,0 L7.25,1", "paper"],
        ]
        assert {"gyro off", "wind"} <= set(plot(opened, name, "plot.layout.annotations.map(({ text }) => text)"))


def test_a_zoom_an_event_a_gap_and_keys_move_the_time_that_every_panel_shows(one: Page) -> None:
    panel = one.locator(".plot[data-name=attitude] .nsewdrag").first
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
    one.locator(".verdict").get_by_role("button", name="tripped").click()
    shows(one, "error", (6.7, 7.8))
    one.get_by_role("button", name="gap of 50 ticks").click()
    shows(one, "error", (6.6, 7.75))
    one.get_by_role("button", name="Show less time").click()
    one.get_by_role("button", name="Later").click()
    shows(one, "input", (6.8, 7.8))
    panel.dblclick()
    wait_for(one, "latency", "plot.layout.xaxis.range[0] < 0 && plot.layout.xaxis.range[1] > 10")


def test_the_cursor_is_one_instant_of_plots_readings_events_and_the_address(open_page: Open) -> None:
    opened = open_page(page([made_report()]))
    first = "document.querySelector('#readings tr').innerText"
    opened.get_by_role("button", name="A tick on").click()
    assert opened.evaluate(first).split() == ["0.002", "s", "tick", "1"]
    opened.evaluate("goTo(3.25)")
    assert opened.evaluate("location.hash") == "#t=3.250"
    shown = opened.evaluate("shown")
    line = opened.locator(".plot[data-name=input] .cursor")
    assert line.is_visible()
    left = float(line.evaluate("(line) => parseFloat(line.style.left)"))
    width = opened.locator(".plot[data-name=input]").evaluate("(plot) => plot.clientWidth")
    assert left == pytest.approx(78 + (3.25 - shown[0]) / (shown[1] - shown[0]) * (width - 88), abs=1)
    past = opened.locator("#events tr.past").count()
    assert 0 < past < opened.locator("#events [data-time]").count()
    assert opened.locator("#events tr.now").count() == 1
    before = opened.evaluate("scene.toDataURL()")
    opened.evaluate("document.activeElement.blur()")  # of a button, which takes keys itself
    opened.keyboard.press("Space")
    opened.wait_for_function("() => cursor > 3.5")
    opened.keyboard.press("Space")
    assert opened.evaluate("playing") == 0
    assert opened.evaluate("scene.toDataURL()") != before
    opened.evaluate("location.hash = '#t=7.5'")
    opened.wait_for_function("() => Math.abs(cursor - 7.5) < 1e-9")


def test_hostile_text_of_a_log_is_text(two: Page) -> None:
    assert two.evaluate("window.hit") is None
    assert two.locator("img").count() == 0
    assert HOSTILE in two.locator("#events td.text").all_inner_texts()
    assert plot(two, "input", "plot.data[1].name") == escape(HOSTILE, quote=False)


def test_a_comparison_shows_what_differs_and_draws_every_run(two: Page) -> None:
    rows = two.locator("#differences tbody tr").all_inner_texts()
    assert "law.C2\t[0.15, 0.15, 0.15]\t[0.3, 0.3, 0.3]" in rows
    first, second = (plot(two, "input", f"plot.data[{i}].line") for i in range(2))
    assert first["color"] != second["color"]
    assert first["dash"] != second["dash"]
    names = plot(two, "attitude", "[...new Set(plot.data.map(({ name }) => name))]")
    assert names == ["desired", "a", escape(HOSTILE, quote=False)]


def test_zooming_in_shows_every_tick_as_a_step_and_all_of_it_every_extreme_where_it_was(open_page: Open) -> None:
    """Thirty seconds of a quantizer that dithers between two levels, with one spike."""
    time = np.arange(15_000, dtype=np.float64) * 0.002
    values = np.where(np.arange(15_000) % 3 == 0, 0.5, 0.25)
    values[7_777] = 9.0
    panel = Panel("input", "Input", "u₁", "V", [Line("commanded", values)])
    opened = open_page(page([replace(made_report(), time=time, panels=[panel])]))
    drawn = "((line) => ({ x: [...line.x], y: [...line.y], shape: line.line.shape }))(plot.data[0])"
    whole = plot(opened, "input", drawn)
    assert len(whole["x"]) < 8_000
    assert whole["x"][int(np.argmax(whole["y"]))] == pytest.approx(7_777 * 0.002, abs=1e-6)
    opened.evaluate("showTime(15.5, 15.6)")
    wait_for(opened, "input", "plot.layout.xaxis.range[0] > 15")
    close = plot(opened, "input", drawn)
    ticks = list(range(7_750, 7_801))
    assert close["shape"] == "hv"
    at = int(np.argmin(np.abs(np.array(close["x"]) - 15.5)))
    assert close["x"][at : at + 51] == pytest.approx(time[ticks], abs=1e-6)
    assert close["y"][at : at + 51] == pytest.approx(values[ticks], abs=1e-5)
