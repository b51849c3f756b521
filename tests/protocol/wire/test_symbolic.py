"""Compiled functions: named rows of doubles in memory, which two functions may share."""

from __future__ import annotations

from array import array

import casadi as ca
import pytest

from aeroloop.protocol.wire.symbolic import Compiled, buffer, parts


def test_parts_of_a_memory_follow_each_other_and_share_it() -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [2 * x, ca.sum1(x), x + 1], ["x"], ["twice", "sum", "next"])
    memory = buffer(5)
    compiled = Compiled(function, parts(memory, {"twice": 2, "sum": 1, "next": 2}))
    compiled.inputs["x"][:] = memoryview(array("d", (3.0, 4.0)))
    compiled()
    assert memory.tolist() == [6.0, 8.0, 7.0, 4.0, 5.0]


def test_shared_memory_of_another_size_is_refused() -> None:
    x = ca.SX.sym("x", 3)
    with pytest.raises(ValueError, match="x holds 3 doubles"):
        Compiled(ca.Function("f", [x], [2 * x], ["x"], ["y"]), {"x": buffer(4)})
