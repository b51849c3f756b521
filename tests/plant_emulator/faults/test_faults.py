"""Faults: each acts as specified, when specified, and identically from the same seed."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, isfinite, isnan, pi, sin, sqrt
from statistics import fmean, pstdev
from weakref import ref

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.envelope import Guard, LimitSettings
from aeroloop.plant_emulator.faults.language import (
    MAX_ANGLE,
    MAX_RATE,
    MAX_TIME_S,
    MAX_VOLTS,
    SIGNALS,
    Fault,
)
from aeroloop.plant_emulator.faults.signals import GARBLED_RATE, FaultyPlant
from aeroloop.plant_emulator.faults.streams import FaultyStream
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector
from aeroloop.protocol.wire.spec import WireSpec

PERIOD = 0.1
LIMIT = 24.0
MANY = 10_000


def sample(k: int) -> Measurement:
    """What is true after k periods: no two are alike, in no component."""
    return Measurement((cos(0.01 * k), 0.0, 0.0, sin(0.01 * k)), (1.0 * k, 10.0 * k, 100.0 * k))


class Stand(Plant):
    """A plant that remembers the voltages of each period and counts its periods as its sensors' truth."""

    def __init__(self, actuators: int = 2) -> None:
        self.actuators = actuators
        self.k = 0
        self.voltages: tuple[float, ...] = (0.0,) * actuators
        self.periods: list[tuple[float, ...]] = []

    def actuate(self, voltages: Sequence[float]) -> None:
        self.voltages = tuple(voltages)

    def advance(self) -> None:
        self.k += 1
        self.periods.append(self.voltages)

    def measure(self) -> Measurement:
        return sample(self.k)

    def close(self) -> None:
        self.voltages = (0.0,) * self.actuators


def faulty(*faults: str, seed: int = 0, actuators: int = 2, started: bool = True) -> tuple[FaultyPlant, Stand]:
    stand = Stand(actuators)
    plant = FaultyPlant(stand, [Fault.parse(text) for text in faults], PERIOD, voltage_limit=LIMIT, seed=seed)
    if started:
        plant.start()
    return plant, stand


def sensed(*faults: str, ticks: int = 8, seed: int = 0) -> list[Measurement]:
    """What is measured at 0 s, 0.1 s, 0.2 s and so on."""
    plant, _ = faulty(*faults, seed=seed)
    seen = [plant.measure()]
    for _ in range(ticks):
        plant.advance()
        seen.append(plant.measure())
    return seen


def driven(*faults: str, ticks: int = 8, seed: int = 0) -> list[tuple[float, ...]]:
    """What the motors have in the periods that begin at 0, 0.1, 0.2, …, commanded (k, −k)."""
    plant, stand = faulty(*faults, seed=seed)
    for k in range(ticks):
        plant.actuate((float(k), float(-k)))
        plant.advance()
    return stand.periods


def passed(*faults: str, frames: Sequence[bytes | None], seed: int = 0, period: float = PERIOD) -> list[list[bytes]]:
    """What comes out at 0 s, 0.1 s, 0.2 s and so on."""
    stream = FaultyStream("command", [Fault.parse(text) for text in faults], seed)
    return [stream.passes(frame, k * period) for k, frame in enumerate(frames)]


def letters(count: int) -> list[bytes | None]:
    return [bytes([ord("a") + k]) for k in range(count)]


def numbered(count: int) -> list[bytes]:
    return [k.to_bytes(4, "big") for k in range(count)]


def flat(ticks: list[list[bytes]]) -> list[bytes]:
    return [frame for tick in ticks for frame in tick]


def missing(values: Sequence[float]) -> bool:
    return all(isnan(value) for value in values)


def turned(q: Quaternion, by: Vector) -> Quaternion:
    """The q of R(q) R(by), from rotation matrices' own definition of order: the body first has q, then turns."""
    angle = hypot(*by)
    s = sin(angle / 2) / angle
    p0, p1, p2, p3 = cos(angle / 2), *(s * part for part in by)
    q0, q1, q2, q3 = q
    return (
        q0 * p0 - (q1 * p1 + q2 * p2 + q3 * p3),
        q0 * p1 + p0 * q1 + (q2 * p3 - q3 * p2),
        q0 * p2 + p0 * q2 + (q3 * p1 - q1 * p3),
        q0 * p3 + p0 * q3 + (q1 * p2 - q2 * p1),
    )


# ── the vocabulary ──


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("attitude:off@5", Fault(signal="attitude", kind="off", start_s=5.0)),
        ("rate.y:bias=0.1@2..4", Fault(signal="rate.y", kind="bias", value=0.1, start_s=2.0, end_s=4.0)),
        ("motor2:stuck@3", Fault(signal="motor2", kind="stuck", start_s=3.0)),
        ("command:drop=0.05@1", Fault(signal="command", kind="drop", value=0.05, start_s=1.0)),
        ("command:delay=0.02@0..10", Fault(signal="command", kind="delay", value=0.02, end_s=10.0)),
        ("measurement:garble=0.1", Fault(signal="measurement", kind="garble", value=0.1)),
        (" motors:bias=-1e-3@1.5..2 ", Fault(signal="motors", kind="bias", value=-0.001, start_s=1.5, end_s=2.0)),
    ],
)
def test_a_fault_is_read_as_it_is_written(text: str, fault: Fault) -> None:
    assert Fault.parse(text) == fault
    assert str(fault) == text.strip().replace("1e-3", "0.001")


