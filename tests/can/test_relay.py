"""Relay of the bridge and node on a CAN bus, each without the other: frames passed on, commands obeyed.

The relay is sans-I/O, so its times are exact to the nanosecond. The node has a real endpoint and a bus inside this
process; the test steps its loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.plant_emulator.hosts.can_node import CanFront
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import Claim, Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.transport.can_format import (
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    CanSettings,
    Heartbeat,
    fingerprint,
)
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.can_in_process import Flaws, Stranger, virtual
from tests.support.zenoh_network import PATIENCE_S

WIRE = WireSpec()
PERIOD_NS = 2_000_000
WATCHDOG_NS = 100_000_000
COUNTERS = WIRE.measurement.counters
FIRST_MEASUREMENT_NS = 1_000_000_000
FIRST_COMMAND_NS = (COUNTERS - 1) * PERIOD_NS
"""After the first measurement, before its counter comes round."""
NOW = 5_000_000_000_000
"""Some instant on the monotonic clock [ns]."""


def measurement(counter: int, codes: Sequence[int] = (1, -2, 3, -4, 5, -6)) -> bytes:
    """A well-formed measurement frame."""
    return WIRE.measurement.pack(counter % COUNTERS, codes)


def command(echo: int, code: int = 5) -> bytes:
    """A well-formed command frame."""
    return WIRE.command.pack(echo % COUNTERS, (code, -code))


# ── the relay: tenancy and watchdog of the bridge ──


def relay(*, lockstep: bool = False, armed: bool = True) -> Relay:
    """A relay that is not claimed."""
    return Relay(WIRE, PERIOD_NS, lockstep=lockstep, watchdog_s=0.1, armed=armed)


def claim(name: str = "a", *, lockstep: bool = False, auto_arm: bool = False) -> Claim:
    """A claim that fits it."""
    return Claim(
        controller=name, session=f"of-{name}", period_ns=PERIOD_NS, lockstep=lockstep, auto_arm=auto_arm, wire=WIRE
    )


def granted(*, lockstep: bool = False) -> Relay:
    """A relay in a session, whose first measurement came at NOW."""
    it = relay(lockstep=lockstep)
    assert isinstance(it.claim(claim(lockstep=lockstep)), Grant)
    assert it.measurement(measurement(0)) is not None
    it.watch(NOW)
    return it


def driven(*, lockstep: bool = False) -> Relay:
    """A relay whose first command, of echo 0, came at NOW."""
    it = granted(lockstep=lockstep)
    assert it.command(command(0), NOW) is not None
    assert it.state is PlantState.DRIVEN
    return it


@settings(max_examples=40)
@given(
    counter=st.integers(0, COUNTERS - 1),
    codes=st.lists(st.integers(-128, 127), min_size=6, max_size=6),
    voltages=st.lists(st.integers(-32, 31), min_size=2, max_size=2),
)
def test_what_is_well_formed_passes_untouched_in_a_session_and_only_there(
    counter: int, codes: list[int], voltages: list[int]
) -> None:
    it = relay()
    there, back = measurement(counter, codes), WIRE.command.pack(counter, voltages)
    assert it.measurement(there) is it.command(back, NOW) is None
    it.claim(claim())
    assert it.measurement(measurement(0)) == measurement(0)
    assert it.measurement(there) == there
    assert it.counter == counter
    assert it.command(back, NOW) == back
    assert it.release("of-a")
    assert it.measurement(there) is it.command(back, NOW) is None
    assert it.refused == 0


def test_measurements_of_before_the_session_are_dropped() -> None:
    it = relay()
    for session in range(3):
        it.claim(claim())
        for late in (7, 8, 15):
            assert it.measurement(measurement(late)) is None, session
        for counter in (0, 1, 3, 15, 0):
            assert it.measurement(measurement(counter)) == measurement(counter)
        it.release("of-a")
    assert it.refused == 0


@pytest.mark.parametrize("frame", [b"", bytes(6), bytes(8)])
def test_a_malformed_measurement_is_counted_and_does_not_pass(frame: bytes) -> None:
    it = granted()
    assert it.measurement(measurement(0)) is not None
    assert it.measurement(frame) is None
    assert it.refused == 1
    assert it.measurement(measurement(1)) is not None


@pytest.mark.parametrize("frame", [b"", bytes(2), bytes(4), b"\0\0\1"])
def test_a_malformed_command_is_counted_and_neither_passes_nor_feeds_the_watchdog(frame: bytes) -> None:
    it = driven()
    assert it.command(frame, NOW + WATCHDOG_NS) is None
    assert it.refused == 1
    it.watch(NOW + WATCHDOG_NS + 1)
    assert it.trip is TripCause.COMMAND_TIMEOUT


def test_the_watchdog_trips_a_nanosecond_after_its_time_and_reports_why() -> None:
    it = driven()
    it.watch(NOW + WATCHDOG_NS)
    assert it.session is not None
    it.watch(NOW + WATCHDOG_NS + 1)
    assert it.state is PlantState.TRIPPED
    assert it.trip is TripCause.COMMAND_TIMEOUT
    assert it.session is None
    assert [notice.text for notice in it.notices if notice.kind == "tripped"] == ["no fresh command for 100 ms: 0 V"]


def test_every_fresh_command_feeds_the_watchdog() -> None:
    it, at = driven(), NOW
    for echo in (*range(1, 16), 40, 41, 70, *range(71, 300, 50)):
        at += WATCHDOG_NS
        assert it.measurement(measurement(echo)) is not None
        it.watch(at)
        assert it.command(command(echo), at) is not None
    assert it.session is not None
    it.watch(at + WATCHDOG_NS + 1)
    assert it.state is PlantState.TRIPPED


def test_an_echo_that_is_repeated_passes_and_does_not_feed_the_watchdog() -> None:
    """Whether it is newer is the node's to say; but it proves nothing about whether its sender still sees the plant."""
    it = driven()
    for ms in range(0, 100, 2):
        assert it.command(command(0, code=ms % 30), NOW + ms * 1_000_000) == command(0, code=ms % 30)
    it.watch(NOW + WATCHDOG_NS + 1)
    assert it.trip is TripCause.COMMAND_TIMEOUT


