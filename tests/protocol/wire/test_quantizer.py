"""Quantizers of every kind: the bound (C.13), the definitions of (C.14) and SPEC.md in exact arithmetic.

The references below, in fractions and in decimals of 50 digits, bisect edges and never divide by l: they share neither
a formula nor a rounding with the code under test.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, localcontext
from fractions import Fraction
from itertools import pairwise
from math import copysign, inf, isnan, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.quantizer import (
    MAX_BITS,
    MIN_BITS,
    MIN_LOGARITHMIC_BITS,
    CodedQuantizer,
    Continuous,
    HysteresisQuantizer,
    LogarithmicQuantizer,
    Quantizer,
    UniformQuantizer,
)

EPS = 2.0**-52
PAST = 1 + 2.0**-40
"""Past an edge by far more than the few units in the last place that SPEC.md grants a tie, and far less than a step."""

limits = st.floats(1e-6, 1e6)
within = st.floats(-1.0, 1.0)  # a value as a part of the limit


def parts_of(limit: float, least: float, most: float) -> st.SearchStrategy[float | None]:
    """A parameter of a quantizer: left out, or a part of the limit."""
    return st.none() | st.floats(least, most).map(lambda part: part * limit)


@st.composite
def uniform(draw: st.DrawFn) -> UniformQuantizer:
    limit = draw(limits)
    return UniformQuantizer(draw(st.integers(MIN_BITS, MAX_BITS)), limit, draw(parts_of(limit, 1e-3, 0.999)))


@st.composite
def hysteretic(draw: st.DrawFn) -> HysteresisQuantizer:
    limit = draw(limits)
    deadzone, hysteresis = draw(parts_of(limit, 1e-3, 0.999)), draw(parts_of(limit, 1e-3, 0.999))
    return HysteresisQuantizer(draw(st.integers(MIN_BITS, MAX_BITS)), limit, deadzone, hysteresis)


@st.composite
def logarithmic(draw: st.DrawFn, most: int = 12) -> LogarithmicQuantizer:
    limit, bits = draw(limits), draw(st.integers(MIN_LOGARITHMIC_BITS, most))
    return LogarithmicQuantizer(bits, limit, draw(parts_of(limit, 1e-4, 0.0399)), draw(parts_of(limit, 0.04, 0.5)))


coded: st.SearchStrategy[CodedQuantizer] = st.one_of(uniform(), hysteretic(), logarithmic())
quantizers: st.SearchStrategy[Quantizer] = coded | limits.map(Continuous)


# What holds for every kind


@settings(max_examples=200)
@given(quantizers, st.lists(within, min_size=1, max_size=20))
def test_the_error_within_the_limit_stays_within_the_bound_whatever_came_before(
    quantizer: Quantizer, walk: list[float]
) -> None:
    for y in (part * quantizer.limit for part in [*walk, 1.0, -1.0]):
        # A level is a sum of three rounded terms, each at most the limit: a few units in its last place.
        assert abs(quantizer.level(quantizer.encode(y)) - y) <= quantizer.bound + 16 * EPS * quantizer.limit
    assert quantizer.saturated == 0


@settings(max_examples=200)
@given(quantizers, st.floats(PAST, 1e12))
def test_beyond_the_range_is_the_outermost_level_and_is_counted(quantizer: Quantizer, far: float) -> None:
    for n, y in enumerate((far * quantizer.limit, -far * quantizer.limit, inf, -inf), start=1):
        assert quantizer.level(quantizer.encode(y)) == copysign(quantizer.outermost, y)
        assert quantizer.saturated == n
    with pytest.raises(ValueError, match="NaN"):
        quantizer.encode(nan)
    assert quantizer.saturated == 4
    assert isnan(quantizer.level(quantizer.invalid))


@settings(max_examples=60)
@given(coded)
def test_codes_are_all_of_r_bits_levels_rise_with_them_and_every_level_is_its_own(quantizer: CodedQuantizer) -> None:
    top = quantizer.top
    assert (top, quantizer.invalid) == (2 ** (quantizer.bits - 1) - 1, -(2 ** (quantizer.bits - 1)))
    codes = range(-top, top + 1)
    levels = [quantizer.level(code) for code in codes]
    assert levels == [-level for level in reversed(levels)]
    assert all(low < high for low, high in pairwise(levels))
    for code, level in zip(codes, levels, strict=True):
        quantizer.reset()
        assert quantizer.encode(level) == code
    wrong: list[Any] = [top + 1, quantizer.invalid - 1, 2**70, 0.5, nan, inf]
    for no_code in wrong:
        with pytest.raises(ValueError, match="not a code"):
            quantizer.level(no_code)


# The uniform kind, in exact arithmetic


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
        index = bisect_left(range(self.top), abs(y), key=self.edge)
        return index if y > 0 else -index


@st.composite
def dyadic(draw: st.DrawFn, most_bits: int = MAX_BITS) -> tuple[Exact, float | None]:
    """A twin whose limit, dead zone, step, edges and levels are all exact in binary64, and the dead zone as given."""
    bits = draw(st.integers(MIN_BITS, most_bits))
    unit = Fraction(2) ** draw(st.integers(-12, 6))
    step = draw(st.integers(1, 15)) * unit
    given_deadzone = draw(st.none() | st.integers(1, 100).map(lambda n: n * unit))
    deadzone = step / 2 if given_deadzone is None else given_deadzone
    twin = Exact(bits, deadzone + (2 ** (bits - 1) - 1) * step, deadzone)
    return twin, None if given_deadzone is None else float(given_deadzone)


@settings(max_examples=200)
@given(dyadic(), st.data())
def test_exact_values_get_the_code_and_level_of_exact_arithmetic(
    pair: tuple[Exact, float | None], data: st.DataObject
) -> None:
    twin, deadzone = pair
    quantizer = UniformQuantizer(twin.bits, float(twin.limit), deadzone)
    assert Fraction(quantizer.step) == twin.step
    assert Fraction(quantizer.bound) == max(twin.deadzone, twin.step / 2)
    # A grid 2^-12 of a step: 28 bits of index and fraction, so exact in binary64, and includes every edge.
    grid = twin.step / 4096
    reach = int(twin.limit / grid) + 4096
    i = data.draw(st.integers(0, twin.top))
    for y in (data.draw(st.integers(-reach, reach)) * grid, twin.edge(i), -twin.edge(i), twin.edge(i) + grid):
        code = quantizer.encode(float(y))
        assert code == twin.code(y)
        assert Fraction(quantizer.level(code)) == twin.level(code)


# The kind with hysteresis


@settings(max_examples=150)
@given(dyadic(most_bits=10), st.fractions(0, 3, max_denominator=4), st.data())
def test_a_sequence_gets_the_codes_of_exact_arithmetic_with_every_tie_held(
    pair: tuple[Exact, float | None], parts: Fraction, data: st.DataObject
) -> None:
    twin, deadzone = pair
    h = parts * twin.step if 0 < parts * twin.step < twin.limit else twin.step / 2
    quantizer = HysteresisQuantizer(twin.bits, float(twin.limit), deadzone, float(h))
    # On a grid of a sixteenth of a step, which holds every edge of a band; steps short and long.
    grid = twin.step / 16
    reach = int(twin.limit / grid) + 40
    held: int | None = None
    at = beyond = 0
    for move in data.draw(st.lists(st.integers(-40, 40) | st.integers(-reach, reach), min_size=1, max_size=60)):
        at = max(-reach, min(reach, at + move))
        y = at * grid
        near = False
        if held is not None and abs(y) <= twin.limit:  # no value beyond the limit escapes the outermost level
            near = abs(y) <= twin.deadzone + h if held == 0 else abs(y - twin.level(held)) <= twin.step / 2 + h
        held = held if near else twin.code(y)
        beyond += abs(y) > twin.limit
        assert quantizer.encode(float(y)) == held
    assert quantizer.saturated == beyond


def test_a_session_starts_without_a_memory_and_no_valid_value_leaves_it_alone() -> None:
    quantizer = HysteresisQuantizer(4, 7.5)
    quantizer.encode(3.0)
    quantizer.resume(quantizer.invalid)
    assert quantizer.encode(2.2) == 3
    quantizer.reset()
    assert quantizer.encode(2.2) == 2
    quantizer.resume(-3.0)  # as numpy has it
    assert repr(quantizer.encode(-2.2)) == "-3"


# The logarithmic-uniform kind


def edges_by_decimals(quantizer: LogarithmicQuantizer) -> list[Decimal]:
    with localcontext() as context:
        context.prec = 50
        y0, yt, limit = (Decimal(y) for y in (quantizer.deadzone, quantizer.threshold, quantizer.limit))
        top = 2 ** (quantizer.bits - 1) - 1
        logarithm = (yt / y0).ln()

        def serves(m: int) -> bool:
            """Whether no geometric interval is longer than l; the last one is the longest."""
            longest = yt - yt * (-logarithm / m).exp()
            return bool(longest * (1 - Decimal(2) ** -30) <= (limit - yt) / (top - m))

        m = next(m for m in range(1, top) if serves(m))
        step = (limit - yt) / (top - m)
        growing = [y0 * (logarithm * i / m).exp() for i in range(m)]
        return growing + [yt + i * step for i in range(top - m + 1)]


@settings(max_examples=60)
@given(logarithmic(most=9), st.data())
def test_edges_levels_and_codes_are_those_of_the_definition_in_decimals(
    quantizer: LogarithmicQuantizer, data: st.DataObject
) -> None:
    exact = edges_by_decimals(quantizer)
    # A power's exponent is rounded and multiplied by a logarithm of up to 10; SPEC.md grants 16 units.
    assert quantizer.edges == pytest.approx([float(edge) for edge in exact], rel=16 * EPS, abs=0)
    levels = [float((a + b) / 2) for a, b in pairwise(exact)]
    assert quantizer.levels[1 : quantizer.top + 1] == pytest.approx(levels, rel=16 * EPS, abs=0)
    i = data.draw(st.integers(0, quantizer.top))
    assert quantizer.encode(quantizer.edges[i]) == quantizer.encode(quantizer.edges[i] / PAST) == i
    assert quantizer.encode(-quantizer.edges[i] * PAST) == -min(i + 1, quantizer.top)
    y = data.draw(within) * quantizer.limit
    codes = {bisect_left(quantizer.edges, abs(y) * (1 + side * 16 * EPS)) for side in (-1, 1)}
    assert abs(quantizer.encode(y)) in codes


UNIFORM, HELD, GROWING = UniformQuantizer, HysteresisQuantizer, LogarithmicQuantizer


@pytest.mark.parametrize(
    ("kind", "wrong", "why"),
    [
        *((UNIFORM, (bits, 1.0), "bits") for bits in (1, 17)),
        *((UNIFORM, (8, limit), "limit") for limit in (0.0, inf, nan)),
        (Continuous, (nan,), "limit"),
        *((UNIFORM, (8, 2.0, deadzone), "dead zone") for deadzone in (0.0, 2.0, nan)),
        *((UNIFORM, (16, limit), "step") for limit in (1e308, 5e-324)),
        *((HELD, (8, 2.0, None, h), "hysteresis") for h in (0.0, 2.0, nan)),
        (GROWING, (2, 2.0), "at least 3 bits"),
        (GROWING, (17, 2.0), "16 bits"),
        (GROWING, (8, 2.0, None, 1.01), "at most half the limit"),
        (GROWING, (8, 2.0, 0.5), "between 0 and the threshold"),
        (GROWING, (16, 2.0, 0.1, 0.1 + 1e-15), "distinguish"),
        (GROWING, (8, 2.0, 5e-324), "distinguish"),
    ],
)
def test_parameters_out_of_bounds_are_refused(kind: Callable[..., Quantizer], wrong: tuple[Any, ...], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        kind(*wrong)
