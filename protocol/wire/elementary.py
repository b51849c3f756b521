"""Sine, cosine and tanh of controllers in plain arithmetic: their bits depend on no C library and no processor.

IEEE 754 fixes the bits of +, −, ×, ÷ and the root; those of libm's functions differ between libraries and versions.
Plants call libm, twice as fast.
"""

from __future__ import annotations

from functools import cache
from math import factorial, pi
from typing import Final

import casadi as ca

from aeroloop.protocol.wire.expressions import as_written

_FIRST: Final = float.fromhex("0x1.921fb544p+0")  # π/2 in parts: 33 bits, so that k times it is exact up to k = 2²⁰,
_SECOND: Final = float.fromhex("0x1.0b4611a6p-34")  # the next 33 bits,
_REST: Final = float.fromhex("0x1.3198a2e037073p-69")  # and what is left, rounded
_SINE: Final = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
    2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
"""Of x³, x⁵…: the polynomial is off by 2⁻⁵⁸ x at most."""
_COSINE: Final = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
"""Of x⁴, x⁶…: the polynomial is off by 2⁻⁵⁸ at most."""


_TANH_IS_1: Final = 22.0  # from here on tanh differs from 1 by less than 2⁻⁶²
_DOUBLINGS: Final = 8
_TERMS: Final = 11  # of eʸ − 1 for |y| ≤ 2 · 22 / 2⁸: what is left out is below 2⁻⁵⁹ y


def sine_cosine(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """sin x and cos x of each element, x in rad; NaN where x is no finite number. Both have the shape of x.

    The argument is reduced by multiples of π/2 to [−π/4, π/4], where the polynomials of FreeBSD's msun (k_sin.c and
    k_cos.c, after Sun's fdlibm) are used. Up to |x| = 2²⁰ π/2 the result is within 0.8 units in the last place, or
    2⁻¹⁰⁰ where it is that small; beyond, the reduction adds as much as half a unit in the last place of x.

    CasADi's derivative of them is that of the polynomials, which is less exact: derive with symbols for both.
    """
    x = ca.SX(x)
    with as_written():
        both = [_sine_cosine()(each) for each in ca.vertsplit(ca.vec(x))]
        return tuple(ca.reshape(ca.vertcat(*part), *x.shape) for part in zip(*both, strict=True))


def tanh(x: ca.SX) -> ca.SX:
    """Tanh of each element, within 12 units in the last place; NaN where x is NaN. Shape as x.

    With t = e⁻²ˣ − 1 it is −t / (2 + t) for x ≥ 0, and t(2y) = t(y) (2 + t(y)) leads there from a power series.
    """
    x = ca.SX(x)
    with as_written():
        return ca.reshape(ca.vertcat(*(_tanh()(each) for each in ca.vertsplit(ca.vec(x)))), *x.shape)


@cache
def _tanh() -> ca.Function:
    with as_written():
        x = ca.SX.sym("x")
        y = ca.fmin(ca.fabs(x), _TANH_IS_1) * (-2 / 2**_DOUBLINGS)
        t = ca.SX(1 / factorial(_TERMS))
        for n in reversed(range(1, _TERMS)):
            t = 1 / factorial(n) + y * t
        t = y * t
        for _ in range(_DOUBLINGS):
            t = t * (2 + t)
        return ca.Function("tanh", [x], [ca.sign(x) * (-t / (2 + t))], ["x"], ["tanh"], {"cse": True})


@cache
def _sine_cosine() -> ca.Function:
    with as_written():
        x = ca.SX.sym("x")
        k = ca.floor(x * (2 / pi) + 0.5)
        r = x - k * _FIRST  # exact
        second = k * _SECOND
        high = r - second
        back = r - high
        low = ((r - (high + back)) + (back - second)) - k * _REST
        y = high + low
        rest = (high - y) + low

        z = y * y
        s1, s2, s3, s4, s5, s6 = _SINE
        of_sine = s2 + z * (s3 + z * s4) + z * (z * z) * (s5 + z * s6)
        cube = z * y
        sine = y - ((z * (0.5 * rest - cube * of_sine) - rest) - cube * s1)

        c1, c2, c3, c4, c5, c6 = _COSINE
        of_cosine = z * (c1 + z * (c2 + z * c3)) + (z * z) * (z * z) * (c4 + z * (c5 + z * c6))
        half = 0.5 * z
        near = 1 - half
        cosine = near + (((1 - near) - half) + (z * of_cosine - y * rest))

        pairs = ca.floor(k / 2)
        odd, turned = k - 2 * pairs, pairs - 2 * ca.floor(pairs / 2)  # 0 or 1: quadrants 1 and 3, 2 and 3
        sign = 1 - 2 * turned
        of_x = sign * ca.if_else(odd, cosine, sine), sign * ca.if_else(odd, -sine, cosine)
        return ca.Function("sine_cosine", [x], list(of_x), ["x"], ["sine", "cosine"], {"cse": True})