def test_the_watchdogs_time_can_be_changed_between_two_ticks() -> None:
    it = driven()
    it.protect(0.25)
    it.watch(NOW + 250_000_000)
    assert it.session is not None
    it.watch(NOW + 250_000_001)
    assert it.state is PlantState.TRIPPED


def test_a_command_that_answers_a_measurement_older_than_the_watchdogs_time_does_not_feed_it() -> None:
    it, ticks = driven(), WATCHDOG_NS // PERIOD_NS
    for counter in range(1, ticks + 4):
        it.measurement(measurement(counter))
    assert it.command(command(2), NOW + 1) == command(2)  # the node judges again
    assert it.stale == 1
    assert it.command(command(3), NOW + 2) == command(3)
    assert it.stale == 1
    it.watch(NOW + WATCHDOG_NS + 2)
    assert it.state is PlantState.DRIVEN
    it.watch(NOW + WATCHDOG_NS + 3)
    assert it.trip is TripCause.COMMAND_TIMEOUT


def test_a_tick_is_a_measurement_that_passes_with_what_was_received_before_it() -> None:
    it = relay()
    it.measurement(measurement(0))
    assert it.ticked == -1
    it.claim(claim())
    seen = []
    for counter, frames in (
        (0, []),
        (1, [command(0)]),
        (2, [command(0, code=9)]),
        (5, [command(2, code=7)]),
        (6, [b"?"]),
        (7, [WIRE.command.pack(6, [WIRE.voltage.quantizer().invalid] * 2)]),
        (5 + COUNTERS, []),
    ):
        for frame in frames:
            it.command(frame, NOW)
        assert it.measurement(measurement(counter)) is not None
        seen.append((it.ticked, it.session_tick, it.outcome, it.answered, it.voltages))
    level = WIRE.voltage.quantizer().level
    five, seven = (level(5), level(-5)), (level(7), level(-7))
    assert seen == [
        (0, 0, Outcome.NONE, -1, OFF),
        (1, 1, Outcome.ACTED, 0, five),
        (2, 2, Outcome.REPEATED, 0, five),
        (5, 5, Outcome.ACTED, 2, seven),  # two were lost on the bus
        (6, 6, Outcome.MALFORMED, 2, seven),
        (7, 7, Outcome.ACTED, 6, OFF),  # whether it is the right answer is the node's to say
        (5 + COUNTERS, 5 + COUNTERS, Outcome.NONE, 6, OFF),
    ]
    assert it.watch(NOW + WATCHDOG_NS + 1)
    assert (it.ticked, it.session_tick, it.answered, it.voltages) == (6 + COUNTERS, 6 + COUNTERS, -1, OFF)
    assert [(operation.kind, operation.tick) for operation in it.operations] == [("claim", -1)]


