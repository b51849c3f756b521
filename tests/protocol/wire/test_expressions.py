"""Quantizers as expressions: every code and level to the last bit, beside the quantizers themselves."""

from __future__ import annotations

from array import array
from functools import cache
from math import copysign, inf, isnan, nan, nextafter
from threading import Event, Thread
from typing import Final

import casadi as ca
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.expressions import NUMBERS, as_written, encode, level, numbers, saturates, with_numbers
from aeroloop.protocol.wire.quantizer import (
    CodedQuantizer,
    Continuous,
    HysteresisQuantizer,
    LogarithmicQuantizer,
    Quantizer,
    UniformQuantizer,
)
from aeroloop.protocol.wire.symbolic import Compiled
from tests.protocol.wire.test_quantizer import quantizers

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
        found = [encode(quantizer, y, held), level(quantizer, code), saturates(quantizer, y)]
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


@st.composite
def values(draw: st.DrawFn, quantizer: Quantizer) -> float:
    """A value anywhere, a special one, or one within a few units in the last place of an edge."""
    if draw(st.booleans()) or not isinstance(quantizer, CodedQuantizer):
        anywhere = st.floats(-1.3, 1.3).map(lambda part: part * quantizer.limit)
        return draw(anywhere | st.sampled_from([0.0, -0.0, inf, -inf, 5e-324, quantizer.limit, -quantizer.limit]))
    i = draw(st.integers(0, quantizer.top) | st.integers(0, min(3, quantizer.top)))
    if isinstance(quantizer, LogarithmicQuantizer):
        edge: float = quantizer.edges[i]
    else:
        assert isinstance(quantizer, UniformQuantizer)
        band = draw(st.sampled_from((-1, 0, 1))) * getattr(quantizer, "hysteresis", 0)
        edge = quantizer.deadzone + i * quantizer.step + band
    towards = draw(st.sampled_from((-inf, inf)))
    for _ in range(draw(st.integers(0, 6))):
        edge = nextafter(edge, towards)
    return edge if draw(st.booleans()) else -edge


@settings(max_examples=400)
@given(st.integers(0, len(FIXED) - 1) | quantizers, st.data())
def test_codes_of_consecutive_values_and_levels_are_the_quantizer_s(
    drawn: int | Quantizer, data: st.DataObject
) -> None:
    quantizer = FIXED[drawn] if isinstance(drawn, int) else drawn
    function = of_constants(drawn) if isinstance(drawn, int) else of_numbers(type(quantizer))
    if not isinstance(drawn, int):
        function.inputs["parameters"][:] = memoryview(array("d", numbers(quantizer)))
    quantizer.reset()
    held = nan
    for y in data.draw(st.lists(values(quantizer), min_size=1, max_size=30)):
        function.inputs["y"][0], function.inputs["held"][0] = y, held
        function()
        held, before = function.outputs["encoded"][0], quantizer.saturated
        assert same(held, float(quantizer.encode(y)))
        assert function.outputs["saturates"][0] == quantizer.saturated - before
    top = quantizer.top if isinstance(quantizer, CodedQuantizer) else 0
    codes = st.floats() if not top else st.integers(-top - 1, top) | st.integers(-2, 1)
    for code in data.draw(st.lists(codes, max_size=20)):
        function.inputs["code"][0] = code
        function()
        assert same(function.outputs["level"][0], quantizer.level(code))


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
