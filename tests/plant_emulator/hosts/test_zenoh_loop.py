"""The plant end's network, tick by tick: the test is its loop and the controller, over a real Zenoh.

No time passes by itself: a test says when the plant ticks, and what was received at which time.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest
import zenoh

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.hosts.latch_file import Latch, LatchFile
from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork
from aeroloop.plant_emulator.plant import Measurement, State
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Grant, Status, Truth
from aeroloop.protocol.messages.operator import Message
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.link import Arrival, ZenohLink
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.plant_end import AT_REST, OFF, PERIOD_NS, Asker, RecordingPlant
from tests.support.simulated_link import wire_of
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

T = TypeVar("T")

LOOP = LoopSettings(realtime="off")
ON_CHANGE = wire_of("on_change", "periodic")
MS = 1_000_000


class Turned:
    """A plant end whose loop is the test."""

    def __init__(self, folder: Path, gathering: Gathering, wire: WireSpec, truth_rate_hz: float) -> None:
        self.wire = wire
        self.plant = RecordingPlant()
        self.endpoint = Endpoint(self.plant, wire, PERIOD_NS, armed=True)
        self.role = Node("plant", "aero", gathering.settings, {})
        settings = PlantSettings(state_directory=folder, truth_rate_hz=truth_rate_hz)
        self.network = ZenohNetwork(self.role, LOOP, self.endpoint, settings)
        self.session = gathering.join()
        self.asker = Asker(self.session)
        self.statuses: list[Status] = []
        self.events: list[Event] = []
        for topic in ("status", "event"):
            self.session.declare_subscriber(topics.key(topic, "aero", role="plant"), self._receive)
        self.network.serve()
        self.network.publish_status()
        self._pool = ThreadPoolExecutor(1)
        self.do(lambda: self.asker.query("status"))  # the session is linked

    def _receive(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if "/status/" in str(sample.key_expr):
            self.statuses.append(Status.decode(payload))
        else:
            self.events.append(Event.decode(payload))

    def do(self, ask: Callable[[], T]) -> T:
        """Ask something in another thread, and take the inbox until it is answered."""
        asked = self._pool.submit(ask)

        def answered() -> bool:
            self.network.take_inbox()
            return asked.done()

        eventually("the answer", answered)
        return asked.result()

    def claim(self) -> None:
        assert isinstance(self.do(lambda: self.asker.claim(wire=self.wire)), Grant)

    def tick(self, sent_ns: int, echo: int | None = None, at_ns: int = 0, code: int = 5) -> None:
        """Tick with the command that answers this session tick, received at a time; the measurement is then sent."""
        arrival = None
        if echo is not None:
            arrival = Arrival(self.wire.command.pack(echo, (code, -code)), at_ns)
        frame = arrival.frame if arrival is not None else None
        measurement = self.endpoint.tick(frame, self.endpoint.ticked + 1)
        self.network.after_tick(measurement, arrival, sent_ns)

    def status(self) -> Status:
        self.network.publish_status()
        return Status.model_validate_json(self.do(lambda: self.asker.query("status")))

    def close(self) -> None:
        self._pool.shutdown()
        self.role.__exit__()


@contextmanager
def turned(folder: Path, wire: WireSpec = ON_CHANGE, truth_rate_hz: float = 0.0) -> Iterator[Turned]:
    with Gathering() as gathering:
        plant_end = Turned(folder, gathering, wire, truth_rate_hz)
        try:
            yield plant_end
        finally:
            plant_end.close()


def test_a_latency_is_from_a_measurements_own_sending_to_the_command_that_answers_it(tmp_path: Path) -> None:
    """On change, most ticks send nothing: a command that answers such a tick has no latency."""
    with turned(tmp_path) as plant:
        plant.claim()
        plant.tick(1000 * MS)
        plant.tick(1002 * MS, echo=0, at_ns=1001 * MS)
        plant.tick(1004 * MS, echo=1, at_ns=1003 * MS)  # the plant is at rest, so that tick 1 was silent
        status = plant.status()
        assert status.latency_us is not None
        assert (status.latency_us.count, status.latency_us.max) == (1, 1000.0)
        assert status.latency_counts is not None
        assert status.latency_counts.sum_us == pytest.approx(1000.0)


def test_no_latency_is_from_the_sending_of_an_earlier_session(tmp_path: Path) -> None:
    with turned(tmp_path) as plant:
        plant.claim()
        plant.tick(1000 * MS)
        plant.plant.now = Measurement(IDENTITY, (1.0, 0.0, 0.0))
        plant.tick(1002 * MS)  # tick 1 is sent here, and silent in the next session
        plant.endpoint.release(plant.asker.session)
        plant.network.follow_session()
        plant.claim()
        plant.tick(2000 * MS)
        plant.tick(2002 * MS)
        plant.tick(2004 * MS, echo=1, at_ns=2003 * MS)
        assert plant.endpoint.outcome is Outcome.ACTED
        assert plant.status().latency_us is None


def test_a_holders_token_is_watched_until_its_session_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with turned(tmp_path) as plant:
        watched: list[str] = []
        monkeypatch.setattr(plant.role, "watch_token", lambda name, _: lambda: watched.append(name))
        plant.claim()
        plant.tick(0)
        assert watched == []
        plant.endpoint.release(plant.asker.session)
        plant.network.follow_session()
        assert watched == ["a"]


def test_frames_that_were_refused_count_beyond_their_session(tmp_path: Path) -> None:
    with turned(tmp_path) as plant:
        plant.claim()
        key = topics.key("command", "aero", session=plant.asker.session)
        for _ in range(3):
            plant.session.put(key, b"too long for a command")
        link = plant.network.link
        assert link is not None
        eventually("the refusal", lambda: link.refused == 3)
        assert plant.status().refused == 3
        plant.endpoint.release(plant.asker.session)
        plant.network.follow_session()
        assert plant.status().refused == 3


@pytest.mark.parametrize(
    ("rate_hz", "expected"),
    [(500.0, [*range(12)]), (100.0, [0, 5, 10]), (0.0, [])],
    ids=["every tick", "fifth", "never"],
)
def test_the_true_state_is_published_as_often_as_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate_hz: float, expected: list[int]
) -> None:
    published: list[int] = []

    def publish(role: Node, topic: str, message: Message) -> None:
        if isinstance(message, Truth):
            published.append(message.tick)
        role.publish_bytes(topic, message.encode())

    monkeypatch.setattr(RecordingPlant, "truth", lambda _: State(IDENTITY, AT_REST, OFF))
    monkeypatch.setattr(Node, "publish", publish)
    with turned(tmp_path, truth_rate_hz=rate_hz) as plant:
        plant.claim()
        for _ in range(12):
            plant.tick(0)
    assert published == expected


def test_a_plant_that_was_armed_has_no_time_of_a_trip(tmp_path: Path) -> None:
    with turned(tmp_path) as plant:
        plant.endpoint.stop()
        plant.network.follow_session()
        assert plant.status().since is not None
        plant.endpoint.arm()
        plant.network.follow_session()
        assert plant.status().since is None


def test_another_plant_of_its_name_is_one_trip_and_one_event_however_often_it_is_heard(tmp_path: Path) -> None:
    with turned(tmp_path) as plant:
        key = topics.key("status", "aero", role="plant")
        other = Status(
            role="plant", state="idle", uptime_s=1, ticks=0, rate_hz=0, skipped=0, process="elsewhere, pid 1"
        )
        for _ in range(3):
            plant.session.put(key, other.encode())
            for _ in range(20):  # the newest status is read every 10 ms at most
                plant.network.take_inbox()
                threading.Event().wait(0.002)
        assert plant.endpoint.trips == {TripCause.DUPLICATE: 1}
        eventually("the event", lambda: any(event.kind == "tripped" for event in plant.events))
        plant.do(lambda: plant.asker.query("status"))
        assert sum(event.kind == "tripped" for event in plant.events) == 1


# ── its end ──


@contextmanager
def driven(folder: Path) -> Iterator[tuple[Driver, Turned]]:
    """A driver that has not begun, of a plant end that is driven."""
    with turned(folder, WireSpec()) as plant:
        plant.claim()
        plant.tick(0)
        plant.tick(0, echo=0)
        plant.network.follow_session()
        assert plant.plant.voltages != OFF
        plant.network.serve = lambda: None  # type: ignore[method-assign]  # it is served already
        yield Driver(plant.endpoint, plant.network, LOOP, plant.role.stop), plant


def test_a_signal_while_it_is_driven_leaves_0_v_and_a_last_status_that_is_idle(tmp_path: Path) -> None:
    with driven(tmp_path) as (driver, plant):
        plant.network.publish_status()
        plant.role.stop.set()
        driver.run()
        assert plant.plant.voltages == OFF
        eventually("the end", lambda: any(event.kind == "stopped" for event in plant.events))
        last = Status.model_validate_json(plant.asker.query("status"))
        assert (last.state, last.session) == (PlantState.IDLE, None)
        eventually("a last status", lambda: plant.statuses[-1].state == PlantState.IDLE)
        assert PlantState.DRIVEN in [status.state for status in plant.statuses]
    assert not (tmp_path / "aero.json").exists()


def test_a_link_that_raises_is_a_trip_on_disk_and_an_event_and_auto_arm_does_not_clear_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def send(link: ZenohLink, frame: bytes) -> None:
        raise zenoh.ZError(f"session closed, {type(link).__name__}, {len(frame)} bytes")

    with driven(tmp_path) as (driver, plant):
        monkeypatch.setattr(ZenohLink, "send", send)
        with pytest.raises(zenoh.ZError):
            driver.run()
        assert plant.plant.voltages == OFF
        eventually("the event", lambda: any(event.kind == "tripped" for event in plant.events))
        (text,) = [event.text for event in plant.events if event.kind == "tripped"]
        assert "unexpected ZError: session closed" in text
    latch = Latch.model_validate_json((tmp_path / "aero.json").read_bytes())
    assert (latch.cause, latch.operator_only) == (TripCause.PLANT, True)
    with turned(tmp_path, WireSpec()) as plant:
        assert "unexpected ZError" in plant.do(plant.asker.refusal)


def test_a_network_that_publishes_nothing_any_more_keeps_the_latch_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def publish(node: Node, topic: str, payload: bytes) -> None:
        raise zenoh.ZError(f"session closed: no {topic} of {len(payload)} bytes from {node.role}")

    with driven(tmp_path) as (driver, plant):
        monkeypatch.setattr(Node, "publish_bytes", publish)
        with pytest.raises(zenoh.ZError):
            driver.run()
        monkeypatch.undo()
        assert plant.plant.voltages == OFF
    assert Latch.model_validate_json((tmp_path / "aero.json").read_bytes()).cause is TripCause.PLANT


def test_a_frozen_disk_delays_neither_0_v_nor_the_event_and_a_trip_at_the_end_is_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk thaws when the end waits for it, and not before."""
    frozen, waited_for, thawed = threading.Event(), threading.Event(), threading.Event()
    wait = LatchFile.wait

    def fsync(descriptor: int) -> None:
        frozen.set()
        assert thawed.wait(PATIENCE_S), descriptor

    def wait_for_disk(file: LatchFile) -> None:
        waited_for.wait(PATIENCE_S)
        thawed.set()
        wait(file)

    with driven(tmp_path) as (driver, plant):
        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(LatchFile, "wait", wait_for_disk)
        monkeypatch.setattr("aeroloop.plant_emulator.hosts.latch_file.KEPT_S", PATIENCE_S)
        ends = threading.Thread(target=driver.run)
        plant.role.enqueue(lambda: plant.endpoint.expire(TripCause.ENVELOPE, "tilted by 80°"))
        plant.role.enqueue(plant.role.stop.set)
        ends.start()
        assert frozen.wait(PATIENCE_S)
        assert plant.plant.voltages == OFF
        eventually("the event", lambda: any(event.kind == "tripped" for event in plant.events))
        assert not (tmp_path / "aero.json").exists()
        waited_for.set()
        ends.join()
        on_disk = (tmp_path / "aero.json").exists()
        thawed.set()
        assert on_disk
        assert Latch.model_validate_json((tmp_path / "aero.json").read_bytes()).cause is TripCause.ENVELOPE
