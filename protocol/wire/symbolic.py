"""Evaluation of a `casadi.Function` in place, for one tick or for a block of ticks.

CasADi writes the equations; the loop evaluates them. A call of a Function with arguments costs 160 µs, most of it for
making and checking matrices. Through `Function.buffer()` it reads and writes preallocated memory, and costs about 1 µs.
`Compiled` keeps that memory and names it; two functions may share a buffer: one's output is the next one's input.

A log reader has many ticks at once. `in_columns` turns a function of scalars into the same function of columns, a row a
tick: each of its instructions then runs over a whole column within CasADi, at a tenth of the cost. `along_rows` is for
recursions from tick to tick: only what depends on the state runs row by row. Both run the function's own instructions,
so the results are equal bit for bit.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from math import prod
from typing import Any, Final, TypeAlias

import casadi as ca

from aeroloop.protocol.wire.expressions import as_written

Buffer: TypeAlias = "memoryview[float]"
"""A row of doubles, written and read by index. Matrices are in CasADi's order, column by column."""

UNROLLED: Final = 64
"""Steps of a recursion that are unrolled into one function, so that calls cost little."""


def buffer(size: int) -> Buffer:
    """Zeroed memory for `size` doubles."""
    return memoryview(bytearray(8 * size)).cast("d")


def parts(memory: Buffer, sizes: Mapping[str, int]) -> dict[str, Buffer]:
    """Consecutive parts of a memory, of these sizes, by name."""
    ends = list(accumulate(sizes.values()))
    return {name: memory[end - sizes[name] : end] for name, end in zip(sizes, ends, strict=True)}


INTEGER: Final = 1.5 * 2.0**52
"""Added to an integer of 32 bits, it gives a double whose low half is that integer."""


def integers(memory: Buffer) -> memoryview[int]:
    """The integers in a memory of doubles that each are an integer plus INTEGER. `tolist` reads them all at once."""
    return memory.cast("B").cast("i")[0 if sys.byteorder == "little" else 1 :: 2]


class Compiled:
    """A function whose named inputs and outputs are rows of doubles in memory.

    Write into `inputs[name]`, call the object, read `outputs[name]`. Nothing is allocated by a call.

    Args:
        function: The function; all its inputs and outputs must be dense and named.
        shared: Buffers to use instead of new ones, by the name of an input or output.

    Attributes:
        evaluate: What a call of the object does, without a Python function in between, for the loop. It does not keep
            the object alive, whose memory it uses.

    Raises:
        ValueError: A shared buffer differs in size from its input or output.
    """

    inputs: dict[str, Buffer]
    outputs: dict[str, Buffer]
    evaluate: Callable[[], None]

    def __init__(self, function: ca.Function, shared: Mapping[str, Buffer] | None = None) -> None:
        shared = shared or {}
        self.function = function
        self._buffer, self.evaluate = function.buffer()
        self.inputs = {}
        self.outputs = {}
        for i in range(function.n_in()):
            name = function.name_in(i)
            self.inputs[name] = self._memory(name, function.size_in(i), shared)
            self._buffer.set_arg(i, self.inputs[name])  # type: ignore[call-arg, arg-type]  # any memoryview will do
        for i in range(function.n_out()):
            name = function.name_out(i)
            self.outputs[name] = self._memory(name, function.size_out(i), shared)
            self._buffer.set_res(i, self.outputs[name])  # type: ignore[call-arg, arg-type]  # the same

    @staticmethod
    def _memory(name: str, shape: tuple[int, int], shared: Mapping[str, Buffer]) -> Buffer:
        memory = shared.get(name)
        if memory is None:
            return buffer(prod(shape))
        if len(memory) != prod(shape):
            raise ValueError(f"{name} holds {prod(shape)} doubles, but the shared memory has {len(memory)}")
        return memory

    def __call__(self) -> None:
        """Evaluate: read the inputs as they stand, write the outputs."""
        self.evaluate()


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
