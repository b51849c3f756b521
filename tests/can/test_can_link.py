"""CAN link in one process: frames byte for byte, heartbeats, refused frames, faults."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from hashlib import sha256
from math import isinf
from threading import Condition
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import (
    COMMAND_ID,
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    CanError,
    CanSettings,
    Heartbeat,
    check_widths,
    fingerprint,
)
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.can_in_process import Flaws, Stranger, virtual
from tests.support.zenoh_network import PATIENCE_S, eventually

PAPER = WireSpec()
PERIOD_NS = 2_000_000
MARK = b"\1\2\3\4\5\6\7"
UNSENT = 20
"""So many frames in a row that are not taken make a fault."""


def wire(
    attitude: int | None, rate: int | None, voltage: int | None, actuators: int = 2, counter_bits: int = 8
) -> WireSpec:
    """A spec of these bits."""
    return WireSpec.model_validate(
        {
            "attitude": {"bits": attitude, "limit": 1.0},
            "rate": {"bits": rate, "limit": 1.0},
            "voltage": {"bits": voltage, "limit": 24.0},
            "actuators": actuators,
            "counter_bits": counter_bits,
        }
    )


# By hand from SPEC.md: bits of a frame, then bytes, then the next length that CAN FD has. 24 and 48 do not come about.
LENGTHS = [
    pytest.param(PAPER, False, (7, 7), (3, 3), id="8-6"),
    pytest.param(wire(10, 10, 16, 2, 4), False, (8, 8), (5, 5), id="10-16-counter-4"),
    pytest.param(wire(2, 2, 2, 3), False, (3, 3), (2, 2), id="2-2-three-motors"),
    pytest.param(wire(8, 8, 6, 3), True, (7, 7), (4, 4), id="8-6-three-motors-FD"),
    pytest.param(wire(10, 10, 6), True, (9, 12), (3, 3), id="10-6"),
    pytest.param(wire(14, 16, 16), True, (13, 16), (5, 5), id="14+16-16"),
    pytest.param(wire(16, 16, None, 2, 10), True, (14, 16), (18, 20), id="16-cont-counter-10"),
    pytest.param(wire(None, 8, None, 3), True, (28, 32), (25, 32), id="cont+8-cont-three-motors"),
    pytest.param(wire(None, None, 6), True, (49, 64), (3, 3), id="cont-6"),
]


@contextmanager
def both_ends(settings: CanSettings, wire: WireSpec = PAPER) -> Iterator[tuple[CanLink, CanLink, Stranger]]:
    """The plant's link, the controller's, and a stranger that reads the bus as it is."""
    plant, controller = CanLink(settings, wire, "plant"), CanLink(settings, wire, "controller")
    try:
        with Stranger(settings) as stranger:
            yield plant, controller, stranger
    finally:
        with ThreadPoolExecutor() as both:  # each waits for its receiver, up to 0.1 s
            list(both.map(CanLink.close, (plant, controller)))


# ── frames ──


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
def test_ids_are_those_of_the_specification(node: int) -> None:
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


@pytest.mark.parametrize("node", [0, 128])
def test_a_node_number_that_would_make_another_kind_of_id_is_refused(node: int) -> None:
    with pytest.raises(ValueError, match="node"):
        CanSettings(node=node)


def test_two_nodes_on_one_bus_do_not_receive_each_others_frames() -> None:
    first, second = virtual(node=1), virtual(node=2)
    second = second.model_copy(update={"channel": first.channel})
    with both_ends(first) as (plant_1, controller_1, near_1), both_ends(second) as (plant_2, controller_2, near_2):
        plant_1.send(b"\x10" + bytes(6))
        controller_1.send(b"\x10\0\0")
        plant_1.beat(Heartbeat(PlantState.DRIVEN, 0, MARK))
        controller_1.beat(Heartbeat(PlantState.GRANTED, 5, MARK))
        near_1.settle(plant_1, controller_1)
        assert plant_2.peer is controller_2.peer is None
        assert isinf(plant_2.silent_s())
        assert isinf(controller_2.silent_s())
        near_2.settle(plant_2, controller_2)
        assert plant_2.take() is controller_2.take() is None
        assert plant_1.take() is not None
        assert controller_1.take() is not None
        assert plant_2.refused == controller_2.refused == 0


def test_the_newest_frame_wins_and_is_given_once() -> None:
    with both_ends(virtual()) as (plant, controller, stranger):
        before = time.monotonic_ns()
        for k in range(5):
            plant.send(bytes([k << 4, *range(6)]))
        stranger.settle(controller)
        assert controller.pending
        arrival = controller.take()
        assert arrival is not None
        assert arrival.frame == bytes([4 << 4, *range(6)])
        assert before <= arrival.at_ns <= time.monotonic_ns()
        assert not controller.pending
        assert controller.take() is None


def test_waiting_ends_when_a_frame_comes_and_at_the_timeout() -> None:
    with both_ends(virtual()) as (plant, controller, _):
        started = time.monotonic()
        assert controller.wait(0.05) is None
        assert time.monotonic() - started >= 0.05
        plant.send(bytes(7))
        assert controller.wait(PATIENCE_S) is not None


def test_a_frame_notifies_a_shared_condition() -> None:
    bus, changed = virtual(), Condition()
    link = CanLink(bus, PAPER, "controller", changed)
    try:
        with Stranger(bus) as stranger, changed:
            stranger.say(MEASUREMENT_ID + 1, bytes(7))
            assert changed.wait(PATIENCE_S)
        assert link.pending
    finally:
        link.close()


# ── what is refused, and what is not even looked at ──


@pytest.mark.parametrize(
    ("wire", "fd", "data"),
    [
        pytest.param(PAPER, False, bytes(6), id="short"),
        pytest.param(PAPER, False, bytes(8), id="long"),
        pytest.param(PAPER, False, b"", id="empty"),
        pytest.param(PAPER, True, bytes(12), id="long-on-an-FD-bus"),
        pytest.param(wire(11, 11, 6), True, bytes(8), id="FD-short"),
        pytest.param(wire(16, 16, 6), True, bytes(12), id="FD-short-by-a-byte"),
        pytest.param(wire(10, 10, 6), True, bytes(9) + b"\1\0\0", id="FD-first-byte-of-the-pad"),
        pytest.param(wire(11, 11, 6), True, bytes(11) + b"\1", id="FD-last-byte-of-the-pad"),
        pytest.param(wire(16, 16, 6), True, bytes(13) + b"\0\x80\0", id="FD-middle-of-the-pad"),
        pytest.param(wire(None, None, 6), True, bytes(63) + b"\xff", id="FD-64"),
    ],
)
def test_a_frame_of_a_wrong_length_or_with_a_pad_that_is_not_zero_is_refused_and_counted(
    wire: WireSpec, fd: bool, data: bytes
) -> None:
    with both_ends(virtual(fd=fd), wire) as (_, controller, stranger):
        stranger.say(MEASUREMENT_ID + 1, data)
        stranger.settle(controller)
        assert controller.take() is None
        assert controller.refused == 1


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
        pytest.param([0x000, 0x001, 0x081, 0x0FF, 0x180, 0x400, 0x701, 0x7FF], {}, id="foreign ids"),
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


# ── heartbeats ──


def next_heartbeat(link: CanLink) -> Heartbeat:
    """The one that comes next, taken away so that another can be waited for."""
    eventually("a heartbeat", lambda: link.peer is not None)
    received, link.peer = link.peer, None
    assert received is not None
    return received


@pytest.mark.parametrize("state", PlantState)
def test_a_plants_heartbeat_carries_its_state_and_every_cause(state: PlantState) -> None:
    with both_ends(virtual()) as (plant, controller, _):
        for cause in (None, *TripCause):
            number = cause.number if cause else 0
            plant.beat(Heartbeat(state, number, MARK))
            received = next_heartbeat(controller)
            assert received[:3] == (state, number, MARK)
            assert received.cause is cause
            assert 0 < received.at_ns <= time.monotonic_ns()
            assert 0 <= controller.silent_s() < PATIENCE_S


def test_a_controllers_heartbeat_carries_the_number_of_the_session() -> None:
    with both_ends(virtual()) as (plant, controller, _):
        for number in range(16):
            controller.beat(Heartbeat(PlantState.GRANTED, number, MARK))
            assert next_heartbeat(plant)[:3] == (PlantState.GRANTED, number, MARK)


@settings(max_examples=40)
@given(state=st.sampled_from(PlantState), number=st.integers(0, 15), mark=st.binary(min_size=7, max_size=7))
def test_a_heartbeat_has_eight_bytes_and_is_read_as_it_was_written(state: PlantState, number: int, mark: bytes) -> None:
    packed = Heartbeat(state, number, mark).pack()
    assert len(packed) == 8
    assert Heartbeat.unpack(packed, 5) == Heartbeat(state, number, mark, 5)


def test_a_heartbeats_bits_are_those_of_the_specification() -> None:
    assert Heartbeat(PlantState.TRIPPED, 9, MARK).pack() == b"\x93\1\2\3\4\5\6\7"
    states = [Heartbeat(state, 0, MARK).pack()[0] for state in ("idle", "granted", "driven", "tripped")]  # type: ignore[arg-type]
    assert states == [0, 1, 2, 3]


def test_causes_are_numbered_as_in_the_specification() -> None:
    causes = [
        "no command in time",
        "invalid command",
        "attitude or rate envelope",
        "voltage saturation",
        "no valid measurement",
        "operator's stop",
        "controller gone",
        "no answer in lockstep",
        "bus lost",
        "node lost",
        "another plant of this name",
    ]
    assert [TripCause(cause).number for cause in causes] == list(range(1, 12))
    said = [Heartbeat(PlantState.TRIPPED, number, MARK).cause for number in range(16)]
    assert said == [None, *causes, None, None, None, None]


def test_a_malformed_heartbeat_is_refused_and_the_last_one_stands() -> None:
    malformed = [b"", bytes(7), bytes(12), *(bytes([state]) + bytes(7) for state in range(4, 16))]
    with both_ends(virtual()) as (_, controller, stranger):
        stranger.settle(controller)
        before = controller.peer
        for data in malformed:
            stranger.say(PLANT_HEARTBEAT_ID + 1, data)
        eventually("the refusals", lambda: controller.refused == len(malformed))
        assert controller.peer is before


# ── what both ends must agree on ──


WIDTHS = st.one_of(st.none(), st.integers(MIN_BITS, MAX_BITS))
ADVICE = re.compile(
    r"a (?P<frame>\w+) frame has (?P<size>\d+) bytes, and a classic CAN frame holds 8: set can\.fd = true, "
    r"or wire\.(?P<first>\w+)\.bits(?: and wire\.(?P<second>\w+)\.bits)? to (?P<widest>\d+) at the most"
    r"(?P<shorter>, or wire\.counter_bits = 4 with can\.short_counter = true)?$"
)


def _refusal(spec: WireSpec, *, fd: bool) -> str | None:
    try:
        check_widths(CanSettings(fd=fd), spec)
    except CanError as error:
        return str(error)
    return None


def _size(frame: str, bits: dict[str, int | None], actuators: int, counter_bits: int) -> int:
    size: int = getattr(wire(**bits, actuators=actuators, counter_bits=counter_bits), frame).size
    return size


@settings(max_examples=60)
@given(
    attitude=WIDTHS, rate=WIDTHS, voltage=WIDTHS, actuators=st.sampled_from([2, 3]), counted=st.sampled_from([4, 8, 16])
)
def test_a_spec_that_does_not_fit_is_refused_with_the_widths_that_would(
    attitude: int | None, rate: int | None, voltage: int | None, actuators: int, counted: int
) -> None:
    bits = {"attitude": attitude, "rate": rate, "voltage": voltage}
    assert _refusal(wire(**bits, actuators=actuators, counter_bits=counted), fd=True) is None
    while (said := _refusal(wire(**bits, actuators=actuators, counter_bits=counted), fd=False)) is not None:
        advice = ADVICE.match(said)
        assert advice is not None, said
        frame, size, widest = advice["frame"], int(advice["size"]), int(advice["widest"])
        assert _size(frame, bits, actuators, counted) == size > 8
        assert (advice["shorter"] is not None) == (_size(frame, bits, actuators, 4) <= 8)
        signals = [name for name in (advice["first"], advice["second"]) if name is not None]
        bits |= dict.fromkeys(signals, widest)
        assert _size(frame, bits, actuators, counted) <= 8
        if widest < MAX_BITS:
            assert _size(frame, {**bits, **dict.fromkeys(signals, widest + 1)}, actuators, counted) > 8
    assert all(_size(frame, bits, actuators, counted) <= 8 for frame in ("measurement", "command"))


def test_a_link_is_not_opened_for_frames_that_do_not_fit() -> None:
    with pytest.raises(CanError, match=r"a measurement frame has 10 bytes.*to 9 at the most$"):
        CanLink(virtual(), wire(11, 11, 6), "plant")
    with pytest.raises(CanError, match=r"a command frame has 17 bytes.*wire\.voltage\.bits to 16 at the most"):
        CanLink(virtual(), wire(8, 8, None), "controller")


def test_the_fingerprint_is_the_one_of_the_specification() -> None:
    """Seven bytes of SHA-256 over this very text; another implementation must come to the same."""
    text = (
        '{"lockstep": false, "period_ns": 2000000, "wire": {"actuators": 2, '
        '"attitude": {"bits": 8, "deadzone": null, "limit": 1.0}, "counter_bits": 8, '
        '"rate": {"bits": 8, "deadzone": null, "limit": 1.0}, '
        '"voltage": {"bits": 6, "deadzone": null, "limit": 24.0}}}'
    )
    ours = fingerprint(PAPER, PERIOD_NS, lockstep=False)
    assert ours == sha256(text.encode()).digest()[:7]
    assert ours.hex() == "094b8ce4a32f59"


def test_the_fingerprint_differs_if_anything_does_that_both_ends_must_agree_on() -> None:
    others = {"bits": 9, "limit": 2.5, "deadzone": 0.125}
    kinds: dict[str, object] = {
        "kind": "logarithmic-uniform",
        "hysteresis": {"kind": "hysteresis-uniform", "hysteresis": 0.125},
        "threshold": {"kind": "logarithmic-uniform", "threshold": 0.125},
    }
    changes: dict[str, object] = {
        f"{signal}.{field}": other
        for signal in ("attitude", "rate", "voltage")
        for field, other in (others | kinds).items()
    }
    changes |= {"actuators": 3, "counter_bits": 10}
    changes |= {"transmit.measurement": "on_change", "transmit.command": "on_change", "transmit.heartbeat_s": 0.02}
    plain = PAPER.model_dump()
    leaves = {
        f"{name}.{field}" if isinstance(value, dict) else name
        for name, value in plain.items()
        for field in (value if isinstance(value, dict) else [""])
    }
    assert set(changes) == leaves, "a field of the wire is not tried here"
    seen = {fingerprint(PAPER, PERIOD_NS, lockstep=False), fingerprint(PAPER, PERIOD_NS, lockstep=True)}
    seen.add(fingerprint(PAPER, PERIOD_NS + 1, lockstep=False))
    for path, value in changes.items():
        other = json.loads(json.dumps(plain))
        *sections, field = path.split(".")
        (other[sections[0]] if sections else other).update(value if isinstance(value, dict) else {field: value})
        seen.add(fingerprint(WireSpec.model_validate(other), PERIOD_NS, lockstep=False))
    seen.add(fingerprint(PAPER.with_bits(None, 6), PERIOD_NS, lockstep=False))
    assert len(seen) == 3 + len(changes) + 1
    assert fingerprint(PAPER.with_bits(8, 6), PERIOD_NS, lockstep=False) == fingerprint(
        PAPER, PERIOD_NS, lockstep=False
    )


# ── faults ──


@pytest.fixture
def flawed(flaws: Flaws) -> Iterator[tuple[CanLink, CanSettings]]:
    """A plant's link on such a bus."""
    del flaws
    bus = virtual()
    link = CanLink(bus, PAPER, "plant")
    yield link, bus
    link.close()


