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
from aeroloop.protocol.messages.models import Grant, Release
from aeroloop.protocol.messages.states import TripCause
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


def test_a_subscriber_that_joins_after_a_session_recovers_its_trace_and_the_plant_replays() -> None:
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:
        emulator = EmulatorOnZenoh(role, LOOP, WIRE, PLANT)
        thread = threading.Thread(target=emulator.run)
        thread.start()
        try:
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
    for batch in batches:
        replay.feed(batch)
    rows = sum(batch.header.rows for batch in batches)
    assert replay.result() == PlantReplayed(ticks=rows, differ=0, first_difference=None, stopped=None)
    outcomes = [outcome for batch in batches for outcome in batch.columns["outcome"].tolist()]
    assert len(outcomes) >= ANSWERED
    assert {Outcome.ACTED, Outcome.WITHHELD} <= set(outcomes)


@contextmanager
def running(network: NetworkSettings, vehicle: str = "aero") -> Iterator[EmulatorOnZenoh]:
    """An armed emulator on a network."""
    with Node("plant", vehicle, network, {}) as role:
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
            Node("plant", "aero", gathering.settings, {})
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
        asker = Asker(zenoh, LOOP.period_ns)
        assert "two plants are named aero" in asker.refusal()
        assert asker.ask("arm").done
        assert first.endpoint.cause is None
