"""Live view of `op top`: shows the published states of roles, and drops messages it cannot parse."""

from __future__ import annotations

from io import StringIO

from rich.console import Console

from aeroloop.protocol.messages.models import (
    PROTOCOL_VERSION,
    Description,
    Event,
    Percentiles,
    Status,
    Telemetry,
    Truth,
)
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


TELEMETRY = Telemetry(
    session="s", tick=1, counter=1, attitude_error=(0.0, 0.0, 0.008726535), rate_error=(0.0, 0.0, 0.0),
    desired=(1.0, 0.0, 0.0, 0.0), state={"damping_estimate": (0.0, 0.0, 0.0), "sign": (1.0,)}, voltages=(12.5, -3.0),
)  # fmt: skip


def test_an_empty_network_is_shown_as_such() -> None:
    assert "no role" in text(Top())


def test_every_role_of_every_vehicle_is_shown_with_its_state() -> None:
    top = top_of(status__plant=status("plant", "driven"), status__controller=status("controller", "running"))
    top.receive("aeroloop/other/status/plant", status("plant", "tripped").encode())
    shown = text(top)
    for word in ("aero", "other", "driven", "running", "tripped", "500", "7"):
        assert word in shown


def test_attitude_error_volts_and_bits_are_shown() -> None:
    half = 2**-0.5
    shown = text(
        top_of(
            status__controller=status("controller", "running").model_copy(update={"session": "s"}),
            description__plant=Description(
                protocol=PROTOCOL_VERSION,
                role="plant",
                vehicle="aero",
                host="h",
                versions={},
                config=load().description(),
            ),
            telemetry=TELEMETRY,
            truth=Truth(tick=1, attitude=(half, 0.0, 0.0, half), rate=(0.0, 0.0, 0.0), voltages=(0.0, 0.0)),
            event__plant=Event(role="recorder", kind="tripped", text="no fresh command for 100 ms: 0 V"),
        )
    )
    for words in (
        "yaw   +90.0°",
        "error  1.00°",
        "+12.5",
        "-3.0",
        "28.0 + 12.0 kbit/s",
        "aero plant: no fresh command",
    ):
        assert words in shown


def test_where_only_changes_are_sent_the_bits_are_those_of_the_frames_that_were() -> None:
    config = load(overrides=["wire.transmit.command=on_change"]).description()
    top = top_of(
        description__plant=Description(
            protocol=PROTOCOL_VERSION, role="plant", vehicle="aero", host="h", versions={}, config=config
        )
    )
    for uptime_s, sent in ((1.0, 40), (3.0, 440), (3.1, 441)):  # the last says nothing of a rate
        report = status("controller", "running").model_copy(
            update={"uptime_s": uptime_s, "sent": sent, "received": 10, "session": "s"}
        )
        top.receive("aeroloop/aero/status/controller", report.encode())
    assert "28.0 + 4.8 kbit/s" in text(top)  # 500 measurements of 7 bytes, 200 commands of 3
    again = status("controller", "running").model_copy(update={"uptime_s": 0.5, "sent": 3, "session": "s"})
    after = again.model_copy(update={"uptime_s": 1.5, "sent": 103})
    for report in (again, after):  # started anew, and so are its counts
        top.receive("aeroloop/aero/status/controller", report.encode())
    assert "28.0 + 2.4 kbit/s" in text(top)


def aged(top: Top, **ages_s: float) -> Top:
    """The same view as if some of its messages had been received so long ago."""
    vehicle = top._vehicles["aero"]
    for name, age_s in ages_s.items():
        if name in vehicle.statuses:
            at, last = vehicle.statuses[name]
            vehicle.statuses[name] = at - age_s, last
        else:
            at, message = getattr(vehicle, name)
            setattr(vehicle, name, (at - age_s, message))
    return top


def driven(**more: Message) -> Top:
    """A loop that runs in session s."""
    names = {"plant": "driven", "controller": "running"}
    roles = {f"status__{role}": status(role, state) for role, state in names.items()}
    return top_of(
        **{name: one.model_copy(update={"session": "s"}) for name, one in roles.items()}, telemetry=TELEMETRY, **more
    )


def test_a_role_that_fell_silent_is_shown_so_with_its_age() -> None:
    shown = text(aged(driven(), plant=SILENT_S + 1))
    assert "silent" in shown
    assert "no status for 4 s, then driven" in shown


def test_error_and_voltages_of_a_session_that_is_over_are_not_shown() -> None:
    assert "+12.5" in text(driven())
    for plant in (status("plant", "tripped"), status("plant", "driven").model_copy(update={"session": "another"})):
        top = driven()
        top.receive("aeroloop/aero/status/plant", plant.encode())
        assert "12.5" not in text(top)
        assert "1.00°" not in text(top)
    for late in ("plant", "telemetry"):
        assert "12.5" not in text(aged(driven(), **{late: SILENT_S + 1}))


def test_an_attitude_that_is_no_longer_published_is_not_shown() -> None:
    truth = Truth(tick=1, attitude=(1.0, 0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0), voltages=(0.0, 0.0))
    assert "yaw" in text(driven(truth=truth))
    shown = text(aged(driven(truth=truth), truth=SILENT_S + 1))
    assert "yaw" not in shown
    assert "no attitude for 4 s" in shown


def test_a_vehicle_without_a_plant_is_marked() -> None:
    assert "no plant" in text(top_of(status__controller=status("controller", "searching")))


def test_sixty_columns_hold_every_figure_and_the_whole_cause() -> None:
    top = driven()
    spread = Percentiles(count=1, p50=12345, p99=67890, p999=1, max=1)
    cause = "no command for 100 ms, the last one at tick 123456, from controller-1234-abcd: 0 V"
    large = {"latency_us": spread, "cause": cause, "uptime_s": 86400 * 99, "skipped": 1234567}
    top.receive("aeroloop/aero/status/plant", status("plant", "tripped").model_copy(update=large).encode())
    shown = text(top, 60)
    assert max(len(line) for line in shown.splitlines()) <= 60
    for word in ("12345/67890", "1234567", "99 d", "tripped"):
        assert word in shown
    assert cause in " ".join(shown.split())


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
