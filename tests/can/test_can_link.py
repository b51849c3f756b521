"""CAN link in one process: frames byte for byte, heartbeats, refusals, faults of the bus, and the closed loop."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from math import isinf
from threading import Event, Thread
from typing import Any

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import (
    COMMAND_ID,
    HEARTBEAT_S,
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    CanError,
    CanSettings,
    Heartbeat,
    fingerprint,
)
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import load
from aeroloop.service.control.controller import Controller
from tests.support.can_in_process import PAPER, Flaws, Stranger, both_ends, virtual
from tests.support.plant_end import claim_of
from tests.support.wires import wire_of
from tests.support.zenoh_network import PATIENCE_S, eventually

MARK = b"\1\2\3\4\5\6\7"
LENGTHS = [
    pytest.param(PAPER, False, (7, 7), (3, 3), id="8-6"),
    pytest.param(wire_of(16, 16, None, 2, 10), True, (14, 16), (18, 20), id="16-cont-counter-10"),
]


@pytest.mark.parametrize(("wire", "fd", "measurement", "command"), LENGTHS)
def test_a_frame_crosses_byte_for_byte_padded_with_zeros_and_no_other_length_or_pad_does(
    wire: WireSpec, fd: bool, measurement: tuple[int, int], command: tuple[int, int]
) -> None:
    with both_ends(virtual(fd=fd), wire) as (plant, controller, stranger):
        for sender, receiver, layout, (size, length) in (
            (plant, controller, wire.measurement, measurement),
            (controller, plant, wire.command, command),
        ):
            codes = [(-1) ** i * (i + 1) for i in range(len(layout.widths))]
            for payload in (bytes(size), layout.pack(1, codes), layout.pack(layout.counters - 1, codes[::-1])):
                sender.send(payload)
                seen = stranger.receive()
                assert bytes(seen.data) == payload + bytes(length - size)
                assert (seen.is_fd, seen.bitrate_switch, seen.is_extended_id) == (length > 8, length > 8, False)
                assert received(receiver) == payload
        assert plant.refused == controller.refused == 0
        # Of a wrong length, or with a pad that is not zero.
        size, length = measurement
        wrong = [bytes(n) for n in (*range(9), 12, 16, 20, 32, 48, 64) if n < size or (n > size and length <= 8 >= n)]
        wrong += [bytes(place) + b"\x80" + bytes(length - place - 1) for place in range(size, length)]
        for data in wrong:
            stranger.say(MEASUREMENT_ID + 1, data)
        stranger.settle(controller)
        assert controller.take() is None
        assert controller.refused == len(wrong) > 0


def test_a_frame_that_cannot_be_read_is_refused_and_displaces_none() -> None:
    with both_ends(virtual(), PAPER) as (plant, _, stranger):
        good = PAPER.command.pack(7, (5, -5))
        for data in (good, good[:-1] + bytes([good[-1] | 1])):  # a padding bit of the second is set
            stranger.say(COMMAND_ID + 1, data)
        eventually("the refusal", lambda: plant.refused == 1)
        assert received(plant) == good


def test_frames_and_heartbeats_are_sent_and_received_by_the_ids_of_the_specification() -> None:
    node = 42
    with both_ends(virtual(node=node)) as (plant, controller, stranger):
        plant.send(bytes(7))
        plant.beat(Heartbeat(PlantState.IDLE, 0, MARK))
        controller.send(bytes(3))
        controller.beat(Heartbeat(PlantState.IDLE, 0, MARK))
        ids = [stranger.receive().arbitration_id - node for _ in range(4)]
        assert ids == [0x100, 0x300, 0x200, 0x380]
        for link in (plant, controller):
            assert link.wait(PATIENCE_S) is not None
            eventually("a heartbeat", lambda link=link: link.peer is not None)  # type: ignore[misc]  # bound now
            assert link.peer is not None
            assert link.peer[:3] == (PlantState.IDLE, 0, MARK)


FRAME, BEAT = MEASUREMENT_ID + 1, PLANT_HEARTBEAT_ID + 1
TICKS = 250


def received(link: CanLink) -> bytes | None:
    arrival = link.wait(PATIENCE_S)
    return None if arrival is None else arrival.frame


@pytest.mark.parametrize(
    ("identifiers", "how"),
    [
        pytest.param([FRAME, BEAT], {"is_extended_id": True}, id="extended ids"),
        pytest.param([FRAME, BEAT], {"is_remote_frame": True, "data": b""}, id="remote frames"),
        pytest.param([0x000, 0x001, 0x081, 0x0FF, 0x180, 0x401, 0x701, 0x7FF], {}, id="foreign ids"),
        pytest.param([0x102, 0x202, 0x302, 0x382, 0x100, 0x300], {}, id="other nodes"),
        pytest.param([0x201, 0x381], {}, id="its own"),  # some interfaces give a sender its own frames back
    ],
)
def test_what_is_not_for_this_end_is_ignored(identifiers: list[int], how: dict[str, Any]) -> None:
    with both_ends(virtual()) as (_, controller, stranger):
        for identifier in identifiers:
            for size in (7, 8):
                stranger.say(identifier, **{"data": bytes(size), "dlc": size, **how})
        stranger.say(FRAME, b"")
        eventually("what came after them", lambda: controller.refused == 1)
        assert controller.peer is None
        assert controller.take() is None
        assert controller.fault is None
        assert isinf(controller.silent_s())
        assert controller.errors == 0


UNSENT = 20
"""So many frames in a row that are not taken make a fault."""


@pytest.fixture
def flawed(flaws: Flaws) -> Iterator[tuple[CanLink, CanSettings]]:
    del flaws
    bus = virtual()
    with closing(CanLink(bus, PAPER, "plant")) as link:
        yield link, bus


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


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("full", "the bus takes no frames: transmit queue is full"),
        ("lost", "the bus is lost: adapter was unplugged"),
        (0x40, "the controller is bus-off"),
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
        assert received(link) == b"\x50\0\0"
        stranger.settle(link)


def test_what_cannot_be_opened_is_reported_in_one_line() -> None:
    with pytest.raises(CanError) as refusal:
        CanLink(CanSettings(interface="socketcan", channel="no-such-can0"), PAPER, "plant")
    assert str(refusal.value).startswith("cannot open the CAN bus socketcan:no-such-can0: ")
    assert "\n" not in str(refusal.value)


# ── the closed loop over a bus, and on change: an empty frame for a silent tick, in lockstep only ──


BOTH = WireSpec.model_validate({"transmit": "on_change"})
WIRES = {"classic": WireSpec(), "FD": WireSpec().with_bits("12/16"), "on change": BOTH}


@pytest.mark.parametrize("wire", WIRES)
def test_in_lockstep_every_frame_over_a_bus_is_that_of_the_loop_without_one(wire: str) -> None:
    settings = load(overrides=["loop.lockstep=true"]).model_copy(update={"wire": WIRES[wire]})
    loop, bus = settings.loop, virtual(fd=wire == "FD")

    def node() -> Endpoint:
        return settings.plant.endpoint(settings.plant.make(loop.period), loop, settings.wire)

    def controller() -> Controller:
        return Controller(settings.wire, settings.law, settings.reference, loop.period)

    over, measurements = Event(), list[bytes]()
    here, law, command = node(), controller(), None
    here.claim(claim_of(wire=settings.wire, period_ns=loop.period_ns, lockstep=True))
    for k in range(TICKS):
        measurements.append(here.tick(command, k) or b"")
        command = law.tick(measurements[-1], k)

    far, law = node(), controller()
    front, link = CanNetwork(bus, loop, far), CanLink(bus, settings.wire, "controller", lockstep=True)
    granted = Heartbeat(PlantState.GRANTED, 1, fingerprint(settings.wire, loop.period_ns, lockstep=True))

    def beat() -> None:
        while not over.wait(HEARTBEAT_S):
            link.beat(granted)

    threads = [Thread(target=Driver(far, front, loop, over).run), Thread(target=beat)]
    for thread in threads:
        thread.start()
    try:
        for k, measurement in enumerate(measurements):
            assert received(link) == measurement, f"tick {k}: the node is {far.cause or far.state}"
            command = law.tick(measurement, k)
            assert command is not None
            link.send(command)
    finally:
        over.set()
        for thread in threads:
            thread.join()
        link.close()


@pytest.mark.parametrize(("wire", "lockstep"), [(BOTH, True), (BOTH, False), (WireSpec(), True)], ids=str)
def test_an_empty_frame_is_refused_and_displaces_nothing_where_it_is_not_what_silence_sends(
    wire: WireSpec, lockstep: bool
) -> None:
    bus, frame = virtual(), bytes(wire.command.size)
    with closing(CanLink(bus, wire, "plant", lockstep=lockstep)) as link, Stranger(bus) as stranger:
        stranger.say(COMMAND_ID + 1, frame)
        stranger.say(COMMAND_ID + 1, UNCHANGED)
        stranger.settle(link)
        assert (received(link), link.refused) == ((UNCHANGED, 0) if lockstep and wire == BOTH else (frame, 1))
