"""Functions over columns: bit for bit equal to the function of each row."""

from __future__ import annotations

from array import array
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.control.columns import UNROLLED, along_rows, in_columns

ROWS = UNROLLED

OPERATIONS = {
    "arithmetic": lambda x, y: ca.vertcat(x + y, x - y, x * y, x / y, -x, 2 * x, x * x, 0.1 * y + 3),
    "comparisons": lambda x, y: ca.vertcat(
        ca.fmin(x, y), ca.fmax(x, y), ca.if_else(x < y, x, y), ca.if_else(ca.logic_and(x > 0, y > 0), x, 0)
    ),
    "functions": lambda x, y: ca.vertcat(ca.sqrt(x), ca.sin(x), ca.cos(y), ca.sin(y * x), ca.atan2(x, y)),
}


def equal_bits(a: Any, b: Any) -> bool:
    """NaN has many bit patterns, and any is as good."""
    a, b = np.asarray(a), np.asarray(b)
    return bool(np.all((a.view(np.int64) == b.view(np.int64)) | (np.isnan(a) & np.isnan(b))))


@pytest.mark.parametrize("operation", OPERATIONS)
@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), values=st.lists(st.floats(), min_size=1, max_size=ROWS))
def test_columns_have_the_bits_of_each_row(operation: str, seed: int, values: list[float]) -> None:
    """Whatever the numbers: sines are the same library's as the loop's, and no simplification loses a −0 or a NaN."""
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    one = ca.Function(
        "one", [x, y], [OPERATIONS[operation](x[0], y), OPERATIONS[operation](y, x[1])], ["x", "y"], ["a", "b"]
    )
    single, many = Compiled(one), Compiled(in_columns(one, ROWS))
    rng = np.random.default_rng(seed)
    numbers = rng.choice([*values, 0.0, -0.0, *rng.normal(size=20), *1e3 * rng.normal(size=5)], size=(3, ROWS))
    np.asarray(many.inputs["x"])[:], np.asarray(many.inputs["y"])[:] = numbers[:2].ravel(), numbers[2]
    many()
    for row in range(ROWS):
        single.inputs["x"][0], single.inputs["x"][1], single.inputs["y"][0] = numbers[:, row]
        single()
        for name in ("a", "b"):
            assert equal_bits(np.asarray(many.outputs[name]).reshape(-1, ROWS)[:, row], single.outputs[name])


RECURSIONS = {
    "state and inputs": lambda x, v, w: ca.vertcat(ca.sin(x[1]) * ca.sqrt(v[0] * v[0] + w) + w, x[0] / 3 - v[1]),
    "state alone": lambda x, v, w: ca.vertcat(x[0] + 1, ca.cos(x[1])),  # noqa: ARG005
    "inputs alone": lambda x, v, w: ca.vertcat(v[0] / w, 3 * v[1]),  # noqa: ARG005
    "constants": lambda x, v, w: ca.vertcat(ca.fmin(1, x[0] + 0.1), 1.5),  # noqa: ARG005
    "no simplification": lambda x, v, w: ca.vertcat(0.1 * (0.3 * (x[0] + v[0])), x[1] + 0.1 * (0.3 * w)),
}


@pytest.mark.parametrize("recursion", RECURSIONS)
def test_a_recursion_along_rows_is_that_of_step_after_step(recursion: str) -> None:
    """Whatever of it depends on the state, which alone goes from row to row."""
    state, v, w = ca.SX.sym("state", 2), ca.SX.sym("v", 2), ca.SX.sym("w")
    with as_written():
        following = RECURSIONS[recursion](state, v, w)
    step = ca.Function("step", [state, v, w], [following], ["state", "v", "w"], ["next"])
    rows = 3 * UNROLLED
    first, vs, ws = ca.MX.sym("first", 2), ca.MX.sym("vs", rows, 2), ca.MX.sym("ws", rows)
    many = Compiled(ca.Function("many", [first, vs, ws], [along_rows(step, first, vs, ws)]))
    rng, single = np.random.default_rng(0), Compiled(step)
    for memory in many.inputs.values():
        np.asarray(memory)[:] = rng.normal(size=len(memory))
    many()
    given_first, given_v, given_w = (np.asarray(memory) for memory in many.inputs.values())
    single.inputs["state"][:] = memoryview(array("d", given_first))
    for row in range(rows):
        single.inputs["v"][:] = memoryview(array("d", given_v.reshape(2, rows)[:, row]))
        single.inputs["w"][0] = given_w[row]
        single()
        single.inputs["state"][:] = single.outputs["next"]
        (after,) = many.outputs.values()
        assert equal_bits(np.asarray(after).reshape(2, rows)[:, row], single.outputs["next"])
