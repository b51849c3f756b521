"""Logarithmic-uniform quantizer of SPEC.md, its edges against decimals of 50 digits."""

from __future__ import annotations

from bisect import bisect_left
from decimal import Decimal, localcontext
from fractions import Fraction
from itertools import pairwise
from math import inf, isnan, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_LOGARITHMIC_BITS, LogarithmicQuantizer, UniformQuantizer
from tests.protocol.wire.test_quantizer import EPS

DIGITS = 50

within = st.floats(-1.0, 1.0)
"""A value as a part of the limit."""


@st.composite
def logarithmic(draw: st.DrawFn, most: int = 12) -> LogarithmicQuantizer:
    limit = draw(st.floats(1e-6, 1e6))
    bits = draw(st.integers(MIN_LOGARITHMIC_BITS, most))
    threshold = draw(st.none() | st.floats(0.04, 0.5).map(lambda part: part * limit))
    deadzone = draw(st.none() | st.floats(1e-4, 0.0399).map(lambda part: part * limit))
    return LogarithmicQuantizer(bits, limit, deadzone, threshold)


def edges_by_decimals(quantizer: LogarithmicQuantizer) -> list[Decimal]:
    """e₀ … e_N as SPEC.md defines them."""
    with localcontext() as context:
        context.prec = DIGITS
        y0, yt, limit = (Decimal(y) for y in (quantizer.deadzone, quantizer.threshold, quantizer.limit))
        top = 2 ** (quantizer.bits - 1) - 1
        logarithm = (yt / y0).ln()

        def serves(m: int) -> bool:
            longest = yt - yt * (-logarithm / m).exp()
            return bool(longest * (1 - Decimal(2) ** -30) <= (limit - yt) / (top - m))

        m = next(m for m in range(1, top) if serves(m))
        step = (limit - yt) / (top - m)
        growing = [y0 * (logarithm * i / m).exp() for i in range(m)]
        return growing + [yt + i * step for i in range(top - m + 1)]


@settings(max_examples=60)
@given(logarithmic(most=9))
def test_edges_and_levels_are_those_of_the_definition_in_decimals(quantizer: LogarithmicQuantizer) -> None:
    exact = edges_by_decimals(quantizer)
    assert len(quantizer.edges) == len(exact) == quantizer.top + 1
    # A power's exponent is rounded and multiplied by a logarithm of up to 10; SPEC.md grants 16 units.
    assert quantizer.edges == pytest.approx([float(edge) for edge in exact], rel=16 * EPS, abs=0)
    levels = [float((a + b) / 2) for a, b in pairwise(exact)]
    assert quantizer.levels[1 : quantizer.top + 1] == pytest.approx(levels, rel=16 * EPS, abs=0)
    assert quantizer.levels[quantizer.top + 2 :] == [-y for y in reversed(quantizer.levels[1 : quantizer.top + 1])]


@settings(max_examples=80)
@given(logarithmic(), st.data())
def test_a_value_gets_the_level_whose_interval_holds_it_and_a_tie_goes_towards_zero(
    quantizer: LogarithmicQuantizer, data: st.DataObject
) -> None:
    i = data.draw(st.integers(0, quantizer.top))
    edge, past = quantizer.edges[i], 1 + 2.0**-40
    assert quantizer.encode(edge) == i
    assert quantizer.encode(edge / past) == i
    assert quantizer.encode(-edge * past) == -min(i + 1, quantizer.top)
    y = data.draw(within) * quantizer.limit
    # Within 16 units in the last place of an edge a tie may be detected.
    codes = {bisect_left(quantizer.edges, abs(y) * (1 + side * 16 * EPS)) for side in (-1, 1)}
    assert abs(quantizer.encode(y)) in codes
    assert quantizer.encode(y) * y >= 0


@pytest.mark.parametrize("bits", range(MIN_LOGARITHMIC_BITS, MAX_BITS + 1))
def test_an_edge_rounded_once_is_a_tie_whatever_the_quantizer_rounds(bits: int) -> None:
    quantizer = LogarithmicQuantizer(bits, 24.0)
    m, alike = quantizer.growing, quantizer.top - quantizer.growing
    for i in range(alike + 1):
        edge = float(6 + Fraction(18 * i, alike))
        assert quantizer.encode(edge) == m + i
        assert quantizer.encode(-edge) == -m - i


def test_where_the_longest_interval_is_l_by_design_rounding_does_not_choose_m() -> None:
    # 0.1 … 0.4 … 0.7 … 1.0; in binary64 the first is longer than the others by a unit in the last place.
    assert LogarithmicQuantizer(3, 1.0, 0.1, 0.4).growing == 1