@pytest.mark.parametrize(
    ("text", "wrong", "right"),
    [
        ("attitude", "it is written", "signal:kind[=value][@start[..end]]"),
        ("", "it is written", "attitude:off@5"),
        ("altitude:off", "no signal 'altitude'", "attitude, attitude.x"),
        ("rate.w:off", "no signal 'rate.w'", "rate.z"),
        ("motor0:off", "no signal 'motor0'", "motor1, motor2, motor3"),
        ("attitude:of", "takes no 'of'", "off, stuck, bias, noise, delay, drop and garble"),
        ("attitude.x:stuck", "attitude.x takes no 'stuck'", "off, bias, noise and drop; attitude as a whole does"),
        ("command:bias=1", "command takes no 'bias'", "off, stuck, delay, drop, garble, duplicate and reorder"),
        ("measurement:noise=1", "measurement takes no 'noise'", "duplicate and reorder"),
        ("rate:duplicate=1", "rate takes no 'duplicate'", "drop and garble"),
        ("motor1:reorder=1", "motor1 takes no 'reorder'", "drop and garble"),
        ("attitude:off=1", "off takes no value, but was given 1", "write off alone"),
        ("motor1:stuck=0", "stuck takes no value, but was given 0", "write stuck alone"),
        ("rate:bias", "bias takes -35 to 35 rad/s", "bias=0.1"),
        ("rate:bias=nan", "not nan", "-35 to 35 rad/s"),
        ("attitude.x:bias=-3.2", "not -3.2", "-3.1416 to 3.1416 rad"),
        ("motors:bias=1e308", "not 1e+308", "-48 to 48 V"),
        ("motor1:noise=48.1", "not 48.1", "0 to 48 V"),
        ("rate:noise=inf", "not inf", "0 to 35 rad/s"),
        ("rate:noise=-1", "not -1", "0 to 35 rad/s"),
        ("rate:delay=10.5", "not 10.5", "0 to 10 s"),
        ("command:delay=-0.1", "not -0.1", "0 to 10 s"),
        ("rate:drop=0", "not 0", "a probability above 0 and up to 1"),
        ("rate:garble=1.01", "not 1.01", "a probability above 0 and up to 1"),
        ("command:duplicate=2", "not 2", "a probability above 0 and up to 1"),
        ("command:reorder", "reorder takes", "reorder=0.1"),
        ("rate:bias=", "'' is not a number", ""),
        ("rate:bias=much", "'much' is not a number", ""),
        ("rate:off@", "'' is not a number", ""),
        ("rate:off@soon", "'soon' is not a number", ""),
        ("rate:off@1..", "'' is not a number", ""),
        ("rate:off@-1", "not at -1 s", "within 0 to 1e+08 s"),
        ("rate:off@inf", "not at inf s", "within 0 to 1e+08 s"),
        ("rate:off@nan", "not at nan s", "within 0 to 1e+08 s"),
        ("rate:off@1e308", "not at 1e+308 s", "within 0 to 1e+08 s"),
        ("rate:off@4..2", "not at 2 s", "after it begins at 4 s"),
        ("rate:off@4..4", "not at 4 s", "after it begins at 4 s"),
        ("rate:off@4..inf", "not at inf s", "after it begins at 4 s and by 1e+08 s"),
        ("rate:off@4..1e9", "not at 1000000000 s", "by 1e+08 s"),
        ("rate:off\n@1", "takes no 'off\\n'", "off, stuck"),
    ],
)
def test_what_is_no_fault_is_refused_in_a_line_that_names_it_and_what_would_be_one(
    text: str, wrong: str, right: str
) -> None:
    with pytest.raises(ValueError, match="fault") as refused:
        Fault.parse(text)
    line = str(refused.value)
    assert type(refused.value) is ValueError
    assert line.startswith(f"fault {text!r}: ")
    assert "\n" not in line
    assert wrong in line
    assert right in line


def test_fields_are_held_to_the_same_rules_as_texts() -> None:
    with pytest.raises(ValueError, match="rate takes no 'reorder'"):
        Fault(signal="rate", kind="reorder", value=0.5)
    with pytest.raises(ValueError, match="bias takes -35 to 35 rad/s"):
        Fault(signal="rate", kind="bias")
    with pytest.raises(ValueError, match="extra"):
        Fault.model_validate({"signal": "rate", "kind": "off", "until": 3})


def values_of(signal: str, kind: str) -> st.SearchStrategy[float | None]:
    if kind in ("off", "stuck"):
        return st.none()
    if kind in ("bias", "noise"):
        size = {"attitude": MAX_ANGLE, "rate": MAX_RATE, "motors": MAX_VOLTS}[SIGNALS[signal].whole]
        return st.floats(-size if kind == "bias" else 0.0, size)
    return st.floats(0.0, 10.0) if kind == "delay" else st.floats(0.0, 1.0, exclude_min=True)


