"""Quantizer of the paper: bound (C.13), definition (C.14), agreement with exact arithmetic.

The reference below is written from (C.14) alone, in fractions: it finds the interval by bisecting the edges and never
divides by l, so it shares neither a formula nor a rounding with the code under test.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from math import copysign, inf, isnan, nan, nextafter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS, Continuous, Quantizer, UniformQuantizer

EPS = 2.0**-52

WIDTHS = range(MIN_BITS, MAX_BITS + 1)
every_width = pytest.mark.parametrize("bits", WIDTHS)

PAST_EDGE = 1 + 2.0**-40
"""Past an edge by far more than the 4 units in the last place that SPEC.md grants a tie, and far less than a step."""


@dataclass(frozen=True)
class Exact:
    """(C.14) in exact arithmetic."""

    bits: int
    limit: Fraction
    deadzone: Fraction

    @property
    def top(self) -> int:
        return (1 << (self.bits - 1)) - 1

    @property
    def step(self) -> Fraction:
        return (self.limit - self.deadzone) / self.top

    def edge(self, i: int) -> Fraction:
        """y0 + i·l: where level i ends, itself included."""
        return self.deadzone + i * self.step

    def level(self, code: int) -> Fraction:
        """y_1 = y0 + l/2 and y_{i+1} = y_i + l, with the code's sign."""
        if code == 0:
            return Fraction(0)
        return (self.deadzone + self.step / 2 + (abs(code) - 1) * self.step) * (1 if code > 0 else -1)

    def code(self, y: Fraction) -> int:
        """The level whose interval, open below and closed above, holds |y|; the outermost one beyond them all."""
        low, high = 0, self.top
        while low < high:
            middle = (low + high) // 2
            if abs(y) <= self.edge(middle):
                high = middle
            else:
                low = middle + 1
        return low if y > 0 else -low


def exact(quantizer: UniformQuantizer, deadzone: float | None) -> Exact:
    """The exact twin of a quantizer; its default dead zone is half a step, limit/(2^R − 1)."""
    limit = Fraction(quantizer.limit)
    half_a_step = limit / (2**quantizer.bits - 1)
    return Exact(quantizer.bits, limit, half_a_step if deadzone is None else Fraction(deadzone))