def test_the_first_measurement_has_a_second_and_the_first_command_until_the_counter_comes_round() -> None:
    in_time, late, silent = granted(), granted(), relay()
    in_time.watch(NOW + FIRST_COMMAND_NS)
    assert in_time.command(command(0), NOW + FIRST_COMMAND_NS) is not None
    in_time.watch(NOW + FIRST_COMMAND_NS + WATCHDOG_NS)
    assert in_time.state is PlantState.DRIVEN
    late.watch(NOW + FIRST_COMMAND_NS + 1)
    assert late.trip is TripCause.COMMAND_TIMEOUT
    assert "no first command within 0.51 s" in late.notices[-1].text
    silent.claim(claim())
    silent.watch(NOW)
    silent.watch(NOW + FIRST_MEASUREMENT_NS)
    assert silent.state is PlantState.GRANTED
    silent.watch(NOW + FIRST_MEASUREMENT_NS + 1)
    assert "no first command within 1 s" in silent.notices[-1].text


def test_the_time_before_a_session_counts_for_nothing_in_it() -> None:
    it = driven()
    it.release("of-a")
    later = NOW + 60_000_000_000
    it.watch(later)
    it.claim(claim())
    it.watch(later + 1_000_000_000)
    it.watch(later + 1_000_000_000 + FIRST_MEASUREMENT_NS)
    assert it.state is PlantState.GRANTED


def test_in_lockstep_a_session_waits_as_long_as_it_likes() -> None:
    it = driven(lockstep=True)
    it.watch(NOW + 3_600_000_000_000)
    assert it.state is PlantState.DRIVEN


def test_a_sessions_first_command_is_fresh_whatever_the_last_sessions_last_one_echoed() -> None:
    it = driven()
    it.release("of-a")
    it.claim(claim())
    it.watch(NOW)
    it.measurement(measurement(0))
    assert it.command(command(0), NOW) is not None
    assert it.state is PlantState.DRIVEN


def test_the_number_counts_sessions_modulo_16_and_refusals_not_at_all() -> None:
    it, seen = relay(), []
    for _ in range(18):
        it.claim(claim())
        assert isinstance(it.claim(claim("b")), Refusal)
        seen.append(it.number)
        it.release("of-a")
    assert seen == [*range(1, 16), 0, 1, 2]


def test_claims_are_refused_while_it_is_unavailable_and_granted_afterwards() -> None:
    it = relay()
    it.unavailable = "node 1 is silent on the bus"
    for auto_arm in (False, True):
        assert it.claim(claim(auto_arm=auto_arm)) == Refusal(reason="node 1 is silent on the bus")
    assert it.state is PlantState.IDLE
    assert it.number == 0
    it.unavailable = None
    assert isinstance(it.claim(claim()), Grant)