@settings(max_examples=80)
@given(logarithmic(), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0) | st.floats(0.0, 1e-9))
def test_it_is_odd_monotone_and_bounded(quantizer: LogarithmicQuantizer, part: float, other: float) -> None:
    low, high = sorted((part * quantizer.limit, (part + other) * quantizer.limit))
    assert quantizer.encode(low) <= quantizer.encode(high)
    for y in (low, high):
        assert quantizer.encode(-y) == -quantizer.encode(y)
        if abs(y) <= quantizer.limit:
            assert abs(quantizer.quantize(y) - y) <= quantizer.bound + 8 * EPS * quantizer.limit


@settings(max_examples=50)
@given(logarithmic())
def test_no_interval_is_longer_than_the_uniform_ones_and_no_fewer_would_grow(quantizer: LogarithmicQuantizer) -> None:
    m, top, alike = quantizer.growing, quantizer.top, 1 + 2.0**-29  # SPEC.md's 2^-30, and rounding
    lengths = [b - a for a, b in pairwise(quantizer.edges)]
    assert max(lengths[:m]) <= quantizer.step * alike
    assert lengths[m:] == pytest.approx([quantizer.step] * (top - m), rel=0, abs=8 * EPS * quantizer.limit)
    assert all(a < b for a, b in pairwise(lengths[:m]))
    if m > 1:
        ratio = (quantizer.threshold / quantizer.deadzone) ** (1 / (m - 1))
        longest, step = quantizer.threshold * (1 - 1 / ratio), (quantizer.limit - quantizer.threshold) / (top - m + 1)
        assert longest * alike > step
    assert quantizer.bound == pytest.approx(max(quantizer.deadzone, quantizer.step / 2), rel=2.0**-29)
    assert quantizer.outermost == quantizer.levels[top] < quantizer.limit


@pytest.mark.parametrize("bits", range(MIN_LOGARITHMIC_BITS, MAX_BITS + 1))
@pytest.mark.parametrize("more", [(1.0,), (24.0,), (2.0, 0.01), (2.0, None, 1.0), (1e-3, 9e-5, 1e-4)])
def test_every_code_survives_decoding_and_encoding(bits: int, more: tuple[float, ...]) -> None:
    quantizer = LogarithmicQuantizer(bits, *more)
    codes = range(-quantizer.top, quantizer.top + 1)
    assert [quantizer.encode(quantizer.level(code)) for code in codes] == list(codes)
    assert isnan(quantizer.level(quantizer.invalid))
    assert quantizer.invalid == -(2 ** (bits - 1))
    assert (quantizer.encode(quantizer.limit), quantizer.saturated) == (quantizer.top, 0)


def test_small_values_err_in_proportion_and_large_ones_by_less_than_the_bound() -> None:
    quantizer, uniform = LogarithmicQuantizer(8, 1.0), UniformQuantizer(8, 1.0)
    for y in (0.002, 0.02, 0.2):
        assert abs(quantizer.quantize(y) - y) <= 0.04 * y  # (ρ − 1)/2 with ρ = 255^(1/82)
    assert quantizer.deadzone == uniform.deadzone / 4


@settings(max_examples=50)
@given(logarithmic(), st.floats(1 + 2.0**-40, 1e9))
def test_beyond_the_limit_is_the_outermost_level_and_is_counted(quantizer: LogarithmicQuantizer, far: float) -> None:
    for n, y in enumerate((far, -far, inf, -inf), start=1):
        assert quantizer.encode(y * quantizer.limit) == (quantizer.top if y > 0 else -quantizer.top)
        assert quantizer.saturated == n


def test_nan_has_no_code_and_what_is_no_code_is_refused() -> None:
    quantizer = LogarithmicQuantizer(8, 1.0)
    with pytest.raises(ValueError, match="NaN"):
        quantizer.encode(nan)
    for code in (128, -129, 0.5, nan):
        with pytest.raises(ValueError, match="not a code"):
            quantizer.level(code)
    assert quantizer.saturated == 0


@pytest.mark.parametrize(
    ("bits", "more", "why"),
    [
        (2, {}, "at least 3 bits"),
        (17, {}, "16 bits"),
        (8, {"threshold": 1.01}, "at most half the limit"),
        (8, {"threshold": nan}, "threshold"),
        (8, {"deadzone": 0.5}, "between 0 and the threshold"),
        (3, {"threshold": 0.01}, "between 0 and the threshold"),
        (8, {"deadzone": 0.0}, "dead zone"),
        (16, {"deadzone": 0.1, "threshold": 0.1 + 1e-15}, "distinguish"),
        (8, {"deadzone": 5e-324}, "distinguish"),
    ],
)
def test_what_makes_no_intervals_is_refused(bits: int, more: dict[str, float], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        LogarithmicQuantizer(bits, 2.0, **more)
