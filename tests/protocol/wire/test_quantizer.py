"""Quantizers of every kind: the bound (C.13), the definitions of (C.14) and SPEC.md; and the same as expressions."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import pairwise, product
from math import copysign, inf, isnan, nan
from threading import Event, Thread
from typing import Any, Final

import casadi as ca
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire import expressions
from aeroloop.protocol.wire.expressions import NUMBERS, as_written, numbers, with_numbers
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
from aeroloop.protocol.wire.symbolic import Compiled

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


# The uniform kind, where every edge and level is exact in binary64

Made = tuple[int, float, float | None]


@st.composite
def dyadic(draw: st.DrawFn, most_bits: int = MAX_BITS) -> Made:
    """Bits, limit and dead zone, of which step, edges and levels are exact; None: half a step."""
    bits, unit = draw(st.integers(MIN_BITS, most_bits)), 2.0 ** draw(st.integers(-12, 6))
    step = draw(st.integers(1, 15)) * unit
    deadzone = draw(st.none() | st.integers(1, 100).map(lambda n: n * unit))
    return bits, (step / 2 if deadzone is None else deadzone) + (2 ** (bits - 1) - 1) * step, deadzone


@settings(max_examples=200)
@given(dyadic(), st.data())
def test_a_value_gets_the_level_of_its_interval_which_is_open_below_and_closed_above(
    made: Made, data: st.DataObject
) -> None:
    quantizer, (_, limit, deadzone) = UniformQuantizer(*made), made
    y0, step = quantizer.deadzone, quantizer.step
    assert y0 == (step / 2 if deadzone is None else deadzone)
    assert (y0 + quantizer.top * step, quantizer.bound) == (limit, max(y0, step / 2))
    grid = step / 4096  # 28 bits of index and fraction
    reach = round(limit / grid) + 4096
    edge = y0 + data.draw(st.integers(0, quantizer.top)) * step
    for y in (data.draw(st.integers(-reach, reach)) * grid, edge, -edge, edge + grid):
        code = quantizer.encode(y)
        index = abs(code)
        below = y0 + (index - 1) * step
        assert index == 0 or (below < abs(y) and code * y > 0)
        assert index == quantizer.top or abs(y) <= below + step
        assert quantizer.level(code) == (copysign(below + step / 2, y) if index else 0)


@settings(max_examples=150)
@given(dyadic(most_bits=10), st.integers(0, 12), st.data())
def test_with_hysteresis_a_code_is_held_while_the_value_is_in_its_widened_interval(
    made: Made, quarters: int, data: st.DataObject
) -> None:
    plain, (_, limit, _) = UniformQuantizer(*made), made
    step = plain.step
    h = quarters * step / 4 if 0 < quarters * step / 4 < limit else step / 2
    quantizer = HysteresisQuantizer(*made, h)
    grid = step / 16  # which holds every edge of a band; moves short and long
    reach = round(limit / grid) + 40
    held: int | None = None
    at = 0
    for move in data.draw(st.lists(st.integers(-40, 40) | st.integers(-reach, reach), min_size=1, max_size=60)):
        at = max(-reach, min(reach, at + move))
        y, near, code = at * grid, False, plain.encode(at * grid)
        if held is not None and abs(y) <= limit:  # no value beyond the limit escapes the outermost level
            near = abs(y) <= plain.deadzone + h if held == 0 else abs(y - plain.level(held)) <= step / 2 + h
        held = held if near else code
        assert quantizer.encode(y) == held
    assert quantizer.saturated == plain.saturated


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


@settings(max_examples=60)
@given(logarithmic(most=9), st.data())
def test_intervals_grow_up_to_the_threshold_are_alike_beyond_it_and_none_that_grows_is_longer(
    quantizer: LogarithmicQuantizer, data: st.DataObject
) -> None:
    y0, yt, limit, m, top = quantizer.deadzone, quantizer.threshold, quantizer.limit, quantizer.growing, quantizer.top

    def longest(m: int) -> float:
        """Of m geometric intervals the last one."""
        return float(yt - yt * (y0 / yt) ** (1 / m))

    def alike(m: int) -> float:
        return (limit - yt) / (top - m)

    assert longest(m) <= alike(m) * (1 + 1e-9)
    assert m == 1 or longest(m - 1) > alike(m - 1) * (1 - 1e-8)
    # A power's exponent is rounded and multiplied by a logarithm of up to 10; SPEC.md grants 16 units.
    edges = [y0 * (yt / y0) ** (i / m) for i in range(m)] + [yt + i * alike(m) for i in range(top - m + 1)]
    assert quantizer.edges == pytest.approx(edges, rel=16 * EPS, abs=0)
    levels = [(a + b) / 2 for a, b in pairwise(edges)]
    assert quantizer.levels[1 : top + 1] == pytest.approx(levels, rel=16 * EPS, abs=0)
    i = data.draw(st.integers(0, top))
    assert quantizer.encode(quantizer.edges[i]) == quantizer.encode(quantizer.edges[i] / PAST) == i
    assert quantizer.encode(-quantizer.edges[i] * PAST) == -min(i + 1, top)


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


# ── as expressions: every code and level to the last bit, beside the quantizers themselves ──


KINDS: Final = UniformQuantizer, HysteresisQuantizer, LogarithmicQuantizer
FIXED: Final[tuple[Quantizer, ...]] = (
    *(kind(bits, limit) for kind in KINDS for bits in range(3, 17) for limit in (1.0, 24.0, 0.3)),
    *(kind(bits, 24.0, 0.4, 7.0) for kind in KINDS[1:] for bits in (3, 8, 16)),
    *(UniformQuantizer(bits, 1.0, 0.37) for bits in (2, 8, 16)),
    HysteresisQuantizer(2, 24.0, 0.4, 0.05),
    Continuous(24.0),
)
"""Quantizers whose parameters are constants of the expressions, as in a controller's tick."""


