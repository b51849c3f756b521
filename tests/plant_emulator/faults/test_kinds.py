"""Faults: their notation, and each kind on values and frames, when specified, in its own components only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import chain
from math import cos, hypot, inf, nan, nextafter, sin, sqrt, ulp
from statistics import fmean, pstdev

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.faults.language import KINDS, MAX_DELAY_S, MAX_TIME_S, SIGNALS, Fault, FaultError
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector
from tests.support.faulty_plant import driven, missing, numbered, passed, sample, sensed


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("attitude:off@5", Fault(signal="attitude", kind="off", start_s=5.0)),
        ("rate.y:bias=0.1@2..4", Fault(signal="rate.y", kind="bias", value=0.1, start_s=2.0, end_s=4.0)),
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
        ("altitude:off", "no signal 'altitude'", "attitude, attitude.x"),
        ("attitude:of", "takes no 'of'", "off, stuck, bias, noise, delay, drop and garble"),
        ("attitude.x:stuck", "attitude.x takes no 'stuck'", "off, bias, noise and drop; attitude as a whole does"),
        ("command:bias=1", "command takes no 'bias'", "off, stuck, delay, drop, garble, duplicate and reorder"),
        ("attitude:off=1", "off takes no value, but was given 1", "write off alone"),
        ("rate:bias", "bias takes -35 to 35 rad/s", "bias=0.1"),
        ("attitude.x:bias=-3.2", "not -3.2", "-3.1416 to 3.1416 rad"),
        ("motors:bias=1e308", "not 1e+308", "-48 to 48 V"),
        ("rate:noise=-1", "not -1", "0 to 35 rad/s"),
        ("rate:delay=10.5", "not 10.5", "0 to 10 s"),
        ("rate:drop=0", "not 0", "a probability above 0 and up to 1"),
        ("rate:bias=much", "'much' is not a number", ""),
        ("rate:off@soon", "'soon' is not a number", ""),
        ("rate:off@nan", "not at nan s", "within 0 to 1e+08 s"),
        ("rate:off@4..2", "not at 2 s", "after it begins at 4 s"),
        ("rate:off@4..1e9", "not at 1000000000 s", "by 1e+08 s"),
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
    ranges = {"bias": (-largest, largest), "deviation": (0.0, largest), "delay": (0.0, MAX_DELAY_S), "nothing": None}
    return ranges.get(KINDS[kind].takes, (ulp(0.0), 1.0))


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


@given(text=st.text() | st.from_regex(r"(attitude|motor1|command):[a-z]*=?[-.0-9einf]*@?[-.0-9]*"))
def test_any_text_is_a_fault_or_one_line_that_states_why_not(text: str) -> None:
    reason = ""
    try:
        fault = Fault.parse(text)
    except FaultError as error:
        reason = str(error)
    if reason:
        assert reason.startswith(f"fault {text!r}: ")
        assert len(reason.splitlines()) == 1
    else:
        assert Fault.parse(str(fault)) == fault


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


def test_all_motors_are_lost_at_the_same_times() -> None:
    periods = driven("motors:drop=0.5", ticks=200)[1:]
    assert {(a == 0, b == 0) for a, b in periods} == {(True, True), (False, False)}


# ── frames ──


@pytest.mark.parametrize(
    ("faults", "frames", "ticks"),
    [
        ([], ["a", "", "b"], ["a", "", "b"]),
        (["off@0.2..0.4"], "abcdef", ["a", "b", "", "", "e", "f"]),
        (["stuck@0.2..0.5"], ["a", "b", "c", "", "e", "f"], ["a", "b", "b", "", "b", "f"]),
        (["stuck"], "abc", ["a", "a", "a"]),
        (["delay=0.2"], "abcde", ["", "", "a", "b", "c"]),
        (["delay=0.05"], "abc", ["", "a", "b"]),
        (["delay=0.2@0.1..0.4"], "abcdef", ["a", "", "", "b", "cde", "f"]),  # what is on its way comes at once, first
        (["duplicate=1@0.1..0.3"], [*"abcd", ""], ["a", "b", "bc", "cd", ""]),
        (["duplicate=1"], ["a", "", ""], ["a", "a", ""]),
        (["reorder=1"], "abcd", ["", "ba", "", "dc"]),
        (["reorder=1@0.1..0.2"], ["a", "b", "", "d", "e"], ["a", "", "", "db", "e"]),
        (["duplicate=1", "delay=0.1"], ["a", "", ""], ["", "a", "a"]),  # one after another, in this order
        (["delay=0.1", "off@0.1"], "abc", ["", "", ""]),
    ],
)
def test_frames_pass_as_written(faults: list[str], frames: Sequence[str], ticks: list[str]) -> None:
    seen = passed(*(f"command:{fault}" for fault in faults), frames=[frame.encode() or None for frame in frames])
    assert [b"".join(tick).decode() for tick in seen] == ticks


@given(delay_ms=st.integers(0, 30), start=st.integers(0, 40), length=st.integers(1, 40))
def test_every_frame_passes_a_delay_once_and_in_order_and_none_too_late(delay_ms: int, start: int, length: int) -> None:
    text = f"command:delay={delay_ms / 1000}@{start / 1000}..{(start + length) / 1000}"
    frames = numbered(60)
    ticks = passed(text, frames=[*frames, *[None] * 60], period=0.001)
    assert list(chain(*ticks)) == frames
    for k, tick in enumerate(ticks):
        for frame in tick:
            sent = int.from_bytes(frame, "big")
            due = sent + delay_ms if start <= sent < start + length else sent
            assert k == min(due, max(sent, start + length))


@pytest.mark.parametrize("kind", ["drop", "garble", "duplicate", "reorder"])
def test_a_fifth_of_the_frames_fails_and_the_others_pass_as_they_are(kind: str) -> None:
    """Five binomial deviations of 40. Of n that could be held back, n·p/(1 + p) = 1667 change places."""
    frames = numbered(MANY)
    ticks = passed(f"command:{kind}=0.2@0..999.9", frames=frames)
    whole = list(chain(*ticks))
    if kind == "drop":
        assert abs(sum(not tick for tick in ticks) - 2000) <= 200
        assert all(tick in ([], [frame]) for tick, frame in zip(ticks, frames, strict=True))
    elif kind == "garble":
        assert abs(sum(tick != [frame] for tick, frame in zip(ticks, frames, strict=True)) - 2000) <= 200
    elif kind == "duplicate":
        assert abs(len(whole) - 12_000) <= 200
        assert sorted(set(whole)) == frames
    else:
        assert sorted(whole) == frames  # nothing is lost or repeated
        assert abs(sum(len(tick) == 2 for tick in ticks) - 1667) <= 200
        assert all(tick[0] > tick[1] for tick in ticks if len(tick) == 2)


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
