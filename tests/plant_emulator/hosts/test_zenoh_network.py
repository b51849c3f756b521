"""An emulator on a real Zenoh: its trace is enough to compute a session again, and a trip or a stop outlives it.

A vehicle has one plant; the file that keeps its latch is also tested alone.
"""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts import latch_file, zenoh_network
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.hosts.latch_file import Latch, LatchFile
from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Grant, Release, Status
from aeroloop.protocol.messages.operator import Answer, Mark, Message
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.runtime import node
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.network_settings import NetworkError, NetworkSettings
from aeroloop.protocol.wire.spec import LoopSettings
from tests.support.plant_end import WIRE, Asker, claim_of
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

LOOP = LoopSettings(realtime="off", rate_hz=100)  # slow, so that a busy machine keeps up
PLANT = PlantSettings(watchdog_s=1.0, faults=["rate:noise=0.01", "command:drop=0.1"])


@contextmanager
def running(
    network: NetworkSettings, vehicle: str = "aero", plant: PlantSettings = PLANT
) -> Iterator[tuple[Node, Endpoint]]:
    """An armed emulator on a network, until the context is left, as SIGTERM ends it."""
    with Node("plant", vehicle, network, {}) as role:
        endpoint = plant.endpoint(plant.make(LOOP.period), LOOP, WIRE)
        driver = Driver(endpoint, ZenohNetwork(role, LOOP, endpoint, plant), LOOP, role.stop)
        thread = threading.Thread(target=driver.run)
        thread.start()
        try:
            yield role, endpoint
        finally:
            role.stop.set()
            thread.join()


def test_a_second_plant_of_a_vehicle_refuses_to_start_and_names_the_first() -> None:
    with Gathering() as gathering, running(gathering.settings):
        zenoh = gathering.join()
        key = topics.key("status", "aero", role="plant")
        eventually("a status", lambda: any(reply.ok is not None for reply in zenoh.get(key)))
        with pytest.raises(NetworkError, match=r"aero has a plant already \(.*, pid \d+\); stop that one, or"):
            Node("plant", "aero", gathering.settings, {})
        with running(gathering.settings, "another") as (_, endpoint):
            assert endpoint.cause is None


def test_two_plants_of_a_vehicle_that_meet_both_trip_until_one_has_ended_and_the_other_is_armed() -> None:
    with Gathering() as one, Gathering() as other, running(one.settings) as (_, first):
        with running(other.settings) as (_, second):
            both = [*one.settings.rendezvous, *other.settings.rendezvous]
            zenoh = one.join(one.settings.model_copy(update={"rendezvous": both}))  # the cut is healed
            for emulator in (first, second):
                eventually("the trip", lambda e=emulator: e.trip is TripCause.DUPLICATE)  # type: ignore[misc]
                assert "two plants are named aero" in str(emulator.cause)
        asker = Asker(zenoh, LOOP.period_ns)
        assert "two plants are named aero" in asker.refusal()
        assert asker.ask("arm").done
        assert first.cause is None


def test_its_last_record_is_shown_without_its_loop() -> None:
    """So that encoding one of many points, however often it is asked for, costs the loop nothing."""
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:
        endpoint = PLANT.endpoint(PLANT.make(LOOP.period), LOOP, WIRE)
        ZenohNetwork(role, LOOP, endpoint, PLANT).serve()  # no driver takes what is queued
        zenoh, answers = gathering.join(), list[bytes]()

        def ask() -> bool:
            replies = zenoh.get(topics.key("show", "aero"), timeout=1.0)
            answers.extend(reply.ok.payload.to_bytes() for reply in replies if reply.ok)
            return bool(answers)

        eventually("an answer", ask)
        assert Answer.decode(answers[0]).text == "aero has no record of a session"