@st.composite
def any_fault(draw: st.DrawFn) -> Fault:
    signal = draw(st.sampled_from(sorted(SIGNALS)))
    kind = draw(st.sampled_from(SIGNALS[signal].kinds))
    start = draw(st.floats(0.0, MAX_TIME_S, exclude_max=True))
    end = draw(st.none() | st.floats(start, MAX_TIME_S, exclude_min=True))
    return Fault(signal=signal, kind=kind, value=draw(values_of(signal, kind)), start_s=start, end_s=end)


@given(fault=any_fault())
def test_what_is_written_reads_back_the_same(fault: Fault) -> None:
    assert Fault.parse(str(fault)) == fault


@given(text=st.text() | st.from_regex(r"(attitude|motor1|command):[a-z]*=?[-.0-9einf]*@?[-.0-9]*"))
def test_any_text_is_a_fault_or_one_line_that_states_why_not(text: str) -> None:
    reason = ""
    try:
        fault = Fault.parse(text)
    except ValueError as error:
        reason = str(error)
    if reason:
        assert reason.startswith(f"fault {text!r}: ")
        assert len(reason.splitlines()) == 1
    else:
        assert Fault.parse(str(fault)) == fault


def test_it_acts_from_its_start_until_just_before_its_end() -> None:
    fault = Fault.parse("rate:off@2..4")
    assert [fault.active(t) for t in (1.999, 2.0, 3.999, 4.0)] == [False, True, True, False]
    assert Fault.parse("rate:off").active(0.0)
    assert Fault.parse("rate:off").active(1e9)


# ── sensors ──


@pytest.mark.parametrize("signal", ["attitude", "attitude.x"])
def test_an_attitude_that_is_off_has_no_valid_value_while_it_lasts(signal: str) -> None:
    seen = sensed(f"{signal}:off@0.3..0.6")
    assert [missing(m.attitude) for m in seen] == [False] * 3 + [True] * 3 + [False] * 3
    assert [m.rate for m in seen] == [sample(k).rate for k in range(9)]


@pytest.mark.parametrize("signal", ["rate", "rate.y"])
def test_a_rate_that_is_off_in_any_axis_has_no_valid_value(signal: str) -> None:
    seen = sensed(f"{signal}:off@0.3..0.6")
    assert [missing(m.rate) for m in seen] == [False] * 3 + [True] * 3 + [False] * 3
    assert [m.attitude for m in seen] == [sample(k).attitude for k in range(9)]


@pytest.mark.parametrize("k", range(1, 100))
def test_a_fault_begins_and_ends_at_the_tick_that_its_decimals_mean(k: int) -> None:
    """In floats, 53 of the first 100 multiples of 0.009 fall short of their decimals: 3 · 0.009 < 0.027."""
    fault = Fault.parse(f"rate:off@{9 * k}e-3..{9 * k + 9}e-3")
    plant = FaultyPlant(Stand(), [fault], 0.009, voltage_limit=LIMIT)
    plant.start()
    seen = []
    for _ in range(k + 1):
        seen.append(missing(plant.measure().rate))
        plant.advance()
    assert [*seen, missing(plant.measure().rate)] == [False] * k + [True, False]
    ticks = passed(f"command:off@{9 * k}e-3..{9 * k + 9}e-3", frames=[b"a"] * (k + 2), period=0.009)
    assert [not tick for tick in ticks] == [False] * k + [True, False]


def test_a_stuck_sensor_reports_its_last_value_before_the_fault() -> None:
    seen = sensed("rate.y:stuck@0.3..0.6", "attitude:stuck@0.5")
    assert [m.rate for m in seen] == [(1.0 * k, 20.0 if 3 <= k < 6 else 10.0 * k, 100.0 * k) for k in range(9)]
    assert [m.attitude for m in seen] == [sample(min(k, 4)).attitude for k in range(9)]


def test_a_sensor_that_is_stuck_at_once_reports_its_first_value() -> None:
    assert [m.rate for m in sensed("rate:stuck")] == [sample(0).rate] * 9


def test_a_biased_rate_is_off_by_the_bias_in_its_axes() -> None:
    seen = sensed("rate.y:bias=0.5@0.3", "rate:bias=-2@0.6")
    for k, m in enumerate(seen):
        all_axes = -2.0 if k >= 6 else 0.0
        y = 0.5 if k >= 3 else 0.0
        assert m.rate == (k + all_axes, 10.0 * k + y + all_axes, 100.0 * k + all_axes)


@pytest.mark.parametrize(
    ("signal", "rotation"),
    [
        ("attitude.x", (0.3, 0.0, 0.0)),
        ("attitude.y", (0.0, 0.3, 0.0)),
        ("attitude.z", (0.0, 0.0, 0.3)),
        ("attitude", (0.3, 0.3, 0.3)),
    ],
)
def test_a_biased_attitude_is_turned_about_the_bodys_axes(signal: str, rotation: Vector) -> None:
    """At k = 7 the body has yawed by 0.14 rad, so that its axes and the inertial ones differ."""
    assert sensed(f"{signal}:bias=0.3", ticks=7)[7].attitude == pytest.approx(
        turned(sample(7).attitude, rotation), abs=1e-15
    )