def test_what_makes_it_unavailable_does_not_clear_a_latch_by_a_claim_that_arms() -> None:
    it = driven()
    it.expire(TripCause.NODE, "node 1 has been silent for 501 ms")
    it.unavailable = "node 1 is silent on the bus"
    it.claim(claim(auto_arm=True))
    assert it.state is PlantState.TRIPPED
    assert it.trip is TripCause.NODE
    it.unavailable = None
    refusal = it.claim(claim())
    assert isinstance(refusal, Refusal)
    assert "has been silent for 501 ms" in refusal.reason
    assert isinstance(it.claim(claim(auto_arm=True)), Grant)


@pytest.mark.parametrize("make", [relay, granted, driven])
def test_an_operators_stop_is_cleared_by_arming_only(make: Callable[[], Relay]) -> None:
    it = make()
    it.stop()
    assert it.state is PlantState.TRIPPED
    assert it.trip is TripCause.OPERATOR
    assert it.measurement(measurement(0)) is it.command(command(1), NOW) is None
    refusal = it.claim(claim(auto_arm=True))
    assert isinstance(refusal, Refusal)
    assert "stopped by an operator" in refusal.reason
    assert it.arm()
    assert it.trip is None
    assert isinstance(it.claim(claim()), Grant)
    assert not it.arm()


def test_it_may_start_unarmed() -> None:
    it = relay(armed=False)
    assert isinstance(it.claim(claim()), Refusal)
    assert it.arm()
    assert isinstance(it.claim(claim()), Grant)


def test_a_refusal_names_the_holder_or_the_differences() -> None:
    it = granted()
    refusal = it.claim(claim("b"))
    assert isinstance(refusal, Refusal)
    assert refusal.holder == "a"
    it.release("of-a")
    other = claim().model_copy(update={"wire": WIRE.with_bits(10, 6), "period_ns": 4_000_000, "lockstep": True})
    refusal = it.claim(other)
    assert isinstance(refusal, Refusal)
    assert refusal.differences == [
        "attitude.bits: 8, not 10",
        "rate.bits: 8, not 10",
        "period_ns: 2000000, not 4000000",
        "lockstep: False, not True",
    ]


def test_only_its_holder_can_be_lost_and_only_a_session_can_expire() -> None:
    it = driven()
    it.lost("b")
    assert it.state is PlantState.DRIVEN
    it.lost("a")
    assert it.trip is TripCause.HOLDER_GONE
    idle = relay()
    idle.expire(TripCause.BUS, "the bus is lost")
    assert idle.state is PlantState.IDLE
    assert idle.trip is None


# ── the node: an endpoint whose sessions are made by a heartbeat ──


class Still(Plant):
    """A plant that stands still and knows its voltages."""

    actuators = 2

    def __init__(self) -> None:
        self.voltages: tuple[float, ...] = ()

    def actuate(self, voltages: Sequence[float]) -> None:
        self.voltages = tuple(voltages)

    def advance(self) -> None:
        pass

    def measure(self) -> Measurement:
        return Measurement(IDENTITY, (0.0, 0.0, 0.0))

    def close(self) -> None:
        self.voltages = (0.0, 0.0)


OFF = (0.0, 0.0)
OURS = fingerprint(WIRE, PERIOD_NS, lockstep=False)
SLACK_S = 0.3
"""For a test that other work on the machine keeps waiting: it must run to notice anything."""


