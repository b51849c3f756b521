"""Sine, cosine and tanh in plain arithmetic, against 60 digits."""

from __future__ import annotations

from decimal import Decimal, getcontext
from math import inf, isnan, nan, pi, ulp

import casadi as ca
import numpy as np
import pytest

from aeroloop.protocol.wire.elementary import sine_cosine, tanh

DIGITS = 60
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803483")
RANDOM = np.random.default_rng(3)
ANGLES = [
    *RANDOM.uniform(-8, 8, 1000),
    *10 ** RANDOM.uniform(-12, 6.2, 1000),
    *(RANDOM.integers(1, 2**20, 1000) * (pi / 2)),  # where most of the argument cancels
    *(np.arange(1, 500) * (pi / 4)),  # the edges of the polynomials
]


@pytest.fixture(autouse=True)
def _digits() -> None:
    getcontext().prec = DIGITS


def exact(x: float) -> tuple[Decimal, Decimal]:
    """Sin x and cos x."""
    turns = (Decimal(x) / (PI / 2)).to_integral_value()
    r = Decimal(x) - turns * (PI / 2)

    def series(term: Decimal, n: int) -> Decimal:
        total = term
        while abs(term) > Decimal(10) ** -DIGITS:
            term *= -r * r / ((n + 1) * (n + 2))
            total, n = total + term, n + 2
        return total

    sine, cosine = series(r, 1), series(Decimal(1), 0)
    return [(sine, cosine), (cosine, -sine), (-sine, -cosine), (-cosine, sine)][int(turns) % 4]


def off(found: float, true: Decimal) -> float:
    """The error in units in the last place of the true value; 0 where it is below 2⁻¹⁰⁰."""
    error = abs(Decimal(found) - true)
    return float(error / Decimal(ulp(float(true)))) if error > Decimal(2) ** -100 else 0.0


def columns(function: ca.Function, values: list[float]) -> np.ndarray:
    return np.array([part.full().ravel() for part in function.map(len(values)).call([ca.DM(values).T])])


def test_sine_and_cosine_are_within_0_8_units_in_the_last_place() -> None:
    x = ca.SX.sym("x")
    found = columns(ca.Function("both", [x], [*sine_cosine(x)]), ANGLES)
    for angle, *both in zip(ANGLES, *found.tolist(), strict=True):
        assert all(off(got, true) < 0.8 for got, true in zip(both, exact(angle), strict=True)), angle


def test_tanh_is_within_12_units_in_the_last_place_and_odd() -> None:
    x = ca.SX.sym("x")
    values = [*RANDOM.uniform(0, 30, 1000), *10 ** RANDOM.uniform(-12, 1, 1000)]
    function = ca.Function("tanh", [x], [tanh(x)])
    (found,), (turned,) = columns(function, values), columns(function, [-value for value in values])
    assert np.array_equal(turned, -found)
    for value, got in zip(values, found.tolist(), strict=True):
        e = (2 * Decimal(value)).exp()
        assert off(got, (e - 1) / (e + 1)) < 12, value


def test_what_is_no_number_gives_none_and_zero_gives_what_it_must() -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("all", [x], [*sine_cosine(x), tanh(x)])
    sine, cosine, of_tanh = (part.full().ravel().tolist() for part in function([nan, 0]))
    assert (sine[1], cosine[1], of_tanh[1]) == (0, 1, 0)
    assert all(map(isnan, (sine[0], cosine[0], of_tanh[0])))
    assert all(isnan(float(part[0])) for part in function([inf, 0])[:2])
    assert float(function([inf, 0])[2][0]) == 1