def test_a_bus_that_takes_no_frames_is_a_fault_after_so_many_in_a_row(
    flaws: Flaws, flawed: tuple[CanLink, CanSettings]
) -> None:
    link, _ = flawed
    for _ in range(3):
        flaws.full = True
        for _ in range(UNSENT - 1):
            link.send(bytes(7))
        assert link.fault is None
        flaws.full = False
        link.send(bytes(7))  # one that is taken begins the count anew
    assert link.errors == 3 * (UNSENT - 1)
    flaws.full = True
    for _ in range(UNSENT - 1):
        link.send(bytes(7))
    assert link.fault is None
    link.beat(Heartbeat(PlantState.IDLE, 0, MARK))
    assert link.fault == "the bus takes no frames: transmit queue is full"


def test_after_a_fault_nothing_is_sent_and_nothing_raises(flaws: Flaws, flawed: tuple[CanLink, CanSettings]) -> None:
    link, _ = flawed
    flaws.full = True
    for _ in range(UNSENT):
        link.send(bytes(7))
    flaws.full = False
    asked = flaws.sent
    link.send(bytes(7))
    link.beat(Heartbeat(PlantState.IDLE, 0, MARK))
    assert flaws.sent == asked
    assert link.take() is None
    assert link.wait(0.01) is None


