"""Emulator on a real Zenoh: its messages are enough to compute a session again, and a vehicle has one plant."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from aeroloop.plant_emulator.hosts.emulator import EmulatorOnZenoh
from aeroloop.plant_emulator.hosts.replay import PlantReplay, PlantReplayed
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Grant, Release
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Batch, Outcome, read_batch
from aeroloop.protocol.runtime.role import OccupiedError, Role
from aeroloop.protocol.transport.history import RecoveringSubscriber
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

WIRE = WireSpec()
LOOP = LoopSettings(realtime="off", rate_hz=100)  # slow, so that a busy machine keeps up
PLANT = PlantSettings(watchdog_s=1.0, faults=["rate:noise=0.01", "command:drop=0.1"])
ANSWERED = 60


def test_a_subscriber_that_joins_after_a_session_recovers_its_trace_and_the_plant_replays() -> None:
    with Gathering() as gathering, Role("plant", "aero", gathering.settings, {}) as role:
        emulator = EmulatorOnZenoh(role, LOOP, WIRE, PLANT)
        thread = threading.Thread(target=emulator.run)
        thread.start()
        try:
            zenoh = gathering.join()
            link = ZenohLink(
                zenoh,
                send_key=topics.key("command", "aero", session="s"),
                receive_key=topics.key("measurement", "aero", session="s"),
                lengths=WIRE.lengths("measurement", lockstep=False),
            )
            claim = Claim(
                controller="c", session="s", period_ns=LOOP.period_ns, lockstep=False, auto_arm=True, wire=WIRE
            )

            def ask(topic: str, payload: bytes) -> bytes:
                for reply in zenoh.get(topics.key(topic, "aero"), payload=payload, timeout=PATIENCE_S):
                    if reply.ok is not None:
                        return reply.ok.payload.to_bytes()
                return b""

            eventually("the grant", lambda: ask("claim", claim.encode()) == Grant(session="s").encode())
            for _ in range(ANSWERED):
                arrival = link.wait(PATIENCE_S)
                assert arrival is not None
                counter = WIRE.measurement.counter(arrival.frame)
                assert counter is not None
                link.send(WIRE.command.pack(counter, (2, -2)))
            ask("release", Release(session="s").encode())
            late = RecoveringSubscriber(zenoh, topics.key("trace", "aero", role="plant"))
            batches: list[Batch] = []

            def final() -> bool:
                for received in late.take():
                    batch = read_batch(received.payload)
                    assert batch is not None
                    batches.append(batch)
                return any(batch.header.final for batch in batches)

            eventually("the session's last batch", final)
        finally:
            role.stop.set()
            thread.join()
    replay = PlantReplay(LOOP, WIRE, PLANT)
    assert all(replay.feed(batch) for batch in batches)
    rows = sum(batch.header.rows for batch in batches)
    assert replay.result() == PlantReplayed(ticks=rows, differ=0, first_difference=None, stopped=None)
    outcomes = [outcome for batch in batches for outcome in batch.columns["outcome"].tolist()]
    assert len(outcomes) >= ANSWERED
    assert {Outcome.ACTED, Outcome.WITHHELD} <= set(outcomes)


@contextmanager
def running(network: NetworkSettings, vehicle: str = "aero") -> Iterator[EmulatorOnZenoh]:
    """An armed emulator on a network."""
    with Role("plant", vehicle, network, {}) as role:
        emulator = EmulatorOnZenoh(role, LOOP, WIRE, PLANT.model_copy(update={"armed_at_start": True}))
        thread = threading.Thread(target=emulator.run)
        thread.start()
        try:
            yield emulator
        finally:
            role.stop.set()
            thread.join()


def test_a_second_plant_of_a_vehicle_refuses_to_start_and_names_the_first() -> None:
    with Gathering() as gathering, running(gathering.settings):
        zenoh = gathering.join()
        key = topics.key("status", "aero", role="plant")
        eventually("a status", lambda: any(reply.ok is not None for reply in zenoh.get(key)))
        with pytest.raises(OccupiedError, match=r"aero has a plant already \(.*, pid \d+\); stop that one, or"):
            Role("plant", "aero", gathering.settings, {})
        with running(gathering.settings, "another") as emulator:
            assert emulator.endpoint.cause is None


def test_two_plants_of_a_vehicle_that_meet_both_trip_until_one_has_ended_and_the_other_is_armed() -> None:
    with Gathering() as one, Gathering() as other, running(one.settings) as first:
        with running(other.settings) as second:
            both = [*one.settings.rendezvous, *other.settings.rendezvous]
            zenoh = one.join(one.settings.model_copy(update={"rendezvous": both}))  # the cut is healed
            for emulator in (first, second):
                eventually("the trip", lambda e=emulator: e.endpoint.trip is TripCause.DUPLICATE)  # type: ignore[misc]
                assert "two plants are named aero" in str(emulator.endpoint.cause)
        claim = Claim(controller="c", session="s", period_ns=LOOP.period_ns, lockstep=False, auto_arm=True, wire=WIRE)
        replies = [reply.ok for reply in zenoh.get(topics.key("claim", "aero"), payload=claim.encode())]
        assert [b"two plants are named aero" in reply.payload.to_bytes() for reply in replies if reply] == [True]
        list(zenoh.get(topics.key("arm", "aero")))
        assert first.endpoint.cause is None