def test_a_bias_about_the_axis_of_yaw_adds_to_the_yaw() -> None:
    yaw = 0.02 * 7 + 0.3
    assert sensed("attitude.z:bias=0.3", ticks=7)[7].attitude == pytest.approx(
        (cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)), abs=1e-15
    )


def test_no_bias_changes_nothing() -> None:
    assert sensed("attitude:bias=0", "rate:bias=0") == sensed()


def test_noise_on_a_rate_has_the_deviation_it_was_given_in_its_axes_only() -> None:
    """Of n samples, mean and deviation lie within 5 of their standard errors σ/√n and σ/√2n."""
    errors = [m.rate[1] - sample(k).rate[1] for k, m in enumerate(sensed("rate.y:noise=0.2", ticks=MANY))]
    assert fmean(errors) == pytest.approx(0.0, abs=5 * 0.2 / sqrt(MANY))
    assert pstdev(errors) == pytest.approx(0.2, abs=5 * 0.2 / sqrt(2 * MANY))
    for k, m in enumerate(sensed("rate.y:noise=0.2")):
        assert (m.rate[0], m.rate[2]) == (sample(k).rate[0], sample(k).rate[2])


def test_noise_on_all_axes_is_another_in_each() -> None:
    for k, m in enumerate(sensed("rate:noise=0.2")):
        assert len({round(seen - true, 6) for seen, true in zip(m.rate, sample(k).rate, strict=True)}) == 3


def test_noise_on_an_attitude_turns_it_by_a_random_angle() -> None:
    seen = sensed("attitude.z:noise=0.01", ticks=MANY)
    yaws = [2 * (sample(k).attitude[0] * q[3] - sample(k).attitude[3] * q[0]) for k, (q, _) in enumerate(seen)]
    assert pstdev(yaws) == pytest.approx(0.01, abs=5 * 0.01 / sqrt(2 * MANY))
    assert all(q[1] == q[2] == 0.0 for q, _ in seen)
    assert all(hypot(*q) == pytest.approx(1.0, abs=1e-12) for q, _ in sensed("attitude:noise=0.5"))
    assert all(q[1] and q[2] for q, _ in sensed("attitude:noise=0.5"))


def test_a_delayed_sensor_reports_what_was_true_then_even_from_before_the_fault() -> None:
    seen = sensed("rate.x:delay=0.2@0.4..0.7", "attitude:delay=0.3@0.1")
    assert [m.rate[0] for m in seen] == [0.0, 1.0, 2.0, 3.0, 2.0, 3.0, 4.0, 7.0, 8.0]
    assert [m.rate[1:] for m in seen] == [sample(k).rate[1:] for k in range(9)]
    assert [m.attitude for m in seen] == [sample(max(0, k - 3)).attitude for k in range(9)]


def test_a_delay_of_nothing_changes_nothing() -> None:
    assert sensed("rate:delay=0", "attitude:delay=0") == sensed()


def test_a_delay_within_a_period_reports_what_was_true_at_its_beginning() -> None:
    assert [m.rate[0] for m in sensed("rate:delay=0.05", ticks=3)] == [0.0, 0.0, 1.0, 2.0]


def test_history_that_is_asked_for_rarely_is_kept_all_the_same() -> None:
    plant, _ = faulty("rate:delay=0.2")
    for _ in range(5):
        plant.advance()
    assert plant.measure().rate == sample(3).rate


@pytest.mark.parametrize("signal", ["attitude", "attitude.y", "rate", "rate.z"])
def test_a_fifth_of_the_samples_is_missing_when_configured_so(signal: str) -> None:
    """Of n = 10,000 with p = 0.2 the deviation is √(np(1 − p)) = 40; 5 of them fail one seed in 1.7 million."""
    seen = sensed(f"{signal}:drop=0.2", ticks=MANY - 1)
    values = [m.attitude if signal.startswith("attitude") else m.rate for m in seen]
    gone = [missing(value) for value in values]
    assert abs(sum(gone) - 2000) <= 200
    assert all(isfinite(sum(value)) for value, lost in zip(values, gone, strict=True) if not lost)


def test_every_sample_is_missing_with_probability_one() -> None:
    assert all(missing(m.rate) for m in sensed("rate:drop=1"))


def test_garbled_attitudes_are_unit_quaternions_of_every_kind() -> None:
    """Each component of a uniform one has mean 0 and deviation 1/2: 5 standard errors."""
    garbled = [m.attitude for m in sensed("attitude:garble=1", ticks=MANY - 1)]
    assert all(hypot(*q) == pytest.approx(1.0, abs=1e-12) for q in garbled)
    for component in zip(*garbled, strict=True):
        assert fmean(component) == pytest.approx(0.0, abs=5 * 0.5 / sqrt(MANY))
        assert pstdev(component) == pytest.approx(0.5, abs=0.02)