def test_an_adapter_that_is_unplugged_is_a_fault(flaws: Flaws, flawed: tuple[CanLink, CanSettings]) -> None:
    link, _ = flawed
    flaws.lost = True
    eventually("the fault", lambda: link.fault is not None)
    assert link.fault == "the bus is lost: adapter was unplugged"
    assert link.errors >= 1


@pytest.mark.parametrize("identifier", [0x40, 0x44, 0x1C8])
def test_bus_off_is_a_fault(identifier: int) -> None:
    with both_ends(virtual()) as (plant, _, stranger):
        stranger.say(identifier, bytes(8), is_error_frame=True)
        eventually("the fault", lambda: plant.fault is not None)
        assert plant.fault == "the controller is bus-off"


def test_other_error_frames_are_only_counted() -> None:
    """As SocketCAN numbers them: lost arbitration, error passive, protocol violation, no acknowledgement, restarted."""
    with both_ends(virtual()) as (plant, _, stranger):
        for identifier in (0x2, 0x4, 0x8, 0x20, 0x100):
            stranger.say(identifier, bytes(8), is_error_frame=True)
        stranger.settle(plant)
        assert plant.errors == 5
        assert plant.fault is None
        stranger.say(COMMAND_ID + 1, bytes(3))
        assert plant.wait(PATIENCE_S) is not None


