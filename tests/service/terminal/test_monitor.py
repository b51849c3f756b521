"""Live view of `op top`: shows the published states of roles, and drops messages it cannot parse."""

from __future__ import annotations

from io import StringIO

from rich.console import Console

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Event, Status, Telemetry, Truth
from aeroloop.protocol.messages.operator import Message
from aeroloop.service.config import load
from aeroloop.service.host.health import SILENT_S
from aeroloop.service.terminal.monitor import Top


def text(top: Top, width: int = 200) -> str:
    """What a terminal of this width would show."""
    page = StringIO()
    console = Console(width=width, file=page)
    console.print(top.draw(width))
    return page.getvalue()


def status(role: str, state: str) -> Status:
    return Status(role=role, state=state, uptime_s=1.0, ticks=10, rate_hz=500.0, skipped=7)


def top_of(**messages: Message) -> Top:
    top = Top()
    for key, message in messages.items():
        top.receive(f"aeroloop/aero/{key.replace('__', '/')}", message.encode())
    return top


def test_an_empty_network_is_shown_as_such() -> None:
    assert "no role" in text(Top())


def test_every_role_of_every_vehicle_is_shown_with_its_state() -> None:
    top = top_of(status__plant=status("plant", "driven"), status__controller=status("controller", "running"))
    top.receive("aeroloop/other/status/plant", status("plant", "tripped").encode())
    shown = text(top)
    for word in ("aero", "other", "driven", "running", "tripped", "500/s", "7"):
        assert word in shown


def test_attitude_error_volts_and_bits_are_shown() -> None:
    telemetry = Telemetry(
        session="s", tick=1, counter=1, attitude_error=(0.0, 0.0, 0.008726535), rate_error=(0.0, 0.0, 0.0),
        desired=(1.0, 0.0, 0.0, 0.0), damping_estimate=(0.0, 0.0, 0.0), voltages=(12.5, -3.0), sign=1,
    )  # fmt: skip
    half = 2**-0.5
    shown = text(
        top_of(
            status__controller=status("controller", "running"),
            description__plant=Description(
                protocol=PROTOCOL_VERSION,
                role="plant",
                vehicle="aero",
                host="h",
                versions={},
                config=load().description(),
            ),
            telemetry=telemetry,
            truth=Truth(tick=1, attitude=(half, 0.0, 0.0, half), rate=(0.0, 0.0, 0.0), voltages=(0.0, 0.0)),
            event=Event(role="plant", kind="tripped", text="no fresh command for 100 ms: 0 V"),
        )
    )
    for words in ("yaw   +90.0°", "error  1.00°", "+12.5", "-3.0", "28.0 + 12.0 kbit/s", "no fresh command for 100 ms"):
        assert words in shown


def test_where_only_changes_are_sent_the_bits_are_those_of_the_frames_that_were() -> None:
    config = load(overrides=["wire.transmit.command=on_change"]).description()
    top = top_of(
        description__plant=Description(
            protocol=PROTOCOL_VERSION, role="plant", vehicle="aero", host="h", versions={}, config=config
        )
    )
    for uptime_s, sent in ((1.0, 40), (3.0, 440), (3.1, 441)):  # the last says nothing of a rate
        report = status("controller", "running").model_copy(update={"uptime_s": uptime_s, "sent": sent, "received": 10})
        top.receive("aeroloop/aero/status/controller", report.encode())
    assert "28.0 + 4.8 kbit/s" in text(top)  # 500 measurements of 7 bytes, 200 commands of 3
    again = status("controller", "running").model_copy(update={"uptime_s": 0.5, "sent": 3})
    after = again.model_copy(update={"uptime_s": 1.5, "sent": 103})
    for report in (again, after):  # started anew, and so are its counts
        top.receive("aeroloop/aero/status/controller", report.encode())
    assert "28.0 + 2.4 kbit/s" in text(top)


def test_a_role_that_fell_silent_is_shown_so() -> None:
    top = top_of(status__plant=status("plant", "driven"))
    vehicle = top._vehicles["aero"]
    at, last = vehicle.statuses["plant"]
    vehicle.statuses["plant"] = at - SILENT_S - 1, last
    assert "silent" in text(top)


def test_what_is_not_understood_is_left_out() -> None:
    top = top_of(status__plant=status("plant", "driven"))
    for key in (
        "aeroloop/aero/status/plant",
        "aeroloop/aero/telemetry",
        "aeroloop/aero/description/plant",
        "elsewhere",
    ):
        top.receive(key, b'{"not": "a message"}')
    assert "driven" in text(top)