def compiled(quantizer: Quantizer, parameters: ca.SX) -> Compiled:
    """(y, held, code, parameters) ↦ (the code of y, the level of code, whether y saturates)."""
    y, held, code = (ca.SX.sym(name) for name in ("y", "held", "code"))
    with as_written():
        encoded, level = expressions.encode(quantizer, y, held), expressions.level(quantizer, code)
        found = [encoded, level, expressions.saturates(quantizer, y)]
    names = ["y", "held", "code", "parameters"], ["encoded", "level", "saturates"]
    return Compiled(ca.Function("quantizer", [y, held, code, parameters], found, *names))


@cache
def of_constants(which: int) -> Compiled:
    return compiled(FIXED[which], ca.SX(0, 0))


@cache
def of_numbers(kind: type[Quantizer]) -> Compiled:
    """One function for all quantizers of a kind, whose parameters are inputs, as in the compiled loop."""
    parameters = ca.SX.sym("parameters", len(NUMBERS))
    quantizer = next(quantizer for quantizer in FIXED if type(quantizer) is kind)
    return compiled(with_numbers(quantizer, parameters), parameters)


def same(a: float, b: float) -> bool:
    """Equal to the last bit, the sign of a zero included; NaN equals NaN."""
    return (isnan(a) and isnan(b)) or (a == b and copysign(1, a) == copysign(1, b))


def assert_alike(quantizer: Quantizer, function: Compiled, values: Iterable[float], codes: Iterable[float]) -> None:
    """Codes of consecutive values, what saturates, and levels of codes are the quantizer's."""
    if len(function.inputs["parameters"]):
        function.inputs["parameters"][:] = memoryview(array("d", numbers(quantizer)))
    quantizer.reset()
    held = nan
    for y in values:
        function.inputs["y"][0], function.inputs["held"][0] = y, held
        function()
        held, before = function.outputs["encoded"][0], quantizer.saturated
        assert same(held, float(quantizer.encode(y))), (quantizer, y)
        assert function.outputs["saturates"][0] == quantizer.saturated - before
    for code in codes:
        function.inputs["code"][0] = code
        function()
        assert same(function.outputs["level"][0], quantizer.level(code))


def over_edges(quantizer: CodedQuantizer) -> Iterator[float]:
    """Values within units in the last place of edges and just past them, each after the levels on either side."""
    yield from (0.0, -0.0, inf, -inf, 5e-324, quantizer.limit, -quantizer.limit)
    for i in {0, 1, 2, quantizer.top - 1, quantizer.top} & {*range(quantizer.top + 1)}:
        if isinstance(quantizer, LogarithmicQuantizer):
            edges = [quantizer.edges[i]]
        else:
            assert isinstance(quantizer, UniformQuantizer)
            h = getattr(quantizer, "hysteresis", 0.0)
            edges = [quantizer.deadzone + i * quantizer.step + side * h for side in (-1, 0, 1)]
        for edge, past in product(edges, (1.0, 1 - 4 * EPS, 1 - EPS, 1 + EPS, 1 + 4 * EPS, 1 / PAST, PAST)):
            for code in (i, min(i + 1, quantizer.top)):
                yield from (quantizer.level(code), edge * past, -quantizer.level(code), -edge * past)


@pytest.mark.parametrize("kind", KINDS)
def test_at_every_edge_the_expressions_of_constants_and_of_numbers_give_the_quantizer_s_codes(
    kind: type[CodedQuantizer],
) -> None:
    for which, quantizer in enumerate(FIXED):
        if type(quantizer) is kind:
            values = [*over_edges(quantizer)]
            for function in (of_constants(which), of_numbers(kind)):
                assert_alike(quantizer, function, values, (-quantizer.top - 1, -quantizer.top, -1, 0, 1, quantizer.top))


@settings(max_examples=100)
@given(quantizers, st.data())
def test_codes_of_consecutive_values_and_levels_are_the_quantizer_s(quantizer: Quantizer, data: st.DataObject) -> None:
    parts = data.draw(st.lists(st.floats(-1.3, 1.3), max_size=30))
    top = quantizer.top if isinstance(quantizer, CodedQuantizer) else 0
    codes = data.draw(st.lists(st.floats() if not top else st.integers(-top - 1, top), max_size=20))
    assert_alike(quantizer, of_numbers(type(quantizer)), [part * quantizer.limit for part in parts], codes)


def test_two_threads_never_build_as_written_at_once() -> None:
    begun = Event()

    def build() -> None:
        with as_written(), as_written():  # nests in one thread
            begun.set()

    thread = Thread(target=build)
    with as_written():
        thread.start()
        assert not begun.wait(0.05)  # time in which it would begin
    thread.join()
    assert begun.is_set()
    assert ca.GlobalOptions.getSimplificationOnTheFly()
