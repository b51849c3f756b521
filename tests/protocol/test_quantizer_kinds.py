"""The other kinds of quantizers are those of SPEC.md, and keep what every bounded quantizer promises.

Neither reference below shares a formula or a rounding with the code: hysteresis is judged in fractions, the edges of
the logarithmic kind in decimals of 50 digits.
"""

from __future__ import annotations

from bisect import bisect_left
from decimal import Decimal, localcontext
from fractions import Fraction
from itertools import pairwise
from math import inf, isnan, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.frames import Kind, SignalSpec, WireSpec
from protocol.hysteresis import HysteresisQuantizer
from protocol.logarithmic import MIN_LOGARITHMIC_BITS, LogarithmicQuantizer
from protocol.quantizer import MAX_BITS, MIN_BITS, CodedQuantizer, UniformQuantizer
from tests.protocol.test_quantizer import EPS, Exact

DIGITS = 50

within = st.floats(-1.0, 1.0)
"""A value as a part of the limit."""


@st.composite
def hysteretic(draw: st.DrawFn) -> HysteresisQuantizer:
    limit = draw(st.floats(1e-6, 1e6))
    deadzone, hysteresis = (draw(st.none() | st.floats(1e-3, 0.999).map(lambda part: part * limit)) for _ in range(2))
    return HysteresisQuantizer(draw(st.integers(MIN_BITS, MAX_BITS)), limit, deadzone, hysteresis)


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


# ── hysteresis-uniform ──


@settings(max_examples=200, deadline=None)
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


@settings(max_examples=100, deadline=None)
@given(hysteretic(), st.lists(within, min_size=1, max_size=50), st.floats(1e-3, 1.0))
def test_whatever_came_before_the_error_within_the_limit_stays_within_the_bound(
    quantizer: HysteresisQuantizer, walk: list[float], scale: float
) -> None:
    y = 0.0
    for part in walk:
        y = max(-quantizer.limit, min(quantizer.limit, y + scale * part * quantizer.limit))
        assert abs(quantizer.quantize(y) - y) <= quantizer.bound + 16 * EPS * quantizer.limit
    assert quantizer.saturated == 0


@settings(max_examples=100, deadline=None)
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


@settings(max_examples=200, deadline=None)
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


@settings(max_examples=100, deadline=None)
@given(hysteretic(), st.lists(st.floats(-1.5, 1.5), max_size=30))
def test_what_it_sent_decodes_to_what_it_would_send_again(quantizer: HysteresisQuantizer, walk: list[float]) -> None:
    for part in walk:
        code = quantizer.encode(part * quantizer.limit)
        assert -quantizer.top <= code <= quantizer.top
        assert quantizer.encode(quantizer.decode(code)) == code


@pytest.mark.parametrize("bits", range(MIN_BITS, 11))
def test_levels_codes_and_the_spare_code_are_those_of_the_uniform_kind_and_all_are_reached(bits: int) -> None:
    quantizer, uniform = HysteresisQuantizer(bits, 3.0), UniformQuantizer(bits, 3.0)
    assert repr(quantizer.levels) == repr(uniform.levels)  # repr: NaN equals itself
    assert quantizer.invalid == uniform.invalid
    for level in uniform.levels:
        if not isnan(level):
            quantizer.reset()
            assert quantizer.quantize(level) == level


@settings(max_examples=50, deadline=None)
@given(hysteretic(), st.floats(1 + 2.0**-40, 1e9))
def test_beyond_the_limit_the_outermost_level_is_held_and_counted(quantizer: HysteresisQuantizer, far: float) -> None:
    for n, y in enumerate((far, -far, far, inf, -inf), start=1):
        assert quantizer.encode(y * quantizer.limit) == (quantizer.top if y > 0 else -quantizer.top)
        assert quantizer.saturated == n
    assert quantizer.encode(-quantizer.limit) == -quantizer.top
    assert quantizer.saturated == 5


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


# ── logarithmic-uniform ──


@settings(max_examples=60, deadline=None)
@given(logarithmic(most=9))
def test_edges_and_levels_are_those_of_the_definition_in_decimals(quantizer: LogarithmicQuantizer) -> None:
    exact = edges_by_decimals(quantizer)
    assert len(quantizer.edges) == len(exact) == quantizer.top + 1
    # A power's exponent is rounded and multiplied by a logarithm of up to 10; SPEC.md grants 16 units.
    assert quantizer.edges == pytest.approx([float(edge) for edge in exact], rel=16 * EPS, abs=0)
    levels = [float((a + b) / 2) for a, b in pairwise(exact)]
    assert quantizer.levels[1 : quantizer.top + 1] == pytest.approx(levels, rel=16 * EPS, abs=0)
    assert quantizer.levels[quantizer.top + 2 :] == [-y for y in reversed(quantizer.levels[1 : quantizer.top + 1])]


@settings(max_examples=200, deadline=None)
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
    # Within 16 units in the last place of an edge a tie may be told.
    codes = {bisect_left(quantizer.edges, abs(y) * (1 + side * 16 * EPS)) for side in (-1, 1)}
    assert abs(quantizer.encode(y)) in codes
    assert quantizer.encode(y) * y >= 0


