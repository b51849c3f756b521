"""Synthetic logs without a network: controller and emulated plant, traces written as the recorder writes them.

Both ends are the project's own: the emulator with its trace, the controller with its trace. Only network and clocks are
simulated, so the expected content of the log is exact, also of a `rough_loop`, in which much goes otherwise.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.trace import PlantTrace
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Event, Grant, Status
from aeroloop.protocol.messages.operator import Change, Gains, Hold, Reference
from aeroloop.protocol.messages.trace import ControllerRow, End, Outcome, Received, Sent, TraceWriter
from aeroloop.protocol.transport.history import Delivery as Message
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.daemon.session import telemetry_of
from aeroloop.service.daemon.tick_source import PlantTick
from aeroloop.service.lab.lockstep import LockstepLoop
from aeroloop.service.recording.rolling import LogFile
from tests.support.clock import FakeClock
from tests.support.plant_end import claim_of

START_NS: Final = 1_800_000_000_000_000_000  # when tick 0 is measured, on the plant's wall clock
VEHICLE, SESSION = "aero", "s1"
MONOTONIC_NS: Final[dict[End, int]] = {"plant": 3_600_000_000_000, "controller": 86_400_000_000_000}
"""The same instant on either end's monotonic clock: they were booted at different times."""
AHEAD_NS: Final = 10_000_000_000  # of the controller's wall clock to the plant's
ONE_WAY_NS: Final = 150_000  # what a frame takes either way, where nothing goes wrong
RUNS: Final[dict[End, int]] = {"plant": 0x1111, "controller": 0x2222}

Changes = dict[int, tuple[Gains | None, Reference | None]]


def lockstep(*overrides: str) -> Settings:
    return load(overrides=["loop.lockstep=true", *overrides])


class Clock(FakeClock):
    """One end's clocks: `now_ns` since tick 0, for everybody, as its monotonic and its wall clock show it."""

    def __init__(self, end: End, drift: float = 0.0) -> None:
        super().__init__(now_ns=0)
        self._monotonic_ns = MONOTONIC_NS[end]
        self._wall_ns = START_NS + (AHEAD_NS if end == "controller" else 0)
        self._rate = 1.0 + drift

    def at(self, now_ns: int) -> int:
        return self._monotonic_ns + round(now_ns * self._rate)

    def monotonic_ns(self) -> int:
        return self.at(self.now_ns)

    def time_ns(self) -> int:
        return self._wall_ns + self.now_ns


class Logged(NamedTuple):
    """A message, when it was recorded, and when it was published on its publisher's wall clock [ns]."""

    at_ns: int
    key: str
    payload: bytes
    published_ns: int


class Messages:
    def __init__(self) -> None:
        self.all: list[Logged] = []

    def add(self, name: str, payload: bytes, clock: Clock, role: str = "controller") -> None:
        key = topics.key(name, VEHICLE, session=SESSION, role=role)
        self.all.append(Logged(START_NS + clock.now_ns, key, payload, clock.time_ns()))


def description(settings: Settings, role: str, **facts: str) -> Description:
    config = settings.description()
    return Description(
        protocol=PROTOCOL_VERSION, role=role, vehicle=VEHICLE, host="h", versions={}, config=config, facts=facts
    )


def write(
    path: Path,
    settings: Settings,
    messages: list[Logged],
    chunk_every: int = 50,
    roles: tuple[str, ...] = ("controller", "plant"),
    its: Mapping[str, Settings] | None = None,
) -> Path:
    """Write a log with both roles' descriptions and these messages; `its` has the settings of roles that differ."""
    path.unlink(missing_ok=True)
    log = LogFile(path)
    for role in roles:
        key = topics.key("description", VEHICLE, role=role)
        log.add_description(key, description((its or {}).get(role, settings), role).model_dump_json().encode())
    numbers: Counter[str] = Counter()
    for i, (at_ns, key, payload, published_ns) in enumerate(messages):
        log.add(Message(key, payload, numbers[key], published_ns, None), at_ns)
        numbers[key] += 1
        if i % chunk_every == chunk_every - 1:
            log.commit()
    log.end()
    return path