def test_a_release_and_a_claim_between_the_same_two_ticks_leave_one_link_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a network: five pairs of requests left six links."""
    session, open_links = MagicMock(), list[object]()
    session.declare_subscriber.return_value.try_recv.return_value = None

    class CountedLink:
        refused = 1

        def __init__(self, *_: object, **__: object) -> None:
            open_links.append(self)

        def close(self) -> None:
            open_links.remove(self)

    monkeypatch.setattr(node, "join", lambda *_: session)
    monkeypatch.setattr(zenoh_network, "ZenohLink", CountedLink)
    role = Node("controller", "aero", NetworkSettings(), {})  # as a plant it would look for another one
    endpoint = PLANT.endpoint(PLANT.make(LOOP.period), LOOP, WIRE)
    network = ZenohNetwork(role, LOOP, endpoint, PLANT)
    network.serve()
    topics_served = {call.args[0]: call.args[1] for call in session.declare_queryable.call_args_list}

    def request(topic: str, message: Message) -> None:
        key = topics.key(topic, "aero")
        payload = SimpleNamespace(to_bytes=message.encode)
        topics_served[key](MagicMock(key_expr=key, payload=payload, attachment=None))

    request("claim", claim_of("c", period_ns=LOOP.period_ns, session="s0"))
    network.take_inbox()
    for i in range(5):
        request("release", Release(session=f"s{i}"))
        request("claim", claim_of("c", period_ns=LOOP.period_ns, session=f"s{i + 1}"))
        network.take_inbox()
        assert endpoint.session == f"s{i + 1}"
    assert open_links == [network.link]
    request("release", Release(session="s5"))
    network.take_inbox()
    assert open_links == []
    published = session.declare_publisher.return_value.put.call_args_list
    statuses = [call.args[0] for call in published if b'"refused":' in call.args[0]]
    assert Status.model_validate_json(statuses[-1]).refused == 6  # of all six links


# ── the latch's file ──


STOP = Latch(
    cause=TripCause.OPERATOR, text="stopped: 0 V", operator_only=True, since=datetime(2026, 11, 23, tzinfo=UTC)
)
TRIP = Latch(
    cause=TripCause.ENVELOPE, text="tilted: 0 V", operator_only=False, since=datetime(2026, 11, 24, tzinfo=UTC)
)


def test_the_next_process_finds_the_newest_latch_and_none_after_it_was_cleared(tmp_path: Path) -> None:
    for before, after in ((None, TRIP), (TRIP, STOP), (STOP, None), (None, None)):
        file = LatchFile(tmp_path / "state", "aero")
        assert file.found == before
        file.keep(after)
        file.wait()
        assert file.unkept is None
    assert [*(tmp_path / "state").iterdir()] == []


@pytest.mark.parametrize("damage", [b"", b"{", STOP.model_dump_json().encode()[:-9], b'{"cause": "sun"}', None])
def test_a_file_that_cannot_be_read_counts_as_a_stop_and_is_named(tmp_path: Path, damage: bytes | None) -> None:
    path = tmp_path / "aero.json"
    path.mkdir() if damage is None else path.write_bytes(damage)
    found = LatchFile(tmp_path, "aero").found
    assert found is not None
    assert (found.cause, found.operator_only) == (TripCause.OPERATOR, True)
    assert str(path) in found.text


def test_a_failure_to_write_an_older_latch_does_not_delay_the_newer_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails while it writes a trip, and a stop already waits: it is tried at once, not after `RETRY_S`."""
    begun, failing = threading.Event(), threading.Event()
    failing.set()

    def fsync(descriptor: int) -> None:
        if failing.is_set():
            begun.set()
            assert renewed.wait(PATIENCE_S), descriptor
            failing.clear()
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    renewed = threading.Event()
    file = LatchFile(tmp_path, "aero")
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(latch_file, "RETRY_S", 10 * PATIENCE_S)
    monkeypatch.setattr(latch_file, "KEPT_S", PATIENCE_S)
    file.keep(TRIP)
    assert begun.wait(PATIENCE_S)
    file.keep(STOP)
    renewed.set()
    file.wait()
    assert file.unkept is None
    assert Latch.model_validate_json(file.path.read_bytes()) == STOP


