"""Plant ends under test: a claim for one, a plant that records its voltages, and queries to one on Zenoh."""

from __future__ import annotations

from collections.abc import Sequence

import zenoh

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Grant, Refusal
from aeroloop.protocol.messages.operator import Answer, Message, Request
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import IDENTITY, Vector
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.zenoh_network import PATIENCE_S, eventually

PERIOD_NS = 2_000_000
WIRE = WireSpec()
COUNTERS = WIRE.measurement.counters
OFF = (0.0, 0.0)
AT_REST: Vector = (0.0, 0.0, 0.0)
REST = Measurement(IDENTITY, AT_REST)


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

    def claim(self, *, auto_arm: bool = True) -> Grant | Refusal:
        """Claim the plant as controller `a`, each time for another session."""
        self._claims += 1
        claim = claim_of(period_ns=self._period_ns, auto_arm=auto_arm, session=self.session)
        payload = self.query("claim", claim.encode())
        return (Refusal if b"reason" in payload else Grant).model_validate_json(payload)

    def refusal(self, *, auto_arm: bool = True) -> str:
        refused = self.claim(auto_arm=auto_arm)
        assert isinstance(refused, Refusal)
        return refused.reason
