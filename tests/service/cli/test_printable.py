"""Words of strangers: what the network or a log says reaches a terminal or a log line as one printable line."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status
from aeroloop.protocol.printable import printable
from aeroloop.service.cli import common
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.host import operator
from aeroloop.service.host.operator import Gathered
from aeroloop.service.terminal.show import markdown, show_all
from tests.support.made_log import VEHICLE, made, write

HOSTILE = "red\x1b[31m\x9b2J\r\nplant  driven\x7f\u2028\u202e end"
CLEAN = "red [31m 2J  plant  driven    end"


def acts_on_a_terminal(text: str) -> list[str]:
    return [line for line in text.split("\n") if not line.isprintable()]


def test_a_text_becomes_one_line_and_printable_text_stays_as_it_is() -> None:
    assert printable(HOSTILE) == CLEAN
    assert printable("‖z‖ ≤ 0.1 · θ̂₁, 3°") == "‖z‖ ≤ 0.1 · θ̂₁, 3°"


@pytest.mark.parametrize("as_markdown", [False, True])
def test_a_table_and_a_paragraph_have_the_lines_that_they_were_given(
    capsys: pytest.CaptureFixture[str], as_markdown: bool
) -> None:
    sheets = [("title\nin two lines", [{"what": HOSTILE, "n": "1"}]), (HOSTILE.replace("\n", " "), [])]
    if as_markdown:
        text = markdown(sheets)
    else:
        show_all(sheets)
        text = capsys.readouterr().out
    assert acts_on_a_terminal(text) == []
    assert len(text.strip().split("\n")) == (8 if as_markdown else 6)
    assert text.count("plant  driven") == 2


def test_review_prints_the_words_of_a_stranger_and_json_keeps_them_exactly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = load()
    messages = [*made(settings, 300)]
    event = Event(role="plant", kind="tripped", text=HOSTILE, session="s1", tick=100)
    key = topics.key("event", VEHICLE, role="plant")
    messages.append(messages[-1]._replace(key=key, payload=event.encode()))
    log = write(tmp_path / "a.mcap", settings, messages)
    assert execute(["log", "review", str(log)]) == 0
    printed = capsys.readouterr().out
    assert CLEAN in " ".join(printed.split("\n"))
    assert acts_on_a_terminal(printed) == []
    assert execute(["log", "review", str(log), "--json"]) == 0
    printed = capsys.readouterr().out
    assert HOSTILE in {mark["text"] for mark in json.loads(printed)["marks"]}
    assert acts_on_a_terminal(printed) == []


def test_a_status_its_troubles_an_answer_and_an_error_are_printable(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    status = Status(role="plant", state="tripped", cause=HOSTILE, uptime_s=1, ticks=0, rate_hz=0, skipped=0)
    gathered = Gathered({VEHICLE: {"plant": status}}, [HOSTILE])
    monkeypatch.setattr(operator, "gather", lambda _: gathered)
    for words in ("op status", "op status --check"):
        execute(words.split())
        captured = capfd.readouterr()
        assert CLEAN in captured.out
        assert acts_on_a_terminal(captured.out + captured.err) == []

    def stop(*_: object, on_answer: Callable[[str], None]) -> tuple[list[str], list[str]]:
        on_answer(HOSTILE)
        return [HOSTILE], [HOSTILE]

    monkeypatch.setattr(operator, "stop", stop)
    monkeypatch.setattr(operator, "send", lambda *_: HOSTILE)
    monkeypatch.setattr(operator, "only_vehicle", lambda _: VEHICLE)
    for words in ("op stop", "op arm"):
        execute(words.split())
        captured = capfd.readouterr()
        assert captured.out == f"{CLEAN}\n"
        assert captured.err in ("", f"aeroloop: {CLEAN}\n")
    common.report(HOSTILE)
    assert capfd.readouterr().err == f"aeroloop: {CLEAN}\n"


LOGS = """
import logging
from aeroloop.service.cli.entry import run_alone
run_alone(lambda _: logging.getLogger("aeroloop").warning("%s", {text!r}, extra={{"role": {text!r}}}))
"""


@pytest.mark.processes
def test_a_log_line_is_one_line() -> None:
    """A process of its own, as logging is set up once; nothing is timed."""
    code = LOGS.format(text=HOSTILE)
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stderr.split("\n")[:-1]
    assert line.endswith(f"WARNING {CLEAN}: {CLEAN}")