class Bus:
    """A node, whose loop turns while the test waits for something, and the controller's side of its bus."""

    def __init__(self, settings: CanSettings) -> None:
        self.plant = Still()
        # Ticks are as fast as this test goes, so the endpoint's own watchdog, which counts them, is out of the way.
        self.endpoint = Endpoint(self.plant, WIRE, PERIOD_NS, watchdog_s=3600)
        self.front = CanFront(settings, LoopSettings(), self.endpoint)
        self.side = CanLink(settings, WIRE, "controller")
        self.stranger = Stranger(settings)
        self.say: Heartbeat | None = None
        self.said_at = 0.0
        self._k = -1
        self.front.serve()

    def close(self) -> None:
        """Leave."""
        self.front.leave()
        self.side.close()
        self.stranger.__exit__(None, None, None)

    def send_heartbeat(self, state: PlantState, number: int = 1, mark: bytes = OURS) -> None:
        """Let the controller's side say this from now on, ten times a second."""
        self.say, self.said_at = Heartbeat(state, number, mark), 0.0

    def turn(self) -> None:
        """One tick of the node, as its driver makes it."""
        if self.say is not None and time.monotonic() >= self.said_at + 0.1:
            self.said_at = time.monotonic()
            self.side.beat(self.say)
        self._k += 1
        self.front.take_inbox()
        arrival = self.front.link.take() if self.front.link else None
        frame = self.endpoint.tick(arrival.frame if arrival else None, self._k)
        if frame is not None:
            self.front.send(frame)
        self.front.after_tick(frame, arrival, 0)
        time.sleep(0.001)

    def until(self, what: str, condition: Callable[[], bool]) -> None:
        """Turn until something is so."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not happen within {PATIENCE_S:g} s"
            self.turn()

    def turn_for(self, seconds: float) -> None:
        """Turn for so long."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.turn()

    def await_heartbeat(self, state: PlantState, number: int = 0) -> None:
        """Turn until the controller's side has received this from the node."""
        wanted = (state, number, OURS)
        self.until(f"heartbeat {wanted}", lambda: self.side.peer is not None and self.side.peer[:3] == wanted)

    def begin(self, number: int = 1) -> None:
        """Turn until a session has begun."""
        self.send_heartbeat(PlantState.GRANTED, number)
        self.until("the session", lambda: self.endpoint.session == f"can-{number}")

    def drive(self, code: int = 5) -> None:
        """Answer measurements until the node is driven."""

        def driven() -> bool:
            arrival = self.side.take()
            if arrival is not None:
                self.side.send(command(arrival.frame[0], code))
            return self.endpoint.state is PlantState.DRIVEN

        self.until("the first command", driven)

    def counters(self, least: int) -> list[int]:
        """Counters of all measurements that were not looked at yet, at least so many."""
        seen: list[int] = []

        def come() -> bool:
            messages = self.stranger.everything()
            seen.extend(message.data[0] for message in messages if message.arbitration_id == MEASUREMENT_ID + 1)
            return len(seen) >= least

        self.until("measurements", come)
        return seen


@pytest.fixture
def hasty_bus() -> Iterator[Bus]:
    """A node on a bus."""
    bus = Bus(virtual())
    yield bus
    bus.close()


@pytest.fixture
def bus(hasty_bus: Bus, monkeypatch: pytest.MonkeyPatch) -> Bus:
    """The same, where half a second in which this test is kept waiting does not end a session that is to go on."""
    monkeypatch.setattr(CanLink, "silent", False)
    return hasty_bus


def test_a_session_begins_when_the_other_side_reports_granted_and_counts_from_0(bus: Bus) -> None:
    bus.await_heartbeat(PlantState.IDLE)
    assert bus.front.link is None
    bus.turn_for(0.05)
    assert bus.side.take() is None, "a measurement without a session"
    bus.begin()
    assert bus.endpoint.state is PlantState.GRANTED
    assert bus.front.link is not None
    bus.await_heartbeat(PlantState.GRANTED)
    seen = bus.counters(40)
    assert seen == [k % COUNTERS for k in range(len(seen))]


def test_a_command_drives_it_and_the_heartbeat_reports_it_at_once(bus: Bus) -> None:
    bus.begin()
    bus.turn_for(0.05)
    assert bus.plant.voltages == OFF
    bus.drive(code=5)
    bus.turn()
    assert bus.plant.voltages == (5 * 48 / 63, -5 * 48 / 63)
    bus.await_heartbeat(PlantState.DRIVEN)


