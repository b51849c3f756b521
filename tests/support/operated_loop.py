"""A controller's loop with operator changes, without network and clock.

A real Node on a double of the network: outgoing messages are kept as bytes, incoming ones are fed through the declared
callbacks. Time stands still unless the test moves `Loop.clock`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import atan2, degrees, radians, sin
from types import SimpleNamespace
from typing import Any, TypeVar

import pytest
import zenoh
from zenoh.handlers import RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, SessionRecord
from aeroloop.protocol.messages.operator import Answer, Change, Gains, Hold, Message, Reference, Setpoint, Sinusoid
from aeroloop.protocol.messages.trace import TraceWriter
from aeroloop.protocol.runtime import node
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.daemon.operator_changes import SETPOINTS, OperatorChanges
from aeroloop.service.settings import ControllerSettings
from tests.support.clock import FakeClock

PERIOD = 0.002
LAW = AdaptiveSettings()
LEVEL = Hold(attitude=(0.0, 0.0, 0.0))
SWING = Sinusoid(amplitude=(0.0, 5.0, 20.0), frequency=(0.0, 0.5, 0.4))
CONFIGURED = ControllerSettings(after_restart="configured")  # which session begins with what: test_operator_changes.py
WIRE = WireSpec(
    attitude=SignalSpec(bits=None, limit=1.0),
    rate=SignalSpec(bits=None, limit=5.0),
    voltage=SignalSpec(bits=None, limit=1e9),
)  # unquantized and hardly limited: a command says the last bit of what the law computes
AT_REST = [0.0] * 6
M = TypeVar("M", bound=Message)


def measured(k: int, codes: list[float] | None = None) -> bytes:
    """The measurement of tick k: at rest and level unless given."""
    return WIRE.measurement.pack(k % WIRE.measurement.counters, codes or AT_REST)


def turned(yaw: float) -> list[float]:
    attitude, rate = WIRE.attitude.quantizer(), WIRE.rate.quantizer()
    return [*(attitude.encode(x) for x in (0.0, 0.0, sin(radians(yaw) / 2))), *(rate.encode(0.0) for _ in range(3))]


def _bytes(payload: bytes) -> SimpleNamespace:
    return SimpleNamespace(to_bytes=lambda: payload)  # as Zenoh hands them over


class Query:
    """What a queryable is called with; keeps what it is answered."""

    def __init__(self, key: str, payload: bytes) -> None:
        self.key_expr, self.payload, self.attachment = key, _bytes(payload), None
        self.replies: list[bytes] = []

    @property
    def answers(self) -> list[Answer]:
        return [Answer.model_validate_json(payload) for payload in self.replies]

    def reply(self, key: str, payload: bytes) -> None:
        assert zenoh.KeyExpr(self.key_expr).includes(zenoh.KeyExpr(key))
        self.replies.append(payload)

    def drop(self) -> None:
        """No further answer will come."""


class Network:
    def __init__(self) -> None:
        self.put: list[tuple[str, bytes]] = []
        self.queryables: dict[str, Callable[[Any], None]] = {}
        self.received: dict[str, deque[SimpleNamespace]] = {}

    def declare_queryable(self, key: str, callback: Callable[[Any], None], *, complete: bool) -> None:
        assert complete
        self.queryables[key] = callback

    def declare_subscriber(self, key: str, ring: RingChannel[Any]) -> SimpleNamespace:
        assert isinstance(ring, RingChannel)
        waiting = self.received[key] = deque[SimpleNamespace](maxlen=SETPOINTS)
        return SimpleNamespace(try_recv=lambda: waiting.popleft() if waiting else None)

    def close(self) -> None:
        """Nothing to close."""


class LonelyNode(Node):
    def declare(self, topic: str, *, lossless: bool = False) -> None:
        del lossless
        network: Any = self.zenoh
        key = topics.key(topic, self.vehicle, role=self.role)
        publisher: Any = SimpleNamespace(id=None, put=lambda payload: network.put.append((key, payload)))
        self._publishers[topic] = publisher


class Loop:
    """What the daemon does around OperatorChanges; `log` has each session's ticks, measurements and commands."""

    def __init__(
        self, reference: Reference, settings: ControllerSettings = CONFIGURED, *, wire: WireSpec = WIRE
    ) -> None:
        self.clock = FakeClock()
        with pytest.MonkeyPatch.context() as patch:
            self.network = Network()
            patch.setattr(node, "join", lambda *_: self.network)
            self.role = LonelyNode("controller", "aero", NetworkSettings(), {}, name="controller-7", clock=self.clock)
        self.configured, self.wire = reference, wire
        self.trace = TraceWriter("controller", wire, 1)
        configured = Settings(law=LAW, reference=reference, controller=settings, wire=wire)
        self.live = OperatorChanges(self.role, configured, self.trace, lambda: "controller-7 does not have aero")
        self.live.serve()
        self.controller = self.fresh()
        self.k, self.session = 0, ""
        self.log: dict[str, list[tuple[int, bytes, bytes | None]]] = {}

    def fresh(self, reference: Reference | None = None) -> Controller:
        return Controller(self.wire, LAW, reference or self.configured, PERIOD)

    # The loop

    def begin(self, last: SessionRecord | None = None) -> None:
        """A session is granted, with the plant's record of the one before."""
        self.session = f"s{len(self.log)}"
        self.log[self.session] = []
        self.controller, self.k = self.fresh(), 0
        self.live.begin(self.controller, self.session, last)

    def end(self) -> None:
        self.live.end()
        self.session = ""

    def tick(self, codes: list[float] | None = None) -> bytes | None:
        """A measurement comes, at rest and level unless given, and is answered."""
        frame = measured(self.k, codes)
        self.live.before_tick(self.k, frame)
        command = self.controller.tick(frame, self.k)
        self.log[self.session].append((self.k, frame, command))
        self.k += 1
        return command

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.tick()

    def malformed(self) -> None:
        self.live.before_tick(self.k, b"junk")
        assert self.controller.tick(b"junk", self.k) is None

    # The operator

    def ask(self, topic: str, message: Message | bytes) -> Query:
        key = topics.key(topic, "aero")
        query = Query(key, message if isinstance(message, bytes) else message.encode())
        self.network.queryables[key](query)
        return query

    def answered(self, topic: str, message: Message | bytes) -> Answer:
        query = self.ask(topic, message)
        self.tick()
        (answer,) = query.answers
        return answer

    def stream(self, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> None:
        self.raw(Setpoint(attitude=(roll, pitch, yaw)).encode())

    def raw(self, payload: bytes) -> None:
        self.network.received[topics.key("reference", "aero")].append(SimpleNamespace(payload=_bytes(payload)))

    # What was published

    def published(self, topic: str, model: type[M]) -> list[M]:
        key = topics.key(topic, "aero", role="controller")
        return [model.model_validate_json(payload) for at, payload in self.network.put if at == key]

    def changes(self) -> list[Change]:
        return [change for change in self.trace.changes if change.session == self.session]

    def events(self, kind: str) -> list[str]:
        return [event.text for event in self.published("event", Event) if event.kind == kind]

    def yaw(self) -> float:
        w, x, y, z = self.controller.desired
        assert (x, y) == (0.0, 0.0)
        return degrees(2 * atan2(z, w))

    def assert_it_runs_again(self) -> None:
        """From the configuration, the frames and the changes, as the review does: byte for byte."""
        for session, ticks in self.log.items():
            again = self.fresh()
            logged = [change.encode() for change in self.trace.changes if change.session == session]
            changes = [Change.model_validate_json(text) for text in logged]
            for k, frame, command in ticks:
                while changes and changes[0].tick <= k:
                    again.apply(changes.pop(0))
                assert again.tick(frame, k) == command, f"{session}, tick {k}"


def gains_with(**changed: tuple[float, float, float]) -> Gains:
    return Gains.model_validate({"C1": LAW.C1, "C2": LAW.C2, "Gamma": LAW.Gamma, **changed})