class ControllerEnd:
    """The controller and its trace, as the daemon runs them."""

    def __init__(
        self,
        settings: Settings,
        messages: Messages,
        clock: Clock,
        session: str = SESSION,
        run: int = RUNS["controller"],
    ) -> None:
        self.controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        self.trace = TraceWriter("controller", settings.wire, run)
        self.trace.session = session
        self._messages, self._clock, self._period = messages, clock, settings.loop.period
        self.trace.state = self.controller.state.model_dump(mode="json")
        first = Change(session=session, tick=0, gains=self.controller.gains, reference=settings.reference)
        self.trace.changes.append(first)

    def follow(self, k: int, gains: Gains | None, reference: Reference | None) -> None:
        here = self.controller.motion.here(k * self._period).row if reference is not None else None
        change = Change(session=self.trace.session, tick=k, gains=gains, reference=reference, within_s=1.0, here=here)
        self.controller.apply(change)
        self.trace.changes.append(change)

    def record(self, tick: PlantTick, command: bytes | None, sent_ns: int) -> None:
        sent_as = Sent.NONE if command is None else Sent.FRAME if command else Sent.SILENT
        self.trace.row(ControllerRow(
            max(tick.tick, 0), tick.received_as, sent_as, tick.at_ns, sent_ns if command is not None else 0,
            tick.frame, command or b"",
        ))  # fmt: skip
        if self.trace.due(self._clock.monotonic_ns()):
            self.publish()
            self.trace.state = self.controller.state.model_dump(mode="json")

    def late(self, tick: int, frame: bytes) -> None:
        """Take in a measurement that came when its tick was over: only its levels are used."""
        self.controller.hold(frame)
        at_ns = self._clock.monotonic_ns()
        self.record(PlantTick(tick, frame, Received.LATE, at_ns, at_ns), None, 0)

    def publish(self, *, final: bool = False) -> None:
        payload = self.trace.take(self._clock.monotonic_ns(), self._clock.time_ns(), final=final)
        self._messages.add("trace", payload, self._clock, "controller")


@dataclass
class Rough:
    """A loop in which much goes otherwise, by chance, and what happened in it. Times are on the plant's clock [ns]."""

    settings: Settings
    chance: random.Random
    messages: list[Logged] = field(default_factory=list)
    measured: dict[int, bytes] = field(default_factory=dict)  # the plant's frames by tick; UNCHANGED where it sent none
    commands: dict[int, bytes | None] = field(default_factory=dict)  # of each tick that the controller computed
    late: int = 0  # measurements that came late
    acted: dict[int, int] = field(default_factory=dict)  # when the command acted on was received, by the tick answered
    sent: dict[int, int] = field(default_factory=dict)  # when the measurement of a tick was sent
    outcomes: list[Outcome] = field(default_factory=list)  # of the plant's ticks, in order

    def happens(self, share: float) -> bool:
        return self.chance.random() < share

    def takes(self, usual_ns: int) -> int:
        return round(self.chance.uniform(0.7, 1.3) * usual_ns)


ROUGH_FAULTS: Final = (
    "command:drop=0.3@0..0.1",
    "command:duplicate=0.2@0..0.1",
    "command:delay=0.006@0..0.05",
    "rate.z:bias=0.05@0..0.1",
)


def rough_loop(seed: int, ticks: int = 1500, *overrides: str) -> Rough:
    """Run a loop in real time with hitches and faults of the plant, changes, and frames lost, late and twice.

    The controller's clock may drift.
    """
    chance = random.Random(seed)
    transmit = "on_change" if seed % 3 == 1 else "periodic"
    settings = load(overrides=["plant.watchdog_s=0.1", f'wire.transmit="{transmit}"', *overrides])
    rough = Rough(settings, chance)
    references = (None, Hold(attitude=(0.0, 5.0, chance.uniform(-20, 20))), settings.reference)
    changes: Changes = {
        k: (Gains(C2=(chance.choice([0.1, 0.15, 0.2]),) * 3), chance.choice(references))
        for k in range(1, ticks)
        if rough.happens(0.003)
    }
    rough.messages = made(settings, ticks, changes, truth_every=10, rough=rough)
    return rough


