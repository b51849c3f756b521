"""State tables of both ends, and a plant end that follows one.

tests/plant_emulator/endpoint/test_limits.py drives a plant end at random and checks its states. Here a model from
SPEC.md, sections 5 and 6, predicts every step: which triggers fire, and the next state in the table.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from enum import StrEnum
from math import nan
from typing import Final

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import Claim, Grant, Refusal
from aeroloop.protocol.messages.states import (
    CONTROLLER_TABLE,
    PLANT_TABLE,
    ControllerState,
    ControllerTrigger,
    Machine,
    PlantState,
    PlantTrigger,
    TripCause,
)
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.spec import WireSpec

# The tables


def reached(start: ControllerState, without: ControllerTrigger | None = None) -> set[ControllerState]:
    """Every state of a controller that can be reached, the first included, without one of the triggers."""
    found, fresh = {start}, {start}
    while fresh:
        edges = CONTROLLER_TABLE.items()
        fresh = {after for (state, trigger), after in edges if state in fresh and trigger is not without} - found
        found |= fresh
    return found


@pytest.mark.parametrize(
    ("table", "states", "triggers"),
    [(PLANT_TABLE, PlantState, PlantTrigger), (CONTROLLER_TABLE, ControllerState, ControllerTrigger)],
)
def test_a_machine_goes_where_its_table_says_and_nowhere_else(
    table: Mapping[tuple[StrEnum, StrEnum], StrEnum], states: type[StrEnum], triggers: type[StrEnum]
) -> None:
    for state in states:
        for trigger in triggers:
            machine = Machine(state, table)
            if (state, trigger) in table:
                assert machine.fire(trigger) is machine.state is table[state, trigger]
            else:
                with pytest.raises(ValueError, match=f"{state}.*{trigger}"):
                    machine.fire(trigger)
                assert machine.state is state


def test_any_plant_can_be_tripped_only_arming_clears_it_and_only_a_granted_one_is_driven() -> None:
    edges = PLANT_TABLE.items()
    assert {state for (state, trigger), after in edges if trigger is PlantTrigger.TRIP} == set(PlantState)
    assert {after for (_, trigger), after in edges if trigger is PlantTrigger.TRIP} == {PlantState.TRIPPED}
    out = {trigger for (state, trigger), after in edges if state is PlantState.TRIPPED is not after}
    assert out == {PlantTrigger.ARM}
    into = {goal: {edge for edge, after in edges if after is goal} for goal in (PlantState.GRANTED, PlantState.DRIVEN)}
    assert into == {
        PlantState.GRANTED: {(PlantState.IDLE, PlantTrigger.GRANT)},
        PlantState.DRIVEN: {(state, PlantTrigger.COMMAND) for state in (PlantState.GRANTED, PlantState.DRIVEN)},
    }


def test_a_controller_stands_down_from_any_state_and_has_a_vehicle_only_by_a_grant() -> None:
    aside = {ControllerState.HOLDING, ControllerState.FAULTED}
    driving = {ControllerState.CLAIMED, ControllerState.READY, ControllerState.RUNNING}
    for state in ControllerState:
        assert CONTROLLER_TABLE[state, ControllerTrigger.STAND_DOWN] is ControllerState.HOLDING
        assert reached(state) == set(ControllerState)  # none is without a way back
    for state in aside:
        assert reached(state, without=ControllerTrigger.RECALL) <= aside
        assert CONTROLLER_TABLE[state, ControllerTrigger.RECALL] is ControllerState.SEARCHING
    assert not reached(ControllerState.SEARCHING, without=ControllerTrigger.GRANT) & driving


# The plant end, foretold

WIRE = WireSpec()
COUNTERS: Final = WIRE.measurement.counters
PERIOD_NS = 20_000_000
WATCHDOG_PERIODS = 5
"""0.1 s of 20 ms."""
FIRST_COMMAND_PERIODS = 50
"""1 s of 20 ms."""
OFF = (0.0, 0.0)
REST = Measurement(IDENTITY, (0.0, 0.0, 0.0))
BLIND = Measurement((nan, nan, nan, nan), (0.0, 0.0, 0.0))
LEVEL = WIRE.voltage.quantizer().level
INVALID = -32
NO_COMMANDS = [(INVALID, INVALID), (INVALID, 3), (3, INVALID)]
NO_VALID_VALUE = (-128,) * 6


class RecordingPlant(Plant):
    """A plant that reports a preset measurement and records the voltages of every period."""

    actuators = 2

    def __init__(self) -> None:
        self.voltages: tuple[float, ...] = OFF
        self.held: list[tuple[float, ...]] = []
        self.seen = REST

    def actuate(self, voltages: Sequence[float]) -> None:
        self.voltages = tuple(voltages)

    def advance(self) -> None:
        self.held.append(self.voltages)

    def measure(self) -> Measurement:
        return self.seen

    def close(self) -> None:
        self.voltages = OFF


def claim(name: str, session: str, *, auto_arm: bool, period_ns: int = PERIOD_NS) -> Claim:
    return Claim(controller=name, session=session, period_ns=period_ns, lockstep=False, auto_arm=auto_arm, wire=WIRE)


names = st.sampled_from(["ann", "bob"])
codes = st.tuples(st.integers(-31, 31), st.integers(-31, 31))
steps = st.sampled_from([1, 1, 1, 2, 4])
"""Ticks from one that is taken to the next: sometimes some are missed."""
KINDS = ["fresh", "fresh", "fresh", "no valid value", "late", "again", "malformed", "nothing", "blind", "recover"]
frames = st.tuples(st.sampled_from(KINDS), codes, st.integers(1, COUNTERS - 1), steps)
"""What comes, its voltages, how many ticks ago that was measured which it answers, ticks until the next."""


class ForetoldPlantEnd(RuleBasedStateMachine):
    """A model beside the real thing: the same must come of both, whatever happens."""

    def __init__(self) -> None:
        super().__init__()
        self.plant = RecordingPlant()
        self.endpoint = Endpoint(self.plant, WIRE, PERIOD_NS)
        self.endpoint.tick(None, 0)
        self.k = 0
        self.state = PlantState.IDLE
        self.latched, self.stopped = True, False  # not armed when it starts
        self.trip: TripCause | None = None
        self.holder: str | None = None
        self.session: str | None = None
        self.sessions = 0
        self.first = 0  # tick of the session's first measurement
        self.sent: dict[int, bool] = {}  # by tick of this session, whether its measurement was valid
        self.answered = -1  # tick of the measurement that the last fresh command answered
        self.age = 0  # periods since that command, or since the first measurement
        self.voltages: tuple[float, ...] = OFF
        self.accepted = self.refused = self.stale = 0
        self.held: list[tuple[float, ...]] = []
        self.reported: list[str] = []

    # The model

    def fire(self, *triggers: PlantTrigger) -> None:
        """Follow the table; a KeyError here is a bug of this model."""
        for trigger in triggers:
            self.state = PLANT_TABLE[self.state, trigger]

    def ended(self, trigger: PlantTrigger, kind: str) -> None:
        self.fire(trigger)
        self.reported.append(kind)
        self.holder = self.session = None
        self.voltages, self.sent = OFF, {}

    def tripped(self, cause: TripCause) -> None:
        self.ended(PlantTrigger.TRIP, "tripped")
        self.latched, self.trip = True, cause

    def armed(self) -> None:
        self.fire(PlantTrigger.ARM)
        self.latched, self.trip = False, None

    def tick(self, frame: bytes | None, ticks: int) -> None:
        """A tick of both; the model has already taken the frame."""
        for _ in range(ticks):
            limit = {PlantState.GRANTED: FIRST_COMMAND_PERIODS, PlantState.DRIVEN: WATCHDOG_PERIODS}.get(self.state)
            self.age += 1
            if limit is not None and self.sent and self.age > limit:
                self.tripped(TripCause.COMMAND_TIMEOUT)
            self.held.append(self.voltages)
        self.k += ticks
        sent = self.endpoint.tick(frame, self.k)
        assert (sent is not None) == (self.session is not None)
        if sent is not None:
            valid = self.plant.seen is REST
            if not self.sent:
                self.first = self.k  # the first measurement has counter 0, also where ticks were skipped before it
                self.age = 0
            assert WIRE.measurement.unpack(sent) == (
                (self.k - self.first) % COUNTERS,
                (0,) * 6 if valid else NO_VALID_VALUE,
            )
            self.sent[self.k] = valid
        assert (self.plant.voltages, self.plant.held) == (self.voltages, self.held)
        self.both_agree()

    def commanded(self, answers: int, pair: tuple[int, int], ticks: int) -> None:
        """A command that answers the measurement of a tick."""
        newer = answers > self.answered
        if newer and self.k - answers > WATCHDOG_PERIODS:
            newer, self.stale = False, self.stale + 1
        if newer and INVALID in pair and self.sent[answers]:
            self.tripped(TripCause.INVALID_COMMAND)
        elif newer:
            self.fire(PlantTrigger.COMMAND)
            self.voltages = OFF if INVALID in pair else (LEVEL(pair[0]), LEVEL(pair[1]))
            self.answered, self.age = answers, 0
            self.accepted += 1
        self.tick(WIRE.command.pack((answers - self.first) % COUNTERS, pair), ticks)

    # What happens

    @rule(name=names, auto_arm=st.booleans())
    def somebody_claims(self, name: str, auto_arm: bool) -> None:
        self.claims(name, auto_arm=auto_arm)

    def claims(self, name: str, *, auto_arm: bool) -> None:
        """A claim that fits."""
        self.sessions += 1
        session = f"{name}-{self.sessions}"
        before = self.holder
        answer = self.endpoint.claim(claim(name, session, auto_arm=auto_arm))
        if before is not None:
            assert isinstance(answer, Refusal)
            assert answer.holder == before
            return
        if auto_arm and not self.stopped:
            self.armed()
        if self.latched:
            assert isinstance(answer, Refusal)
            assert "aeroloop op arm" in answer.reason
            return
        assert answer == Grant(session=session)
        self.fire(PlantTrigger.GRANT)
        self.reported.append("claimed")
        self.holder, self.session = name, session
        self.voltages = OFF
        self.first, self.answered, self.age = self.k + 1, -1, -1

    @rule(name=names, frames=st.lists(frames, min_size=1, max_size=20))
    def somebody_claims_and_drives(self, name: str, frames: list[tuple[str, tuple[int, int], int, int]]) -> None:
        """Or goes on with a session that runs. Many at once, or few sessions would get beyond their start."""
        if self.session is None:
            self.claims(name, auto_arm=True)
        self.tick(None, 1)
        for what, pair, ago, ticks in frames:
            self.comes(what, pair, ago, ticks)

    @rule(frame=frames)
    def one_frame_comes(self, frame: tuple[str, tuple[int, int], int, int]) -> None:
        self.comes(*frame)

    def comes(self, what: str, pair: tuple[int, int], ago: int, ticks: int) -> None:
        """With a frame or without; where there is no measurement to answer, without."""
        if what in ("blind", "recover"):
            self.plant.seen = REST if what == "recover" else BLIND
        if what in ("fresh", "no valid value") and self.k in self.sent:
            self.commanded(self.k, NO_COMMANDS[ago % 3] if what == "no valid value" else pair, ticks)
        elif what == "late" and self.k - ago in self.sent:
            self.commanded(self.k - ago, pair, ticks)
        elif what == "again" and self.session is not None and self.answered >= 0:
            self.tick(WIRE.command.pack((self.answered - self.first) % COUNTERS, pair), ticks)
        elif what == "malformed":
            self.refused += self.session is not None
            self.tick((b"", b"\x00", b"\x57\xe1\x0f")[ago % 3], ticks)
        else:
            self.tick(None, ticks)

    @rule(ticks=st.sampled_from([n + few for n in (WATCHDOG_PERIODS, FIRST_COMMAND_PERIODS) for few in (-1, 0, 1)]))
    def nothing_comes_for_long(self, ticks: int) -> None:
        self.tick(None, ticks)

    @rule(name=names, what=st.sampled_from(["arm", "stop", "release", "die", "expire", "claim another", "command"]))
    def somebody_meddles(self, name: str, what: str) -> None:
        """One rule for all of them, so that a session now and then lives for long."""
        getattr(self, what.replace(" ", "_"))(name)

    def arm(self, _: str) -> None:
        """An operator arms."""
        assert self.endpoint.arm() == (self.session is None)
        if self.session is None:
            self.armed()
            self.stopped = False
            self.reported.append("armed")

    def stop(self, _: str) -> None:
        """An operator stops."""
        was_tripped, trip = self.endpoint.state is PlantState.TRIPPED, self.endpoint.trip
        self.endpoint.stop()
        if not was_tripped:
            self.tripped(TripCause.OPERATOR)
        else:
            assert self.endpoint.trip is trip
            self.reported += [] if self.stopped else ["changed"]
        self.stopped = True

    def release(self, name: str) -> None:
        """The holder releases its session; any other controller releases one that is over."""
        mine = name == self.holder
        session = self.session if mine and self.session is not None else f"{name}-{self.sessions + 1}"
        assert self.endpoint.release(session) == mine
        if mine:
            self.ended(PlantTrigger.RELEASE, "released")

    def die(self, name: str) -> None:
        """A liveliness token goes."""
        self.endpoint.lost(name)
        if name == self.holder:
            self.tripped(TripCause.HOLDER_GONE)

    def expire(self, _: str) -> None:
        """Its owner ends the session, if there is one."""
        self.endpoint.expire(TripCause.NO_ANSWER, "no answer for 2 s")
        if self.session is not None:
            self.tripped(TripCause.NO_ANSWER)

    def claim_another(self, name: str) -> None:
        """A claim that is meant for a plant of another period arms nothing."""
        answer = self.endpoint.claim(claim(name, "other", auto_arm=True, period_ns=PERIOD_NS + 1))
        assert isinstance(answer, Refusal)
        assert answer.differences

    def command(self, _: str) -> None:
        """A command comes to a plant without a holder."""
        if self.session is None:
            self.tick(WIRE.command.pack(self.k % COUNTERS, (31, 31)), 1)

    # What holds after each step

    @invariant()
    def both_agree(self) -> None:
        end = self.endpoint
        assert (end.state, end.trip, end.session, end.holder) == (self.state, self.trip, self.session, self.holder)
        assert (end.session is not None) == (end.state in (PlantState.GRANTED, PlantState.DRIVEN))
        assert (end.accepted, end.refused, end.stale) == (self.accepted, self.refused, self.stale)
        assert [notice.kind for notice in end.notices] == self.reported

    @invariant()
    def without_permission_it_cannot_be_driven(self) -> None:
        """Tried on a copy: the next tick is at 0 V, and a claim is granted just when there is no cause against it."""
        assert (self.endpoint.cause is not None) == self.latched
        if self.endpoint.session is not None:
            return
        plant = copy.copy(self.endpoint.plant)
        assert isinstance(plant, RecordingPlant)
        plant.held = []  # a copy of all that was held at each step would be most of the work of this test
        endpoint = copy.deepcopy(self.endpoint, {id(self.endpoint.plant): plant, id(WIRE): WIRE})
        assert endpoint.plant is plant
        assert endpoint.tick(WIRE.command.pack(self.k % COUNTERS, (31, 31)), self.k + 1) is None
        assert (endpoint.plant.voltages, endpoint.plant.held[-1]) == (OFF, OFF)
        plainly = isinstance(endpoint.claim(claim("eve", "eve", auto_arm=False)), Grant)
        assert plainly == (endpoint.cause is None)
        if not plainly:
            assert isinstance(endpoint.claim(claim("eve", "eve", auto_arm=True)), Grant) == (not self.stopped)


TestForetoldPlantEnd = ForetoldPlantEnd.TestCase
TestForetoldPlantEnd.settings = settings(max_examples=40, stateful_step_count=40)


def test_a_command_that_answers_no_measurement_of_this_session_does_not_drive() -> None:
    endpoint = Endpoint(RecordingPlant(), WIRE, PERIOD_NS, armed=True)
    for k in range(100):
        endpoint.tick(None, k)
    endpoint.claim(claim("ann", "ann", auto_arm=False))
    endpoint.tick(None, 100)  # the measurement with counter 0, the only one that there is to answer
    endpoint.tick(WIRE.command.pack(5, (31, 31)), 101)
    assert endpoint.state is PlantState.GRANTED