def test_a_full_disk_is_said_leaves_the_file_whole_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = [False]

    def fsync(descriptor: int) -> None:
        if full[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        del descriptor

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(latch_file, "RETRY_S", 0.01)
    file = LatchFile(tmp_path, "aero")
    file.keep(TRIP)
    file.wait()
    full[0] = True
    file.keep(STOP)
    file.wait()
    assert "No space left on device" in str(file.unkept)
    assert Latch.model_validate_json(file.path.read_bytes()) == TRIP
    full[0] = False
    eventually("another attempt", lambda: file.unkept is None)
    assert Latch.model_validate_json(file.path.read_bytes()) == STOP


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer waits for the disk as long as a shared machine takes, which is sometimes half a second and more."""
    monkeypatch.setattr(latch_file, "KEPT_S", PATIENCE_S)


class Plant:
    """A process of the plant: an emulator on a network of its own, armed at its start. A context."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()

    def __enter__(self) -> Plant:
        gathering = self._stack.enter_context(Gathering())
        session = gathering.join()
        self.asker = Asker(session, LOOP.period_ns)
        self.events: list[Event] = []
        key = topics.key("event", "aero", role="plant")
        session.declare_subscriber(
            key, lambda sample: self.events.append(Event.model_validate_json(sample.payload.to_bytes()))
        )
        plant = PlantSettings(state_directory=self._folder)
        self._role, self.endpoint = self._stack.enter_context(running(gathering.settings, plant=plant))
        eventually("a status", lambda: b"uptime_s" in self.asker.query("status"))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def status(self) -> Status:
        return Status.model_validate_json(self.asker.query("status"))

    def stop(self) -> Answer:
        """As `aeroloop op stop` does."""
        return self.asker.ask("stop", by="alice@bench")

    def arm(self) -> Answer:
        """As `aeroloop op arm` does."""
        return self.asker.ask("arm")

    def grants(self, *, auto_arm: bool = False) -> bool:
        return isinstance(self.asker.claim(auto_arm=auto_arm), Grant)

    def trip(self) -> None:
        assert self.grants()
        self._role.enqueue(lambda: self.endpoint.expire(TripCause.ENVELOPE, "tilted by 80°"))
        eventually("the trip", lambda: self.endpoint.trip is not None)


def test_a_mark_is_an_event_with_its_tick_and_the_operator_s_name_if_it_can_be_printed(tmp_path: Path) -> None:
    with Plant(tmp_path) as plant:
        assert plant.grants(auto_arm=True)
        eventually("a tick", lambda: plant.endpoint.event_tick is not None)
        for by in ("alice@bench", "\x1b[2J", "a" * 101, None):
            assert "no recorder runs" in plant.asker.ask("mark", Mark(text="a bump"), by).text
        assert plant.arm().done is False  # held
        eventually("the events", lambda: len([event for event in plant.events if event.kind == "marked"]) == 4)
        marks = [event for event in plant.events if event.kind == "marked"]
        assert [mark.text for mark in marks] == ["a bump (by alice@bench)", "a bump", "a bump", "a bump"]
        assert all(mark.session == plant.asker.session and mark.tick is not None for mark in marks)


def test_a_trip_holds_in_the_next_process_until_arm_or_a_claim_with_auto_arm(tmp_path: Path) -> None:
    with Plant(tmp_path) as plant:
        plant.trip()
    with Plant(tmp_path) as plant:
        assert "tilted by 80°: 0 V" in plant.asker.refusal(auto_arm=False)
        assert plant.grants(auto_arm=True)
    with Plant(tmp_path) as plant:
        plant.trip()
        assert plant.stop().done
    with Plant(tmp_path) as plant:
        refusal = plant.asker.refusal(auto_arm=True)
        assert "tilted by 80°: 0 V; then stopped by an operator (alice@bench)" in refusal
        assert plant.arm().done
    with Plant(tmp_path) as plant:
        assert plant.grants()


def test_the_answer_to_a_stop_waits_for_the_disk_and_0_v_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, freed = threading.Event(), threading.Event()
    with Plant(tmp_path) as plant:
        path, on_disk, answers = tmp_path / "aero.json", list[bool](), list[Answer]()

        def fsync(descriptor: int) -> None:
            stuck.set()
            assert freed.wait(PATIENCE_S), descriptor

        def stop() -> None:
            answers.append(plant.stop())
            on_disk.append(path.exists())

        monkeypatch.setattr(os, "fsync", fsync)
        operator = threading.Thread(target=stop)
        operator.start()
        assert stuck.wait(PATIENCE_S)
        assert plant.endpoint.trip is TripCause.OPERATOR
        ticked = plant.endpoint.ticked
        eventually("a loop that goes on", lambda: plant.endpoint.ticked > ticked + 10)
        assert answers == []
        freed.set()
        operator.join()
        assert [(answer.done, "forget" in answer.text) for answer in answers] == [(True, False)]
        assert on_disk == [True]


def test_a_plant_that_cannot_keep_a_stop_stops_and_says_so_in_its_answer_and_its_status(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with Plant(tmp_path / "file" / "state") as plant:  # which even root cannot make
        why = f"{tmp_path}/file/state/aero.json cannot be written (Not a directory)"
        eventually("the status", lambda: why in str(plant.status().unkept))
        answer = plant.stop()
        assert answer.done
        assert "at 0 V" in answer.text
        assert f"but a restart of the plant would forget it: {why}" in answer.text
        assert plant.endpoint.trip is TripCause.OPERATOR
        assert plant.arm().text == "aero is armed: the next controller to claim it may drive it"
