"""Faults: their notation, each kind on values and frames, their time, injection and random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import chain
from math import cos, inf, isnan, nan, nextafter, sin, sqrt, ulp
from statistics import fmean, pstdev

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aeroloop.plant_emulator.faults.injection import MAX_FAULTS, Faults
from aeroloop.plant_emulator.faults.language import BY_CHANCE, MAX_DELAY_S, MAX_TIME_S, SIGNALS, Fault, FaultError
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.wire.attitude import Vector
from tests.support.plant_end import RecordingPlant

PERIOD = 0.1
LIMIT = 24.0


def sample(k: int) -> Measurement:
    """What is true after k periods: no two are alike, in no component."""
    return Measurement((cos(0.01 * k), 0.0, 0.0, sin(0.01 * k)), (1.0 * k, 10.0 * k, 100.0 * k))


class Faulty(RecordingPlant):
    """A plant behind faults, asked as the endpoint asks them. Without them it measures the count of its periods."""

    def __init__(
        self, *faults: str, seed: int = 0, actuators: int = 2, started: bool = True, period: float = PERIOD
    ) -> None:
        super().__init__(actuators)
        self.faults = Faults(actuators, period, voltage_limit=LIMIT, seed=seed)
        self.faults.inject([Fault.parse(fault) for fault in faults], "configured")
        if started:
            self.faults.start()

    def actuate(self, voltages: Sequence[float]) -> None:
        super().actuate(self.faults.voltages(tuple(voltages)))

    def advance(self) -> None:
        super().advance()
        self.faults.advance(self)

    def measure(self) -> Measurement:
        return sample(len(self.periods))

    def seen(self) -> Measurement:
        return self.faults.measure(self)

    def commands(self, frame: bytes | None) -> list[bytes]:
        return self.faults.passes("command", frame)

    def inject(self, *faults: str, clear: bool = False) -> list[tuple[int, str]]:
        return self.faults.inject([Fault.parse(fault) for fault in faults], "injected", clear=clear)


def sensed(*faults: str, ticks: int = 8, seed: int = 0) -> list[Measurement]:
    plant = Faulty(*faults, seed=seed)
    seen = [plant.seen()]
    for _ in range(ticks):
        plant.advance()
        seen.append(plant.seen())
    return seen


def driven(*faults: str, ticks: int = 8, seed: int = 0) -> list[tuple[float, ...]]:
    """What the motors have in the periods that begin at 0, 0.1, 0.2, …, commanded (k, −k)."""
    plant = Faulty(*faults, seed=seed)
    for k in range(ticks):
        plant.actuate((float(k), float(-k)))
        plant.advance()
    return plant.periods


def passed(*faults: str, frames: Sequence[bytes | None], seed: int = 0) -> list[list[bytes]]:
    """The commands that pass at 0 s, 0.1 s, 0.2 s and so on."""
    plant = Faulty(*faults, seed=seed)
    ticks = []
    for frame in frames:
        ticks.append(plant.commands(frame))
        plant.advance()
    return ticks


def numbered(count: int) -> list[bytes]:
    return [k.to_bytes(4, "big") for k in range(count)]


def missing(values: Sequence[float]) -> bool:
    return all(isnan(value) for value in values)


@pytest.mark.parametrize(
    ("text", "wrong", "right"),
    [
        ("attitude", "it is written", "signal:kind[=value][@start[..end]]"),
        ("altitude:off", "no signal 'altitude'", "attitude, attitude.x"),
        ("attitude.x:stuck", "attitude.x takes no 'stuck'", "off, bias, noise, drop; attitude as a whole does"),
        ("attitude:off=1", "off takes no value, but was given 1", "write off alone"),
        ("rate:bias", "bias takes -35 to 35 rad/s", "bias=0.1"),
        ("rate:bias=much", "could not convert string to float: 'much'", ""),
        ("rate:off@4..2", "not at 2 s", "after it begins at 4 s"),
        ("rate:off\n@1", "takes no 'off\\n'", "off, stuck"),
    ],
)
def test_what_is_no_fault_is_refused_in_a_line_that_names_it_and_what_would_be_one(
    text: str, wrong: str, right: str
) -> None:
    with pytest.raises(FaultError) as refused:
        Fault.parse(text)
    line = str(refused.value)
    assert line.startswith(f"fault {text!r}: ")
    assert "\n" not in line
    assert wrong in line
    assert right in line


def range_of(signal: str, kind: str) -> tuple[float, float] | None:
    """Least and largest value; None for a kind without one."""
    largest = SIGNALS[signal].largest
    ranges = {"bias": (-largest, largest), "noise": (0.0, largest), "delay": (0.0, MAX_DELAY_S)}
    return (ulp(0.0), 1.0) if kind in BY_CHANCE else ranges.get(kind)


@st.composite
def any_fault(draw: st.DrawFn) -> Fault:
    signal = draw(st.sampled_from(sorted(SIGNALS)))
    kind = draw(st.sampled_from(SIGNALS[signal].kinds))
    start = draw(st.floats(0.0, MAX_TIME_S, exclude_max=True))
    end = draw(st.none() | st.floats(start, MAX_TIME_S, exclude_min=True))
    within = range_of(signal, kind)
    value = None if within is None else draw(st.floats(*within))
    return Fault(signal=signal, kind=kind, value=value, start_s=start, end_s=end)


@given(fault=any_fault())
def test_a_fault_reads_back_the_same_and_just_beyond_its_ranges_is_none(fault: Fault) -> None:
    assert Fault.parse(str(fault)) == fault
    within, start = range_of(fault.signal, fault.kind), fault.start_s
    values = [0.0, 1.0] if within is None else [None, nan, nextafter(within[0], -inf), nextafter(within[1], inf)]
    wrong: list[tuple[str, float | None]] = [("value", value) for value in values]
    wrong += [("start_s", t) for t in (-ulp(0.0), nan, inf, MAX_TIME_S + 1)]
    wrong += [("end_s", t) for t in (start, nan, inf, nextafter(MAX_TIME_S, inf))]
    for field, value in wrong:
        with pytest.raises(ValueError, match=r"takes|must"):
            Fault(**{**asdict(fault), field: value})


# ── kinds ──


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
        (["rate.y:bias=0.5@0.3"], lambda k, _: (k, 10 * k + 0.5 * between(k, 3), 100 * k)),
        (["rate:delay=0.05"], lambda k, true: true(max(0, k - 1))),  # what was true at the beginning of a period
        (["rate.x:delay=0.2@0.4..0.7"], lambda k, _: (k - 2 * between(k, 4, 7), 10 * k, 100 * k)),
        (["rate:drop=1"], lambda *_: GONE),
        (["rate:bias=1@0.3", "rate:stuck@0.3"], lambda k, true: true(min(k, 2))),  # one after another, in this order
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


@pytest.mark.parametrize(("signal", "rotation"), [("attitude.x", (0.3, 0.0, 0.0)), ("attitude", (0.3, 0.3, 0.3))])
def test_a_biased_attitude_is_turned_about_the_bodys_axes(signal: str, rotation: Vector) -> None:
    """At k = 7 the body has yawed by 0.14 rad, so that its axes and the inertial ones differ."""
    q = Rotation.from_quat(sample(7).attitude, scalar_first=True) * Rotation.from_rotvec(rotation)
    seen = sensed(f"{signal}:bias=0.3", ticks=7)[7]
    assert seen.attitude == pytest.approx(q.as_quat(scalar_first=True).tolist(), abs=1e-15)


def test_noise_has_the_deviation_it_was_given() -> None:
    """Of n samples, mean and deviation lie within 5 of their standard errors σ/√n and σ/√2n."""
    noise = 0.2
    added = [m.rate[1] - sample(k).rate[1] for k, m in enumerate(sensed(f"rate.y:noise={noise}", ticks=MANY))]
    assert fmean(added) == pytest.approx(0.0, abs=5 * noise / sqrt(MANY))
    assert pstdev(added) == pytest.approx(noise, abs=5 * noise / sqrt(2 * MANY))


# ── motors ──


@pytest.mark.parametrize(
    ("faults", "voltages"),
    [
        (["motor2:off@0.3..0.6"], lambda k: (k, 0 if between(k, 3, 6) else -k)),
        (["motors:off@0.3..0.6"], lambda k: (0, 0) if between(k, 3, 6) else (k, -k)),
        (["motor1:stuck@0.3..0.6"], lambda k: (2 if between(k, 3, 6) else k, -k)),
        (["motor1:bias=0.5@0.3", "motors:bias=-1@0.6"], lambda k: (k + 0.5 * (k >= 3) - (k >= 6), -k - (k >= 6))),
        (["motor1:delay=0.2@0.4"], lambda k: (k - 2 if k >= 4 else k, -k)),
        (["motors:delay=0.3"], lambda k: (max(0, k - 3), -max(0, k - 3))),
    ],
)
def test_a_motor_fails_as_written(faults: list[str], voltages: Callable[[int], tuple[float, float]]) -> None:
    assert driven(*faults) == [voltages(k) for k in range(8)]


# ── frames ──


@pytest.mark.parametrize(
    ("faults", "frames", "ticks"),
    [
        ([], ["a", "", "b"], ["a", "", "b"]),
        (["off@0.2..0.4"], "abcdef", ["a", "b", "", "", "e", "f"]),
        (["stuck@0.2..0.5"], ["a", "b", "c", "", "e", "f"], ["a", "b", "b", "", "b", "f"]),
        (["delay=0.2@0.1..0.4"], "abcdef", ["a", "", "", "b", "cde", "f"]),  # what is on its way comes at once, first
        (["duplicate=1@0.1..0.3"], [*"abcd", ""], ["a", "b", "bc", "cd", ""]),
        (["reorder=1@0.1..0.2"], ["a", "b", "", "d", "e"], ["a", "", "", "db", "e"]),
        (["duplicate=1", "delay=0.1"], ["a", "", ""], ["", "a", "a"]),  # one after another, in this order
        (["delay=0.1", "off@0.1"], "abc", ["", "", ""]),
    ],
)
def test_frames_pass_as_written(faults: list[str], frames: Sequence[str], ticks: list[str]) -> None:
    seen = passed(*(f"command:{fault}" for fault in faults), frames=[frame.encode() or None for frame in frames])
    assert [b"".join(tick).decode() for tick in seen] == ticks


def test_a_fifth_of_the_frames_is_dropped_and_none_is_lost_by_reordering() -> None:
    """Five binomial deviations of 40. Of n that could be held back, n·p/(1 + p) = 1667 change places."""
    frames = numbered(MANY)
    dropped = passed("command:drop=0.2@0..999.9", frames=frames)
    assert abs(sum(not tick for tick in dropped) - 2000) <= 200
    assert all(tick in ([], [frame]) for tick, frame in zip(dropped, frames, strict=True))
    reordered = passed("command:reorder=0.2@0..999.9", frames=frames)
    assert sorted(chain(*reordered)) == frames
    assert abs(sum(len(tick) == 2 for tick in reordered) - 1667) <= 200
    assert all(tick[0] > tick[1] for tick in reordered if len(tick) == 2)


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


# ── begin and end ──


@example(period=0.009, start=27, length=None)
@given(
    period=st.sampled_from((0.002, 0.009, 1 / 300, 0.1)),
    start=st.integers(0, 300),
    length=st.none() | st.integers(1, 300),
)
def test_a_fault_acts_at_the_ticks_of_its_status_and_events_and_at_no_other(
    period: float, start: int, length: int | None
) -> None:
    """Starts and ends are whole milliseconds, most of them between two ticks; 3 · 0.009 < 0.027 in floats."""
    end = "" if length is None else f"..{(start + length) / 1000}"
    plant = Faulty(f"rate:off@{start / 1000}{end}", f"command:off@{start / 1000}{end}", period=period)
    acted, events = [], []
    for k in range(round(0.7 / period)):
        acted.append(missing(plant.seen().rate))
        assert (plant.commands(b"a") == []) == acted[-1]
        events += [tick for tick, _ in plant.faults.transitions()]
        assert acted[-1] == (start / 1000 <= round(k * period, 9) < (start + (length or 1000)) / 1000)
        plant.advance()
    for status in plant.faults.statuses(0):
        assert status.begin_tick is not None
        ticks = range(status.begin_tick, len(acted) if status.end_tick is None else status.end_tick)
        assert acted == [k in ticks for k in range(len(acted))]
        edges = [] if not ticks else [ticks.start] if length is None else [ticks.start, ticks.stop]
        assert events == sorted(2 * edges)


def test_nothing_fails_and_no_time_passes_before_the_start() -> None:
    faults = ("rate:off", "motors:off", "command:off", "motor1:noise=1")
    plant, at_once = Faulty(*faults, started=False), Faulty(*faults)
    for k in range(5):
        plant.actuate((3.0, 3.0))
        plant.advance()
        assert (plant.faults.time, plant.voltages, plant.seen()) == (0.0, (3.0, 3.0), sample(k + 1))
        assert plant.commands(b"a") == [b"a"]
    plant.faults.start()
    for each in (plant, at_once):
        each.actuate((3.0, 3.0))
    assert plant.voltages == at_once.voltages != (0.0, 0.0)  # nor does the wait use up random numbers
    assert missing(plant.seen().rate)


@pytest.mark.parametrize(
    ("kind", "first", "later"),
    [
        ("stuck", b"new", b"new"),
        ("delay=0.1", b"", b"new"),
        ("duplicate=1", b"new", b"newnewer"),
        ("reorder=1", b"", b"newernew"),
    ],
)
def test_no_frame_of_a_session_acts_in_the_next(kind: str, first: bytes, later: bytes) -> None:
    """Neither one that was held back nor the last one that passed."""
    plant = Faulty(f"command:{kind}@0.2")
    for frame in (b"old", b"older", b"oldest"):
        plant.commands(frame)
        plant.advance()
    plant.faults.forget_frames()
    assert b"".join(plant.commands(b"new")) == first
    plant.advance()
    assert b"".join(plant.commands(b"newer")) == later


def test_a_fault_injected_in_a_session_holds_no_frame_of_the_one_before() -> None:
    plant = Faulty()
    assert plant.commands(b"old") == [b"old"]
    plant.faults.forget_frames()
    plant.inject("command:stuck")
    assert plant.commands(b"new") == [b"new"]
    assert plant.commands(b"newer") == [b"new"]


# ── injection ──


def test_a_motor_that_is_stuck_after_the_others_faults_were_cleared_holds_what_was_commanded() -> None:
    plant = Faulty("motors:off")
    plant.actuate((5.0, -5.0))
    plant.advance()
    assert plant.voltages == (0.0, 0.0)
    plant.inject("motor1:stuck", clear=True)
    plant.actuate((7.0, -7.0))
    assert plant.voltages == (5.0, -7.0)


def test_what_is_injected_counts_from_now_and_holds_what_it_has_now() -> None:
    plant = Faulty()
    seen = []
    for k in range(1, 9):
        if k == 4:
            plant.inject("motor1:delay=0.2", "motor2:stuck", "rate.x:delay=0.2", "rate.y:stuck", "rate.z:off@0.2..0.3")
        plant.actuate((1.0 * k, -1.0 * k))
        plant.advance()
        seen.append(plant.seen())
    assert plant.periods == [(1, -1), (2, -2), (3, -3), (3, -3), (3, -3), (4, -3), (5, -3), (6, -3)]
    known = [m.rate for m in seen if not missing(m.rate)]
    assert [rate[0] for rate in known] == [1, 2, 3, 3, 4, 5, 6]
    assert [rate[1] for rate in known] == [10, 20, 30, 30, 30, 30, 30]
    assert [k for k, m in enumerate(seen, 1) if missing(m.rate)] == [5]
    assert [m.attitude for m in seen] == [sample(k).attitude for k in range(1, 9)]


def test_of_faults_that_cannot_be_none_is_injected() -> None:
    plant = Faulty("rate:off")
    with pytest.raises(FaultError, match=r"^fault 'motor3:off@2': the plant has no motor3, but motor1, motor2$"):
        plant.inject("rate:off", "motor3:off@2", clear=True)
    with pytest.raises(FaultError, match="op inject --clear"):
        plant.inject(*["rate:off"] * MAX_FAULTS)
    assert len(plant.faults.statuses(0)) == 1
    three = Faulty("motor3:off", actuators=3)
    three.actuate((1.0, 2.0, 3.0))
    assert three.voltages == (1.0, 2.0, 0.0)


def test_faults_that_are_over_make_room() -> None:
    """A plant that receives faults for days keeps a bounded number of them."""
    plant = Faulty(*["command:off@0..0.1"] * MAX_FAULTS)
    plant.faults.transitions()
    plant.advance()
    plant.faults.transitions()
    plant.inject(*["rate:off"] * (MAX_FAULTS - 1))
    assert [status.source for status in plant.faults.statuses(0)] == ["configured"] + ["injected"] * (MAX_FAULTS - 1)


def test_once_cleared_the_plant_is_as_without_faults_and_what_was_to_come_never_begins() -> None:
    plant = Faulty("rate:off", "attitude:off", "motors:off", "command:delay=0.1", "rate:off@9")
    plant.faults.transitions()
    plant.actuate((5.0, 5.0))
    plant.advance()
    assert plant.commands(b"a") == []
    ends = plant.inject(clear=True)
    assert [tick for tick, _ in ends] == [1] * 4
    assert ends[3][1] == "fault ends (configured): command:delay=0.1, 1 commands delayed"
    plant.actuate((5.0, 5.0))
    assert plant.voltages == (5.0, 5.0)
    plant.advance()
    assert plant.seen() == sample(2)
    assert plant.commands(b"b") == [b"b"]
    assert [(status.begin_tick, status.end_tick) for status in plant.faults.statuses(10)] == [(10, 11)] * 4


def test_frames_are_of_one_direction_and_those_held_back_are_lost_with_their_session() -> None:
    plant = Faulty("command:delay=0.1", "measurement:off@0.2")
    assert plant.commands(b"a") == []
    plant.faults.forget_frames()
    plant.advance()
    assert plant.commands(b"b") == []
    assert plant.faults.passes("measurement", b"m") == [b"m"]
    plant.advance()
    assert plant.commands(None) == [b"b"]
    assert plant.faults.passes("measurement", b"m") == []
    plant.inject("command:stuck", clear=True)
    assert plant.commands(b"c") == [b"b"]  # the frame that passed last


# ── random numbers ──


def test_the_same_seed_fails_the_same_way_and_another_otherwise() -> None:
    sensors = ("attitude:noise=0.1", "attitude:garble=0.3", "rate:noise=0.1", "rate.x:garble=0.3", "rate:drop=0.3")

    def all_of(seed: int) -> list[str]:
        seen = sensed(*sensors, ticks=50, seed=seed)
        motors = driven("motors:noise=1", "motor1:garble=0.3", "motors:drop=0.3", ticks=50, seed=seed)
        kinds = ("drop", "garble", "duplicate", "reorder")
        streams = [passed(f"command:{kind}=0.5", frames=numbered(50), seed=seed) for kind in kinds]
        return [repr(part) for part in (seen, motors, *streams)]

    assert all_of(3) == all_of(3)
    assert all(one != other for one, other in zip(all_of(3), all_of(4), strict=True))


def test_one_more_fault_leaves_the_random_numbers_of_the_others_and_has_its_own() -> None:
    alone = [m.rate for m in sensed("rate:noise=0.1")]
    assert [m.rate for m in sensed("rate:noise=0.1", "attitude:garble=0.5")] == alone
    twice = [m.rate[0] - k for k, m in enumerate(sensed("rate:noise=0.1", "rate:noise=0.1"))]
    assert twice != pytest.approx([2 * (rate[0] - k) for k, rate in enumerate(alone)])
    plant = Faulty("command:drop=0.5", "measurement:drop=0.5")
    passes = [(plant.commands(b"a"), plant.faults.passes("measurement", b"a")) for _ in range(100)]
    assert any(command != measurement for command, measurement in passes)
