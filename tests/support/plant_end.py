"""Plant ends under test: a claim, a plant that records its voltages, queries on Zenoh, a driver's loop in fake time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Self
from unittest.mock import patch

import zenoh

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.driver import Driver, PlantNetwork
from aeroloop.plant_emulator.hosts.trace import PlantTrace
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Grant, Refusal, SessionRecord
from aeroloop.protocol.messages.operator import Answer, Gains, Hold, Message, Request
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.messages.trace import Batch, read_batch
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.attitude import IDENTITY, Vector
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.clock import FakeClock
from tests.support.zenoh_network import PATIENCE_S, eventually

PERIOD_NS = 2_000_000
WIRE = WireSpec()
COUNTERS = WIRE.measurement.counters
OFF = (0.0, 0.0)
AT_REST: Vector = (0.0, 0.0, 0.0)
REST = Measurement(IDENTITY, AT_REST)
GAINS = Gains(C1=(0.5, 0.5, 0.5), C2=(0.4, 0.4, 0.4), Gamma=(0.1, 0.1, 0.1))
TURNED = Hold(attitude=(0.0, 0.0, 30.0))


def claim_of(
    name: str = "a",
    *,
    wire: WireSpec = WIRE,
    period_ns: int = PERIOD_NS,
    lockstep: bool = False,
    auto_arm: bool = True,
    session: str | None = None,
) -> Claim:
    """A controller's claim, of the session `of-NAME` unless given."""
    return Claim(
        controller=name,
        session=session or f"of-{name}",
        period_ns=period_ns,
        lockstep=lockstep,
        auto_arm=auto_arm,
        wire=wire,
    )


def record_of(name: str, **changed: Any) -> SessionRecord:
    """A record of a controller's session, in which an operator gave gains and a reference; `changed` are fields."""
    given: dict[str, Any] = {
        "controller": name, "session": f"of-{name}", "gains": GAINS, "gains_from": "operator", "reference": TURNED,
        "reference_from": "operator", "within_s": 2.0, "since_tick": 0,
    }  # fmt: skip
    return SessionRecord(**given | changed)


def command(echo: int, code: int = 5) -> bytes:
    return WIRE.command.pack(echo % COUNTERS, (code, -code))


def volts(code: int = 5) -> tuple[float, float]:
    return code * 48 / 63, -code * 48 / 63


class RecordingPlant(Plant):
    """A plant that measures `now` and records the voltages of every period."""

    def __init__(self, actuators: int = 2) -> None:
        self.actuators = actuators
        self.periods: list[tuple[float, ...]] = []
        self.now = REST
        self.voltages: tuple[float, ...] = (0.0,) * actuators

    def actuate(self, voltages: Sequence[float]) -> None:
        self.voltages = tuple(voltages)

    def advance(self) -> None:
        self.periods.append(self.voltages)

    def measure(self) -> Measurement:
        return self.now

    def close(self) -> None:
        self.voltages = (0.0,) * self.actuators


def claimed(wire: WireSpec = WIRE, *, lockstep: bool = False) -> tuple[Endpoint, RecordingPlant]:
    """An endpoint at tick 0, granted to "a", that has sent its first measurement, of counter 0."""
    plant = RecordingPlant(wire.actuators)
    endpoint = Endpoint(plant, wire, PERIOD_NS, lockstep=lockstep)
    assert isinstance(endpoint.claim(claim_of(wire=wire, lockstep=lockstep)), Grant)
    assert endpoint.tick(None, 0)
    return endpoint, plant


def state_of(endpoint: Endpoint) -> PlantState:
    """The state as it is now; read like this so that mypy does not take it for what it was a line above."""
    return endpoint.state


class Asker:
    """Queries to the plant end of the vehicle `aero`, over a Zenoh session; each is repeated until it is answered.

    Its claims are of WIRE and of this period [ns].
    """

    def __init__(self, session: zenoh.Session, period_ns: int = PERIOD_NS) -> None:
        self._session = session
        self._period_ns = period_ns
        self._claims = 0

    @property
    def session(self) -> str:
        return f"of-a-{self._claims}"

    def query(self, topic: str, payload: bytes = b"", by: str | None = None) -> bytes:
        answers: list[bytes] = []

        def answered() -> bool:
            key = topics.key(topic, "aero", role="plant")
            replies = self._session.get(key, payload=payload, timeout=PATIENCE_S, attachment=by)
            answers.extend(reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)
            return bool(answers)

        eventually(f"an answer to {topic}", answered)
        return answers[0]

    def ask(self, topic: str, request: Message | None = None, by: str | None = None) -> Answer:
        return Answer.model_validate_json(self.query(topic, (request or Request()).encode(), by))

    def claim(self, *, auto_arm: bool = True, wire: WireSpec = WIRE) -> Grant | Refusal:
        """Claim the plant as controller `a`, each time for another session."""
        self._claims += 1
        claim = claim_of(wire=wire, period_ns=self._period_ns, auto_arm=auto_arm, session=self.session)
        payload = self.query("claim", claim.encode())
        return (Refusal if b"reason" in payload else Grant).model_validate_json(payload)

    def refusal(self, *, auto_arm: bool = True) -> str:
        refused = self.claim(auto_arm=auto_arm)
        assert isinstance(refused, Refusal)
        return refused.reason


