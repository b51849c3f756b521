"""Synthetic log of a loop in simulated real time with many faults, and the generator's record of them.

Hitches at both ends; frames lost, late and duplicated in both directions; skipped ticks; injected faults; operator's
changes; two clocks with offset and drift. The seed selects the mix.
"""

from __future__ import annotations

import random
import threading
from collections import deque
from dataclasses import dataclass, field
from unittest.mock import patch

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.emulator import Emulator
from aeroloop.plant_emulator.hosts.zenoh_network import PlantTrace
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.operator import Gains, Hold
from aeroloop.protocol.messages.trace import Outcome, Received
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings, load
from aeroloop.service.daemon.tick_source import MAILBOX, TickSource
from tests.support.clock import FakeClock
from tests.support.made_log import RUNS, SESSION, Clock, ControllerEnd, Messages


@dataclass
class Known:
    """What happened.

    Attributes:
        settings: The configuration.
        messages: What a recorder would have taken in.
        measured: Frames that the plant made, by session tick; UNCHANGED where it sent none.
        commands: What the controller sent at each tick that it computed.
        late: Measurements that came late.
        acted: When the plant received the command that it acted on, on its clock, by the tick that it answers [ns].
        sent: When the measurement of a tick was sent, on the plant's clock [ns].
        outcomes: Of the plant's ticks, in order.
    """

    settings: Settings
    messages: Messages = field(default_factory=Messages)
    measured: dict[int, bytes] = field(default_factory=dict)
    commands: dict[int, bytes | None] = field(default_factory=dict)
    late: int = 0
    acted: dict[int, int] = field(default_factory=dict)
    sent: dict[int, int] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)


