"""Claims, freshness of commands, watchdog and latch, against a model that has the tick of every measurement.

The model is SPEC.md, sections 5 and 6: it predicts every state of the table, every event and the voltages of every
period. It holds for both ends that judge commands: the plant's Endpoint, and the Relay of a CAN bridge, through which
the same measurements and commands pass.

A short counter of 16 ticks and a watchdog of 5, so that counters wrap often.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import nan

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, VehicleClaim
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.models import Grant, Refusal
from aeroloop.protocol.messages.states import PLANT_TABLE, PlantState, PlantTrigger, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.plant_end import OFF, PERIOD_NS, REST, RecordingPlant, claim_of

COUNTERS, WATCHDOG = 16, 5
FIRST_COMMAND = COUNTERS - 1
"""Before the counter is back at 0."""
WIRE = WireSpec(counter_bits=4)
LEVEL = WIRE.voltage.quantizer().level
BLIND = Measurement(IDENTITY, (nan, 0.0, 0.0))
INVALID = -32
"""Code of "no valid value"."""


class EndpointEnd:
    """An Endpoint, with the voltages of every period."""

    judges_values = True
    """Whether a command without a valid value trips if it answers a measurement with one."""

    def __init__(self, watchdog: int = WATCHDOG, *, armed: bool = False) -> None:
        self.plant = RecordingPlant()
        self._endpoint = Endpoint(self.plant, WIRE, PERIOD_NS, watchdog_s=watchdog * PERIOD_NS * 1e-9, armed=armed)
        self._endpoint.tick(None, 0)
        self.claims: VehicleClaim = self._endpoint

    def tick(self, frame: bytes | None, ticks: int) -> tuple[bool, list[tuple[float, ...]]]:
        """Receive a command, then measure so many ticks later. Whether it measured; voltages of the periods."""
        self.plant.periods.clear()
        measured = self._endpoint.tick(frame, self._endpoint.ticked + ticks)
        assert self.plant.voltages == self.claims.voltages
        return measured is not None, self.plant.periods


class RelayEnd:
    """A bridge to which a plant's measurements and a controller's commands come as to an endpoint, tick by tick."""

    judges_values = False

    def __init__(self, watchdog: int = WATCHDOG, *, armed: bool = False) -> None:
        self.plant = RecordingPlant()  # it stands behind the bus, and is not seen
        self._relay = Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=watchdog * PERIOD_NS * 1e-9, armed=armed)
        self.claims: VehicleClaim = self._relay
        self._number = self._now_ns = 0
        self._measured = -1  # tick of the last measurement since the session's first

    def tick(self, frame: bytes | None, ticks: int) -> tuple[bool, list[tuple[float, ...]]]:
        """Receive a command, look at the clock in every period, then receive a measurement."""
        relay, held = self._relay, list[tuple[float, ...]]()
        if relay.number != self._number:
            self._number, self._measured = relay.number, -ticks
        if frame is not None:
            relay.command(frame, self._now_ns)
        for _ in range(ticks):
            if self._measured >= 0:
                relay.watch(self._now_ns)
            held.append(relay.voltages)
            self._now_ns += PERIOD_NS
        self._measured += ticks
        measured = relay.measurement(WIRE.measurement.pack(self._measured % COUNTERS, [0] * 6), self._now_ns)
        if self._measured == 0:
            relay.watch(self._now_ns)
        return measured is not None, held


ENDS = [EndpointEnd, RelayEnd]
names = st.sampled_from("ab")
KINDS = ["fresh", "fresh", "fresh", "no valid value", "late", "again", "malformed", "nothing", "blind", "recover"]
frames = st.tuples(
    st.sampled_from(KINDS), st.integers(-31, 31), st.integers(1, COUNTERS - 1), st.sampled_from([1, 1, 1, 2, 4])
)
"""What is received, its voltage, the age of the measurement that it answers, ticks until the next."""


class PlantEnd(RuleBasedStateMachine):
    """The model beside an end: both come to the same, whatever happens."""

    make: Callable[[], EndpointEnd | RelayEnd]

    def __init__(self) -> None:
        super().__init__()
        self.end = self.make()
        self.k = 0
        self.state = PlantState.IDLE
        self.latched, self.stopped = True, False  # not armed when it starts
        self.trip: TripCause | None = None
        self.holder: str | None = None
        self.first = 0  # tick of the session's first measurement
        self.sent: dict[int, bool] = {}  # by tick of this session, whether its measurement was valid
        self.answered = -1  # tick of the measurement that the last fresh command answered
        self.age = 0  # periods since that command, or since the first measurement
        self.voltages: tuple[float, ...] = OFF
        self.refused = self.stale = 0
        self.events: list[str] = []

    # ── the model ──

    def fire(self, trigger: PlantTrigger) -> None:
        """Follow the table; a KeyError here is a bug of this model."""
        self.state = PLANT_TABLE[self.state, trigger]

    def ended(self, trigger: PlantTrigger, kind: str) -> None:
        self.fire(trigger)
        self.events.append(kind)
        self.holder, self.voltages, self.sent = None, OFF, {}

    def tripped(self, cause: TripCause) -> None:
        self.ended(PlantTrigger.TRIP, "tripped")
        self.latched, self.trip = True, cause

    def armed(self) -> None:
        self.fire(PlantTrigger.ARM)
        self.latched, self.trip = False, None

    def tick(self, frame: bytes | None, ticks: int, outcome: Outcome = Outcome.NONE) -> None:
        """A tick of both; the model has already taken the frame."""
        expected = []
        running = self.holder is not None
        for _ in range(ticks):
            limit = {PlantState.GRANTED: FIRST_COMMAND, PlantState.DRIVEN: WATCHDOG}.get(self.state)
            self.age += 1
            if limit is not None and self.sent and self.age > limit:
                self.tripped(TripCause.COMMAND_TIMEOUT)
            expected.append(self.voltages)
        self.k += ticks
        measured, held = self.end.tick(frame, ticks)
        assert held == expected
        assert measured == (self.holder is not None)
        if measured:
            if not self.sent:
                self.first, self.age = self.k, 0
            self.sent[self.k] = self.end.plant.now is REST
            assert self.end.claims.counter == (self.k - self.first) % COUNTERS
            assert self.end.claims.answered == (self.answered - self.first if self.answered >= self.first else -1)
        if running and (measured or outcome is not Outcome.INVALID):
            assert self.end.claims.outcome is outcome
        self.it_is_where_the_table_led()

    def commanded(self, answers: int, pair: tuple[int, int], ticks: int) -> None:
        """A command that answers the measurement of a tick."""
        valid = INVALID not in pair
        if answers <= self.answered:
            outcome = Outcome.REPEATED
        elif self.k - answers > WATCHDOG:
            outcome = Outcome.STALE
            self.stale += 1
        elif not valid and self.sent[answers] and self.end.judges_values:
            outcome = Outcome.INVALID
            self.tripped(TripCause.INVALID_COMMAND)
        else:
            outcome = Outcome.ACTED
            self.fire(PlantTrigger.COMMAND)
            self.voltages = (LEVEL(pair[0]), LEVEL(pair[1])) if valid else OFF
            self.answered, self.age = answers, 0
        self.tick(WIRE.command.pack((answers - self.first) % COUNTERS, pair), ticks, outcome)

    # ── what happens ──

    @rule(name=names, auto_arm=st.booleans())
    def a_controller_claims(self, name: str, auto_arm: bool) -> None:
        before, answer = self.holder, self.end.claims.claim(claim_of(name, wire=WIRE, auto_arm=auto_arm))
        if before is None and auto_arm and not self.stopped:
            self.armed()
        if before is not None or self.latched:
            assert isinstance(answer, Refusal)
            assert answer.holder == before
            assert (before or "aeroloop op arm") in answer.reason
            return
        assert answer == Grant(session=f"of-{name}")
        self.fire(PlantTrigger.GRANT)
        self.events.append("claimed")
        self.holder, self.voltages = name, OFF
        self.first, self.answered, self.age = self.k + 1, -1, -1

    @rule(name=names, frames=st.lists(frames, min_size=1, max_size=20))
    def a_controller_claims_and_drives(self, name: str, frames: Sequence[tuple[str, int, int, int]]) -> None:
        """Or goes on with a session that runs. Many at once, or few sessions would get beyond their start."""
        if self.holder is None:
            self.a_controller_claims(name, True)
        self.tick(None, 1)
        for frame in frames:
            self.a_frame_is_received(frame)

    @rule(frame=frames)
    def a_frame_is_received(self, frame: tuple[str, int, int, int]) -> None:
        """A command or none; where there is no measurement to answer, none."""
        kind, code, ago, ticks = frame
        if kind in ("blind", "recover"):
            self.end.plant.now = REST if kind == "recover" else BLIND
        if kind in ("fresh", "no valid value") and self.k in self.sent:
            self.commanded(self.k, (code, INVALID) if kind == "no valid value" else (code, -code), ticks)
        elif kind == "late" and self.k - ago in self.sent:
            self.commanded(self.k - ago, (code, -code), ticks)
        elif kind == "again" and self.answered in self.sent:
            self.commanded(self.answered, (code, -code), ticks)
        elif kind == "malformed":
            self.refused += self.holder is not None
            frame_bytes = (b"", b"\x00", bytes(WIRE.command.size + 1))[ago % 3]
            self.tick(frame_bytes, ticks, Outcome.MALFORMED if self.holder is not None else Outcome.NONE)
        elif self.holder is None:
            self.tick(WIRE.command.pack(ago, (code, code)), ticks)  # nobody may drive it
        else:
            self.tick(None, ticks)

    @rule(ticks=st.sampled_from([n + few for n in (WATCHDOG, FIRST_COMMAND) for few in (-1, 0, 1)] + [10 * COUNTERS]))
    def nothing_is_received_for_long(self, ticks: int) -> None:
        self.tick(None, ticks)

    @rule(name=names, what=st.sampled_from(["arm", "stop", "release", "lost", "expire", "claim of another period"]))
    def another_change(self, name: str, what: str) -> None:
        """One rule for all of them, so that a session now and then lives for long."""
        claims = self.end.claims
        if what == "arm":
            assert claims.arm() == (self.holder is None)
            if self.holder is None:
                self.armed()
                self.stopped = False
                self.events.append("armed")
        elif what == "stop":
            was_tripped, stopped, self.stopped = self.state is PlantState.TRIPPED, self.stopped, True
            claims.stop()
            if not was_tripped:
                self.tripped(TripCause.OPERATOR)
            elif not stopped:
                self.events.append("changed")
        elif what == "release":
            assert claims.release(f"of-{name}") == (name == self.holder)
            if name == self.holder:
                self.ended(PlantTrigger.RELEASE, "released")
        elif what == "lost":
            claims.lost(name)
            if name == self.holder:
                self.tripped(TripCause.HOLDER_GONE)
        elif what == "expire":
            claims.expire(TripCause.NO_ANSWER, "no answer for 2 s")
            if self.holder is not None:
                self.tripped(TripCause.NO_ANSWER)
        else:  # it clears no latch
            refused = claims.claim(claim_of(name, wire=WIRE, period_ns=PERIOD_NS + 1))
            assert isinstance(refused, Refusal)
            assert refused.differences == [f"period_ns: {PERIOD_NS}, not {PERIOD_NS + 1}"]

    # ── what holds after each step ──

    @invariant()
    def it_is_where_the_table_led(self) -> None:
        claims = self.end.claims
        assert (claims.state, claims.trip, claims.cause is not None) == (self.state, self.trip, self.latched)
        session = None if self.holder is None else f"of-{self.holder}"
        assert (claims.holder, claims.session) == (self.holder, session)
        assert [notice.kind for notice in claims.notices] == self.events
        assert (claims.refused, claims.stale) == (self.refused, self.stale)
        assert claims.operator_only == self.stopped


class OfEndpoint(PlantEnd):
    """The plant endpoint."""

    make = EndpointEnd


class OfRelay(PlantEnd):
    """The relay between network and CAN bus."""

    make = RelayEnd


TestEndpoint, TestRelay = OfEndpoint.TestCase, OfRelay.TestCase
TestEndpoint.settings = TestRelay.settings = settings(max_examples=80, stateful_step_count=40)


@pytest.mark.parametrize("end", ENDS)
@settings(max_examples=30)
@example(delay=WATCHDOG)
@example(delay=WATCHDOG + 1)
@given(delay=st.integers(0, 5 * COUNTERS))
def test_a_stream_that_is_late_for_good_drives_within_the_watchdogs_time_and_never_beyond(
    end: Callable[..., EndpointEnd | RelayEnd], delay: int
) -> None:
    """Also where its echoes look fresh, because the counter has come round: by then the session is over."""
    it = end(armed=True)
    assert acted(it, delay) == (delay <= WATCHDOG)
    assert (it.claims.trip is TripCause.COMMAND_TIMEOUT) == (delay > WATCHDOG)


@pytest.mark.parametrize("end", ENDS)
def test_a_command_that_answers_no_measurement_of_this_session_does_not_drive(
    end: Callable[..., EndpointEnd | RelayEnd],
) -> None:
    it = end(armed=True)
    it.tick(None, 5)
    assert isinstance(it.claims.claim(claim_of(wire=WIRE)), Grant)
    it.tick(None, 1)  # the measurement with counter 0, the only one that there is to answer
    it.tick(WIRE.command.pack(COUNTERS - 2, (31, 31)), 1)  # by its echo 2 ticks old
    assert it.claims.state is PlantState.GRANTED


def acted(it: EndpointEnd | RelayEnd, delay: int) -> bool:
    """Whether any command of a stream acts that answers every measurement so many ticks late."""
    assert isinstance(it.claims.claim(claim_of(wire=WIRE)), Grant)
    it.tick(None, 1)
    outcomes = []
    for now in range(delay + 3 * COUNTERS):
        frame = WIRE.command.pack((now - delay) % COUNTERS, (3, 0)) if now >= delay else None
        it.tick(frame, 1)
        outcomes.append(it.claims.outcome)
    return Outcome.ACTED in outcomes
