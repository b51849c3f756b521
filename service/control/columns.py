"""Columnar evaluation: the same CasADi function of many ticks at once, a row a tick.

`in_columns` turns a function of scalars into the same function of columns: each of its instructions then runs over a
whole column within CasADi, at a tenth of the cost. `along_rows` is for recursions from tick to tick: only what depends
on the state runs row by row. Both run the function's own instructions, so the results are equal bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import casadi as ca

from aeroloop.protocol.wire.expressions import as_written

UNROLLED: Final = 64
"""Steps of a recursion that are unrolled into one function, so that calls cost little."""


def in_columns(function: ca.Function, rows: int) -> ca.Function:
    """The same function of many rows at once.

    Args:
        function: Of scalars and vectors; made of SX, all outputs dense.
        rows: How many.

    Returns:
        A function with the same names. An input or output of shape (n, m) becomes one of shape (rows, n·m), whose
        columns are the elements in CasADi's order, column by column.
    """
    names = function.name_in(), function.name_out()
    given = [ca.MX.sym(name, rows, function.numel_in(name)) for name in names[0]]
    found = _evaluated(function, [ca.horzsplit(matrix) for matrix in given], _applied)
    return ca.Function(f"{function.name()}_columns", given, [ca.horzcat(*each) for each in found], *names)


def along_rows(step: ca.Function, first: ca.MX, *columns: ca.MX) -> ca.MX:
    """States of a recursion over rows. What does not depend on the state is computed in columns.

    Args:
        step: (state, inputs…) ↦ next state; made of SX.
        first: State before the first row. Shape (n, 1).
        columns: The inputs, a row a step; as many rows as a multiple of UNROLLED. Shapes (rows, …).

    Returns:
        The state after each row. Shape (rows, n).
    """
    state = ca.SX.sym("state", step.numel_in(0))
    used, symbols = list[ca.MX](), dict[int, ca.SX]()  # columns that the recursion takes up

    def within(value: Any) -> ca.SX:
        if isinstance(value, ca.SX):
            return value
        if value.is_constant():
            return ca.SX(float(value))
        if id(value) not in symbols:
            used.append(value)
            symbols[id(value)] = ca.SX.sym("used")
        return symbols[id(value)]

    def applied(operation: int, *of: Any) -> Any:
        if any(isinstance(value, ca.SX) for value in of):
            of = tuple(map(within, of))
        return _applied(operation, *of)

    with as_written():
        given: list[Sequence[Any]] = [ca.vertsplit(state), *(ca.horzsplit(column) for column in columns)]
        after = ca.vertcat(*map(within, _evaluated(step, given, applied)[0]))
        recursion = ca.Function("recursion", [state, ca.vertcat(*symbols.values())], [after])
        many = ca.SX.sym("many", len(used), UNROLLED)
        states = recursion.mapaccum(UNROLLED)(state, many)
        some = ca.Function("steps", [state, many], [states[:, -1], states])
        _, rows = some.mapaccum(columns[0].shape[0] // UNROLLED)(first, ca.horzcat(*used).T)
    return rows.T


def _applied(operation: int, *of: Any) -> Any:
    """A CasADi operation on one or two values, all of them SX or all MX."""
    kind = type(of[0])
    return kind.unary(operation, *of) if len(of) == 1 else kind.binary(operation, *of)


def _evaluated(function: ca.Function, given: Sequence[Sequence[Any]], apply: Callable[..., Any]) -> list[list[Any]]:
    """The elements of a function's outputs, instruction by instruction, from those of its inputs; constants are MX."""
    found: list[list[Any]] = [[None] * function.numel_out(name) for name in function.name_out()]
    work: dict[int, Any] = {}
    for i in range(function.n_instructions()):
        operation, of, to = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if operation == ca.OP_INPUT:
            work[to[0]] = given[of[0]][of[1]]
        elif operation == ca.OP_OUTPUT:
            found[to[0]][to[1]] = work[of[0]]
        elif operation == ca.OP_CONST:
            work[to[0]] = ca.MX(function.instruction_constant(i))
        else:
            work[to[0]] = apply(operation, *(work[place] for place in of))
    return found
