"""Hysteresis-uniform quantizer of SPEC.md, against exact fractions, and its bound after any sequence."""

from __future__ import annotations

from fractions import Fraction
from math import inf, isnan, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS, HysteresisQuantizer, UniformQuantizer
from tests.protocol.wire.test_quantizer import EPS, Exact

within = st.floats(-1.0, 1.0)
"""A value as a part of the limit."""


@st.composite
def hysteretic(draw: st.DrawFn) -> HysteresisQuantizer:
    limit = draw(st.floats(1e-6, 1e6))
    deadzone, hysteresis = (draw(st.none() | st.floats(1e-3, 0.999).map(lambda part: part * limit)) for _ in range(2))
    return HysteresisQuantizer(draw(st.integers(MIN_BITS, MAX_BITS)), limit, deadzone, hysteresis)


@settings(max_examples=80)
@given(st.data())
def test_a_sequence_gets_the_codes_of_exact_arithmetic_with_every_tie_held(data: st.DataObject) -> None:
    bits = data.draw(st.integers(MIN_BITS, 10))
    unit = Fraction(2) ** data.draw(st.integers(-12, 6))
    step, top = data.draw(st.integers(1, 15)) * unit, 2 ** (bits - 1) - 1
    given_deadzone = data.draw(st.none() | st.integers(1, 100).map(lambda n: n * unit))
    deadzone = step / 2 if given_deadzone is None else given_deadzone
    limit = deadzone + top * step
    h = data.draw(st.fractions(0, 3, max_denominator=4)) * step
    h = h if 0 < h < limit else step / 2
    quantizer = HysteresisQuantizer(
        bits, float(limit), None if given_deadzone is None else float(given_deadzone), float(h)
    )
    twin, held = Exact(bits, limit, deadzone), None
    # On a grid of a sixteenth of a step, which holds every edge of a band; steps short and long.
    grid = step / 16
    reach = int(limit / grid) + 40
    moves = data.draw(st.lists(st.integers(-40, 40) | st.integers(-reach, reach), min_size=1, max_size=60))
    at = 0
    for move in moves:
        at = max(-reach, min(reach, at + move))
        y = at * grid
        if held is not None and abs(y) <= limit:
            near = abs(y) <= deadzone + h if held == 0 else abs(y - twin.level(held)) <= step / 2 + h
        else:
            near = False
        held = held if near else twin.code(y)
        assert quantizer.encode(float(y)) == held


@settings(max_examples=50)
@given(hysteretic(), st.lists(within, min_size=1, max_size=50), st.floats(1e-3, 1.0))
def test_whatever_came_before_the_error_within_the_limit_stays_within_the_bound(
    quantizer: HysteresisQuantizer, walk: list[float], scale: float
) -> None:
    y = 0.0
    for part in walk:
        y = max(-quantizer.limit, min(quantizer.limit, y + scale * part * quantizer.limit))
        assert abs(quantizer.quantize(y) - y) <= quantizer.bound + 16 * EPS * quantizer.limit
    assert quantizer.saturated == 0


@settings(max_examples=50)
@given(hysteretic())
def test_the_bound_is_the_uniform_one_and_h_and_is_reached(quantizer: HysteresisQuantizer) -> None:
    half, h = quantizer.step / 2, quantizer.hysteresis
    assert quantizer.bound == max(quantizer.deadzone, half) + h
    held = 0 if quantizer.deadzone > half else 1
    # 2^-40 of the limit within the edge that leads towards 0, or from 0 outwards as far as the range goes.
    edge = quantizer.deadzone + h if held == 0 else quantizer.deadzone - h
    reached = min(quantizer.limit, edge) + (-1 if held == 0 else 1) * 2.0**-40 * quantizer.limit
    quantizer.resume(held)
    expected = min(quantizer.bound, quantizer.limit) if held == 0 else quantizer.bound
    assert abs(quantizer.quantize(reached) - reached) == pytest.approx(expected, abs=2.0**-39 * quantizer.limit)


@settings(max_examples=80)
@given(hysteretic(), within, st.lists(within, min_size=1, max_size=20))
def test_noise_of_less_than_h_changes_no_code(quantizer: HysteresisQuantizer, part: float, noise: list[float]) -> None:
    y = part * quantizer.limit
    code = quantizer.encode(y)
    for n in noise:
        near = max(-quantizer.limit, min(quantizer.limit, y + n * quantizer.hysteresis))
        assert quantizer.encode(near) == code