def make_log(
    path: Path, ticks: int, *, settings: Settings | None = None, begin: int = 0, chunk_every: int = 20, **options: Any
) -> None:
    """Write a log of a loop, without the messages before a tick; `options` as of `made`."""
    settings = settings or lockstep()
    since_ns = START_NS + begin * settings.loop.period_ns
    messages = [message for message in made(settings, ticks, **options) if message.at_ns >= since_ns]
    write(path, settings, messages, chunk_every)


def make_log_with_faults_of_frames(path: Path, ticks: int, settings: Settings) -> None:
    """Write a log of a lockstep loop whose plant holds back, drops, repeats or overtakes frames, as configured."""
    loop, wire, messages = settings.loop, settings.wire, Messages()
    plant_clock, clock = Clock("plant"), Clock("controller")
    endpoint = settings.plant.endpoint(settings.plant.make(loop.period), loop, wire)

    def publish(batch: bytes) -> None:
        messages.add("trace", batch, plant_clock, "plant")

    trace = PlantTrace(wire, publish, RUNS["plant"], plant_clock)
    claim = claim_of("c", wire=wire, period_ns=loop.period_ns, lockstep=True, session=SESSION)
    assert isinstance(endpoint.claim(claim), Grant)
    trace.follow(endpoint)
    end = ControllerEnd(settings, messages, clock)
    both = LockstepLoop(endpoint, end.controller, endpoint.tick(None, 0))
    arrival: Arrival | None = None
    for k in range(ticks):
        plant_clock.now_ns = clock.now_ns = k * loop.period_ns
        trace.row(endpoint, both.measurement, arrival, plant_clock.monotonic_ns())
        command: bytes | None = None
        for answered in both.answer():
            command, at_ns = answered.command, clock.monotonic_ns()
            end.record(PlantTick(answered.k, answered.measurement, answered.received_as, at_ns, at_ns), command, at_ns)
        arrival = both.advance(command)
    end.publish(final=True)
    endpoint.release(SESSION)
    trace.follow(endpoint)
    write(path, settings, messages.all)