Case = tuple[UniformQuantizer, float | None]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Any quantizer: any width, twelve decades of limits, the default dead zone or one anywhere below the limit."""
    bits = draw(st.integers(MIN_BITS, MAX_BITS))
    limit = draw(st.floats(1e-6, 1e6))
    deadzone = draw(st.none() | st.floats(1e-3, 0.999).map(lambda part: part * limit))
    return UniformQuantizer(bits, limit, deadzone), deadzone


within = st.floats(-1.0, 1.0)
"""A value as a part of the limit."""


@st.composite
def dyadic(draw: st.DrawFn) -> tuple[UniformQuantizer, Exact]:
    """A quantizer whose limit, dead zone, step, edges and levels are all exact in binary64."""
    bits = draw(st.integers(MIN_BITS, MAX_BITS))
    unit = Fraction(2) ** draw(st.integers(-12, 6))
    step = draw(st.integers(1, 15)) * unit
    top = 2 ** (bits - 1) - 1
    deadzone = draw(st.none() | st.integers(1, 1000).map(lambda n: n * unit))
    limit = (step / 2 if deadzone is None else deadzone) + top * step
    quantizer = UniformQuantizer(bits, float(limit), None if deadzone is None else float(deadzone))
    return quantizer, Exact(bits, limit, step / 2 if deadzone is None else deadzone)


@settings(max_examples=80)
@given(cases(), within)
def test_the_error_within_the_limit_stays_within_the_bound(case: Case, part: float) -> None:
    quantizer, _ = case
    y = part * quantizer.limit
    # A level is a sum of three rounded terms, each at most the limit: a few units in its last place.
    assert abs(quantizer.quantize(y) - y) <= quantizer.bound + 8 * EPS * quantizer.limit
    assert quantizer.saturated == 0


@settings(max_examples=50)
@given(cases())
def test_the_bound_is_the_larger_of_dead_zone_and_half_a_step_and_is_reached(case: Case) -> None:
    quantizer, deadzone = case
    twin = exact(quantizer, deadzone)
    # Rounded once for l, which inherits the rounding of limit − y0.
    assert quantizer.bound == pytest.approx(float(max(twin.deadzone, twin.step / 2)), rel=4 * EPS)
    reached = max(abs(quantizer.quantize(y) - y) for y in (quantizer.deadzone, quantizer.limit))
    # Reached to the rounding of the outermost level, as above.
    assert reached >= quantizer.bound - 8 * EPS * quantizer.limit


@settings(max_examples=80)
@given(dyadic(), st.data())
def test_exact_values_get_the_code_and_level_of_exact_arithmetic(
    pair: tuple[UniformQuantizer, Exact], data: st.DataObject
) -> None:
    quantizer, twin = pair
    # A grid 2^-12 of a step: 28 bits of index and fraction, so exact in binary64, and includes every edge.
    grid = twin.step / 4096
    reach = int(twin.limit / grid) + 4096
    y = data.draw(st.integers(-reach, reach)) * grid
    code = quantizer.encode(float(y))
    assert code == twin.code(y)
    assert Fraction(quantizer.level(code)) == twin.level(code)
    assert quantizer.saturated == (abs(y) > twin.limit)


@settings(max_examples=80)
@given(cases(), within)
def test_any_value_gets_the_code_of_exact_arithmetic_but_for_the_rounding_of_an_edge(case: Case, part: float) -> None:
    quantizer, deadzone = case
    y = part * quantizer.limit
    twin = exact(quantizer, deadzone)
    # l is off by up to 2 roundings, hence an edge by as many units in the limit's last place; the tie adds 4 more.
    slack = Fraction(8 * EPS * quantizer.limit)
    least, most = twin.code(max(abs(Fraction(y)) - slack, Fraction(0))), twin.code(abs(Fraction(y)) + slack)
    assert abs(least) <= abs(quantizer.encode(y)) <= abs(most)
    assert quantizer.encode(y) * y >= 0


@every_width
@pytest.mark.parametrize("limit", [1.0, 24.0, 3.3e-5])
def test_at_every_edge_of_the_default_quantizer_a_tie_goes_towards_zero(bits: int, limit: float) -> None:
    quantizer = UniformQuantizer(bits, limit)
    for i in range(quantizer.top + 1):
        edge = float(Fraction(limit) * (2 * i + 1) / (2**bits - 1))  # y0 + i·l, rounded once
        assert quantizer.encode(edge) == i
        assert quantizer.encode(-edge) == -i
        beyond = min(i + 1, quantizer.top)
        assert quantizer.encode(edge * PAST_EDGE) == beyond
        assert quantizer.encode(-edge * PAST_EDGE) == -beyond


@every_width
@pytest.mark.parametrize("deadzone", [0.25, 1.0, 777.0])
@pytest.mark.parametrize("step", [0.5, 3.0])
def test_at_every_edge_after_a_given_dead_zone_a_tie_goes_towards_zero(bits: int, deadzone: float, step: float) -> None:
    top = 2 ** (bits - 1) - 1
    quantizer = UniformQuantizer(bits, deadzone + top * step, deadzone)
    assert quantizer.step == step  # all of these are exact in binary64, edges included
    for i in range(top + 1):
        edge = deadzone + i * step
        assert quantizer.encode(edge) == i
        assert quantizer.encode(-edge) == -i
        # 2^-30 of a step: far from the tie's 4 units in the last place of an index of 15 bits, and exact.
        beyond = min(i + 1, top)
        assert quantizer.encode(edge + step * 2.0**-30) == beyond
        assert quantizer.encode(-edge - step * 2.0**-30) == -beyond


def test_the_paper_s_tie_is_not_rounded_to_even() -> None:
    quantizer = UniformQuantizer(4, 7.5)  # l = 1
    assert [quantizer.quantize(y) for y in (0.5, 1.5, 2.5, 3.5, -0.5, -1.5)] == [0.0, 1.0, 2.0, 3.0, 0.0, -1.0]


@settings(max_examples=50)
@given(cases())
def test_levels_start_at_the_dead_zone_plus_half_a_step_and_go_up_by_steps(case: Case) -> None:
    quantizer, deadzone = case
    twin = exact(quantizer, deadzone)
    # Relative to the limit: three terms, each rounded.
    slack = 8 * EPS * quantizer.limit
    assert quantizer.level(0) == 0.0
    for i in {1, 2, quantizer.top // 2, quantizer.top - 1, quantizer.top} - {0}:
        if i <= quantizer.top:
            assert quantizer.level(i) == pytest.approx(float(twin.level(i)), rel=0, abs=slack)
            assert quantizer.level(-i) == -quantizer.level(i)
    levels = [quantizer.level(code) for code in range(-quantizer.top, quantizer.top + 1)]
    assert all(low < high for low, high in pairwise(levels))


@every_width
@pytest.mark.parametrize("limit", [24.0, 0.3])
def test_the_default_dead_zone_gives_the_paper_s_step_and_levels_at_its_multiples(bits: int, limit: float) -> None:
    quantizer = UniformQuantizer(bits, limit)
    step = 2 * limit / (2**bits - 1)
    assert quantizer.step == step
    assert quantizer.deadzone == step / 2
    for k in range(-quantizer.top, quantizer.top + 1):
        # A sum of three rounded terms against one rounded product.
        assert abs(quantizer.level(k) - k * step) <= 4 * EPS * abs(k * step)


@settings(max_examples=80)
@given(cases(), st.floats(-2.0, 2.0))
def test_it_is_odd(case: Case, part: float) -> None:
    quantizer, _ = case
    y = part * quantizer.limit
    assert quantizer.encode(-y) == -quantizer.encode(y)
    assert quantizer.quantize(-y) == -quantizer.quantize(y)


@settings(max_examples=80)
@given(cases(), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0) | st.floats(0.0, 1e-12))
def test_it_is_monotone(case: Case, part: float, other: float) -> None:
    quantizer, _ = case
    low, high = sorted((part * quantizer.limit, (part + other) * quantizer.limit))
    assert quantizer.encode(low) <= quantizer.encode(high)
    assert quantizer.quantize(low) <= quantizer.quantize(high)


@every_width
@pytest.mark.parametrize(("limit", "deadzone"), [(1.0, None), (24.0, None), (1e-3, None), (1.0, 0.1), (3.0, 2.9)])
def test_every_code_survives_decoding_and_encoding(bits: int, limit: float, deadzone: float | None) -> None:
    quantizer = UniformQuantizer(bits, limit, deadzone)
    for code in range(-quantizer.top, quantizer.top + 1):
        level = quantizer.level(code)
        assert quantizer.encode(level) == code
        assert quantizer.level(code) == level
    assert quantizer.saturated == 0


@every_width
def test_the_spare_code_is_the_least_one_and_decodes_to_nan(bits: int) -> None:
    quantizer = UniformQuantizer(bits, 1.0)
    assert quantizer.invalid == -(2 ** (bits - 1))
    assert isnan(quantizer.level(quantizer.invalid))
    assert isnan(quantizer.level(quantizer.invalid))


@settings(max_examples=50)
@given(cases(), st.floats(PAST_EDGE, 1e12))
def test_beyond_the_range_is_the_outermost_level_and_is_counted(case: Case, factor: float) -> None:
    quantizer, _ = case
    for n, y in enumerate((factor * quantizer.limit, -factor * quantizer.limit, inf, -inf), start=1):
        assert quantizer.encode(y) == copysign(quantizer.top, y)
        assert quantizer.saturated == n
        quantizer.encode(0.0)
        assert quantizer.saturated == n


@settings(max_examples=50)
@given(cases())
def test_the_limit_itself_is_within_the_range(case: Case) -> None:
    quantizer, _ = case
    assert quantizer.encode(quantizer.limit) == quantizer.top
    assert quantizer.encode(-quantizer.limit) == -quantizer.top
    assert quantizer.saturated == 0


@pytest.mark.parametrize("quantizer", [UniformQuantizer(8, 1.0), UniformQuantizer(2, 1.0, 0.5), Continuous(1.0)])
def test_nan_is_refused_and_not_counted(quantizer: Quantizer) -> None:
    with pytest.raises(ValueError, match="NaN"):
        quantizer.encode(nan)
    assert quantizer.saturated == 0


@every_width
def test_what_is_no_code_is_refused(bits: int) -> None:
    quantizer = UniformQuantizer(bits, 1.0)
    for code in (quantizer.top + 1, quantizer.invalid - 1, 2**70, -(2**70), 0.0, 1.0, 0.5, nan, inf):
        with pytest.raises(ValueError, match="not a code"):
            quantizer.level(code)


@pytest.mark.parametrize("bits", [-1, 0, 1, 17, 64])
def test_bits_out_of_bounds_are_refused(bits: int) -> None:
    with pytest.raises(ValueError, match="bits"):
        UniformQuantizer(bits, 1.0)


@pytest.mark.parametrize("limit", [0.0, -0.0, -1.0, inf, -inf, nan])
def test_a_limit_that_is_not_positive_and_finite_is_refused(limit: float) -> None:
    with pytest.raises(ValueError, match="limit"):
        UniformQuantizer(8, limit)
    with pytest.raises(ValueError, match="limit"):
        UniformQuantizer(8, limit, 0.1)
    with pytest.raises(ValueError, match="limit"):
        Continuous(limit)


@pytest.mark.parametrize("deadzone", [0.0, -0.1, 2.0, 2.1, inf, nan])
def test_a_dead_zone_outside_the_range_is_refused(deadzone: float) -> None:
    with pytest.raises(ValueError, match="dead zone"):
        UniformQuantizer(8, 2.0, deadzone)


@pytest.mark.parametrize("limit", [1e308, 5e-324])
def test_a_limit_whose_step_no_float_can_hold_is_refused(limit: float) -> None:
    with pytest.raises(ValueError, match="step"):
        UniformQuantizer(16, limit)


@given(st.floats(1e-300, 1e300), within)
def test_without_quantization_a_value_is_its_own_code(limit: float, part: float) -> None:
    quantizer = Continuous(limit)
    y = part * limit
    assert quantizer.encode(y) == y
    assert quantizer.level(y) == y
    assert quantizer.quantize(y) == y
    assert quantizer.level(y) == y
    assert (quantizer.bound, quantizer.saturated) == (0.0, 0)


@given(st.floats(1e-300, 1e300))
def test_without_quantization_what_lies_beyond_the_limit_is_the_limit_and_is_counted(limit: float) -> None:
    quantizer = Continuous(limit)
    for n, y in enumerate((nextafter(limit, inf), -nextafter(limit, inf), inf, -inf), start=1):
        assert quantizer.encode(y) == copysign(limit, y)
        assert quantizer.saturated == n


def test_without_quantization_nan_means_no_valid_value() -> None:
    quantizer = Continuous(1.0)
    assert isnan(quantizer.invalid)
    assert isnan(quantizer.level(quantizer.invalid))
    assert isnan(quantizer.level(quantizer.invalid))