def test_by_default_a_code_changes_once_the_value_is_over_a_step_from_its_level() -> None:
    quantizer = HysteresisQuantizer(4, 7.5)  # l = 1
    codes = [quantizer.encode(y) for y in (1.0, 0.0, 2.0, 2.1, 3.0, 1.0, 0.9)]
    assert codes == [1, 1, 1, 2, 2, 2, 1]


@settings(max_examples=50)
@given(hysteretic(), st.lists(st.floats(-1.5, 1.5), max_size=30))
def test_what_it_sent_decodes_to_what_it_would_send_again(quantizer: HysteresisQuantizer, walk: list[float]) -> None:
    for part in walk:
        code = quantizer.encode(part * quantizer.limit)
        assert -quantizer.top <= code <= quantizer.top
        assert quantizer.encode(quantizer.level(code)) == code


@pytest.mark.parametrize("bits", range(MIN_BITS, 11))
def test_levels_codes_and_the_spare_code_are_those_of_the_uniform_kind_and_all_are_reached(bits: int) -> None:
    quantizer, uniform = HysteresisQuantizer(bits, 3.0), UniformQuantizer(bits, 3.0)
    assert repr(quantizer.levels) == repr(uniform.levels)  # repr: NaN equals itself
    assert quantizer.invalid == uniform.invalid
    for level in uniform.levels:
        if not isnan(level):
            quantizer.reset()
            assert quantizer.quantize(level) == level


@settings(max_examples=50)
@given(hysteretic(), st.floats(1 + 2.0**-40, 1e9))
def test_beyond_the_limit_the_outermost_level_is_held_and_counted(quantizer: HysteresisQuantizer, far: float) -> None:
    for n, y in enumerate((far, -far, far, inf, -inf), start=1):
        assert quantizer.encode(y * quantizer.limit) == (quantizer.top if y > 0 else -quantizer.top)
        assert quantizer.saturated == n
    assert quantizer.encode(-quantizer.limit) == -quantizer.top
    assert quantizer.saturated == 5


def test_what_is_held_may_reach_beyond_the_limit_but_no_value_there_escapes_the_outermost_level() -> None:
    quantizer = HysteresisQuantizer(4, 7.5, hysteresis=7.4)  # l = 1: 3 is held from −4.9 to 10.9, 0 from −7.9 on
    for n, (held, y, code) in enumerate(
        [(7, 7.6, 7), (3, 7.6, 7), (0, -7.6, -7), (-1, 7.6, 7), (1, -7.6, -7)], start=1
    ):
        quantizer.resume(held)
        assert quantizer.encode(y) == code
        assert quantizer.saturated == n
    quantizer.resume(1)
    assert quantizer.encode(-6.9) == 1
    quantizer = HysteresisQuantizer(2, 1.0, deadzone=0.05, hysteresis=0.99)  # ±1 is held down to ∓0.94, and 0 to ±1.04
    for n, (held, y) in enumerate([(0, 1.03), (0, -1.03), (1, 1.03)], start=1):
        quantizer.resume(held)
        assert quantizer.encode(y) == (1 if y > 0 else -1)
        assert quantizer.saturated == n


def test_a_session_starts_without_a_memory_and_no_valid_value_leaves_it_alone() -> None:
    quantizer = HysteresisQuantizer(4, 7.5)
    quantizer.encode(3.0)
    quantizer.resume(quantizer.invalid)
    with pytest.raises(ValueError, match="NaN"):
        quantizer.encode(nan)
    assert quantizer.outermost == 7.0
    assert quantizer.encode(2.2) == 3
    quantizer.encode(99.0)
    quantizer.reset()
    assert quantizer.encode(2.2) == 2
    assert quantizer.saturated == 1
    quantizer.resume(-3.0)  # as numpy has it
    assert repr(quantizer.encode(-2.2)) == "-3"


@pytest.mark.parametrize("h", [0.0, -0.1, 2.0, inf, nan])
def test_a_hysteresis_outside_the_range_is_refused(h: float) -> None:
    with pytest.raises(ValueError, match="hysteresis"):
        HysteresisQuantizer(8, 2.0, hysteresis=h)