def made(
    settings: Settings,
    ticks: int,
    changes: Changes = {},  # noqa: B006  # never changed
    *,
    truth_every: int = 0,  # ticks; 0 is never
    lost: Container[int] = (),  # ticks whose measurement never reaches the controller
    skipped: Container[int] = (),  # ticks that the plant has no time for
    session: str = SESSION,
    at_ns: int = 0,  # when it begins, after the first instant of both clocks
    injected: Mapping[int, str | None] = {},  # faults, before a tick; None clears all
    rough: Rough | None = None,  # notes what goes otherwise by chance
) -> list[Logged]:
    """The messages of a loop in which nothing else goes wrong, with an operator's changes by tick.

    Each session is of processes of its own. With faults, injected or configured, the plant also publishes events, and a
    status every 100 ticks.
    """
    wire, loop = settings.wire, settings.loop
    messages = Messages()
    drift = rough.chance.choice([0.0, 1e-4, -5e-5]) if rough else 0.0
    plant_clock, clock = Clock("plant"), Clock("controller", drift)
    endpoint, n = settings.plant.endpoint(settings.plant.make(loop.period), loop, wire), at_ns // 1_000_000

    def publish(k: int) -> None:
        for notice in endpoint.notices:
            messages.add("event", Event(role="plant", **notice._asdict()).encode(), plant_clock, "plant")
        endpoint.notices.clear()
        status = Status(
            role="plant", state=endpoint.state, session=endpoint.session, uptime_s=1 + k * loop.period, ticks=k,
            rate_hz=loop.rate_hz, skipped=0, faults=endpoint.fault_statuses(),
        )  # fmt: skip
        messages.add("status", status.encode(), plant_clock, "plant")

    plant_clock.now_ns = at_ns
    trace = PlantTrace(
        wire, lambda batch: messages.add("trace", batch, plant_clock, "plant"), RUNS["plant"] + n, plant_clock
    )
    claim = claim_of("c", wire=wire, period_ns=loop.period_ns, lockstep=loop.lockstep, session=session)
    assert isinstance(endpoint.claim(claim), Grant)
    trace.follow(endpoint)
    end = ControllerEnd(settings, messages, clock, session, RUNS["controller"] + n)
    coming: list[Arrival] = []
    overtaken: list[tuple[int, bytes]] = []  # measurements that are late
    resumes = 0
    for k in range(ticks):
        if rough and rough.happens(0.004):
            resumes = k + rough.chance.randrange(20)
        if k in skipped or k < resumes:
            continue
        now_ns = plant_clock.now_ns = at_ns + k * loop.period_ns
        if k in injected:
            fault = injected[k]
            endpoint.inject([] if fault is None else [Fault.parse(fault)], clear=fault is None)
            trace.follow(endpoint)
        elif rough and rough.happens(0.004):
            endpoint.inject([Fault.parse(rough.chance.choice(ROUGH_FAULTS))])
            trace.follow(endpoint)
        arrived = [one for one in coming if one.at_ns <= plant_clock.monotonic_ns()]
        arrival = arrived[-1] if arrived else None  # the newest wins
        coming = coming[len(arrived) :]
        measurement = endpoint.tick(arrival.frame if arrival else None, k)
        assert measurement is not None, endpoint.notices
        trace.row(endpoint, measurement, arrival, plant_clock.monotonic_ns())
        if truth_every and k % truth_every == 0 and (truth := endpoint.truth()) is not None:
            messages.add("truth", truth.encode(), plant_clock, "plant")
        if k % 100 == 0 and (injected or settings.plant.faults):
            publish(k)
        taken: bytes | None = None if k in lost else measurement
        clock.now_ns = now_ns + (rough.takes(ONE_WAY_NS) if rough else ONE_WAY_NS)
        if rough:
            rough.measured[k], rough.sent[k] = measurement, plant_clock.monotonic_ns()
            rough.outcomes.append(endpoint.outcome)
            if endpoint.outcome is Outcome.ACTED and arrival is not None:
                rough.acted[endpoint.answered] = arrival.at_ns
            if overtaken and rough.happens(0.5):
                end.late(*overtaken.pop(0))
                rough.late += 1
            if measurement and rough.happens(0.04):
                taken = UNCHANGED if wire.transmit.measurement == "on_change" else None
                overtaken += [(k, measurement)] * rough.happens(0.5)
        if taken is None:
            continue
        if k in changes:
            end.follow(k, *changes[k])
        command, received_ns = end.controller.tick(taken, k), clock.monotonic_ns()
        if rough:
            rough.commands[k] = command
            clock.now_ns += rough.takes(200_000)
        received_as = Received.FRAME if taken else Received.SILENT
        end.record(PlantTick(k, taken, received_as, received_ns, received_ns), command, clock.monotonic_ns())
        if k % 10 == 0 and end.controller.tick_index == k:
            messages.add("telemetry", telemetry_of(end.controller, session).encode(), clock)
        if command or (command is not None and loop.lockstep):
            arrives_ns, copies = plant_clock.at(clock.now_ns + ONE_WAY_NS), 1
            if rough:
                late_ns = rough.chance.randrange(20 * loop.period_ns) if rough.happens(0.005) else 0
                arrives_ns = plant_clock.at(clock.now_ns + rough.takes(ONE_WAY_NS)) + late_ns
                arrives_ns = max([arrives_ns, *(one.at_ns + 1 for one in coming)])
                copies = rough.chance.choice([0, 2]) if rough.happens(0.05) else 1
            coming += [Arrival(command, arrives_ns + i) for i in range(copies)]
    end.publish(final=True)
    endpoint.release(session)
    trace.follow(endpoint)
    if injected or settings.plant.faults:
        publish(ticks)
    return messages.all


AN_OPERATORS_WORDS: Changes = {
    120: (Gains(C2=(0.2, 0.2, 0.2)), None),
    250: (None, Hold(attitude=(0.0, 5.0, -10.0))),
    400: (Gains(Gamma=(0.01, 0.01, 0.01)), load().reference),
}
