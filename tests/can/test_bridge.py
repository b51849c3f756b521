"""Bridge between a real Zenoh and a bus in this process, with the test as the node: trips and their causes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zenoh

from aeroloop.plant_emulator.hosts.can_bridge import Bridge
from aeroloop.plant_emulator.hosts.latch_file import Latch
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, EventKind, Grant, Release, Status
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import NEVER, Batch, Outcome, read_batch
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.can_format import Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.wire.spec import LoopSettings
from tests.support.can_in_process import Flaws, virtual
from tests.support.plant_end import WIRE, Asker
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

LOOP = LoopSettings(realtime="off")
OURS = fingerprint(WIRE, LOOP.period_ns, lockstep=False)
SLACK_S = 0.3  # for a test that other work on the machine keeps waiting: it must run to notice anything


class Ends:
    """A bridge in a thread, a node that is the test, and a controller that is the test."""

    def __init__(self, gathering: Gathering) -> None:
        bus = virtual()
        self.role = Node("plant", "aero", gathering.settings, {})
        # No watchdog here: it counts real time, and the relay's is tried without.
        self._bridge = Bridge(self.role, LOOP, WIRE, PlantSettings(watchdog_s=10), bus)
        self.node = CanLink(bus, WIRE, "plant")
        self._session = gathering.join()
        self.asker = Asker(self._session, LOOP.period_ns)
        self.received: dict[str, list[bytes]] = {"event": [], "trace": [], "measurement": []}
        for topic in self.received:
            self._session.declare_subscriber(topics.key(topic, "aero"), self._receive)
        alive = threading.Event()
        token = topics.key("alive", "aero", role="plant")
        self._session.liveliness().declare_subscriber(token, lambda _: alive.set(), history=True)
        self._says = Heartbeat(PlantState.IDLE, 0, OURS)
        self._over = threading.Event()
        self.raised: Exception | None = None
        self._threads = [threading.Thread(target=run) for run in (self._run, self._beat)]
        for thread in self._threads:
            thread.start()
        assert alive.wait(PATIENCE_S)

    @property
    def events(self) -> list[Event]:
        return [Event.decode(payload) for payload in self.received["event"]]

    @property
    def batches(self) -> list[Batch]:
        return [batch for payload in self.received["trace"] if (batch := read_batch(payload))]

    def _receive(self, sample: zenoh.Sample) -> None:
        address = topics.read_key(str(sample.key_expr))
        assert address is not None
        self.received[address.topic.name].append(sample.payload.to_bytes())

    def close(self) -> None:
        self._over.set()
        self.role.stop.set()
        for thread in self._threads:
            thread.join()
        self.role.zenoh.close()
        self.node.close()

    def say(self, state: PlantState, cause: TripCause | None = None, mark: bytes = OURS) -> None:
        self._says = Heartbeat(state, cause.number if cause else 0, mark)
        self.node.beat(self._says)

    def _run(self) -> None:
        try:
            self._bridge.run()
        except Exception as error:
            self.raised = error

    def join(self) -> None:
        """Wait until the bridge has ended by itself."""
        self._threads[0].join()

    def fall_silent(self) -> None:
        self._over.set()
        self._threads[1].join()

    def hold(self) -> None:
        eventually("the grant", lambda: isinstance(self.asker.claim(), Grant))
        eventually("granted on the bus", lambda: self.received_state() is PlantState.GRANTED)
        self.say(PlantState.GRANTED)
        time.sleep(0.15)  # what a node says in the first 0.1 s may be of before the session

    def release(self) -> bool:
        return self.asker.ask("release", Release(session=self.asker.session)).done

    def received_state(self) -> PlantState | None:
        """The state that the node last received from the bridge."""
        return self.node.peer.state if self.node.peer else None

    def trip(self, *, idle: bool = True) -> str:
        """Why the bridge tripped, once it has; the node has then received idle, where the bus carries it."""
        eventually("the trip", lambda: any(event.kind == "tripped" for event in self.events))
        if idle:
            eventually("idle on the bus", lambda: self.received_state() is PlantState.IDLE)
        return next(event.text for event in self.events if event.kind == "tripped")

    def trips(self) -> dict[TripCause, int]:
        """Trips so far by their causes, as a status counts them."""
        return Status.model_validate_json(self.asker.query("status")).trips

    def command(self, echo: int) -> None:
        key = topics.key("command", "aero", session=self.asker.session)
        self._session.put(key, WIRE.command.pack(echo, (3, -3)))

    def _beat(self) -> None:
        while not self._over.wait(0.1):
            self.node.beat(self._says)


@pytest.fixture
def ends() -> Iterator[Ends]:
    with Gathering() as gathering, closing(Ends(gathering)) as ends:
        yield ends


def test_it_sends_the_node_a_sessions_number_and_its_end(ends: Ends) -> None:
    eventually("idle on the bus", lambda: ends.received_state() is PlantState.IDLE)
    for number in (1, 2):
        ends.hold()
        assert ends.node.peer is not None
        assert ends.node.peer[1:3] == (number, OURS)
        assert ends.release()
        eventually("idle on the bus", lambda: ends.received_state() is PlantState.IDLE)
        ends.say(PlantState.IDLE)
    ends.hold()
    ends.role.stop.set()
    eventually("idle on the bus", lambda: ends.received_state() is PlantState.IDLE)


@pytest.mark.parametrize("end", ["stop", "release", "silent node", "signal", "exception"])
def test_the_node_is_sent_the_end_before_anything_is_published(end: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the bridge's own calls, which nothing on the network can change."""
    journal: list[str] = []
    node: list[CanLink] = []
    beat, event, send = CanLink.beat, Node.event, ZenohLink.send

    def journaled_beat(link: CanLink, heartbeat: Heartbeat) -> None:
        if link is not node[0]:
            journal.append(heartbeat.state)
        beat(link, heartbeat)

    def journaled_event(role: Node, kind: EventKind, *words: Any) -> None:
        journal.append(kind)
        event(role, kind, *words)

    def failing_send(link: ZenohLink, frame: bytes) -> None:
        if end == "exception":
            raise OSError("no such device")
        send(link, frame)

    with Gathering() as gathering, closing(Ends(gathering)) as ends:
        node.append(ends.node)
        ends.hold()
        monkeypatch.setattr(CanLink, "beat", journaled_beat)
        monkeypatch.setattr(Node, "event", journaled_event)
        monkeypatch.setattr(ZenohLink, "send", failing_send)
        match end:
            case "stop":
                assert ends.asker.ask("stop").done
            case "release":
                assert ends.release()
            case "silent node":
                ends.fall_silent()
            case "signal":
                ends.role.stop.set()
            case "exception":
                ends.node.send(WIRE.measurement.pack(0, (0, 0, 0, 0, 0, 0)))
        told = "released" if end in ("release", "signal") else "tripped"
        eventually("the event", lambda: told in journal)
        assert PlantState.IDLE in journal[: journal.index(told)]
        if end == "exception":
            ends.join()
            assert isinstance(ends.raised, OSError)
            assert "unexpected OSError: no such device" in ends.trip()
            latch = Path(os.environ["STATE_DIRECTORY"], "aero.json")
            assert Latch.model_validate_json(latch.read_bytes()).cause is TripCause.PLANT


