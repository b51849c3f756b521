"""Log lines of JSON: stable keys for every event, a daemon's last error included."""

from __future__ import annotations

import json
import logging
import subprocess
import sys

import pytest

from aeroloop.protocol.messages.models import Event, EventKind
from aeroloop.protocol.runtime.node import log_event
from aeroloop.service.cli.processes import JsonLines

KEYS = ["time", "level", "logger", "event", "role", "vehicle", "session", "tick", "message"]


@pytest.mark.parametrize("kind", ["started", "tripped", "fault"])
def test_an_events_line_has_its_fields_as_keys(kind: EventKind, caplog: pytest.LogCaptureFixture) -> None:
    event = Event(role="plant", kind=kind, text="100 % of „x“\nin two lines", session="s1", tick=7)
    with caplog.at_level(logging.INFO):
        log_event(event, "aero")
    line = json.loads(JsonLines().format(caplog.records[0]))
    assert list(line) == KEYS
    expected = {"event": kind, "role": "plant", "vehicle": "aero", "session": "s1", "tick": 7, "message": event.text}
    assert {key: line[key] for key in expected} == expected
    assert line["level"] == ("warning" if kind != "started" else "info")


def test_another_librarys_line_has_the_same_keys() -> None:
    record = logging.LogRecord("zenoh", logging.ERROR, "a.py", 1, "no %s", ("link",), None)
    line = json.loads(JsonLines().format(record))
    assert (list(line), line["message"], line["event"]) == (KEYS, "no link", None)


@pytest.mark.parametrize("wrong", [("--set", "loop.rate_hz=x"), ("--config", "no/such.toml")])
def test_a_daemon_that_cannot_start_logs_one_line_of_json(wrong: tuple[str, str]) -> None:
    command = [sys.executable, "-P", "-m", "aeroloop", "--log-format", "json", "recorder", *wrong]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    (line,) = (json.loads(line) for line in done.stderr.splitlines())
    assert (done.returncode, line["level"], line["event"], line["role"]) == (2, "critical", "failed", "recorder")
    assert "rate_hz" in line["message"] or "no/such.toml" in line["message"]