class World(FakeClock, Link):
    """Plant, network and the controller's end of its link, in one simulated time [ns since the plant's first tick]."""

    def __init__(self, known: Known, chance: random.Random, plant_clock: Clock, clock: Clock, depth: int) -> None:
        settings = known.settings
        self._known, self._chance = known, chance
        self._plant_clock, self._clock = plant_clock, clock
        self._period_ns = settings.loop.period_ns
        self._hitch = chance.choice([0.0, 0.005, 0.03])
        self._lost, self._twice = chance.choice([0.0, 0.02]), chance.choice([0.0, 0.02])
        self._to_controller: list[tuple[int, bytes]] = []
        self._to_plant: list[tuple[int, bytes]] = []
        self._waiting: deque[Arrival] = deque(maxlen=depth)
        self.emulator = Emulator(settings.loop, settings.wire, settings.plant, threading.Event())
        self.trace = PlantTrace(
            settings.loop, settings.wire, lambda b: known.messages.add("trace", b, plant_clock, "plant"), RUNS["plant"]
        )
        self._due_ns, self._tick = 0, -1
        self.now_ns = 0

    def takes(self, usual_ns: int, worst: float = 20.0) -> int:
        """How long something takes: usually so long, now and then much longer."""
        longer = self._chance.random() < self._hitch
        return round(
            self._chance.uniform(0.7, 1.3) * usual_ns
            + (self._chance.uniform(0, worst) * self._period_ns if longer else 0)
        )

    def pass_time(self, until_ns: int) -> None:
        while self._due_ns <= until_ns:
            self._set(max(self.now_ns, self._due_ns))
            self._plants_tick()
        self._set(max(self.now_ns, until_ns))
        while self._to_controller and self._to_controller[0][0] <= self.now_ns:
            at_ns, frame = self._to_controller.pop(0)
            self._waiting.append(Arrival(frame, self._clock.at(at_ns)))

    def _set(self, now_ns: int) -> None:
        self.now_ns = self._plant_clock.now_ns = self._clock.now_ns = now_ns

    def _plants_tick(self) -> None:
        endpoint, known, now_ns = self.emulator.endpoint, self._known, self.now_ns
        tick = now_ns // self._period_ns
        arrival = None
        while self._to_plant and self._to_plant[0][0] <= now_ns:  # the newest wins
            at_ns, frame = self._to_plant.pop(0)
            arrival = Arrival(frame, self._plant_clock.at(at_ns))
        if self._chance.random() < 0.002:
            fault = self._chance.choice(
                [
                    "measurement:drop=0.3@0..0.1",
                    "command:duplicate=0.2@0..0.1",
                    "command:delay=0.006@0..0.05",
                    "rate.z:bias=0.05@0..0.1",
                    "measurement:garble=0.1@0..0.1",
                ]
            )
            self.emulator.inject([Fault.parse(fault)])
            self.trace.follow(endpoint)
        measurement = self.emulator.tick(arrival.frame if arrival else None, tick)
        session_tick = endpoint.session_tick
        sent_ns = self._plant_clock.monotonic_ns()
        at_ns = now_ns
        for frame in self.emulator._outgoing(measurement):
            if frame != UNCHANGED:
                at_ns += 1000
                self._send(self._to_controller, frame, at_ns)
        self.trace.row(endpoint, measurement, arrival, sent_ns)
        self.trace.follow(endpoint)
        if endpoint.session is not None and measurement is not None:
            known.measured[session_tick], known.sent[session_tick] = measurement, sent_ns
            known.outcomes.append(endpoint.outcome)
            if endpoint.outcome is Outcome.ACTED and arrival is not None:
                known.acted[endpoint.answered] = arrival.at_ns
            if session_tick % 10 == 0:
                truth = self.emulator.truth()
                assert truth is not None
                known.messages.add("truth", truth.encode(), self._plant_clock, "plant")
        done_ns = now_ns + self.takes(100_000)
        self._due_ns = max(tick + 1, -(-done_ns // self._period_ns)) * self._period_ns

    def _send(self, way: list[tuple[int, bytes]], frame: bytes, at_ns: int) -> None:
        if self._chance.random() < self._lost:
            return
        arrives_ns = max(at_ns + self.takes(150_000, worst=3.0), way[-1][0] + 1 if way else 0)
        way.append((arrives_ns, frame))
        if self._chance.random() < self._twice:
            way.append((arrives_ns + 1000, frame))

    @property
    def pending(self) -> bool:
        self.pass_time(self.now_ns)
        return bool(self._waiting)

    def take(self) -> Arrival | None:
        return self._waiting.popleft() if self.pending else None

    def wait(self, timeout_s: float) -> Arrival | None:
        deadline = self.now_ns + round(timeout_s * 1e9)
        while not self.pending and self.now_ns < deadline:
            following = [self._due_ns, *(at for at, _ in self._to_controller[:1]), deadline]
            self.pass_time(min(at for at in following if at > self.now_ns))
        return self.take()

    def send(self, frame: bytes) -> None:
        self._send(self._to_plant, frame, self.now_ns)

    def close(self) -> None:
        pass

    # the tick source's clock

    def monotonic_ns(self) -> int:
        return self._clock.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        self.pass_time(self.now_ns + round(seconds * 1e9))


def rough_loop(seed: int, ticks: int = 1500, *overrides: str) -> Known:
    """Run a session of about so many ticks."""
    chance = random.Random(seed)
    transmit = chance.choice(["periodic", "periodic", "on_change"])
    settings = load(overrides=["plant.watchdog_s=0.1", f'wire.transmit="{transmit}"', *overrides])
    known = Known(settings)
    plant_clock, clock = Clock("plant"), Clock("controller", drift=chance.choice([0.0, 1e-4, -5e-5]))
    sparse = settings.wire.transmit.measurement == "on_change"
    world = World(known, chance, plant_clock, clock, MAILBOX if sparse else 1)
    with patch("aeroloop.plant_emulator.hosts.zenoh_network.time", plant_clock):
        endpoint, loop, wire = world.emulator.endpoint, settings.loop, settings.wire
        claim = Claim(
            controller="c", session=SESSION, period_ns=loop.period_ns, lockstep=False, auto_arm=True, wire=wire
        )
        assert isinstance(endpoint.claim(claim), Grant)
        world.trace.follow(endpoint)
        end = ControllerEnd(settings, known.messages, clock)
        source = TickSource(world, loop, wire, stale_s=settings.controller.stale_s, clock=world)
        k = -1
        while world.now_ns < ticks * loop.period_ns and endpoint.session is not None:
            now = source.next(0.02)
            if now is None:
                continue
            if now.received_as is Received.LATE or now.tick == k:
                end.controller.hold(now.frame)
                known.late += now.received_as is Received.LATE
                end.record(now, None, 0)
                continue
            if chance.random() < 0.003:
                gains = Gains(C2=(chance.choice([0.1, 0.15, 0.2]),) * 3)
                reference = chance.choice(
                    [None, Hold(attitude=(0.0, 5.0, chance.uniform(-20, 20))), settings.reference]
                )
                end.follow(now.tick, chance.choice([None, gains]) if reference else gains, reference)
            world.pass_time(world.now_ns + world.takes(200_000))
            command = end.controller.tick(now.frame, now.tick)
            k = now.tick
            if command:
                world.send(command)
            known.commands[k] = command
            end.record(now, command, clock.monotonic_ns())
        end.publish(final=True)
        endpoint.release(SESSION)
        world.trace.follow(endpoint)
    return known
