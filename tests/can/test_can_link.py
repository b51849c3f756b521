"""CAN link in one process: frames byte for byte, heartbeats, and what is refused or ignored."""

from __future__ import annotations

from math import isinf
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import MEASUREMENT_ID, PLANT_HEARTBEAT_ID, CanError, Heartbeat
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.can_in_process import PAPER, Stranger, both_ends, virtual
from tests.support.wires import wire_of
from tests.support.zenoh_network import PATIENCE_S, eventually

MARK = b"\1\2\3\4\5\6\7"
LENGTHS = [
    pytest.param(PAPER, False, (7, 7), (3, 3), id="8-6"),
    pytest.param(wire_of(10, 10, 16, 2, 4), False, (8, 8), (5, 5), id="10-16-counter-4"),
    pytest.param(wire_of(2, 2, 2, 3), False, (3, 3), (2, 2), id="2-2-three-motors"),
    pytest.param(wire_of(8, 8, 6, 3), True, (7, 7), (4, 4), id="8-6-three-motors-FD"),
    pytest.param(wire_of(10, 10, 6), True, (9, 12), (3, 3), id="10-6"),
    pytest.param(wire_of(14, 16, 16), True, (13, 16), (5, 5), id="14+16-16"),
    pytest.param(wire_of(16, 16, None, 2, 10), True, (14, 16), (18, 20), id="16-cont-counter-10"),
    pytest.param(wire_of(None, 8, None, 3), True, (28, 32), (25, 32), id="cont+8-cont-three-motors"),
    pytest.param(wire_of(None, None, 6), True, (49, 64), (3, 3), id="cont-6"),
]


def crosses(sender: CanLink, receiver: CanLink, stranger: Stranger, size: int, length: int) -> None:
    """Any bytes of this size cross, in a frame of this length."""

    @settings(max_examples=30)
    @given(payload=st.binary(min_size=size, max_size=size))
    def cross(payload: bytes) -> None:
        sender.send(payload)
        seen = stranger.receive()
        assert bytes(seen.data) == payload + bytes(length - size)
        assert seen.dlc == length
        assert (seen.is_fd, seen.bitrate_switch, seen.is_extended_id) == (length > 8, length > 8, False)
        arrival = receiver.wait(PATIENCE_S)
        assert arrival is not None
        assert arrival.frame == payload

    cross()


@pytest.mark.parametrize(("wire", "fd", "measurement", "command"), LENGTHS)
def test_a_frame_crosses_byte_for_byte_and_is_padded_with_zeros(
    wire: WireSpec, fd: bool, measurement: tuple[int, int], command: tuple[int, int]
) -> None:
    assert (wire.measurement.size, wire.command.size) == (measurement[0], command[0])
    with both_ends(virtual(fd=fd), wire) as (plant, controller, stranger):
        crosses(plant, controller, stranger, *measurement)
        crosses(controller, plant, stranger, *command)
        assert plant.refused == controller.refused == 0


@pytest.mark.parametrize("node", [1, 42, 127])
def test_frames_and_heartbeats_are_sent_and_received_by_the_ids_of_the_specification(node: int) -> None:
    with both_ends(virtual(node=node)) as (plant, controller, stranger):
        plant.send(bytes(7))
        plant.beat(Heartbeat(PlantState.IDLE, 0, MARK))
        controller.send(bytes(3))
        controller.beat(Heartbeat(PlantState.IDLE, 0, MARK))
        assert [stranger.receive().arbitration_id for _ in range(4)] == [
            0x100 + node,
            0x300 + node,
            0x200 + node,
            0x380 + node,
        ]
        for link in (plant, controller):
            assert link.wait(PATIENCE_S) is not None
            assert next_heartbeat(link)[:3] == (PlantState.IDLE, 0, MARK)


@pytest.mark.parametrize(("wire", "fd", "measurement", "command"), LENGTHS)
def test_a_frame_of_a_wrong_length_or_with_a_pad_that_is_not_zero_is_refused_and_counted(
    wire: WireSpec, fd: bool, measurement: tuple[int, int], command: tuple[int, int]
) -> None:
    del command
    size, length = measurement
    wrong = [bytes(n) for n in (*range(9), 12, 16, 20, 32, 48, 64) if n < size or (n > size and length <= 8 >= n)]
    wrong += [bytes(12)] if fd and length <= 8 else []
    wrong += [bytes(place) + b"\x80" + bytes(length - place - 1) for place in range(size, length)]
    with both_ends(virtual(fd=fd), wire) as (_, controller, stranger):
        for data in wrong:
            stranger.say(MEASUREMENT_ID + 1, data)
        stranger.settle(controller)
        assert controller.take() is None
        assert controller.refused == len(wrong) > 0


def test_a_refused_frame_neither_replaces_one_that_waits_nor_breaks_the_silence() -> None:
    with both_ends(virtual()) as (plant, controller, stranger):
        stranger.say(MEASUREMENT_ID + 1, bytes(6))
        stranger.say(PLANT_HEARTBEAT_ID + 1, bytes(7))
        eventually("the refusals", lambda: controller.refused == 2)
        assert isinf(controller.silent_s())
        plant.send(b"\x30" + bytes(6))
        stranger.say(MEASUREMENT_ID + 1, bytes(8))
        stranger.settle(controller)
        arrival = controller.take()
        assert arrival is not None
        assert arrival.frame == b"\x30" + bytes(6)
        assert controller.refused == 3


FRAME, BEAT = MEASUREMENT_ID + 1, PLANT_HEARTBEAT_ID + 1


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


def next_heartbeat(link: CanLink) -> Heartbeat:
    """The one that comes next, taken away so that another can be waited for."""
    eventually("a heartbeat", lambda: link.peer is not None)
    received, link.peer = link.peer, None
    assert received is not None
    return received


def test_a_malformed_heartbeat_is_refused_and_the_last_one_stands() -> None:
    malformed = [b"", bytes(7), bytes(12), *(bytes([state]) + bytes(7) for state in range(4, 16))]
    with both_ends(virtual()) as (_, controller, stranger):
        stranger.settle(controller)
        before = controller.peer
        for data in malformed:
            stranger.say(PLANT_HEARTBEAT_ID + 1, data)
        eventually("the refusals", lambda: controller.refused == len(malformed))
        assert controller.peer is before


def test_a_link_is_not_opened_for_frames_that_do_not_fit() -> None:
    with pytest.raises(CanError, match=r"a measurement frame has 10 bytes.*lower wire.attitude.bits"):
        CanLink(virtual(), wire_of(11, 11, 6), "plant")
    with pytest.raises(CanError, match=r"a command frame has 17 bytes.*lower wire.voltage.bits"):
        CanLink(virtual(), wire_of(8, 8, None), "controller")
