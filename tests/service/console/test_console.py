"""The console on a running loop: a browser's clicks act, and nothing else than its own page can do anything.

Real time: an event is waited for half a minute; on an idle machine each comes within a second.
"""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from aeroloop.protocol.messages.models import Truth
from aeroloop.service.config import load
from aeroloop.service.console.server import Console, ConsoleError
from aeroloop.service.testing.hil import Hil
from tests.support.browser import PATIENCE_MS, chromium
from tests.support.processes import AEROLOOP, PATIENT

pytestmark = [pytest.mark.processes, pytest.mark.realtime]

Complaints = list[str]


@contextmanager
def console(hil: Hil) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """`op console` as a process: the address that it prints."""
    words = ["op", "console", "--port", "0", "--set", f"network.rendezvous={hil.settings.network.rendezvous}"]
    with subprocess.Popen([*AEROLOOP, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("the console is at http://127.0.0.1:")
            yield line.split()[4].rstrip(","), process
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=30)


@contextmanager
def opened(address: str) -> Iterator[tuple[Page, Complaints]]:
    """The page in a browser that resolves no other host's name, and what failed or complained."""
    own = urlsplit(address).netloc
    with chromium("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1") as browser:
        page, complaints = browser.new_page(viewport={"width": 1280, "height": 900}), Complaints()
        page.set_default_timeout(PATIENCE_MS)
        page.on("request", lambda each: complaints.append(each.url) if urlsplit(each.url).netloc != own else None)
        page.on("requestfailed", lambda each: complaints.append(each.url))
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(address)
        page.wait_for_selector("body[data-drawn]")
        page.wait_for_function("() => runTimes[0].length > 20")
        yield page, complaints


def test_a_page_shows_the_loop_and_a_click_on_stop_brings_0_v_within_a_period(hil: Hil) -> None:
    hil.start(settings={**PATIENT, "plant.truth_rate_hz": 500})
    with console(hil) as (address, _), opened(address) as (page, complaints):
        newest = "document.querySelector('.plot[data-name=angles]').data[0].x.at(-1)"
        first = page.evaluate(f"[{newest}, scene.toDataURL()]")
        page.wait_for_function(f"() => {newest} > {first[0] + 1}")
        assert page.evaluate("scene.toDataURL()") != first[1]
        assert page.inner_text("#state") == "driven"
        page.wait_for_selector(".stage:not(.old) th:has-text('now')")
        page.fill("[name=yaw]", "20")
        page.wait_for_function("() => /shortest [0-9.]+ s/.test(document.querySelector('#preview').textContent)")
        page.click("form[data-verb=goto] button")
        page.wait_for_selector("#answers li.good:has-text('goto: aero follows roll, pitch, yaw')")
        page.fill("[name=yaw]", "90")
        page.fill("[name=within]", "0.05")
        page.click("form[data-verb=goto] button")
        page.wait_for_selector("#answers li.bad:has-text('would do')")
        page.fill("[name=text]", "seen in the browser")
        page.click("form[data-verb=mark] button")
        page.wait_for_selector("#events td:has-text('seen in the browser')")
        page.click(".bar .stop")
        page.wait_for_selector("#answers li.good:has-text('stop: aero is at 0 V')")
        page.wait_for_selector("#state:has-text('tripped')")
        page.wait_for_selector(".stage.old th:has-text('last known, ')")  # no attitude is measured now
        hil.kill("plant")
        page.wait_for_selector("#state:has-text('silent for ')")
        assert complaints == []
    assert any("stopped by an operator" in trip for trip in hil.log.trips)
    (tripped,) = (event for event in hil.log.events if event.kind == "tripped")
    assert tripped.tick is not None
    after = [truth for _, truth in hil.log.messages(Truth) if truth.session is None]
    assert not any(any(truth.voltages) for truth in after)
    last = max(truth.session_tick or 0 for _, truth in hil.log.messages(Truth) if truth.session is not None)
    assert last <= tripped.tick  # no tick of the session after that of the trip


def test_a_page_without_its_server_is_grey_its_buttons_are_off_and_it_names_the_command(hil: Hil) -> None:
    hil.start(settings=PATIENT)
    with console(hil) as (address, process), opened(address) as (page, _):
        process.send_signal(signal.SIGSTOP)
        page.click(".bar .stop")  # in the midst of it: nothing answers
        process.kill()
        page.wait_for_selector("body.gone")
        assert page.is_visible("#instead:has-text('aeroloop op stop --set vehicle=aero')")
        assert page.is_disabled(".bar .stop")
        age = "Number(document.querySelector('#vehicles tbody tr').children[3].textContent)"
        before = page.evaluate(age)
        page.wait_for_function(f"() => {age} > {before} + 1")
    assert hil.state("plant") == "driven"


NONSENSE: list[str | bytes] = [
    "no JSON", "[]", "3", "null", "\x00", b"\xff\xfe", '{"verb": 3}', '{"verb": "erase"}', '{"verb": "goto"}',
    "[" * 60_000,
    '{"verb": "arm", "vehicle": ' + "[" * 30_000, '{"verb": "mark", "text": "\\ud800"}', '{"verb": "\\ud800"}',
    '{"verb": "arm", "number": "\\ud800"}', '{"verb": "arm", "number": NaN}', '{"verb": "arm", "vehicle": "aero/**/$"}',
    '{"verb": "arm", "vehicle": "*"}', '{"verb": "goto", "attitude": [1' + "0" * 400 + ", 0, 0]}",
    '{"verb": "preview", "vehicle": "aero", "attitude": [1e308, 1e308, 1e308]}',
    '{"verb": "gains", "gains": {"C1": 1}}', '{"verb": "mark", "text": ""}',
    '{"verb": "goto", "vehicle": "aero", "attitude": [0, 1e300, 0]}', '{"verb": "inject", "fault": "\\u0000"}',
    '{"verb": "inject", "fault": "rate:off@1e999"}', '{"verb": "track", "what": ["hold"]}',
    '{"verb": "gains", "vehicle": "aero", "gains": {"\\u001b[2J": [1, 2, 3]}}',
]  # fmt: skip
"""What no page sends, though it has the token; four kinds of it closed the socket."""


def status_of(address: str, path: str, **headers: str) -> int:
    to = http.client.HTTPConnection(urlsplit(address).netloc, timeout=30)
    to.request("GET", path, headers=headers)
    return to.getresponse().status


def test_another_origin_another_host_and_a_wrong_token_get_nothing(hil: Hil) -> None:
    hil.start(settings=PATIENT)
    with console(hil) as (address, _):
        place, query = urlsplit(address).netloc, urlsplit(address).query
        assert status_of(address, f"/?{query}") == 200
        assert status_of(address, "/") == 401
        assert status_of(address, "/?token=%C3%A9") == 401
        assert status_of(address, f"/?{query[:-1]}") == 401
        assert status_of(address, f"/?{query}", Host="evil.example") == 403
        assert status_of(address, f"/?{query}", Origin="http://evil.example") == 403
        assert status_of(address, f"/other?{query}") == 404
        socket = f"ws://{place}/socket?{query}"
        mine = Origin(f"http://{place}")
        for origin, url, code in (
            (Origin("http://evil.example"), socket, 403),
            (None, socket, 403),
            (mine, socket[:-2], 401),
        ):
            with pytest.raises(InvalidStatus) as refused:
                connect(url, origin=origin)
            assert refused.value.response.status_code == code
        with connect(socket, origin=mine) as page:
            for text in NONSENSE:
                page.send(text)
                failed = str(answer(page)["failed"])
                assert failed.isprintable(), text  # one line
                assert len(failed) < 1000
    assert hil.state("plant") == "driven"


def count(socket: ClientConnection) -> int:
    """How many rows a page knows after its next block with any."""
    while not (block := json.loads(socket.recv(timeout=30))).get("count"):
        socket.send('{"verb": "shown"}')
    return int(block["count"])


def answer(socket: ClientConnection) -> dict[str, object]:
    """The next answer among the blocks."""
    while True:
        message: dict[str, object] = json.loads(socket.recv(timeout=30))
        if message["type"] == "answer":
            return message


def test_a_slow_page_gets_the_newest_block_and_delays_no_other(hil: Hil) -> None:
    hil.start(settings=PATIENT)
    with console(hil) as (address, _):
        place, query = urlsplit(address).netloc, urlsplit(address).query
        url, origin = f"ws://{place}/socket?{query}", Origin(f"http://{place}")
        with connect(url, origin=origin) as slow, connect(url, origin=origin) as quick:
            before = newest = count(slow)  # and it reads no more
            while newest < before + 60:
                newest = count(quick)
                quick.send('{"verb": "shown"}')
            slow.send('{"verb": "shown"}')
            block = json.loads(slow.recv(timeout=30))
            assert block["count"] >= newest  # at once, with all rows between
            assert len(block["rows"]) == block["count"] - before


@pytest.mark.parametrize(
    ("address", "tls", "line"),
    [
        ("192.0.2.1", None, "is beyond this host, where the console speaks TLS only"),
        ("a-host.example", None, "is beyond this host, where the console speaks TLS only"),
        ("0.0.0.0", (Path("no.pem"), Path("no.key")), "is every address"),  # noqa: S104  # it is refused
        ("192.0.2.1", (Path("no.pem"), Path("no.key")), "--tls no.pem no.key: No such file or directory"),
    ],
)
def test_beyond_this_host_there_is_tls_or_nothing(address: str, tls: tuple[Path, Path] | None, line: str) -> None:
    with pytest.raises(ConsoleError, match=line):
        Console(load().network, address, 0, tls, None)
