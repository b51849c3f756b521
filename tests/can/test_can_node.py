"""The node on a CAN bus, without a bridge: sessions made by the other side's heartbeat, commands obeyed, a bus lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import MEASUREMENT_ID, CanSettings, Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import LoopSettings
from tests.support.can_in_process import Flaws, Stranger, virtual
from tests.support.plant_end import COUNTERS, OFF, PERIOD_NS, WIRE, RecordingPlant, command, volts
from tests.support.zenoh_network import PATIENCE_S

OURS = fingerprint(WIRE, PERIOD_NS, lockstep=False)
SLACK_S = 0.3  # for a test that other work on the machine keeps waiting: it must run to notice anything


class Bus:
    """A node, whose loop turns while the test waits for something, and the controller's side of its bus."""

    def __init__(self, settings: CanSettings) -> None:
        self.plant = RecordingPlant()
        # Ticks are as fast as this test goes, so the endpoint's own watchdog, which counts them, is out of the way.
        self.endpoint = Endpoint(self.plant, WIRE, PERIOD_NS, watchdog_s=3600)
        self.front = CanNetwork(settings, LoopSettings(), self.endpoint)
        self.side = CanLink(settings, WIRE, "controller")
        self.stranger = Stranger(settings)
        self.say: Heartbeat | None = None
        self.said_at, self._k = 0.0, -1
        self.front.serve()

    def close(self) -> None:
        self.front.leave()
        self.side.close()
        self.stranger.__exit__(None, None, None)

    def send_heartbeat(self, state: PlantState, number: int = 1, mark: bytes = OURS) -> None:
        """Let the controller's side say this from now on, ten times a second."""
        self.say, self.said_at = Heartbeat(state, number, mark), 0.0

    def turn(self) -> None:
        if self.say is not None and time.monotonic() >= self.said_at + 0.1:
            self.said_at = time.monotonic()
            self.side.beat(self.say)
        self._k += 1
        self.front.take_inbox()
        arrival = self.front.link.take() if self.front.link else None
        frame = self.endpoint.tick(arrival.frame if arrival else None, self._k)
        if frame and self.front.link:
            self.front.link.send(frame)
        self.front.after_tick(frame, arrival, 0)
        time.sleep(0.001)

    def until(self, what: str, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not happen within {PATIENCE_S:g} s"
            self.turn()

    def turn_for(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.turn()

    def await_heartbeat(self, state: PlantState, number: int = 0) -> None:
        """Turn until the controller's side has received this from the node."""
        wanted = (state, number, OURS)
        self.until(f"heartbeat {wanted}", lambda: self.side.peer is not None and self.side.peer[:3] == wanted)

    def begin(self, number: int = 1) -> None:
        self.send_heartbeat(PlantState.GRANTED, number)
        self.until("the session", lambda: self.endpoint.session == f"can-{number}")

    def drive(self, code: int = 5) -> None:

        def driven() -> bool:
            arrival = self.side.take()
            if arrival is not None:
                self.side.send(command(arrival.frame[0], code))
            return self.endpoint.state is PlantState.DRIVEN

        self.until("the first command", driven)

    def lose(self) -> None:
        """Let the node's bus take no frame any more."""
        link = self.front.link
        assert isinstance(link, CanLink)
        link.fault = "the bus is lost"

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
    with closing(Bus(virtual())) as bus:
        yield bus


@pytest.fixture
def bus(hasty_bus: Bus, monkeypatch: pytest.MonkeyPatch) -> Bus:
    """The same, where half a second in which this test is kept waiting does not end a session that is to go on."""
    monkeypatch.setattr(CanLink, "silent", False)
    return hasty_bus


def test_a_command_drives_it_none_from_before_the_session_and_the_heartbeat_reports_it_at_once(bus: Bus) -> None:
    bus.turn_for(0.1)  # so that any echo could be that of a measurement, were there one
    bus.side.send(command(15, code=31))
    bus.begin()
    bus.turn_for(0.1)
    assert bus.endpoint.state is PlantState.GRANTED
    assert bus.plant.voltages == OFF
    bus.drive(code=5)
    bus.turn()
    assert bus.plant.voltages == volts(5)
    bus.await_heartbeat(PlantState.DRIVEN)


def test_another_fingerprint_is_never_followed_and_ends_a_session_that_runs(
    bus: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """What makes a fingerprint another one: ../protocol/transport/test_can_format.py."""
    bus.send_heartbeat(PlantState.GRANTED, 1, bytes(7))
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
    bus.drive()
    bus.send_heartbeat(PlantState.GRANTED, 2, bytes(7))
    bus.await_heartbeat(PlantState.IDLE)
    bus.turn()
    assert bus.plant.voltages == OFF
    assert bus.endpoint.session is None


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


def test_a_session_begins_with_a_number_that_is_granted_counts_from_0_and_ends_with_the_next(bus: Bus) -> None:
    bus.await_heartbeat(PlantState.IDLE)
    bus.turn_for(0.05)
    assert bus.front.link is None
    assert bus.side.take() is None, "a measurement without a session"
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


@pytest.mark.parametrize("end", ["release", "silence", "stop", "signal", "lost bus"])
def test_the_motors_have_0_v_before_the_node_logs_that_its_session_ended_or_opens_the_bus_again(
    end: str, bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, tuple[float, ...]]] = []

    def logged(event: Event, _: str | None) -> None:
        seen.append((event.kind, bus.plant.voltages))

    def reopened(_: CanLink) -> bool:
        seen.append(("reopened", bus.plant.voltages))
        return False

    bus.begin()
    bus.drive()
    bus.turn()
    assert bus.plant.voltages != OFF
    monkeypatch.setattr("aeroloop.plant_emulator.hosts.can_node.log_event", logged)
    monkeypatch.setattr(CanLink, "reopen", reopened)
    match end:
        case "release":
            bus.send_heartbeat(PlantState.IDLE)
        case "silence":
            monkeypatch.setattr(CanLink, "silent", True)
        case "stop":
            bus.endpoint.stop()
        case "signal":
            bus.endpoint.leave()
        case "lost bus":
            bus.lose()
    bus.until("the end", lambda: any(kind in ("released", "tripped") for kind, _ in seen))
    bus.turn()
    assert {voltages for _, voltages in seen} == {OFF}
    assert ("reopened" in [kind for kind, _ in seen]) == (end == "lost bus")


def test_a_trip_stands_until_there_is_another_session_and_reports_its_cause(bus: Bus) -> None:
    bus.begin(number=1)
    bus.drive()
    bus.endpoint.expire(TripCause.ENVELOPE, "tilted too far")
    bus.await_heartbeat(PlantState.TRIPPED, 3)
    for state in (PlantState.GRANTED, PlantState.IDLE):  # heartbeats of the same number go on; a release arms nothing
        bus.send_heartbeat(state, 1)
        bus.turn_for(0.15)
        bus.side.send(command(1))
        bus.turn_for(0.05)
        assert bus.endpoint.state is PlantState.TRIPPED
        assert bus.plant.voltages == OFF
    bus.begin(number=2)
    bus.await_heartbeat(PlantState.GRANTED, 0)


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
    bus.until("the reopening", bus.side.reopen)
    bus.send_heartbeat(PlantState.IDLE)
    bus.await_heartbeat(PlantState.TRIPPED, 7)  # mended, it says what happened
    bus.begin(number=2)
    bus.await_heartbeat(PlantState.GRANTED)
    bus.drive()
