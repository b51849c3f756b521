"""Limits and latch of the plant end, and the transitions of its state machine."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, nan, radians, sin

import pytest
from hypothesis import settings, strategies
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, LimitMonitor, LimitSettings
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import Claim, Grant, Refusal
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.frames import DEFAULT_COUNTER_BITS
from aeroloop.protocol.wire.spec import WireSpec

COUNTERS = 1 << DEFAULT_COUNTER_BITS

WIRE = WireSpec()
PERIOD_NS = 2_000_000
OFF = (0.0, 0.0)
REST = Measurement(IDENTITY, (0.0, 0.0, 0.0))


class Stand(Plant):
    """A plant that shows the voltages it has and reports a preset measurement."""

    actuators = 2

    def __init__(self) -> None:
        self.voltages: tuple[float, ...] = OFF
        self.seen = REST

    def actuate(self, voltages: Sequence[float]) -> None:
        self.voltages = tuple(voltages)

    def advance(self) -> None:
        pass

    def measure(self) -> Measurement:
        return self.seen

    def close(self) -> None:
        self.voltages = OFF


def claim(name: str = "a", *, auto_arm: bool = False) -> Claim:
    return Claim(controller=name, session=name, period_ns=PERIOD_NS, lockstep=False, auto_arm=auto_arm, wire=WIRE)


def tilted(degrees: float) -> Measurement:
    return Measurement((cos(radians(degrees) / 2), 0.0, sin(radians(degrees) / 2), 0.0), (0.0, 0.0, 0.0))


def driven(limits: LimitSettings) -> tuple[Endpoint, Stand]:
    """An endpoint at tick 1, at full voltage."""
    plant = Stand()
    full = WIRE.voltage.quantizer().outermost
    endpoint = Endpoint(plant, WIRE, PERIOD_NS, limits=LimitMonitor(limits, PERIOD_NS, full))
    assert isinstance(endpoint.claim(claim(auto_arm=True)), Grant)
    endpoint.tick(None, 0)
    endpoint.tick(WIRE.command.pack(0, [31, -31]), 1)
    assert endpoint.state is PlantState.DRIVEN
    return endpoint, plant


@pytest.mark.parametrize(
    ("within", "beyond", "why"),
    [
        (tilted(29.9), tilted(30.1), "max_tilt_deg"),
        (tilted(-29.9), tilted(-30.1), "max_tilt_deg"),
        (Measurement(IDENTITY, (0.0, 3.0, 3.9)), Measurement(IDENTITY, (0.0, 3.0, 4.1)), "max_rate"),
    ],
)
def test_beyond_an_envelope_it_trips_within_the_tick_and_names_it(
    within: Measurement, beyond: Measurement, why: str
) -> None:
    endpoint, plant = driven(LimitSettings(max_tilt_deg=30.0, max_rate=5.0))
    plant.seen = within
    assert endpoint.tick(None, 2) is not None
    plant.seen = beyond
    assert endpoint.tick(None, 3) is None
    assert (endpoint.state, plant.voltages) == (PlantState.TRIPPED, OFF)
    assert endpoint.cause is not None
    assert why in endpoint.cause


def test_turning_about_the_vertical_is_no_tilt() -> None:
    endpoint, plant = driven(LimitSettings(max_tilt_deg=1.0))
    for k, yaw in enumerate(range(0, 360, 10), start=2):
        plant.seen = Measurement((cos(radians(yaw) / 2), 0.0, 0.0, sin(radians(yaw) / 2)), (0.0, 0.0, 0.0))
        assert endpoint.tick(WIRE.command.pack((k - 1) % COUNTERS, [1, 1]), k) is not None


@pytest.mark.parametrize(("limit", "value"), [("max_saturated_s", 0.02), ("max_invalid_s", 0.02)])
def test_what_may_last_a_while_trips_just_after_it(limit: str, value: float) -> None:
    """0.02 s are 10 ticks; the eleventh in a row is one too many."""
    endpoint, plant = driven(LimitSettings.model_validate({limit: value}))
    if limit == "max_invalid_s":
        plant.seen = Measurement((nan, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    code = 31 if limit == "max_saturated_s" else 1
    ticks = 0
    while endpoint.state is PlantState.DRIVEN:
        ticks += 1
        endpoint.tick(WIRE.command.pack(ticks % COUNTERS, [code, 0]), ticks + 1)
        assert ticks < 20
    # the voltage was at its limit at tick 1 already; the sensors fail from tick 2 on
    assert ticks == (10 if limit == "max_saturated_s" else 11)
    assert plant.voltages == OFF


def test_a_voltage_that_leaves_its_limit_in_between_does_not_trip() -> None:
    endpoint, _ = driven(LimitSettings(max_saturated_s=0.02))
    for k in range(1, 60):
        endpoint.tick(WIRE.command.pack(k % COUNTERS, [31 if k % 8 else 30, 0]), k + 1)
    assert endpoint.state is PlantState.DRIVEN


def test_an_unarmed_plant_refuses_and_states_how_to_arm_it() -> None:
    endpoint = Endpoint(Stand(), WIRE, PERIOD_NS)
    answer = endpoint.claim(claim())
    assert isinstance(answer, Refusal)
    assert "aeroloop op arm" in answer.reason
    assert endpoint.arm()
    assert isinstance(endpoint.claim(claim()), Grant)
    assert not endpoint.arm()  # there is nothing to arm while it is held


def test_an_operators_stop_is_cleared_by_arming_and_by_no_claim() -> None:
    endpoint, plant = driven(LimitSettings())
    endpoint.stop()
    endpoint.tick(WIRE.command.pack(1, [31, 31]), 2)
    assert plant.voltages == OFF
    assert isinstance(endpoint.claim(claim("b", auto_arm=True)), Refusal)
    endpoint.arm()
    assert isinstance(endpoint.claim(claim("b")), Grant)


def test_a_trip_is_cleared_by_a_claim_only_if_that_claim_arms() -> None:
    endpoint, _ = driven(LimitSettings())
    endpoint.lost("a")
    assert isinstance(endpoint.claim(claim("b")), Refusal)
    assert isinstance(endpoint.claim(claim("b", auto_arm=True)), Grant)


def test_a_release_leaves_the_plant_armed() -> None:
    endpoint, _ = driven(LimitSettings())
    assert endpoint.release("a")
    assert isinstance(endpoint.claim(claim("b")), Grant)


TRANSITIONS = {
    (PlantState.IDLE, PlantState.GRANTED),
    (PlantState.IDLE, PlantState.TRIPPED),  # an operator's stop
    (PlantState.GRANTED, PlantState.DRIVEN),
    (PlantState.GRANTED, PlantState.IDLE),
    (PlantState.GRANTED, PlantState.TRIPPED),
    (PlantState.DRIVEN, PlantState.IDLE),
    (PlantState.DRIVEN, PlantState.TRIPPED),
    (PlantState.TRIPPED, PlantState.IDLE),
    (PlantState.TRIPPED, PlantState.GRANTED),
}
"""The drawing in SPEC.md, section 6, as pairs."""


class PlantEnd(RuleBasedStateMachine):
    """Anybody does anything in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.plant = Stand()
        guard = LimitMonitor(LimitSettings(max_tilt_deg=45.0), PERIOD_NS, 24.0)
        self.endpoint = Endpoint(self.plant, WIRE, PERIOD_NS, limits=guard)
        self.k = 0
        self.endpoint.tick(None, 0)
        self.before = self.endpoint.state
        self.stopped = False

    @rule(name=strategies.sampled_from("ab"), auto_arm=strategies.booleans())
    def somebody_claims(self, name: str, auto_arm: bool) -> None:
        held, cause = self.endpoint.holder, self.endpoint.cause
        granted = isinstance(self.endpoint.claim(claim(name, auto_arm=auto_arm)), Grant)
        assert granted == (held is None and (cause is None or (auto_arm and not self.stopped)))

    @rule(name=strategies.sampled_from("ab"))
    def somebody_releases(self, name: str) -> None:
        held = self.endpoint.holder
        assert self.endpoint.release(name) == (name == held)

    @rule(name=strategies.sampled_from("ab"))
    def somebody_dies(self, name: str) -> None:
        self.endpoint.lost(name)

    @rule()
    def an_operator_stops(self) -> None:
        self.endpoint.stop()
        self.stopped = True

    @rule()
    def an_operator_arms(self) -> None:
        if self.endpoint.arm():
            self.stopped = False

    @rule(frame=strategies.binary(max_size=3) | strategies.none(), ticks=strategies.integers(1, 60))
    def bytes_come(self, frame: bytes | None, ticks: int) -> None:
        self.k += ticks
        self.endpoint.tick(frame, self.k)

    @precondition(lambda self: self.endpoint.session is not None)
    @rule(code=strategies.integers(-32, 31))
    def an_answer_comes(self, code: int) -> None:
        self.k += 1
        self.endpoint.tick(WIRE.command.pack(self.endpoint.counter, [code, code]), self.k)

    @rule(degrees=strategies.sampled_from([0.0, 44.0, 46.0]))
    def it_tilts(self, degrees: float) -> None:
        self.plant.seen = tilted(degrees)

    @invariant()
    def it_went_only_where_the_drawing_goes(self) -> None:
        now = self.endpoint.state
        assert now is self.before or (self.before, now) in TRANSITIONS
        self.before = now

    @invariant()
    def a_session_runs_just_while_it_is_held(self) -> None:
        held = self.endpoint.state in (PlantState.GRANTED, PlantState.DRIVEN)
        assert held == (self.endpoint.session is not None) == (self.endpoint.holder is not None)

    @invariant()
    def every_trip_has_a_cause(self) -> None:
        assert self.endpoint.state is not PlantState.TRIPPED or self.endpoint.cause is not None

    @invariant()
    def nothing_but_a_driven_plant_gets_voltage_at_the_next_tick(self) -> None:
        if self.endpoint.state is not PlantState.DRIVEN:
            self.k += 1
            self.endpoint.tick(None, self.k)
            assert self.plant.voltages == OFF


TestPlantEnd = PlantEnd.TestCase
TestPlantEnd.settings = settings(max_examples=80, stateful_step_count=40)
