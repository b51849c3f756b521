"""Plant endpoint: claims, lifetime of a command, measurements.

Time is the tick index, so every bound on time is exact to the tick. The plant is a double that records its calls;
period i is the time from tick i to tick i + 1, and `plant.held[i]` are the voltages during it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isnan, nan

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Claim, Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.attitude import IDENTITY, Vector
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

WIRE = WireSpec()
COUNTERS = WIRE.measurement.counters
CONTINUOUS = WireSpec().with_bits(None, None)
PERIOD_NS = 2_000_000
WATCHDOG_TICKS = 50
"""0.1 s of 2 ms."""
FIRST_COMMAND_TICKS = 255
"""The counter is back at 0 at the next."""
OFF = (0.0, 0.0)
AT_REST: Vector = (0.0, 0.0, 0.0)


class RecordingPlant(Plant):
    """A plant that stays where it is put and writes down the voltages of every period."""

    def __init__(self, actuators: int = 2) -> None:
        self.actuators = actuators
        self.held: list[tuple[float, ...]] = []
        self.now = Measurement(IDENTITY, AT_REST)
        self._voltages: tuple[float, ...] = ()

    def actuate(self, voltages: Sequence[float]) -> None:
        self._voltages = tuple(voltages)

    def advance(self) -> None:
        self.held.append(self._voltages)

    def measure(self) -> Measurement:
        return self.now

    def close(self) -> None:
        self._voltages = OFF


def _claim(name: str = "a", wire: WireSpec = WIRE, changed: dict[str, object] | None = None) -> Claim:
    claim = Claim(controller=name, session=f"of-{name}", period_ns=PERIOD_NS, lockstep=False, auto_arm=True, wire=wire)
    return claim.model_copy(update=changed)


def _claimed(wire: WireSpec = WIRE) -> tuple[Endpoint, RecordingPlant]:
    """An endpoint at tick 0, granted to "a", that has sent its first measurement, of counter 0."""
    plant = RecordingPlant(wire.actuators)
    endpoint = Endpoint(plant, wire, PERIOD_NS)
    assert isinstance(endpoint.claim(_claim(wire=wire)), Grant)
    assert endpoint.tick(None, 0) is not None
    return endpoint, plant


def _command(echo: int, code: int = 5, wire: WireSpec = WIRE) -> bytes:
    return wire.command.pack(echo % COUNTERS, [code, -code])


def _volts(code: int = 5) -> tuple[float, float]:
    return code * 48 / 63, -code * 48 / 63


def _read(frame: bytes | None, wire: WireSpec = WIRE) -> tuple[int, tuple[float, ...]]:
    assert frame is not None
    read = wire.measurement.unpack(frame)
    assert read is not None
    return read


def _kinds(endpoint: Endpoint) -> list[str]:
    return [notice.kind for notice in endpoint.notices]


def _state(endpoint: Endpoint) -> PlantState:
    """The state as it is now; read like this so that mypy does not take it for what it was a line above."""
    return endpoint.state


def _is_off(plant: RecordingPlant, period: int) -> bool:
    return plant.held[period] == OFF


# Claim


def test_a_claim_is_granted_and_the_next_tick_measures_with_counter_0() -> None:
    plant = RecordingPlant()
    endpoint = Endpoint(plant, WIRE, PERIOD_NS)
    for k in range(4):
        assert endpoint.tick(None, k) is None  # no session
    assert endpoint.claim(_claim()) == Grant(session="of-a")
    assert (endpoint.state, endpoint.session, endpoint.holder) == (PlantState.GRANTED, "of-a", "a")
    for k in range(4, 4 + 2 * COUNTERS):
        command = None if k == 4 else _command(k - 5)
        assert _read(endpoint.tick(command, k))[0] == (k - 4) % COUNTERS == endpoint.counter
    assert _kinds(endpoint) == ["claimed"]
    assert "a" in endpoint.notices[0].text
    assert endpoint.notices[0].session == "of-a"


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"period_ns": 1_000_000}, "period_ns: 2000000, not 1000000"),
        ({"lockstep": True}, "lockstep: False, not True"),
        ({"protocol": 99}, f"protocol: {PROTOCOL_VERSION}, not 99"),
        ({"wire": WIRE.model_copy(update={"rate": SignalSpec(bits=10, limit=1.0)})}, "rate.bits: 8, not 10"),
        (
            {"wire": WIRE.model_copy(update={"voltage": SignalSpec(bits=6, limit=18.0)})},
            "voltage.limit: 24.0, not 18.0",
        ),
        ({"wire": WIRE.model_copy(update={"actuators": 3})}, "actuators: 2, not 3"),
    ],
)
def test_a_claim_that_differs_is_refused_by_the_name_of_the_field(changed: dict[str, object], field: str) -> None:
    endpoint = Endpoint(RecordingPlant(), WIRE, PERIOD_NS)
    answer = endpoint.claim(_claim(changed=changed))
    assert isinstance(answer, Refusal)
    assert answer.differences == [field]
    assert field in answer.reason
    assert answer.holder is None
    assert (endpoint.state, endpoint.session) == (PlantState.IDLE, None)
    assert endpoint.tick(None, 0) is None


def test_a_plant_that_is_held_is_refused_by_the_name_of_its_holder() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    answer = endpoint.claim(_claim("b"))
    assert isinstance(answer, Refusal)
    assert answer.holder == "a"
    assert "a" in answer.reason
    endpoint.tick(_command(1), 2)
    assert plant.held == [_volts(), _volts()]  # and the holder notices nothing
    assert (endpoint.session, endpoint.state) == ("of-a", PlantState.DRIVEN)


def test_a_grant_leaves_the_motors_at_0_v_until_the_first_command() -> None:
    endpoint, plant = _claimed()
    for k in range(1, 6):
        endpoint.tick(None, k)
    endpoint.tick(_command(5), 6)
    assert plant.held == [OFF] * 5 + [_volts()]
    assert _state(endpoint) is PlantState.DRIVEN


# Commands


def test_a_command_acts_from_the_start_of_the_period_in_which_it_came_and_until_the_next() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0, 3), 1)
    endpoint.tick(None, 2)
    endpoint.tick(_command(2, 7), 3)
    assert plant.held == [_volts(3), _volts(3), _volts(7)]
    assert endpoint.accepted == 2


@pytest.mark.parametrize("late", [0, 3])
def test_time_begins_at_tick_0_and_the_very_first_call_takes_no_command(late: int) -> None:
    """So that the plant can be computed again from its ticks alone."""
    plant = RecordingPlant()
    endpoint = Endpoint(plant, WIRE, PERIOD_NS)
    endpoint.claim(_claim())
    assert _read(endpoint.tick(_command(0), late))[0] == 0
    assert plant.held == [OFF] * late
    assert endpoint.accepted == 0


@pytest.mark.parametrize("frame", [b"", b"\0", _command(1)[:-1], _command(1) + b"\0"])
def test_a_malformed_command_is_counted_and_does_nothing(frame: bytes) -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    endpoint.tick(frame, 2)
    assert (endpoint.refused, endpoint.accepted) == (1, 1)
    assert plant.held == [_volts(), _volts()]


def test_malformed_commands_do_not_feed_the_watchdog() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    for k in range(2, 80):
        endpoint.tick(b"junk!", k)
    assert _is_off(plant, WATCHDOG_TICKS)
    assert endpoint.refused == WATCHDOG_TICKS  # until the session ended; then no command is expected


def test_a_command_without_a_valid_value_trips_at_once() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    invalid = WIRE.voltage.quantizer().invalid
    assert endpoint.tick(WIRE.command.pack(1, [5, invalid]), 2) is None
    assert plant.held == [_volts(), OFF]
    assert _state(endpoint) is PlantState.TRIPPED
    assert (endpoint.session, endpoint.holder) == (None, None)
    assert "no valid value" in endpoint.notices[-1].text
    assert endpoint.notices[-1].session == "of-a"


# Watchdog


def test_the_watchdog_gives_0_v_exactly_when_its_time_is_over() -> None:
    endpoint, plant = _claimed()
    for k in range(1, 11):
        endpoint.tick(_command(k - 1), k)  # the last one acts from period 9 on
    for k in range(11, 100):
        measured = endpoint.tick(None, k)
        assert (measured is None) == (k > 9 + WATCHDOG_TICKS)
    assert plant.held[: 9 + WATCHDOG_TICKS] == [_volts()] * (9 + WATCHDOG_TICKS)
    assert plant.held[9 + WATCHDOG_TICKS :] == [OFF] * (99 - 9 - WATCHDOG_TICKS)
    assert _state(endpoint) is PlantState.TRIPPED
    assert _kinds(endpoint) == ["claimed", "tripped"]
    assert "100 ms" in endpoint.notices[-1].text


@pytest.mark.parametrize(("watchdog_s", "ticks"), [(0.02, 10), (0.5, 250), (1e-6, 1)])
def test_the_watchdogs_time_can_be_set(watchdog_s: float, ticks: int) -> None:
    plant = RecordingPlant()
    endpoint = Endpoint(plant, WIRE, PERIOD_NS, watchdog_s=watchdog_s)
    endpoint.claim(_claim())
    endpoint.tick(None, 0)
    endpoint.tick(_command(0), 1)
    for k in range(2, 300):
        endpoint.tick(None, k)
    assert plant.held.index(OFF) == ticks


@pytest.mark.parametrize(
    ("counter_bits", "ticks"),
    [
        pytest.param(8, FIRST_COMMAND_TICKS, id="before the counter comes round"),
        pytest.param(10, 500, id="at most a second"),
        pytest.param(4, 500, id="a counter that is short by configuration"),
    ],
)
def test_a_granted_claim_waits_so_long_for_its_first_command(counter_bits: int, ticks: int) -> None:
    endpoint, plant = _claimed(WireSpec(counter_bits=counter_bits))
    for k in range(1, ticks + 1):
        assert endpoint.tick(None, k) is not None
    assert endpoint.tick(None, ticks + 1) is None
    assert _state(endpoint) is PlantState.TRIPPED
    assert f"first command within {ticks * 0.002:.3g} s" in endpoint.notices[-1].text
    assert set(plant.held) == {OFF}


@pytest.mark.parametrize("stall", [60, 1000])
def test_a_stall_of_the_plants_owner_trips_in_the_plants_time(stall: int) -> None:
    """Ticks that are skipped pass for the plant all the same, and under 0 V as soon as the time is over."""
    endpoint, plant = _claimed()
    for k in range(1, 4):
        endpoint.tick(_command(k - 1), k)
    assert endpoint.tick(_command(3), 3 + stall) is None  # a command that came before the stall, found after it
    assert len(plant.held) == 3 + stall
    assert plant.held[: 3 + WATCHDOG_TICKS] == [_volts()] * (3 + WATCHDOG_TICKS)
    assert plant.held[3 + WATCHDOG_TICKS :] == [OFF] * (stall - WATCHDOG_TICKS)
    assert _state(endpoint) is PlantState.TRIPPED


def test_a_trip_is_latched_and_only_a_new_claim_ends_it() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    tripped_at = 2 + WATCHDOG_TICKS
    for k in range(2, tripped_at):
        endpoint.tick(None, k)
    for k in range(tripped_at, tripped_at + 30):
        assert endpoint.tick(_command(k - 1), k) is None  # the old holder goes on commanding
        assert _is_off(plant, k - 1)
    assert _state(endpoint) is PlantState.TRIPPED
    assert endpoint.accepted == 1

    k = tripped_at + 30
    assert endpoint.claim(_claim("b")) == Grant(session="of-b")
    assert _read(endpoint.tick(None, k))[0] == 0  # its own count
    assert _is_off(plant, k - 1)
    endpoint.tick(_command(0, 7), k + 1)  # an echo that the last session had, too
    assert plant.held[k] == _volts(7)
    assert _state(endpoint) is PlantState.DRIVEN


def _seen_codes(
    endpoint: Endpoint, plant: RecordingPlant, rates: Sequence[float], k: int, wire: WireSpec
) -> list[float]:
    """The codes of ω_x at ticks from k on, of a body that turns about x at these rates [rad/s]."""
    codes = []
    for i, rate in enumerate(rates):
        plant.now = Measurement(IDENTITY, (rate, 0.0, 0.0))
        codes.append(_read(endpoint.tick(None, k + i), wire)[1][3])
    return codes


def test_what_a_quantizer_holds_outlasts_a_failed_sensor_but_no_session() -> None:
    wire = WireSpec(rate=SignalSpec(bits=4, limit=7.5, kind="hysteresis-uniform"))  # l = 1
    endpoint, plant = _claimed(wire)
    assert _seen_codes(endpoint, plant, [3.0, 2.2, nan, 2.2], 1, wire) == [3, 3, -8, 3]
    assert endpoint.release("of-a")
    assert isinstance(endpoint.claim(_claim("b", wire)), Grant)
    assert _seen_codes(endpoint, plant, [2.2, 3.0, 3.1], 5, wire) == [2, 2, 3]


def test_each_axis_holds_its_own_level() -> None:
    wire = WireSpec(rate=SignalSpec(bits=4, limit=7.5, kind="hysteresis-uniform"))
    endpoint, plant = _claimed(wire)
    codes = []
    for k, rate in enumerate(((3.0, 2.0, 0.0), (2.2, 2.8, 0.9)), start=1):
        plant.now = Measurement(IDENTITY, rate)
        codes.append(_read(endpoint.tick(None, k), wire)[1][3:])
    assert codes == [(3, 2, 0), (3, 2, 0)]


# The other ends of a session


def test_a_release_ends_the_session_with_0_v() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    assert endpoint.release("of-a")
    assert (endpoint.state, endpoint.session, endpoint.holder) == (PlantState.IDLE, None, None)
    assert endpoint.tick(_command(1), 2) is None
    assert plant.held == [_volts(), OFF]
    assert _kinds(endpoint) == ["claimed", "released"]
    assert isinstance(endpoint.claim(_claim("b")), Grant)


def test_only_the_session_that_runs_can_be_released() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    assert not endpoint.release("of-b")
    endpoint.tick(_command(1), 2)
    assert plant.held == [_volts(), _volts()]
    assert endpoint.session == "of-a"


def test_a_holder_that_is_gone_means_0_v() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    endpoint.lost("b")  # somebody else
    endpoint.tick(_command(1), 2)
    assert _state(endpoint) is PlantState.DRIVEN
    endpoint.lost("a")
    assert _state(endpoint) is PlantState.TRIPPED
    assert endpoint.tick(_command(2), 3) is None
    assert plant.held == [_volts(), _volts(), OFF]
    assert _kinds(endpoint) == ["claimed", "tripped"]
    assert "a is gone" in endpoint.notices[-1].text


def test_the_owner_can_end_a_session_and_ending_none_is_not_reported() -> None:
    endpoint, plant = _claimed()
    endpoint.tick(_command(0), 1)
    endpoint.expire(TripCause.NO_ANSWER, "no answer in lockstep")
    endpoint.expire(TripCause.NO_ANSWER, "no answer in lockstep")
    endpoint.tick(_command(1), 2)
    assert plant.held == [_volts(), OFF]
    assert _kinds(endpoint) == ["claimed", "tripped"]
    assert "no answer in lockstep" in endpoint.notices[-1].text


# Measurements


def test_a_measurement_carries_the_vector_of_the_quaternion_with_positive_scalar_and_the_rate() -> None:
    endpoint, plant = _claimed(CONTINUOUS)
    plant.now = Measurement((-0.5, 0.5, -0.1, 0.7), (0.1, -0.2, 0.3))
    assert _read(endpoint.tick(None, 1), CONTINUOUS)[1] == (-0.5, 0.1, -0.7, 0.1, -0.2, 0.3)
    plant.now = Measurement((0.5, 0.5, -0.1, 0.7), (0.1, -0.2, 0.3))
    assert _read(endpoint.tick(None, 2), CONTINUOUS)[1] == (0.5, -0.1, 0.7, 0.1, -0.2, 0.3)


def test_rates_beyond_the_range_are_sent_as_its_edge_and_counted() -> None:
    endpoint, plant = _claimed()
    plant.now = Measurement(IDENTITY, (2.0, -7.0, 0.5))
    assert _read(endpoint.tick(None, 1))[1][3:] == (127, -127, 64)
    assert endpoint.saturated == 2


@pytest.mark.parametrize("wire", [WIRE, CONTINUOUS], ids=["8/6 bits", "cont"])
@pytest.mark.parametrize("failed", range(7))
@pytest.mark.parametrize("value", [nan, inf])
def test_a_failed_sensor_makes_the_whole_measurement_invalid(wire: WireSpec, failed: int, value: float) -> None:
    endpoint, plant = _claimed(wire)
    values = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    values[failed] = value
    w, x, y, z, a, b, c = values
    plant.now = Measurement((w, x, y, z), (a, b, c))
    counter, codes = _read(endpoint.tick(None, 1), wire)
    assert counter == 1
    levels = [wire.attitude.quantizer().level(code) for code in codes]
    assert [isnan(level) for level in levels] == [True] * 6
    plant.now = Measurement(IDENTITY, AT_REST)
    assert _read(endpoint.tick(None, 2), wire)[1] == (0, 0, 0, 0, 0, 0)  # the session went on