def test_a_measurement_from_before_a_session_is_none_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has arrived, but not yet been taken, when the claim is granted."""
    links: list[CanLink] = []
    connect = CanLink.__init__

    def opened(link: CanLink, *words: Any, **options: Any) -> None:
        connect(link, *words, **options)
        links.append(link)

    monkeypatch.setattr(CanLink, "__init__", opened)
    with Gathering() as gathering, closing(Ends(gathering)) as ends:
        ends.say(PlantState.IDLE)
        take_inbox, early = ends.role.take_inbox, threading.Event()

        def take_with_an_early_frame() -> bool:
            if not early.is_set():
                ends.node.send(WIRE.measurement.pack(0, (1, 1, 1, 1, 1, 1)))
                eventually("the early frame", lambda: links[0].pending)
            acted = take_inbox()
            if acted:
                early.set()
            return acted

        monkeypatch.setattr(ends.role, "take_inbox", take_with_an_early_frame)
        ends.hold()
        assert early.is_set()
        frame = WIRE.measurement.pack(0, (0, 0, 0, 0, 0, 0))
        ends.node.send(frame)
        eventually("the measurement", lambda: bool(ends.received["measurement"]))
        assert ends.received["measurement"] == [frame]


def test_it_writes_the_plants_trace_with_a_row_for_every_measurement_that_passed(ends: Ends) -> None:
    ends.hold()
    frames = [WIRE.measurement.pack(counter, (counter, 0, 0, 0, 0, 0)) for counter in range(10)]
    for counter, frame in enumerate(frames):
        ends.node.send(frame)
        eventually("the measurement", lambda frame=frame: ends.received["measurement"][-1:] == [frame])  # type: ignore[misc]
        ends.command(counter)
        assert ends.node.wait(PATIENCE_S)
    assert ends.release()
    eventually("the last batch", lambda: any(batch.header.final for batch in ends.batches))
    rows = [batch.columns for batch in ends.batches if batch.header.rows]
    assert b"".join(columns["measurement"].tobytes() for columns in rows) == b"".join(frames)
    for name, expected in {
        "session_tick": [*range(10)], "outcome": [0] + [Outcome.ACTED] * 9, "answered": [NEVER, *range(9)],
    }.items():  # fmt: skip
        assert [value for columns in rows for value in columns[name].tolist()] == expected
    kinds = [operation.kind for batch in ends.batches for operation in batch.tail.operations]
    assert kinds == ["claim", "release"]


@pytest.mark.parametrize(
    ("says", "why", "refused"),
    [
        ((PlantState.TRIPPED, TripCause.ENVELOPE, OURS), "tripped: attitude or rate envelope", None),
        ((PlantState.TRIPPED, TripCause.SATURATION, OURS), "tripped: voltage saturation", None),
        ((PlantState.TRIPPED, None, OURS), "tripped: no cause reported", None),
        ((PlantState.IDLE, None, OURS), "was started again", None),
        (
            (PlantState.GRANTED, None, bytes(7)),
            "has another wire spec now",
            "node 1 has another wire spec, period or lockstep setting than the bridge",
        ),
    ],
)
def test_it_trips_when_the_node_has_left_the_session_and_reports_why(
    ends: Ends, says: tuple[PlantState, TripCause | None, bytes], why: str, refused: str | None
) -> None:
    ends.hold()
    ends.say(*says)
    assert ends.trip() == f"node 1 {why}: 0 V"
    assert ends.trips() == {says[1] or TripCause.NODE: 1}
    if refused:
        assert ends.asker.refusal() == refused
    else:
        ends.hold()  # armed by the claim; that the node was tripped before is not held against it
        assert sum(event.kind == "tripped" for event in ends.events) == 1


def test_it_trips_when_the_node_falls_silent_and_refuses_claims_for_it(ends: Ends) -> None:
    ends.hold()
    ends.fall_silent()
    silent_since = time.monotonic()
    assert ends.trip().startswith("node 1 has been silent for ")
    assert time.monotonic() - silent_since < 0.5 + SLACK_S
    assert ends.asker.refusal() == "node 1 is silent on the bus"


def test_it_trips_when_the_bus_is_lost_refuses_claims_for_it_and_opens_it_again(flaws: Flaws, ends: Ends) -> None:
    ends.hold()
    flaws.lost = flaws.gone = True
    assert ends.trip(idle=False) == "the bus is lost: adapter was unplugged: 0 V"
    assert ends.asker.refusal() == "the bus is lost: adapter was unplugged"
    eventually("an event", lambda: any("trying again twice a second" in event.text for event in ends.events))
    flaws.lost = flaws.gone = False
    eventually("the reopening", ends.node.reopen)
    ends.say(PlantState.IDLE)
    eventually("its return", lambda: any(event.text == "the bus is open again" for event in ends.events))
    latched = "the bus is lost: adapter was unplugged: 0 V; `aeroloop op arm` clears it"
    eventually("the latch", lambda: ends.asker.refusal(auto_arm=False) == latched)
    ends.hold()