def test_garbled_rates_are_anywhere_within_ten_radians_a_second() -> None:
    for i, component in enumerate(zip(*(m.rate for m in sensed("rate:garble=1", ticks=999)), strict=True)):
        assert -GARBLED_RATE <= min(component) < -0.98 * GARBLED_RATE, i
        assert 0.98 * GARBLED_RATE < max(component) <= GARBLED_RATE, i


def test_garbling_acts_on_its_axis_and_as_often_as_configured() -> None:
    seen = sensed("rate.y:garble=0.2", ticks=MANY - 1)
    changed = sum(m.rate[1] != sample(k).rate[1] for k, m in enumerate(seen))
    assert abs(changed - 2000) <= 200  # 5 deviations, as above
    assert all((m.rate[0], m.rate[2]) == (1.0 * k, 100.0 * k) for k, m in enumerate(seen))


def test_faults_act_one_after_another_in_the_order_given() -> None:
    assert sensed("rate:bias=1@0.3", "rate:stuck@0.3")[8].rate == sample(2).rate
    assert sensed("rate:stuck@0.3", "rate:bias=1@0.3")[8].rate == tuple(v + 1 for v in sample(2).rate)


def test_a_sample_is_taken_once_a_period_however_often_it_is_asked_for() -> None:
    plant, _ = faulty("rate:noise=1")
    plant.advance()
    assert plant.measure() == plant.measure()
    assert plant.measure() is plant.measure()
    once = plant.measure()
    plant.advance()
    assert plant.measure() != once


# ── motors ──


def test_a_motor_that_is_off_has_no_voltage_whatever_is_commanded() -> None:
    assert driven("motor2:off@0.3..0.6") == [(k, 0 if 3 <= k < 6 else -k) for k in range(8)]
    assert driven("motors:off@0.3..0.6") == [(0, 0) if 3 <= k < 6 else (k, -k) for k in range(8)]


def test_a_stuck_motor_keeps_the_voltage_it_had() -> None:
    assert driven("motor1:stuck@0.3..0.6") == [(2 if 3 <= k < 6 else k, -k) for k in range(8)]
    assert driven("motors:stuck@0.3") == [(min(k, 2), -min(k, 2)) for k in range(8)]


def test_a_motor_that_is_stuck_at_once_keeps_what_it_had_before_the_start() -> None:
    plant, stand = faulty("motor1:stuck", started=False)
    plant.actuate((5.0, 5.0))
    plant.start()
    plant.actuate((7.0, 7.0))
    assert stand.voltages == (5.0, 7.0)


def test_a_biased_motor_has_that_much_more() -> None:
    assert driven("motor1:bias=0.5@0.3", "motors:bias=-1@0.6") == [
        (k + 0.5 * (k >= 3) - (k >= 6), -k - (k >= 6)) for k in range(8)
    ]


def test_noise_on_a_motor_has_the_deviation_it_was_given() -> None:
    """Within 5 of the standard errors σ/√n and σ/√2n."""
    periods = driven("motor2:noise=0.3", ticks=MANY)
    errors = [u[1] + k for k, u in enumerate(periods)]
    assert fmean(errors) == pytest.approx(0.0, abs=5 * 0.3 / sqrt(MANY))
    assert pstdev(errors) == pytest.approx(0.3, abs=5 * 0.3 / sqrt(2 * MANY))
    assert all(u[0] == k for k, u in enumerate(periods))


def test_a_delayed_motor_does_what_was_commanded_then() -> None:
    assert driven("motor1:delay=0.2@0.4") == [(k - 2 if k >= 4 else k, -k) for k in range(8)]
    assert driven("motors:delay=0.3") == [(max(0, k - 3), -max(0, k - 3)) for k in range(8)]


def test_a_motor_has_no_voltage_in_a_fifth_of_the_periods() -> None:
    """As for sensors: 5 binomial deviations of 40."""
    periods = driven("motor2:drop=0.2", ticks=MANY)
    gone = sum(u[1] == 0 for u in periods[1:])
    assert abs(gone - 2000) <= 200
    assert all(u[1] in (0, -k) and u[0] == k for k, u in enumerate(periods))


def test_all_motors_are_lost_at_the_same_times() -> None:
    periods = driven("motors:drop=0.5", ticks=200)[1:]
    assert {(a == 0, b == 0) for a, b in periods} == {(True, True), (False, False)}


def test_a_garbled_motor_has_any_voltage_of_the_supply() -> None:
    periods = driven("motor1:garble=1", ticks=1000)
    assert -LIMIT <= min(u[0] for u in periods) < -0.98 * LIMIT
    assert 0.98 * LIMIT < max(u[0] for u in periods) <= LIMIT
    assert all(u[1] == -k for k, u in enumerate(periods))


def test_a_motor_fails_and_recovers_under_a_voltage_that_is_held() -> None:
    plant, stand = faulty("motor1:off@0.3..0.6")
    plant.actuate((5.0, 5.0))
    for _ in range(8):
        plant.advance()
    assert stand.periods == [(5, 5)] * 3 + [(0, 5)] * 3 + [(5, 5)] * 2