def test_heartbeats_come_ten_times_a_second_and_at_once_on_a_change(bus: Bus) -> None:
    bus.await_heartbeat(PlantState.IDLE)
    bus.stranger.everything()
    bus.turn_for(1.0)
    beats = [m for m in bus.stranger.everything() if m.arbitration_id == PLANT_HEARTBEAT_ID + 1]
    assert 5 <= len(beats) <= 11  # fewer only where this test is kept waiting
    bus.until("a heartbeat", lambda: bool(bus.stranger.everything()))
    bus.endpoint.stop()  # not 0.1 s later, but with this turn
    bus.turn()
    assert bus.stranger.heartbeat(PlantState.TRIPPED).cause is TripCause.OPERATOR


@pytest.mark.parametrize(
    "mark",
    [
        pytest.param(fingerprint(WIRE.with_bits(8, 8), PERIOD_NS, lockstep=False), id="wire"),
        pytest.param(fingerprint(WIRE, 2 * PERIOD_NS, lockstep=False), id="period"),
        pytest.param(fingerprint(WIRE, PERIOD_NS, lockstep=True), id="lockstep"),
        pytest.param(bytes(7), id="none"),
    ],
)
def test_another_fingerprint_is_never_followed(bus: Bus, mark: bytes, caplog: pytest.LogCaptureFixture) -> None:
    bus.send_heartbeat(PlantState.GRANTED, 1, mark)
    bus.until("the refusal", lambda: "another wire spec" in caplog.text)
    for echo in range(40):
        bus.side.send(command(echo))
        bus.turn()
    bus.turn_for(0.2)
    assert bus.plant.voltages == OFF
    assert bus.endpoint.state is PlantState.IDLE
    assert bus.side.take() is None
    assert len(caplog.records) == 1, "it is reported now and then, not with every heartbeat"
    bus.begin(number=1)  # the same number, with the right one


def test_another_fingerprint_ends_a_session_that_runs(bus: Bus) -> None:
    bus.begin()
    bus.drive()
    bus.send_heartbeat(PlantState.GRANTED, 2, bytes(7))
    bus.await_heartbeat(PlantState.IDLE)
    bus.turn_for(0.15)
    assert bus.plant.voltages == OFF
    assert bus.endpoint.session is None


def test_idle_from_the_other_side_releases_it(bus: Bus) -> None:
    bus.begin()
    bus.drive()
    bus.send_heartbeat(PlantState.IDLE)
    bus.await_heartbeat(PlantState.IDLE)
    bus.turn()
    assert bus.plant.voltages == OFF
    assert bus.front.link is None
    bus.begin(number=1)  # it may even be the same number: idle came in between
    assert bus.counters(1)


def test_silence_trips_it_after_half_a_second(hasty_bus: Bus) -> None:
    bus = hasty_bus
    bus.begin()
    bus.drive()
    bus.turn_for(0.2)
    bus.say = None
    bus.await_heartbeat(PlantState.TRIPPED, 7)
    assert 0.5 <= time.monotonic() - bus.said_at < 0.5 + SLACK_S
    assert bus.plant.voltages == OFF
    assert bus.endpoint.trip is TripCause.HOLDER_GONE


def test_commands_are_a_sign_of_life_too(hasty_bus: Bus) -> None:
    """Every frame counts as a sign of life; heartbeats are for when no other frame is sent."""
    bus = hasty_bus
    bus.begin()
    bus.drive()
    bus.say = None
    deadline = time.monotonic() + 0.7
    while time.monotonic() < deadline:
        bus.side.send(command(0))
        bus.turn()
    assert bus.endpoint.state is PlantState.DRIVEN


def test_another_number_is_another_session(bus: Bus) -> None:
    bus.begin(number=3)
    bus.drive()
    bus.turn()
    assert bus.plant.voltages != OFF
    bus.stranger.everything()
    bus.begin(number=4)
    assert bus.endpoint.state is PlantState.GRANTED
    bus.turn()
    assert bus.plant.voltages == OFF
    bus.await_heartbeat(PlantState.GRANTED)
    seen = bus.counters(40)
    start = next(i for i in range(len(seen)) if seen[i : i + 16] == list(range(16)))
    assert seen[start:] == [k % COUNTERS for k in range(len(seen) - start)]