# ── a driver's loop on a scripted link and network, in the time of a fake clock ──


RUN = 0x0123_4567_89AB_CDEF


class Wires(Link):
    """Frames on their way to the plant, each due at a tick; the newest that is due is taken."""

    def __init__(self, clock: FakeClock, answer: Callable[[bytes], None]) -> None:
        self.tick = -1
        self._clock = clock
        self.sent: list[bytes] = []
        self.answer = answer
        self._due: list[tuple[int, bytes]] = []

    def deliver(self, frame: bytes, tick: int) -> None:
        self._due.append((tick, frame))

    def send(self, frame: bytes) -> None:
        self.sent.append(frame)
        self.answer(frame)

    @property
    def pending(self) -> bool:
        return any(tick <= self.tick for tick, _ in self._due)

    def take(self) -> Arrival | None:
        due = [frame for tick, frame in self._due if tick <= self.tick]
        self._due = [(tick, frame) for tick, frame in self._due if tick > self.tick]
        return Arrival(due[-1], self._clock.monotonic_ns()) if due else None

    def wait(self, timeout_s: float) -> Arrival | None:
        del timeout_s
        return self.take()

    def close(self) -> None:
        self._due.clear()


class Stage(PlantNetwork):
    """Runs the driver of the plant `made`, an emulator's unless given, to a tick.

    `between` is called between ticks, `answer` with every measurement that is sent (UNCHANGED in lockstep only), and
    `skip` gives the ticks to skip before the next. `sent` are the measurements, `wires` the way of the commands.
    """

    def __init__(
        self,
        loop: LoopSettings,
        wire: WireSpec,
        plant: PlantSettings,
        *,
        between: Callable[[Stage], None] = lambda _: None,
        answer: Callable[[Stage, bytes], None] = lambda *_: None,
        skip: Callable[[], int] = lambda: 0,
        made: Plant | None = None,
    ) -> None:
        super().__init__()
        self.stop, self.clock = threading.Event(), FakeClock()
        self.loop, self.wire = loop, wire
        self.endpoint = plant.endpoint(made or plant.make(loop.period), loop, wire)
        self.wires = Wires(self.clock, lambda frame: answer(self, frame))
        self._published: deque[bytes] = deque()
        self.trace = PlantTrace(wire, self._published.append, RUN, self.clock)
        self._between, self._skip = between, skip
        self._claims = 0
        self._ends = 0

    def run(self, ticks: int, answer_timeout_s: float = -1.0) -> Self:
        """Run to a tick. In lockstep nothing comes by waiting, unless a longer time-out is given."""
        self._ends = ticks
        with patch("aeroloop.plant_emulator.hosts.driver.ANSWER_TIMEOUT_S", answer_timeout_s):
            Driver(self.endpoint, self, self.loop, self.stop, self.clock).run()
        return self

    @property
    def batches(self) -> list[Batch]:
        batches = [read_batch(payload) for payload in self._published]
        assert None not in batches
        return [batch for batch in batches if batch is not None]

    def claim(self, *, auto_arm: bool = True) -> Grant | Refusal:
        self._claims += 1
        of_loop: dict[str, Any] = {"period_ns": self.loop.period_ns, "lockstep": self.loop.lockstep}
        return self.endpoint.claim(
            claim_of("c", wire=self.wire, auto_arm=auto_arm, session=f"s{self._claims}", **of_loop)
        )

    def command(self, measurement: bytes, codes: Sequence[float]) -> None:
        counter = self.wire.measurement.counter(measurement)
        assert counter is not None
        self.wires.deliver(self.wire.command.pack(counter, codes), self.endpoint.ticked)

    @property
    def link(self) -> Link | None:
        return self.wires if self.endpoint.session is not None else None

    def serve(self) -> None:
        """Nothing to declare."""

    def take_inbox(self) -> None:
        self._between(self)
        if skipped := self._skip():
            self.clock.advance((skipped + 0.5) * self.loop.period)
        self.follow_session()

    def wait_for_inbox(self, timeout_s: float) -> None:
        self.clock.sleep(timeout_s)

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        self.trace.row(self.endpoint, measurement, arrival, sent_ns)
        self.wires.tick = self.endpoint.ticked
        self.follow_session()
        if self.endpoint.ticked >= self._ends:
            self.stop.set()

    def follow_session(self) -> None:
        self.trace.follow(self.endpoint)
        if self.endpoint.session is None:
            self.wires.close()

    def publish_status(self) -> None:
        """Nobody reads it."""

    def leave(self) -> None:
        self.follow_session()
        self.trace.finish()