def test_a_motor_that_is_not_there_cannot_fail() -> None:
    with pytest.raises(ValueError, match=r"^fault 'motor3:off@2': the plant has no motor3, but motor1, motor2$"):
        faulty("motor3:off@2")
    plant, _ = faulty()
    with pytest.raises(ValueError, match="no motor3"):
        plant.inject(Fault.parse("motor3:off"))
    three, stand = faulty("motor3:off", actuators=3)
    three.actuate((1.0, 2.0, 3.0))
    assert (three.actuators, stand.voltages) == (3, (1.0, 2.0, 0.0))


# ── the plant's time ──


def test_nothing_fails_and_no_time_passes_before_the_start() -> None:
    plant, stand = faulty("rate:off", "motors:off", started=False)
    for _ in range(5):
        plant.actuate((3.0, 3.0))
        plant.advance()
    assert (plant.time, stand.voltages, plant.measure()) == (0.0, (3.0, 3.0), sample(5))
    plant.start()
    plant.actuate((3.0, 3.0))
    assert stand.voltages == (0.0, 0.0)
    assert missing(plant.measure().rate)
    plant.advance()
    plant.start()
    plant.advance()
    assert plant.time == 0.2


def test_the_time_waited_for_a_start_changes_no_random_number() -> None:
    def run(waited: int) -> list[float]:
        plant, stand = faulty("rate:noise=1", started=False)
        for _ in range(waited):
            plant.advance()
        plant.start()
        stand.k = 0
        seen = []
        for _ in range(5):
            plant.advance()
            seen.append(plant.measure().rate[0])
        return seen

    assert run(0) == run(7)


def test_an_injected_fault_counts_from_now() -> None:
    plant, _ = faulty()
    seen = []
    for k in range(10):
        if k == 4:
            plant.inject(Fault.parse("rate:off@0.2..0.4"))
        plant.advance()
        seen.append(missing(plant.measure().rate))
    assert seen == [t in (6, 7) for t in range(1, 11)]


def test_what_gets_stuck_now_holds_what_it_has_now() -> None:
    plant, stand = faulty()
    for k in range(1, 4):
        plant.actuate((1.0 * k, 2.0 * k))
        plant.advance()
        plant.measure()
    for text in ("motor1:stuck", "rate:stuck", "attitude:stuck"):
        plant.inject(Fault.parse(text))
    plant.actuate((9.0, 9.0))
    plant.advance()
    assert stand.voltages == (3.0, 9.0)
    assert plant.measure() == sample(3)


def test_what_is_late_from_now_on_is_what_it_is_now_until_the_delay_is_over() -> None:
    plant, stand = faulty()
    seen = []
    for k in range(1, 8):
        if k == 4:
            plant.inject(Fault.parse("motor1:delay=0.2"))
            plant.inject(Fault.parse("rate.x:delay=0.2"))
        plant.actuate((1.0 * k, 0.0))
        plant.advance()
        seen.append(plant.measure().rate[0])
    assert [u[0] for u in stand.periods] == [1, 2, 3, 3, 3, 4, 5]
    assert seen == [1, 2, 3, 3, 3, 4, 5]


@pytest.mark.parametrize("text", ["motor1:bias=1@0..0.2", "rate:bias=1@0..0.2", "attitude:bias=1@0..0.2"])
def test_a_fault_that_is_over_is_forgotten(text: str) -> None:
    """A plant that receives faults for days must not look through all of them at every tick."""
    fault = Fault.parse(text)
    plant = FaultyPlant(Stand(), [fault], PERIOD, voltage_limit=LIMIT)
    kept = ref(fault)
    del fault
    plant.start()
    plant.advance()
    assert kept() is not None
    plant.advance()
    plant.advance()
    assert kept() is None


def test_once_cleared_sensors_and_motors_act_as_without_faults() -> None:
    plant, stand = faulty("rate:off", "attitude:off", "motors:off")
    plant.actuate((5.0, 5.0))
    plant.advance()
    assert stand.voltages == (0.0, 0.0)
    plant.clear()
    assert stand.voltages == (5.0, 5.0)
    plant.advance()
    assert plant.measure() == sample(2)


@pytest.mark.parametrize("fault", ["motors:bias=3", "motors:stuck@0.1", "motors:garble=1", "motors:delay=1"])
def test_it_is_closed_at_no_voltage_whatever_its_faults(fault: str) -> None:
    plant, stand = faulty(fault)
    for _ in range(3):
        plant.actuate((5.0, 5.0))
        plant.advance()
    assert stand.voltages != (0.0, 0.0) or "delay" in fault
    for step in (plant.close, plant.close, plant.clear, plant.advance):
        step()
        assert stand.voltages == (0.0, 0.0)


def test_a_closed_plant_is_not_woken_by_a_fault_that_comes_too_late() -> None:
    plant, stand = faulty()
    plant.actuate((5.0, 5.0))
    plant.advance()
    plant.close()
    plant.inject(Fault.parse("motor1:off"))
    plant.advance()
    assert stand.voltages == (0.0, 0.0)