@pytest.mark.parametrize("fault", ["full", "lost", "bus-off"])
def test_a_link_works_again_once_it_is_reopened(flaws: Flaws, flawed: tuple[CanLink, CanSettings], fault: str) -> None:
    link, bus = flawed
    with Stranger(bus) as stranger:
        if fault == "full":
            flaws.full = True
            for _ in range(UNSENT):
                link.send(bytes(7))
        elif fault == "lost":
            flaws.lost = True
        else:
            stranger.say(0x40, bytes(8), is_error_frame=True)
        eventually("the fault", lambda: link.fault is not None)
        flaws.full = flaws.lost = False
        stranger.everything()
        assert link.reopen()
        assert link.fault is None
        for _ in range(2):
            flaws.full = True
            for _ in range(UNSENT - 1):  # what was not taken before the fault does not count any more
                link.send(bytes(7))
            flaws.full = False
            link.send(b"\x20" + bytes(6))
        assert link.fault is None
        assert bytes(stranger.receive().data) == b"\x20" + bytes(6)
        stranger.say(COMMAND_ID + 1, b"\x50\0\0")
        arrival = link.wait(PATIENCE_S)
        assert arrival is not None
        assert arrival.frame == b"\x50\0\0"
        stranger.settle(link)


def test_a_bus_that_is_still_gone_can_be_tried_again_and_the_fault_stands_meanwhile(
    flaws: Flaws, flawed: tuple[CanLink, CanSettings]
) -> None:
    link, _ = flawed
    flaws.lost = flaws.gone = True
    eventually("the fault", lambda: link.fault is not None)
    for _ in range(3):
        assert not link.reopen()
        assert link.fault == "the bus is lost: adapter was unplugged"
        link.send(bytes(7))
    flaws.lost = flaws.gone = False
    assert link.reopen()
    assert link.fault is None


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


def test_a_librarys_error_of_many_lines_is_reported_in_one(flaws: Flaws) -> None:
    flaws.gone = True
    with pytest.raises(CanError) as refusal:
        CanLink(virtual(channel="x"), PAPER, "plant")
    assert str(refusal.value) == "cannot open the CAN bus virtual:x: could not open x:"
