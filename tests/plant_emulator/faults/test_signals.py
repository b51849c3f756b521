"""Faults of sensors and motors: each acts as specified, when specified, in its own components only."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, hypot, nan, sin, sqrt
from statistics import fmean, pstdev

import pytest

from aeroloop.plant_emulator.faults.injection import GARBLED_RATE
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector
from tests.support.faulty_plant import LIMIT, driven, faulty, missing, sample, sensed

MANY = 10_000
GONE = nan, nan, nan


def between(k: int, start: int, end: int = 100) -> bool:
    return start <= k < end


@pytest.mark.parametrize(
    ("faults", "rate"),
    [
        (["rate:off@0.3..0.6"], lambda k, true: GONE if between(k, 3, 6) else true(k)),
        (["rate.y:off@0.3..0.6"], lambda k, true: GONE if between(k, 3, 6) else true(k)),
        (["rate:stuck"], lambda _, true: true(0)),
        (["rate.y:stuck@0.3..0.6"], lambda k, _: (k, 20 if between(k, 3, 6) else 10 * k, 100 * k)),
        (["rate:bias=0"], lambda k, true: true(k)),
        (["rate.y:bias=0.5@0.3"], lambda k, _: (k, 10 * k + 0.5 * between(k, 3), 100 * k)),
        (["rate:bias=-2@0.6"], lambda k, true: tuple(x - 2 * between(k, 6) for x in true(k))),
        (["rate:delay=0"], lambda k, true: true(k)),
        (["rate:delay=0.05"], lambda k, true: true(max(0, k - 1))),  # what was true at the beginning of a period
        (["rate.x:delay=0.2@0.4..0.7"], lambda k, _: (k - 2 * between(k, 4, 7), 10 * k, 100 * k)),
        (["rate:drop=1"], lambda *_: GONE),
        (["rate:bias=1@0.3", "rate:stuck@0.3"], lambda k, true: true(min(k, 2))),  # one after another, in this order
        (["rate:stuck@0.3", "rate:bias=1@0.3"], lambda k, true: tuple(x + between(k, 3) for x in true(min(k, 2)))),
    ],
)
def test_a_rate_fails_as_written_and_the_attitude_does_not(
    faults: list[str], rate: Callable[[int, Callable[[int], Vector]], Vector]
) -> None:
    seen = sensed(*faults)
    assert [m.rate for m in seen] == [
        pytest.approx(rate(k, lambda k: sample(k).rate), abs=0, nan_ok=True) for k in range(9)
    ]
    assert [m.attitude for m in seen] == [sample(k).attitude for k in range(9)]


@pytest.mark.parametrize(
    ("fault", "reported"),
    [
        ("attitude:off@0.3..0.6", lambda k: None if between(k, 3, 6) else k),
        ("attitude.x:off@0.3..0.6", lambda k: None if between(k, 3, 6) else k),
        ("attitude:stuck@0.5", lambda k: min(k, 4)),
        ("attitude:bias=0", lambda k: k),
        ("attitude:delay=0", lambda k: k),
        ("attitude:delay=0.3@0.1", lambda k: max(0, k - 3)),  # even from before the fault
    ],
)
def test_an_attitude_fails_as_written_and_the_rate_does_not(fault: str, reported: Callable[[int], int | None]) -> None:
    for k, m in enumerate(sensed(fault)):
        of = reported(k)
        assert missing(m.attitude) if of is None else m.attitude == sample(of).attitude
        assert m.rate == sample(k).rate


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
    seen = sensed(f"{signal}:bias=0.3", ticks=7)
    assert seen[7].attitude == pytest.approx(turned(sample(7).attitude, rotation), abs=1e-15)
    assert seen[0].attitude == pytest.approx(turned(IDENTITY, rotation), abs=1e-15)


def errors(signal: str, noise: float) -> list[float]:
    """Of many samples, what noise on this signal adds to it."""
    fault = f"{signal}:noise={noise}"
    if signal == "motor2":
        return [u[1] + k for k, u in enumerate(driven(fault, ticks=MANY))]
    seen = sensed(fault, ticks=MANY)
    if signal == "rate.y":
        return [m.rate[1] - sample(k).rate[1] for k, m in enumerate(seen)]
    true = [sample(k).attitude for k in range(MANY + 1)]
    return [2 * (p[0] * q[3] - p[3] * q[0]) for p, (q, _) in zip(true, seen, strict=True)]


@pytest.mark.parametrize(("signal", "noise"), [("rate.y", 0.2), ("attitude.z", 0.01), ("motor2", 0.3)])
def test_noise_has_the_deviation_it_was_given(signal: str, noise: float) -> None:
    """Of n samples, mean and deviation lie within 5 of their standard errors σ/√n and σ/√2n."""
    added = errors(signal, noise)
    assert fmean(added) == pytest.approx(0.0, abs=5 * noise / sqrt(MANY))
    assert pstdev(added) == pytest.approx(noise, abs=5 * noise / sqrt(2 * MANY))


def test_noise_is_in_its_components_only_and_in_each_another() -> None:
    for k, m in enumerate(sensed("rate.y:noise=0.2")):
        assert (m.rate[0], m.rate[2]) == (sample(k).rate[0], sample(k).rate[2])
    for k, m in enumerate(sensed("rate:noise=0.2")):
        assert len({round(seen - true, 6) for seen, true in zip(m.rate, sample(k).rate, strict=True)}) == 3
    assert all(q[1] == q[2] == 0.0 for q, _ in sensed("attitude.z:noise=0.01"))
    for q, _ in sensed("attitude:noise=0.5"):
        assert q[1]
        assert q[2]
        assert hypot(*q) == pytest.approx(1.0, abs=1e-12)
    assert all(u[0] == k for k, u in enumerate(driven("motor2:noise=0.3")))


@pytest.mark.parametrize("signal", ["attitude", "attitude.y", "rate", "rate.z", "rate.y", "motor2"])
def test_a_fifth_of_the_values_fails_when_configured_so_and_the_others_are_true(signal: str) -> None:
    """Of n = 10,000 with p = 0.2 the deviation is √(np(1 − p)) = 40; 5 of them fail one seed in 1.7 million."""
    if signal == "motor2":
        periods = driven("motor2:drop=0.2", ticks=MANY)
        failed = [u[1] == 0 for u in periods[1:]]
        assert all(u[1] in (0, -k) and u[0] == k for k, u in enumerate(periods))
    elif signal == "rate.y":
        seen = sensed("rate.y:garble=0.2", ticks=MANY - 1)
        failed = [m.rate[1] != sample(k).rate[1] for k, m in enumerate(seen)]
        assert all((m.rate[0], m.rate[2]) == (1.0 * k, 100.0 * k) for k, m in enumerate(seen))
    else:
        seen, i = sensed(f"{signal}:drop=0.2", ticks=MANY - 1), signal.startswith("rate")
        failed = [missing(m[i]) for m in seen]
        assert all(lost or m[i] == sample(k)[i] for k, (m, lost) in enumerate(zip(seen, failed, strict=True)))
    assert abs(sum(failed) - 2000) <= 200


def test_garbled_attitudes_are_unit_quaternions_of_every_kind() -> None:
    """Each component of a uniform one has mean 0 and deviation 1/2: 5 standard errors."""
    garbled = [m.attitude for m in sensed("attitude:garble=1", ticks=MANY - 1)]
    assert all(hypot(*q) == pytest.approx(1.0, abs=1e-12) for q in garbled)
    for component in zip(*garbled, strict=True):
        assert fmean(component) == pytest.approx(0.0, abs=5 * 0.5 / sqrt(MANY))
        assert pstdev(component) == pytest.approx(0.5, abs=0.02)


def test_garbled_rates_and_motors_are_anywhere_within_their_range_and_no_others() -> None:
    rates = list(zip(*(m.rate for m in sensed("rate:garble=1", ticks=999)), strict=True))
    motors = driven("motor1:garble=1", ticks=1000)
    for limit, values in [*((GARBLED_RATE, rate) for rate in rates), (LIMIT, [u[0] for u in motors])]:
        assert -limit <= min(values) < -0.98 * limit
        assert 0.98 * limit < max(values) <= limit
    assert all(u[1] == -k for k, u in enumerate(motors))


def test_history_that_is_asked_for_rarely_is_kept_all_the_same() -> None:
    plant, _ = faulty("rate:delay=0.2")
    for _ in range(5):
        plant.advance()
    assert plant.measure().rate == sample(3).rate


def test_a_sample_is_taken_once_a_period_however_often_it_is_asked_for() -> None:
    plant, _ = faulty("rate:noise=1")
    plant.advance()
    once = plant.measure()
    assert plant.measure() is once
    plant.advance()
    assert plant.measure() != once


# ── motors ──


@pytest.mark.parametrize(
    ("faults", "voltages"),
    [
        (["motor2:off@0.3..0.6"], lambda k: (k, 0 if between(k, 3, 6) else -k)),
        (["motors:off@0.3..0.6"], lambda k: (0, 0) if between(k, 3, 6) else (k, -k)),
        (["motor1:stuck@0.3..0.6"], lambda k: (2 if between(k, 3, 6) else k, -k)),
        (["motors:stuck@0.3"], lambda k: (min(k, 2), -min(k, 2))),
        (["motor1:bias=0.5@0.3", "motors:bias=-1@0.6"], lambda k: (k + 0.5 * (k >= 3) - (k >= 6), -k - (k >= 6))),
        (["motor1:delay=0.2@0.4"], lambda k: (k - 2 if k >= 4 else k, -k)),
        (["motors:delay=0.3"], lambda k: (max(0, k - 3), -max(0, k - 3))),
    ],
)
def test_a_motor_fails_as_written(faults: list[str], voltages: Callable[[int], tuple[float, float]]) -> None:
    assert driven(*faults) == [voltages(k) for k in range(8)]


def test_a_motor_that_is_stuck_at_once_keeps_what_it_had_before_the_start() -> None:
    plant, stand = faulty("motor1:stuck", started=False)
    plant.actuate((5.0, 5.0))
    plant.start()
    plant.actuate((7.0, 7.0))
    assert stand.voltages == (5.0, 7.0)


def test_all_motors_are_lost_at_the_same_times() -> None:
    periods = driven("motors:drop=0.5", ticks=200)[1:]
    assert {(a == 0, b == 0) for a, b in periods} == {(True, True), (False, False)}


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
