"""Faults of a CAN bus: what makes one, what a link does meanwhile, and how it works again."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import COMMAND_ID, CanError, CanSettings, Heartbeat
from aeroloop.protocol.transport.can_link import CanLink
from tests.support.can_in_process import PAPER, Flaws, Stranger, virtual
from tests.support.zenoh_network import PATIENCE_S, eventually

MARK = b"\1\2\3\4\5\6\7"
UNSENT = 20
"""So many frames in a row that are not taken make a fault."""


@pytest.fixture
def flawed(flaws: Flaws) -> Iterator[tuple[CanLink, CanSettings]]:
    del flaws
    bus = virtual()
    link = CanLink(bus, PAPER, "plant")
    yield link, bus
    link.close()


def fill(flaws: Flaws, link: CanLink, frames: int) -> None:
    flaws.full = True
    for _ in range(frames):
        link.send(bytes(7))
    flaws.full = False


def test_a_bus_that_takes_no_frames_is_a_fault_after_so_many_in_a_row(
    flaws: Flaws, flawed: tuple[CanLink, CanSettings]
) -> None:
    link, _ = flawed
    for _ in range(3):
        fill(flaws, link, UNSENT - 1)
        assert link.fault is None
        link.send(bytes(7))  # one that is taken begins the count anew
    assert link.errors == 3 * (UNSENT - 1)
    fill(flaws, link, UNSENT - 1)
    assert link.fault is None
    flaws.full = True
    link.beat(Heartbeat(PlantState.IDLE, 0, MARK))
    assert link.fault == "the bus takes no frames: transmit queue is full"


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("full", "the bus takes no frames: transmit queue is full"),
        ("lost", "the bus is lost: adapter was unplugged"),
        (0x40, "the controller is bus-off"),
        (0x44, "the controller is bus-off"),
        (0x1C8, "the controller is bus-off"),
    ],
)
def test_after_a_fault_nothing_is_sent_or_raised_until_the_link_is_reopened(
    flaws: Flaws, flawed: tuple[CanLink, CanSettings], fault: str | int, words: str
) -> None:
    link, bus = flawed
    with Stranger(bus) as stranger:
        if isinstance(fault, int):
            stranger.say(fault, bytes(8), is_error_frame=True)
        elif fault == "full":
            fill(flaws, link, UNSENT)
        flaws.lost = fault == "lost"
        eventually("the fault", lambda: link.fault is not None)
        assert link.fault == words
        assert link.errors >= 1
        flaws.lost = False
        asked = flaws.sent
        link.send(bytes(7))
        link.beat(Heartbeat(PlantState.IDLE, 0, MARK))
        assert flaws.sent == asked
        assert link.take() is link.wait(0.01) is None
        stranger.everything()
        assert link.reopen()
        for _ in range(2):
            fill(flaws, link, UNSENT - 1)  # what was not taken before the fault does not count any more
            link.send(b"\x20" + bytes(6))
        assert link.fault is None
        assert bytes(stranger.receive().data) == b"\x20" + bytes(6)
        stranger.say(COMMAND_ID + 1, b"\x50\0\0")
        arrival = link.wait(PATIENCE_S)
        assert arrival is not None
        assert arrival.frame == b"\x50\0\0"
        stranger.settle(link)


@pytest.mark.parametrize("lost", [False, True])
def test_closing_twice_does_no_harm_and_nothing_is_sent_or_received_afterwards(
    flaws: Flaws, flawed: tuple[CanLink, CanSettings], lost: bool
) -> None:
    link, bus = flawed
    with Stranger(bus) as stranger:
        flaws.lost = lost
        if lost:
            eventually("the fault", lambda: link.fault is not None)
        link.close()
        link.close()
        assert flaws.closed == 1
        asked = flaws.sent
        link.send(bytes(7))
        link.beat(Heartbeat(PlantState.IDLE, 0, MARK))
        assert flaws.sent == asked
        stranger.say(COMMAND_ID + 1, bytes(3))
        assert link.wait(0.05) is None


@pytest.mark.parametrize(
    ("interface", "channel", "options"),
    [
        pytest.param("nonsense", "x", {}, id="interface"),
        pytest.param("slcan", "/dev/no-such-port", {}, id="port"),
        pytest.param("slcan", __file__, {"sleep_after_open": 0}, id="no-serial-port"),
        pytest.param("socketcan", "no-such-can0", {}, id="network-interface"),
        pytest.param("gs_usb", "no such adapter", {}, id="adapter-without-its-library"),
        pytest.param("virtual", "x", {"fd": True}, id="option"),
        pytest.param("udp_multicast", "239.74.163.2", {"port": "nonsense"}, id="option-of-a-wrong-type"),
    ],
)
def test_what_cannot_be_opened_is_reported_in_one_line(
    interface: str, channel: str, options: dict[str, object]
) -> None:
    with pytest.raises(CanError) as refusal:
        CanLink(CanSettings(interface=interface, channel=channel, options=options), PAPER, "plant")
    assert str(refusal.value).startswith(f"cannot open the CAN bus {interface}:{channel}: ")
    assert "\n" not in str(refusal.value)