@settings(max_examples=200, deadline=None)
@given(logarithmic(), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0) | st.floats(0.0, 1e-9))
def test_it_is_odd_monotone_and_bounded(quantizer: LogarithmicQuantizer, part: float, other: float) -> None:
    low, high = sorted((part * quantizer.limit, (part + other) * quantizer.limit))
    assert quantizer.encode(low) <= quantizer.encode(high)
    for y in (low, high):
        assert quantizer.encode(-y) == -quantizer.encode(y)
        if abs(y) <= quantizer.limit:
            assert abs(quantizer.quantize(y) - y) <= quantizer.bound + 8 * EPS * quantizer.limit


@settings(max_examples=100, deadline=None)
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
    assert isnan(quantizer.decode(quantizer.invalid))
    assert quantizer.invalid == -(2 ** (bits - 1))
    assert (quantizer.encode(quantizer.limit), quantizer.saturated) == (quantizer.top, 0)


def test_small_values_err_in_proportion_and_large_ones_by_less_than_the_bound() -> None:
    quantizer, uniform = LogarithmicQuantizer(8, 1.0), UniformQuantizer(8, 1.0)
    for y in (0.002, 0.02, 0.2):
        assert abs(quantizer.quantize(y) - y) <= 0.04 * y  # (ρ − 1)/2 with ρ = 255^(1/82)
    assert quantizer.deadzone == uniform.deadzone / 4


@settings(max_examples=50, deadline=None)
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
            quantizer.decode(code)
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
        (16, {"deadzone": 0.1, "threshold": 0.1 + 1e-15}, "tell apart"),
        (8, {"deadzone": 5e-324}, "tell apart"),
    ],
)
def test_what_makes_no_intervals_is_refused(bits: int, more: dict[str, float], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        LogarithmicQuantizer(bits, 2.0, **more)


# ── the kinds in a wire ──


@pytest.mark.parametrize(
    ("kind", "made"),
    [
        ("uniform", UniformQuantizer),
        ("hysteresis-uniform", HysteresisQuantizer),
        ("logarithmic-uniform", LogarithmicQuantizer),
    ],
)
def test_a_signal_has_the_quantizer_that_it_names(kind: Kind, made: type[CodedQuantizer]) -> None:
    assert type(SignalSpec(bits=8, limit=1.0, kind=kind).quantizer()) is made
    assert SignalSpec(bits=None, limit=1.0, kind=kind).quantizer().bound == 0


def test_the_parameters_reach_the_quantizer() -> None:
    held = SignalSpec(bits=8, limit=2.0, kind="hysteresis-uniform", deadzone=0.1, hysteresis=0.25).quantizer()
    assert isinstance(held, HysteresisQuantizer)
    assert (held.deadzone, held.hysteresis) == (0.1, 0.25)
    grown = SignalSpec(bits=8, limit=2.0, kind="logarithmic-uniform", deadzone=0.01, threshold=0.75).quantizer()
    assert isinstance(grown, LogarithmicQuantizer)
    assert (grown.deadzone, grown.threshold) == (0.01, 0.75)


@pytest.mark.parametrize(
    ("signal", "why"),
    [
        ({"hysteresis": 0.1}, 'hysteresis belongs to kind = "hysteresis-uniform"'),
        ({"kind": "logarithmic-uniform", "hysteresis": 0.1}, "hysteresis belongs to"),
        ({"kind": "hysteresis-uniform", "threshold": 0.1}, 'threshold belongs to kind = "logarithmic-uniform"'),
        ({"bits": "cont", "threshold": 0.1}, "threshold belongs to"),
        ({"kind": "logarithmic-uniform", "bits": 2}, "at least 3 bits"),
        ({"kind": "hysteresis-uniform", "hysteresis": 1.0}, "less than the limit"),
        ({"kind": "logarithm"}, "kind"),
    ],
)
def test_a_parameter_that_does_not_belong_to_the_kind_is_refused(signal: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        SignalSpec.model_validate({"bits": 8, "limit": 1.0, **signal})


def test_other_bits_keep_the_kind_and_are_refused_where_it_takes_none_such() -> None:
    wire = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform", threshold=0.2))
    assert wire.with_bits(10, 6).rate == wire.rate.model_copy(update={"bits": 10})
    assert wire.with_bits(None, 6).with_bits(8, 6) == wire
    with pytest.raises(ValueError, match="at least 3 bits"):
        wire.with_bits(2, 6)


def test_two_wires_differ_in_kind_and_its_parameters() -> None:
    uniform = WireSpec()
    held = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform", hysteresis=0.1))
    assert uniform.differences(held) == ["rate.kind: uniform, not hysteresis-uniform", "rate.hysteresis: None, not 0.1"]


def test_what_is_told_of_a_uniform_signal_is_what_it_was_before_there_were_other_kinds() -> None:
    told = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform")).agreed()
    assert told["attitude"] == {"bits": 8, "limit": 1.0, "deadzone": None}
    assert told["rate"] == {
        "bits": 8, "limit": 1.0, "deadzone": None, "kind": "logarithmic-uniform", "hysteresis": None, "threshold": None
    }  # fmt: skip
    assert WireSpec.model_validate(told).rate.kind == "logarithmic-uniform"
