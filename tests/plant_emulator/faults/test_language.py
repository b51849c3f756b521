"""Language of faults: what is written is read, and what is no fault is refused in a clear line."""

from __future__ import annotations

from dataclasses import asdict
from math import inf, nan, nextafter, ulp

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.faults.language import KINDS, MAX_DELAY_S, MAX_TIME_S, SIGNALS, Fault, FaultError


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
