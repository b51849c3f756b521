"""An emulator on a real Zenoh: its trace is enough to compute a session again, and a trip or a stop outlives it.

A vehicle has one plant; the file that keeps its latch is also tested alone.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from aeroloop.plant_emulator.hosts import latch_file
from aeroloop.plant_emulator.hosts.emulator import EmulatorOnZenoh
from aeroloop.plant_emulator.hosts.latch_file import Latch, LatchFile, state_directory
from aeroloop.plant_emulator.hosts.replay import PlantReplay, PlantReplayed
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Grant, Release, Status
from aeroloop.protocol.messages.operator import Answer, Request
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Batch, Outcome, read_batch
from aeroloop.protocol.runtime.node import Node, OccupiedError
from aeroloop.protocol.transport.history import RecoveringSubscriber
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.spec import LoopSettings
from tests.support.plant_end import WIRE, Asker
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

LOOP = LoopSettings(realtime="off", rate_hz=100)  # slow, so that a busy machine keeps up
PLANT = PlantSettings(watchdog_s=1.0, faults=["rate:noise=0.01", "command:drop=0.1"])
ANSWERED = 60


@contextmanager
def running(
    network: NetworkSettings, vehicle: str = "aero", plant: PlantSettings = PLANT
) -> Iterator[tuple[Node, EmulatorOnZenoh]]:
    """An armed emulator on a network, until the context is left, as SIGTERM ends it."""
    with Node("plant", vehicle, network, {}) as role:
        emulator = EmulatorOnZenoh(role, LOOP, WIRE, plant)
        thread = threading.Thread(target=emulator.run)
        thread.start()
        try:
            yield role, emulator
        finally:
            role.stop.set()
            thread.join()


def test_a_subscriber_that_joins_after_a_session_recovers_its_trace_and_the_plant_replays() -> None:
    batches: list[Batch] = []
    with Gathering() as gathering, running(gathering.settings):
        zenoh = gathering.join()
        asker = Asker(zenoh, LOOP.period_ns)
        eventually("the grant", lambda: isinstance(asker.claim(), Grant))
        link = ZenohLink(
            zenoh,
            send_key=topics.key("command", "aero", session=asker.session),
            receive_key=topics.key("measurement", "aero", session=asker.session),
            lengths=WIRE.lengths("measurement", lockstep=False),
        )
        for _ in range(ANSWERED):
            arrival = link.wait(PATIENCE_S)
            assert arrival is not None
            counter = WIRE.measurement.counter(arrival.frame)
            assert counter is not None
            link.send(WIRE.command.pack(counter, (2, -2)))
        asker.ask("release", Release(session=asker.session))
        late = RecoveringSubscriber(zenoh, topics.key("trace", "aero", role="plant"))

        def final() -> bool:
            found = [read_batch(received.payload) for received in late.take()]
            batches.extend(batch for batch in found if batch is not None)
            return any(batch.header.final for batch in batches)

        eventually("the session's last batch", final)
    replay = PlantReplay(LOOP, WIRE, PLANT)
    for batch in batches:
        replay.feed(batch)
    rows = sum(batch.header.rows for batch in batches)
    assert replay.result() == PlantReplayed(ticks=rows, differ=0, first_difference=None, stopped=None)
    outcomes = [outcome for batch in batches for outcome in batch.columns["outcome"].tolist()]
    assert len(outcomes) >= ANSWERED
    assert {Outcome.ACTED, Outcome.WITHHELD} <= set(outcomes)


def test_a_second_plant_of_a_vehicle_refuses_to_start_and_names_the_first() -> None:
    with Gathering() as gathering, running(gathering.settings):
        zenoh = gathering.join()
        key = topics.key("status", "aero", role="plant")
        eventually("a status", lambda: any(reply.ok is not None for reply in zenoh.get(key)))
        with pytest.raises(OccupiedError, match=r"aero has a plant already \(.*, pid \d+\); stop that one, or"):
            Node("plant", "aero", gathering.settings, {})
        with running(gathering.settings, "another") as (_, emulator):
            assert emulator.endpoint.cause is None


def test_two_plants_of_a_vehicle_that_meet_both_trip_until_one_has_ended_and_the_other_is_armed() -> None:
    with Gathering() as one, Gathering() as other, running(one.settings) as (_, first):
        with running(other.settings) as (_, second):
            both = [*one.settings.rendezvous, *other.settings.rendezvous]
            zenoh = one.join(one.settings.model_copy(update={"rendezvous": both}))  # the cut is healed
            for emulator in (first, second):
                eventually("the trip", lambda e=emulator: e.endpoint.trip is TripCause.DUPLICATE)  # type: ignore[misc]
                assert "two plants are named aero" in str(emulator.endpoint.cause)
        asker = Asker(zenoh, LOOP.period_ns)
        assert "two plants are named aero" in asker.refusal()
        assert asker.ask("arm").done
        assert first.endpoint.cause is None


# ── the latch's file ──


STOP = Latch(
    cause=TripCause.OPERATOR, text="stopped: 0 V", operator_only=True, since=datetime(2026, 11, 23, tzinfo=UTC)
)
TRIP = Latch(
    cause=TripCause.ENVELOPE, text="tilted: 0 V", operator_only=False, since=datetime(2026, 11, 24, tzinfo=UTC)
)


@contextmanager
def kept_in(folder: Path) -> Iterator[LatchFile]:
    file = LatchFile(folder, "aero")
    try:
        yield file
    finally:
        file.close()


def test_the_next_process_finds_the_newest_latch_and_none_after_it_was_cleared(tmp_path: Path) -> None:
    for before, after in ((None, TRIP), (TRIP, STOP), (STOP, None), (None, None)):
        with kept_in(tmp_path / "state") as file:
            assert file.found == before
            file.keep(after)
            file.wait()
            assert file.unkept is None
    assert [*(tmp_path / "state").iterdir()] == []


@pytest.mark.parametrize("damage", [b"", b"{", STOP.model_dump_json().encode()[:-9], b'{"cause": "sun"}', None])
def test_a_file_that_cannot_be_read_counts_as_a_stop_and_is_named(tmp_path: Path, damage: bytes | None) -> None:
    path = tmp_path / "aero.json"
    path.mkdir() if damage is None else path.write_bytes(damage)
    with kept_in(tmp_path) as file:
        assert file.found is not None
        assert (file.found.cause, file.found.operator_only) == (TripCause.OPERATOR, True)
        assert str(path) in file.found.text


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
    with kept_in(tmp_path) as file:
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


def test_the_folder_is_systemds_or_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/aeroloop:/var/lib/other")
    monkeypatch.setenv("XDG_STATE_HOME", "/home/alice/state")
    assert state_directory() == Path("/var/lib/aeroloop")
    monkeypatch.delenv("STATE_DIRECTORY")
    assert state_directory() == Path("/home/alice/state/aeroloop")
    monkeypatch.delenv("XDG_STATE_HOME")
    assert state_directory() == Path("~/.local/state/aeroloop")


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
        self._role, self.emulator = self._stack.enter_context(running(gathering.settings, plant=plant))
        eventually("a status", lambda: b"uptime_s" in self.asker.query("status"))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def status(self) -> Status:
        return Status.model_validate_json(self.asker.query("status"))

    def stop(self) -> Answer:
        """As `aeroloop op stop` does."""
        return self.asker.ask("stop", Request(by="alice@bench"))

    def arm(self) -> Answer:
        """As `aeroloop op arm` does."""
        return self.asker.ask("arm")

    def grants(self, *, auto_arm: bool = False) -> bool:
        return isinstance(self.asker.claim(auto_arm=auto_arm), Grant)

    def trip(self) -> None:
        assert self.grants()
        self._role.enqueue(lambda: self.emulator.endpoint.expire(TripCause.ENVELOPE, "tilted by 80°"))
        eventually("the trip", lambda: self.emulator.endpoint.trip is not None)


def test_a_stop_holds_in_the_next_process_until_arm_whether_the_plant_was_killed_or_terminated(tmp_path: Path) -> None:
    with Plant(tmp_path / "terminated") as plant:
        assert plant.stop().text == "aero is at 0 V; `aeroloop op arm` lets it be driven again"
        shutil.copytree(tmp_path / "terminated", tmp_path / "killed")  # all that is left if it is killed now
        since = plant.status().since
        assert since is not None
    why = "stopped by an operator (alice@bench): 0 V"
    for how in ("killed", "terminated"):
        with Plant(tmp_path / how) as plant:
            status = plant.status()
            assert (status.state, status.since) == (PlantState.TRIPPED, since)
            text = f"{why} ({since:%Y-%m-%d %H:%M:%S} UTC); `aeroloop op arm` clears"
            eventually("its event", lambda: any(text in event.text for event in plant.events))  # noqa: B023
            for auto_arm in (True, False):
                assert plant.asker.refusal(auto_arm=auto_arm) == f"{why}; `aeroloop op arm` clears it"
            assert plant.arm().done
            assert plant.grants()
        with Plant(tmp_path / how) as plant:
            assert plant.grants()


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
        assert plant.emulator.endpoint.trip is TripCause.OPERATOR
        ticked = plant.emulator.endpoint.ticked
        eventually("a loop that goes on", lambda: plant.emulator.endpoint.ticked > ticked + 10)
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
        assert plant.emulator.endpoint.trip is TripCause.OPERATOR
        assert plant.arm().text == "aero is armed: the next controller to claim it may drive it"


def test_a_disk_that_hangs_is_named_in_the_answer_and_in_the_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_file, "KEPT_S", 0.1)
    with Plant(tmp_path) as plant:
        freed = threading.Event()
        monkeypatch.setattr(os, "fsync", lambda _: freed.wait(PATIENCE_S))
        assert "aero.json is not written yet" in plant.stop().text
        eventually("the status", lambda: "not written yet" in str(plant.status().unkept))
        freed.set()
