"""Quantizers as expressions: every code and level to the last bit, beside the quantizers themselves."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from math import copysign, inf, isnan, nan, nextafter
from random import Random
from threading import Event, Thread

import casadi as ca
import pytest

from aeroloop.protocol.wire.expressions import as_written, encode, level, saturates
from aeroloop.protocol.wire.quantizer import (
    CodedQuantizer,
    Continuous,
    HysteresisQuantizer,
    LogarithmicQuantizer,
    Quantizer,
    UniformQuantizer,
)
from aeroloop.protocol.wire.symbolic import Compiled

LIMITS = (1.0, 24.0, 0.3)
EVERY: tuple[Quantizer, ...] = (
    *(UniformQuantizer(bits, limit) for bits in range(2, 17) for limit in LIMITS),
    *(UniformQuantizer(bits, 1.0, 0.37) for bits in range(2, 17)),
    *(HysteresisQuantizer(bits, limit) for bits in range(2, 17) for limit in LIMITS),
    *(HysteresisQuantizer(bits, 24.0, 0.4, 0.05) for bits in range(2, 17)),
    *(LogarithmicQuantizer(bits, limit) for bits in range(3, 17) for limit in LIMITS),
    *(LogarithmicQuantizer(bits, 24.0, 0.4, 7.0) for bits in range(3, 17)),
    Continuous(24.0),
)


@cache
def compiled(which: int) -> Compiled:
    """(y, held, code) ↦ (the code of y, the level of code, whether y saturates) of one of EVERY."""
    y, held, code = (ca.SX.sym(name) for name in ("y", "held", "code"))
    with as_written():
        found = [encode(EVERY[which], y, held), level(EVERY[which], code), saturates(EVERY[which], y)]
        names = ["y", "held", "code"], ["encoded", "level", "saturates"]
        return Compiled(ca.Function("every", [y, held, code], found, *names))


def same(a: float, b: float) -> bool:
    """Equal to the last bit, the sign of a zero included; NaN equals NaN."""
    return (isnan(a) and isnan(b)) or (a == b and copysign(1, a) == copysign(1, b))


def value(quantizer: Quantizer, held: float, random: Random) -> float:
    """A value anywhere, a special one, or one within a few units in the last place of an edge, often of a near one."""
    anywhere = random.uniform(-1.3, 1.3) * quantizer.limit
    special = random.choice([0.0, -0.0, inf, -inf, 5e-324, quantizer.limit, -quantizer.limit])
    if not isinstance(quantizer, CodedQuantizer):
        return random.choice([anywhere, special])
    near = 0 if isnan(held) else abs(int(held)) + random.randint(-2, 1)
    i = min(quantizer.top, max(0, random.choice([near, random.randint(0, quantizer.top)])))
    if isinstance(quantizer, LogarithmicQuantizer):
        edge = quantizer.edges[i]
    else:
        assert isinstance(quantizer, UniformQuantizer)
        edge = quantizer.deadzone + i * quantizer.step + random.randint(-1, 1) * getattr(quantizer, "hysteresis", 0)
    for _ in range(random.randint(0, 6)):
        edge = nextafter(edge, random.choice([-inf, inf]))
    return random.choice([anywhere, special, edge, edge, edge]) * random.choice([-1, 1])


@pytest.mark.parametrize("seed", range(5))
def test_codes_of_consecutive_values_are_the_quantizers(seed: int) -> None:
    random = Random(seed)
    for which, quantizer in enumerate(EVERY):
        function, held = compiled(which), nan
        quantizer.reset()
        for _ in range(60):
            y = value(quantizer, held, random)
            function.inputs["y"][0], function.inputs["held"][0] = y, held
            function()
            held, before = function.outputs["encoded"][0], quantizer.saturated
            assert same(held, float(quantizer.encode(y))), (quantizer.__dict__, y)
            assert function.outputs["saturates"][0] == quantizer.saturated - before, (quantizer.__dict__, y)


def levels() -> Iterator[tuple[int, float]]:
    """Each code of few bits, and of many bits the outermost, the innermost and some between."""
    for which, quantizer in enumerate(EVERY):
        if isinstance(quantizer, CodedQuantizer):
            top = quantizer.top
            some = range(top + 1) if top < 300 else {*range(9), *range(top - 9, top + 1), *range(0, top, top // 99)}
            yield from ((which, sign * code) for code in some for sign in (1.0, -1.0))
            yield which, quantizer.invalid
        else:
            yield from ((which, code) for code in (0.0, -0.0, 1.5, -24.0, nan))


def test_levels_are_the_quantizers() -> None:
    for which, code in levels():
        quantizer, function = EVERY[which], compiled(which)
        function.inputs["code"][0] = code
        function()
        known = quantizer.level(int(code) if isinstance(quantizer, CodedQuantizer) else code)
        assert same(function.outputs["level"][0], known), (quantizer.__dict__, code)


def test_what_is_built_as_written_keeps_its_order_and_the_switch_returns() -> None:
    def steps() -> ca.SX:
        return (0.1 * (3.0 * x) + 1) - 1 + 0

    x = ca.SX.sym("x")
    with as_written():
        written = ca.Function("f", [x], [steps()])
    simplified = ca.Function("f", [x], [steps()])
    for value in (7e-3, -0.0):
        assert same(float(written(value)), (0.1 * (3.0 * value) + 1) - 1 + 0)
    assert float(simplified(7e-3)) != float(written(7e-3))


def test_two_threads_never_build_as_written_at_once() -> None:
    inside, first_may_end = Event(), Event()
    order: list[str] = []

    def first() -> None:
        with as_written():
            inside.set()
            first_may_end.wait()
            order.append("first ends")

    def second() -> None:
        with as_written(), as_written():  # nests in one thread
            order.append("second begins")

    threads = [Thread(target=first), Thread(target=second)]
    threads[0].start()
    inside.wait()
    threads[1].start()
    threads[1].join(0.05)  # time in which it would begin; if it does not, the order cannot fail
    first_may_end.set()
    for thread in threads:
        thread.join()
    assert order == ["first ends", "second begins"]
    assert ca.GlobalOptions.getSimplificationOnTheFly()