def test_the_plant_inside_is_at_hand() -> None:
    plant, stand = faulty("command:off", "measurement:off")
    assert plant.plant is stand
    plant.actuate((1.0, 2.0))
    plant.advance()
    assert (stand.voltages, plant.measure()) == ((1.0, 2.0), sample(1))


def test_an_endpoint_trips_when_its_sensors_fail() -> None:
    """0.1 s are 50 ticks of 2 ms."""
    wire, period_ns = WireSpec(), 2_000_000
    still = Stand()
    plant = FaultyPlant(still, [Fault.parse("rate:off@0.2")], 0.002, voltage_limit=LIMIT)
    guard = Guard(LimitSettings(max_rate=1e9, max_invalid_s=0.1), period_ns, LIMIT)
    endpoint = Endpoint(plant, wire, period_ns, guard=guard, armed=True)
    claim = Claim(controller="a", session="a", period_ns=period_ns, lockstep=False, auto_arm=False, wire=wire)
    assert isinstance(endpoint.claim(claim), Grant)
    plant.start()
    endpoint.tick(None, 0)
    k = 0
    while endpoint.state in (PlantState.GRANTED, PlantState.DRIVEN):
        endpoint.tick(wire.command.pack(endpoint.counter, [1, 1]), k := k + 1)
        assert k < 1000
    assert endpoint.cause is not None
    assert "no valid value" in endpoint.cause
    assert k == 100 + 50
    assert still.voltages == (0.0, 0.0)


# ── streams ──


def test_a_stream_without_faults_passes_what_comes() -> None:
    assert passed(frames=[b"a", None, b"b"]) == [[b"a"], [], [b"b"]]


def test_nothing_passes_a_stream_that_is_off() -> None:
    assert passed("command:off@0.2..0.4", frames=letters(6)) == [[b"a"], [b"b"], [], [], [b"e"], [b"f"]]


def test_a_stuck_stream_passes_its_last_frame_for_each_new_one() -> None:
    frames = [b"a", b"b", b"c", None, b"e", b"f"]
    assert passed("command:stuck@0.2..0.5", frames=frames) == [[b"a"], [b"b"], [b"b"], [], [b"b"], [b"f"]]
    assert passed("command:stuck", frames=letters(3)) == [[b"a"]] * 3


def test_a_delayed_stream_keeps_order_and_count() -> None:
    assert passed("command:delay=0.2", frames=letters(5)) == [[], [], [b"a"], [b"b"], [b"c"]]
    late = passed("command:delay=0.05", frames=letters(3))
    assert late == [[], [b"a"], [b"b"]]


def test_what_is_on_its_way_when_a_delay_ends_comes_at_once_and_first() -> None:
    ticks = passed("command:delay=0.2@0.1..0.4", frames=letters(6))
    assert ticks == [[b"a"], [], [], [b"b"], [b"c", b"d", b"e"], [b"f"]]


@given(delay_ms=st.integers(0, 30), start=st.integers(0, 40), length=st.integers(1, 40))
def test_every_frame_passes_a_delay_once_and_in_order_and_none_too_late(delay_ms: int, start: int, length: int) -> None:
    text = f"command:delay={delay_ms / 1000}@{start / 1000}..{(start + length) / 1000}"
    frames = numbered(60)
    ticks = passed(text, frames=[*frames, *[None] * 60], period=0.001)
    assert flat(ticks) == frames
    for k, tick in enumerate(ticks):
        for frame in tick:
            sent = int.from_bytes(frame, "big")
            due = sent + delay_ms if start <= sent < start + length else sent
            assert k == min(due, max(sent, start + length))


def test_a_fifth_of_the_frames_is_lost_and_the_others_pass_as_they_are() -> None:
    """As for sensors: 5 binomial deviations of 40."""
    frames = numbered(MANY)
    ticks = passed("command:drop=0.2", frames=frames)
    assert abs(sum(not tick for tick in ticks) - 2000) <= 200
    assert all(tick in ([], [frame]) for tick, frame in zip(ticks, frames, strict=True))


def test_a_garbled_frame_differs_in_exactly_one_bit_and_in_any() -> None:
    frame = bytes(range(3))
    flips = set()
    for (garbled,) in passed("command:garble=1", frames=[frame] * 500):
        difference = int.from_bytes(garbled, "big") ^ int.from_bytes(frame, "big")
        assert len(garbled) == 3
        assert difference.bit_count() == 1
        flips.add(difference)
    assert len(flips) == 24  # that a bit is spared 500 times has probability (23/24)^500 = 6e-10
    assert passed("command:garble=1", frames=[b""]) == [[b""]]
    changed = sum(tick != [frame] for tick in passed("command:garble=0.2", frames=[frame] * MANY))
    assert abs(changed - 2000) <= 200  # 5 deviations, as above


