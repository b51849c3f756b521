"""Live view of `op top`: what is published, as far as it is true now."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from io import StringIO

import pytest
from rich.console import Console

from aeroloop.protocol.messages.models import Event, Status, Telemetry, Truth
from aeroloop.protocol.messages.operator import Message
from aeroloop.service.host.health import SILENT_S
from aeroloop.service.terminal.monitor import Top

LEVEL = (1.0, 0.0, 0.0, 0.0)
TELEMETRY = Telemetry(
    session="s", tick=1, counter=1, attitude_error=(0.0, 0.0, 0.008726535), rate_error=(0.0, 0.0, 0.0),
    desired=LEVEL, state={"damping_estimate": (0.0, 0.0, 0.0), "sign": (1.0,)}, voltages=(12.5, -3.0),
)  # fmt: skip


class View:
    """A view with a clock of its own, which stands still."""

    def __init__(self, **messages: Message) -> None:
        self.now = 0.0
        self.top = Top(lambda: self.now)
        self.receive(**messages)

    def receive(self, **messages: Message) -> None:
        for key, message in messages.items():
            self.top.receive(f"aeroloop/aero/{key.replace('__', '/')}", message.encode())

    def text(self, width: int = 200) -> str:
        """What a terminal of this width would show."""
        page = StringIO()
        Console(width=width, file=page).print(self.top.draw(width))
        return page.getvalue()


def status(role: str, state: str, **more: object) -> Status:
    fields = {"uptime_s": 1.0, "ticks": 10, "rate_hz": 500.0, "skipped": 7, "session": "s", **more}
    return Status.model_validate({"role": role, "state": state, **fields})


def driven(**more: Message) -> View:
    """A loop that runs in session s."""
    roles = {"status__plant": status("plant", "driven"), "status__controller": status("controller", "running")}
    return View(**roles, telemetry=TELEMETRY, **more)


def test_every_role_of_every_vehicle_is_shown_with_its_state_and_a_missing_one_is_named() -> None:
    assert "no role" in View().text()
    view = driven()
    view.top.receive("aeroloop/other/status/plant", status("plant", "tripped").encode())
    shown = view.text()
    for words in ("aero", "other", "driven", "running", "tripped", "500", "7"):
        assert words in shown
    assert [line.split()[0] for line in shown.splitlines() if "missing" in line] == ["controller"]


def test_attitude_error_volts_and_events_are_shown() -> None:
    half = 2**-0.5
    truth = Truth(tick=1, attitude=(half, 0.0, 0.0, half), rate=(0.0, 0.0, 0.0), voltages=(0.0, 0.0))
    event = Event(role="recorder", kind="tripped", text="no fresh command for 100 ms: 0 V")
    shown = driven(truth=truth, event__plant=event).text()
    for words in ("yaw   +90.0°", "error  1.00°", "+12.5", "-3.0", "aero plant: no fresh"):
        assert words in shown


@pytest.mark.parametrize("plant", [("tripped", None), ("driven", "another")])
def test_error_and_voltages_of_a_session_that_is_over_are_not_shown(plant: tuple[str, str | None]) -> None:
    view = driven()
    assert "+12.5" in view.text()
    view.receive(status__plant=status("plant", plant[0], session=plant[1]))
    assert not any(words in view.text() for words in ("12.5", "1.00°"))


def test_what_is_no_longer_published_is_shown_as_silent_with_its_age() -> None:
    view = driven(truth=Truth(tick=1, attitude=LEVEL, rate=(0.0, 0.0, 0.0), voltages=(0.0, 0.0)))
    assert "yaw" in view.text()
    view.now = SILENT_S + 1
    shown = view.text()
    assert all(words in shown for words in ("silent", "no status for 4 s, then driven", "no attitude for 4 s"))
    assert not any(words in shown for words in ("yaw", "12.5"))
    view.receive(status__plant=status("plant", "driven"))
    assert "no telemetry for 4 s" in view.text()


@pytest.mark.parametrize(("days", "said"), [(13, True), (15, False)])
def test_a_role_whose_certificate_expires_soon_says_so(days: int, said: bool) -> None:
    until = datetime.now(UTC) + timedelta(days=days)
    shown = View(status__plant=status("plant", "driven", certificate_until=until)).text()
    assert (f"expires at {until:%Y-%m-%d}" in shown) == said
