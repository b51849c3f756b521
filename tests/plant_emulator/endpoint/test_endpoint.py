"""Plant endpoint: refused claims, deadlines, codes of measurements, limits, the session's record, and silence.

What commands, claims, releases, stops and trips do is in test_freshness.py. Time is the tick index, so every bound on
time is exact to the tick; period i is the time from tick i to tick i + 1, and `plant.periods[i]` are its voltages.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, nan, radians, sin

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, VehicleClaim
from aeroloop.plant_emulator.endpoint.limits import LimitMonitor, LimitSettings
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Grant, Refusal, SessionRecord
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.spec import LoopSettings, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy
from tests.support.plant_end import (
    AT_REST,
    COUNTERS,
    OFF,
    PERIOD_NS,
    REST,
    WIRE,
    RecordingPlant,
    claim_of,
    claimed,
    command,
    record_of,
    state_of,
    volts,
)
from tests.support.simulated_link import wire_of

# ── claims ──


@pytest.mark.parametrize(
    ("changed", "fields"),
    [
        ({"protocol": 99}, [f"protocol: {PROTOCOL_VERSION}, not 99"]),
        (
            {"wire": WIRE.model_copy(update={"actuators": 3}), "period_ns": 1_000_000, "lockstep": True},
            ["actuators: 2, not 3", "period_ns: 2000000, not 1000000", "lockstep: False, not True"],
        ),
    ],
)
def test_a_claim_that_differs_is_refused_by_the_names_of_the_fields(
    end: VehicleClaim, changed: dict[str, object], fields: list[str]
) -> None:
    answer = end.claim(claim_of().model_copy(update=changed))
    assert isinstance(answer, Refusal)
    assert (answer.differences, answer.holder) == (fields, None)
    assert all(field in answer.reason for field in fields)
    assert (end.state, end.session) == (PlantState.IDLE, None)


# ── deadlines ──


@pytest.mark.parametrize(
    ("counter_bits", "ticks"),
    [
        pytest.param(8, 255, id="before the counter comes round"),
        pytest.param(10, 500, id="at most a second"),
        pytest.param(4, 500, id="a counter that is short by configuration"),
    ],
)
def test_a_granted_claim_waits_so_long_for_its_first_command(counter_bits: int, ticks: int) -> None:
    endpoint, plant = claimed(WireSpec(counter_bits=counter_bits))
    for k in range(1, ticks + 1):
        assert endpoint.tick(None, k) is not None
    assert endpoint.tick(None, ticks + 1) is None
    assert state_of(endpoint) is PlantState.TRIPPED
    assert f"no first command within {ticks * 0.002:.3g} s" in endpoint.notices[-1].text
    assert set(plant.periods) == {OFF}


# ── measurements ──


def test_what_a_quantizer_holds_outlasts_a_failed_sensor_but_no_session() -> None:
    wire = WireSpec(rate=SignalSpec(bits=4, limit=7.5, kind="hysteresis-uniform"))  # l = 1
    endpoint, plant = claimed(wire)

    def codes_of_x(k: int, *rates: float) -> list[float]:
        codes = []
        for i, rate in enumerate(rates):
            plant.now = Measurement(IDENTITY, (rate, 0.0, 0.0))
            read = wire.measurement.unpack(endpoint.tick(None, k + i) or b"")
            assert read is not None
            codes.append(read[1][3])
        return codes

    assert codes_of_x(1, 3.0, 2.2, nan, 2.2) == [3, 3, -8, 3]
    assert endpoint.release("of-a")
    assert isinstance(endpoint.claim(claim_of("b", wire=wire)), Grant)
    assert codes_of_x(5, 2.2, 3.0, 3.1) == [2, 2, 3]


# ── limits: tilt, rate, time at full voltage, time without valid sensor values ──


def turned(degrees: float) -> Measurement:
    return Measurement((cos(radians(degrees) / 2), 0.0, sin(radians(degrees) / 2), 0.0), AT_REST)


def driven(limits: LimitSettings) -> tuple[Endpoint, RecordingPlant]:
    plant = RecordingPlant()
    full = WIRE.voltage.quantizer().outermost
    endpoint = Endpoint(plant, WIRE, PERIOD_NS, limits=LimitMonitor(limits, PERIOD_NS, full))
    assert isinstance(endpoint.claim(claim_of()), Grant)
    endpoint.tick(None, 0)
    endpoint.tick(WIRE.command.pack(0, [31, -31]), 1)
    assert endpoint.state is PlantState.DRIVEN
    return endpoint, plant


@pytest.mark.parametrize(
    ("within", "beyond", "why"),
    [
        (turned(29.9), turned(30.1), "tilted by 30.1°, more than limits.max_tilt_deg = 30°: 0 V"),
        (
            Measurement(IDENTITY, (0.0, 3.0, 3.9)),
            Measurement(IDENTITY, (0.0, 3.0, 4.1)),
            "turns at 5.08 rad/s, more than limits.max_rate = 5 rad/s: 0 V",
        ),
    ],
)
def test_beyond_an_envelope_it_trips_within_the_tick_and_names_it(
    within: Measurement, beyond: Measurement, why: str
) -> None:
    endpoint, plant = driven(LimitSettings(max_tilt_deg=30.0, max_rate=5.0))
    plant.now = within
    assert endpoint.tick(None, 2) is not None
    plant.now = beyond
    assert endpoint.tick(None, 3) is None
    assert (endpoint.state, endpoint.trip, plant.voltages) == (PlantState.TRIPPED, TripCause.ENVELOPE, OFF)
    assert endpoint.cause == why
    assert isinstance(endpoint.claim(claim_of("b", auto_arm=False)), Refusal)  # latched, as every trip


@pytest.mark.parametrize(
    ("limit", "cause"), [("max_saturated_s", TripCause.SATURATION), ("max_invalid_s", TripCause.SENSORS)]
)
def test_what_may_last_a_while_trips_just_after_it(limit: str, cause: TripCause) -> None:
    """0.02 s are 10 ticks; the eleventh in a row is one too many. One tick of another kind begins the count anew."""
    endpoint, plant = driven(LimitSettings.model_validate({limit: 0.02}))
    saturates = cause is TripCause.SATURATION
    for k, bad in enumerate(([False] + [True] * 10) * 3 + [True], 1):
        assert endpoint.state is PlantState.DRIVEN
        plant.now = Measurement((nan if bad and not saturates else 1.0, 0.0, 0.0, 0.0), AT_REST)
        endpoint.tick(WIRE.command.pack(k % COUNTERS, [31 if bad and saturates else 30, 0]), k + 1)
    assert (endpoint.trip, plant.voltages) == (cause, OFF)


@pytest.mark.parametrize("code", [31, -31])
def test_a_motor_is_saturated_at_either_end_of_its_range(code: int) -> None:
    endpoint, _ = driven(LimitSettings(max_saturated_s=0.02))
    for k in range(1, 12):
        endpoint.tick(WIRE.command.pack(k, [0, code]), k + 1)
    assert endpoint.trip is TripCause.SATURATION


@pytest.mark.parametrize(
    ("limit", "cause"), [("max_saturated_s", TripCause.SATURATION), ("max_invalid_s", TripCause.SENSORS)]
)
def test_what_may_last_a_while_counts_from_its_own_sessions_start(limit: str, cause: TripCause) -> None:
    """Nine ticks of the last session and ten of this one are no more than ten in a row."""
    endpoint, plant = driven(LimitSettings.model_validate({limit: 0.02}))
    saturates = cause is TripCause.SATURATION
    codes = [31, -31] if saturates else [5, 5]
    plant.now = REST if saturates else Measurement((nan, 0.0, 0.0, 0.0), AT_REST)
    for k in range(1, 9):
        endpoint.tick(WIRE.command.pack(k, codes), k + 1)
    assert endpoint.release("of-a")
    assert isinstance(endpoint.claim(claim_of("b")), Grant)
    endpoint.tick(None, 10)  # the first of a session, which is at 0 V
    for k in range(9):
        assert endpoint.tick(WIRE.command.pack(k, codes), 11 + k) is not None
    endpoint.tick(WIRE.command.pack(9, codes), 20)
    endpoint.tick(WIRE.command.pack(10, codes), 21)
    assert endpoint.trip is cause


def test_quansers_board_is_saturated_where_it_clips() -> None:
    """It clips at plant.quanser.voltage_limit, which is less than what a command can say: 18 V of 23.6."""
    settings = PlantSettings(via="quanser", limits=LimitSettings(max_saturated_s=0.02))
    endpoint = settings.endpoint(RecordingPlant(), LoopSettings(), WIRE)
    assert isinstance(endpoint.claim(claim_of()), Grant)
    endpoint.tick(None, 0)
    below, at_limit = (WIRE.voltage.quantizer().encode(volts) for volts in (17.5, 18.5))
    for k in range(20):
        endpoint.tick(WIRE.command.pack(k, [below, 0]), k + 1)
    assert endpoint.state is PlantState.DRIVEN
    for k in range(20, 32):
        endpoint.tick(WIRE.command.pack(k, [at_limit, 0]), k + 1)
    assert endpoint.trip is TripCause.SATURATION


@pytest.mark.parametrize("length", [1.0, 1.005, 1 + 1e-9])
@pytest.mark.parametrize("direction", [0.0, 0.3, 1.1, 2.2])
def test_a_limit_of_180_degrees_is_beyond_no_attitude(length: float, direction: float) -> None:
    endpoint, plant = driven(LimitSettings(max_tilt_deg=180.0))
    upside_down = (0.0, length * cos(direction), length * sin(direction), 0.0)
    plant.now = Measurement(upside_down, AT_REST)
    assert endpoint.tick(None, 2) is not None
    assert endpoint.trip is None


# ── record of the last session, for the next controller ──


def last_granted(end: VehicleClaim, name: str) -> SessionRecord | None:
    answer = end.claim(claim_of(name))
    assert isinstance(answer, Grant)
    return answer.last


@pytest.fixture(params=["endpoint", "bridge"])
def end(request: pytest.FixtureRequest) -> VehicleClaim:
    if request.param == "endpoint":
        return Endpoint(RecordingPlant(), WIRE, PERIOD_NS, armed=True)
    return Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=0.1, armed=True)


def stopped(end: VehicleClaim) -> TripCause | None:
    end.stop()
    return end.trip


ENDINGS: list[tuple[Callable[[VehicleClaim], object], TripCause | str]] = [
    (lambda end: end.release("of-a"), "released"),
    (lambda end: end.lost("a"), TripCause.HOLDER_GONE),
    (lambda end: end.stop(), TripCause.OPERATOR),
    # A session that an operator's stop followed is not to be resumed, however it had ended before.
    (lambda end: [end.release("of-a"), stopped(end)], TripCause.OPERATOR),
]


@pytest.mark.parametrize(("ends", "how"), ENDINGS)
def test_the_next_controller_gets_the_last_record_and_how_its_session_ended(
    end: VehicleClaim, ends: Callable[[VehicleClaim], object], how: TripCause | str
) -> None:
    assert not end.keep(record_of("a"))  # no session
    assert last_granted(end, "a") is None
    changes = list(end.changes)
    assert end.keep(record_of("a"))
    assert not end.keep(record_of("b"))  # of another controller, of another session
    assert not end.keep(record_of("a").model_copy(update={"session": "of-b"}))
    assert not end.keep(record_of("a").model_copy(update={"controller": "b"}))
    assert end.keep(record_of("a", within_s=5.0))  # the newest counts
    assert end.changes == changes  # it is no change of the trace
    ends(end)
    assert not end.keep(record_of("a"))
    end.arm()
    assert last_granted(end, "b") == record_of("a", within_s=5.0).model_copy(update={"ended": how})
    end.release("of-b")
    assert last_granted(end, "c") is None  # a session without a record leaves none


def test_a_stop_before_any_session_leaves_no_record(end: VehicleClaim) -> None:
    end.stop()
    assert end.last is None


def test_two_plants_of_one_name_are_a_trip_even_after_an_operators_stop(end: VehicleClaim) -> None:
    end.stop()
    end.stop(TripCause.DUPLICATE, "two plants")
    end.stop()
    assert (end.trip, [notice.kind for notice in end.notices]) == (TripCause.DUPLICATE, ["tripped", "tripped"])
    assert end.trips == {TripCause.OPERATOR: 1, TripCause.DUPLICATE: 1}


# ── faults ──


def test_a_fault_that_begins_in_a_skipped_tick_has_that_tick_in_its_event() -> None:
    endpoint, _ = claimed()
    endpoint.inject(PlantSettings(faults=["rate:bias=0.1@0.01..0.02"]).parsed_faults)
    endpoint.notices.clear()
    endpoint.tick(None, 20)  # ticks 1 to 19 are skipped
    assert [(notice.kind, notice.tick) for notice in endpoint.notices] == [("fault", 5), ("fault", 10)]


# ── the on-change policy: frames sent, levels held, and the end of holding ──


HEARTBEAT = 15
"""Ticks: 30 ms of 2 ms."""
WATCHDOG_TICKS = 50
BOTH = wire_of("on_change", "on_change")


def claim_again(endpoint: Endpoint) -> None:
    endpoint.release("of-a")
    answer = endpoint.claim(claim_of("b", wire=endpoint.wire, lockstep=endpoint.lockstep))
    assert isinstance(answer, Grant)


def invalid(echo: int) -> bytes:
    return BOTH.command.pack(echo % COUNTERS, [BOTH.voltage.quantizer().invalid] * 2)


def turning(rate: float) -> Measurement:
    return Measurement(IDENTITY, (rate, 0.0, 0.0))


# ── what it sends ──


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_plant_at_rest_sends_heartbeats_only_and_a_change_at_once(lockstep: bool) -> None:
    endpoint, plant = claimed(BOTH, lockstep=lockstep)
    sent = {}
    for k in range(1, 60):
        plant.now = turning(0.5 if k >= 40 else 0.001)  # which is less than half a step
        frame = endpoint.tick(command(k - 1), k)
        assert frame is not None  # silence is distinguished from no session
        if frame != UNCHANGED:
            sent[k] = BOTH.measurement.unpack(frame)
    changed = (0, 0, 0, 64, 0, 0)
    assert sent == {15: (15, (0,) * 6), 30: (30, (0,) * 6), 40: (40, changed), 55: (55, changed)}
    claim_again(endpoint)  # a session starts with a frame though nothing has changed
    assert endpoint.tick(None, 60) == BOTH.measurement.pack(0, changed)
    endpoint.release("of-b")
    assert endpoint.tick(None, 61) is None


def test_no_valid_value_is_said_once_held_and_ended_by_the_next_frame() -> None:
    endpoint, plant = claimed(BOTH)
    said = {}
    for k in range(1, 40):
        plant.now = turning(nan if 10 <= k < 30 else 0.0)
        said[k] = endpoint.tick(invalid(k - 1) if 10 <= k - 1 < 30 else command(k - 1), k)
    no_value = [quantizer.invalid for quantizer in (BOTH.attitude.quantizer(), BOTH.rate.quantizer()) for _ in range(3)]
    assert {k: frame for k, frame in said.items() if frame} == {
        10: BOTH.measurement.pack(10, no_value),
        25: BOTH.measurement.pack(25, no_value),
        30: BOTH.measurement.pack(30, (0,) * 6),
    }
    assert plant.periods[9:12] == [volts(), OFF, OFF]
    assert plant.periods[30:] == [volts()] * 9
    assert state_of(endpoint) is PlantState.DRIVEN


# ── what it holds ──


@pytest.mark.parametrize("policy", ["on_change", "periodic"])
def test_in_real_time_no_frame_holds_for_the_watchdogs_time_and_an_empty_one_is_refused(policy: Policy) -> None:
    for frame in (None, UNCHANGED):
        endpoint, plant = claimed(wire_of("on_change", policy))
        for k in range(1, 80):
            endpoint.tick(command(k - 1) if k in (1, 16) else frame, k)
        assert plant.periods == [volts()] * (15 + WATCHDOG_TICKS) + [OFF] * (79 - 15 - WATCHDOG_TICKS)
        assert endpoint.trip is TripCause.COMMAND_TIMEOUT
        assert endpoint.refused == (0 if frame is None else 14 + WATCHDOG_TICKS)


def test_an_empty_command_in_lockstep_repeats_the_last_commands_voltages_but_none_of_the_last_session() -> None:
    endpoint, plant = claimed(BOTH, lockstep=True)
    endpoint.tick(command(0, 7), 1)
    for k in range(2, 300):
        endpoint.tick(UNCHANGED, k)
    assert plant.periods == [volts(7)] * 299
    assert (endpoint.refused, state_of(endpoint)) == (0, PlantState.DRIVEN)
    claim_again(endpoint)
    endpoint.tick(None, 300)
    endpoint.tick(UNCHANGED, 301)
    assert plant.periods[299:] == [OFF, OFF]
    assert (endpoint.refused, state_of(endpoint)) == (1, PlantState.GRANTED)


# ── in real time, the end of silence may show late that values are valid again ──


def test_a_heartbeat_without_a_valid_value_is_forgiven_as_long_as_a_measurement_may_have_been_lost() -> None:
    endpoint, plant = claimed(BOTH)
    for k in range(1, 11 + HEARTBEAT):
        plant.now = turning(nan if 5 <= k < 10 else 0.0)
        endpoint.tick(invalid(k - 1) if k > 5 else command(k - 1), k)
        assert state_of(endpoint) is PlantState.DRIVEN
        assert plant.periods[-1] == (OFF if k > 5 else volts())
    endpoint.tick(invalid(10 + HEARTBEAT), 11 + HEARTBEAT)
    assert endpoint.trip is TripCause.INVALID_COMMAND


def test_no_measurement_of_an_earlier_session_forgives_a_command() -> None:
    """Its last counters, without a valid value, are just before this session's first, as the counter comes round."""
    endpoint, plant = claimed(BOTH)
    for k in range(1, COUNTERS):
        plant.now = turning(nan if k >= COUNTERS - HEARTBEAT else 0.0)
        endpoint.tick(invalid(k - 1) if k > COUNTERS - HEARTBEAT else command(k - 1), k)
    assert state_of(endpoint) is PlantState.DRIVEN
    plant.now = turning(0.0)
    claim_again(endpoint)
    assert endpoint.tick(None, COUNTERS)
    endpoint.tick(invalid(0), COUNTERS + 1)
    assert endpoint.trip is TripCause.INVALID_COMMAND