def test_a_duplicate_passes_a_tick_later_before_the_next_frame() -> None:
    assert passed("command:duplicate=1@0.1..0.3", frames=[*letters(4), None]) == [
        [b"a"],
        [b"b"],
        [b"b", b"c"],
        [b"c", b"d"],
        [],
    ]
    assert passed("command:duplicate=1", frames=[b"a", None, None]) == [[b"a"], [b"a"], []]
    assert abs(len(flat(passed("command:duplicate=0.2", frames=numbered(MANY)))) - 12_000) <= 200


def test_a_reordered_frame_changes_places_with_the_next() -> None:
    assert passed("command:reorder=1", frames=letters(4)) == [[], [b"b", b"a"], [], [b"d", b"c"]]
    assert passed("command:reorder=1@0.1..0.2", frames=[b"a", b"b", None, b"d", b"e"]) == [
        [b"a"],
        [],
        [],
        [b"d", b"b"],
        [b"e"],
    ]


def test_reordering_loses_and_repeats_nothing() -> None:
    """A fifth of those that could be held back are: of n frames, about n·p/(1 + p) = 1667, and 5·40 around it."""
    frames = numbered(MANY)
    ticks = passed("command:reorder=0.2@0..999.9", frames=frames)
    assert sorted(flat(ticks)) == frames
    assert abs(sum(len(tick) == 2 for tick in ticks) - 1667) <= 200
    assert all(tick[0] > tick[1] for tick in ticks if len(tick) == 2)


def test_stream_faults_act_one_after_another() -> None:
    assert passed("command:duplicate=1", "command:delay=0.1", frames=[b"a", None, None]) == [[], [b"a"], [b"a"]]
    assert passed("command:delay=0.1", "command:off@0.1", frames=letters(3)) == [[], [], []]


def test_a_stream_knows_only_its_own_faults() -> None:
    faults = [Fault.parse("measurement:off"), Fault.parse("rate:off")]
    assert FaultyStream("command", faults).passes(b"a", 0.0) == [b"a"]
    assert FaultyStream("measurement", faults).passes(b"a", 0.0) == []


def test_a_stream_passes_frames_untouched_until_something_is_injected_and_after_it_is_over() -> None:
    stream = FaultyStream("command", [])
    assert stream.passes(b"a", 5.0) == [b"a"]
    stream.inject(Fault.parse("measurement:off"), 5.0)
    stream.inject(Fault.parse("command:stuck@0.1..0.2"), 5.0)
    assert [stream.passes(frame, t) for frame, t in ((b"b", 5.0), (b"c", 5.1), (b"d", 5.2))] == [[b"b"], [b"b"], [b"d"]]
    stream.inject(Fault.parse("command:stuck"), 5.3)
    assert stream.passes(b"e", 5.3) == [b"d"]
    stream.clear()
    assert stream.passes(b"f", 5.4) == [b"f"]


def test_what_is_held_back_for_one_session_is_lost_with_it() -> None:
    stream = FaultyStream("command", [Fault.parse("command:delay=0.1")])
    assert stream.passes(b"a", 0.0) == []
    stream.forget()
    assert stream.passes(b"b", 0.1) == []
    assert stream.passes(None, 0.2) == [b"b"]


# ── again ──

RANDOM = ("attitude:noise=0.1", "attitude:garble=0.3", "rate:noise=0.1", "rate.x:garble=0.3", "rate:drop=0.3")


def test_the_same_seed_fails_the_same_way_and_another_otherwise() -> None:
    def all_of(seed: int) -> list[str]:
        seen = sensed(*RANDOM, ticks=50, seed=seed)
        motors = driven("motors:noise=1", "motor1:garble=0.3", "motors:drop=0.3", ticks=50, seed=seed)
        stream = [
            passed(f"command:{kind}=0.5", frames=numbered(50), seed=seed)
            for kind in ("drop", "garble", "duplicate", "reorder")
        ]
        return [repr(part) for part in (seen, motors, *stream)]

    assert all_of(3) == all_of(3)
    assert all(one != other for one, other in zip(all_of(3), all_of(4), strict=True))


def test_one_more_fault_leaves_the_random_numbers_of_the_others() -> None:
    alone = [m.rate for m in sensed("rate:noise=0.1")]
    assert [m.rate for m in sensed("rate:noise=0.1", "attitude:garble=0.5")] == alone


def test_the_two_streams_do_not_lose_the_same_ticks() -> None:
    def lost(signal: str) -> list[bool]:
        stream = FaultyStream("command" if signal == "command" else "measurement", [Fault.parse(f"{signal}:drop=0.5")])
        return [not stream.passes(b"a", 0.1 * k) for k in range(100)]

    assert lost("command") != lost("measurement")


def test_identity_is_turned_by_the_angle_of_the_bias() -> None:
    plant = FaultyPlant(Stand(), [Fault.parse(f"attitude.x:bias={pi / 2!r}")], PERIOD, voltage_limit=LIMIT)
    assert plant.measure() == Measurement(IDENTITY, (0.0, 0.0, 0.0))
    plant.start()
    assert plant.measure().attitude == pytest.approx((sqrt(0.5), sqrt(0.5), 0.0, 0.0), abs=1e-15)