def test_a_session_begins_afresh_with_counter_0_whatever_the_last_one_came_to(bus: Bus) -> None:
    for number in range(1, 6):
        bus.begin(number)
        assert bus.counters(1)[0] == 0
        bus.turn_for(0.01 * number)
        bus.send_heartbeat(PlantState.IDLE)
        bus.until("the release", lambda: bus.endpoint.session is None)
        bus.stranger.everything()


def test_what_came_before_a_session_does_not_drive_it(bus: Bus) -> None:
    bus.turn_for(0.1)  # so that any echo could be that of a measurement, were there one
    bus.side.send(command(15, code=31))
    bus.begin()
    bus.turn_for(0.1)
    assert bus.endpoint.state is PlantState.GRANTED
    assert bus.plant.voltages == OFF


def test_a_trip_stands_until_there_is_another_session_and_reports_its_cause(bus: Bus) -> None:
    bus.begin(number=1)
    bus.drive()
    bus.endpoint.expire(TripCause.ENVELOPE, "tilted too far")
    bus.await_heartbeat(PlantState.TRIPPED, 3)
    bus.turn_for(0.3)  # heartbeats of the same number go on, and commands too
    bus.side.send(command(1))
    bus.turn_for(0.05)
    assert bus.endpoint.state is PlantState.TRIPPED
    assert bus.plant.voltages == OFF
    bus.send_heartbeat(PlantState.IDLE, 1)
    bus.turn_for(0.05)
    assert bus.endpoint.state is PlantState.TRIPPED, "a release is not an arming"
    bus.begin(number=2)
    bus.await_heartbeat(PlantState.GRANTED, 0)


def test_a_node_that_leaves_reports_idle_and_is_at_rest(bus: Bus) -> None:
    bus.begin()
    bus.drive()
    bus.front.leave()
    bus.stranger.heartbeat(PlantState.IDLE)
    assert bus.endpoint.session is None
    sent = bus.side.peer
    bus.front.leave()
    assert bus.side.peer is sent


# ── the node's bus fails ──


def test_a_bus_that_fails_for_a_moment_is_opened_again_and_the_session_goes_on(
    flaws: Flaws, bus: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    bus.begin()
    bus.drive()
    opened = flaws.opened
    bus.stranger.say(0x40, bytes(8), is_error_frame=True)  # bus-off, at both ends
    bus.until("the fault", lambda: "bus-off" in caplog.text)
    assert bus.side.reopen()
    assert flaws.opened == opened + 2
    bus.stranger.everything()
    bus.side.peer = None
    bus.await_heartbeat(PlantState.DRIVEN)
    assert bus.counters(1)
    bus.turn_for(0.2)
    assert bus.endpoint.session == "can-1"


def test_a_bus_that_stays_away_trips_it_and_is_tried_twice_a_second(
    flaws: Flaws, hasty_bus: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    bus = hasty_bus
    bus.begin()
    bus.drive()
    opened = flaws.opened
    flaws.lost = flaws.gone = True
    lost_at = time.monotonic()
    bus.until("the trip", lambda: bus.endpoint.state is PlantState.TRIPPED)
    assert time.monotonic() - lost_at < 0.5 + SLACK_S
    assert bus.endpoint.trip is TripCause.HOLDER_GONE
    bus.turn_for(1.2)
    assert bus.plant.voltages == OFF
    assert 2 <= flaws.opened - opened <= 2 + (time.monotonic() - lost_at) / 0.5
    assert sum("trying again" in record.getMessage() for record in caplog.records) == 1
    flaws.lost = flaws.gone = False
    assert bus.side.reopen()
    bus.send_heartbeat(PlantState.IDLE)
    bus.await_heartbeat(PlantState.TRIPPED, 7)  # mended, it says what happened
    bus.begin(number=2)
    bus.await_heartbeat(PlantState.GRANTED)
    bus.drive()
