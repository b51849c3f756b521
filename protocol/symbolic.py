"""A `casadi.Function` evaluated in place.

CasADi writes the equations; the loop evaluates them. Called with arguments a Function costs 160 µs, most of it in
making and checking matrices. Through `Function.buffer()` it reads and writes memory that we own, and costs about a
microsecond. `Compiled` keeps that memory alive and gives it names; two functions may share it, so that what one writes
is what the next reads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import prod
from typing import TypeAlias

import casadi as ca

Buffer: TypeAlias = "memoryview[float]"
"""A row of doubles, written and read by index. Matrices lie column by column, as CasADi keeps them."""


def buffer(size: int) -> Buffer:
    """Zeroed memory for `size` doubles."""
    return memoryview(bytearray(8 * size)).cast("d")


class Compiled:
    """A function whose named inputs and outputs are rows of doubles in memory.

    Write into `inputs[name]`, call the object, read `outputs[name]`. Nothing is allocated by a call.

    Args:
        function: The function; all its inputs and outputs must be dense and named.
        shared: Memory to use instead of fresh memory, by the name of an input or output.

    Raises:
        ValueError: A shared buffer has another size than the input or output it stands for.
    """

    inputs: dict[str, Buffer]
    outputs: dict[str, Buffer]

    def __init__(self, function: ca.Function, shared: Mapping[str, Buffer] | None = None) -> None:
        shared = shared or {}
        self.function = function
        self._buffer, evaluate = function.buffer()
        self._evaluate: Callable[[], None] = evaluate
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
        self._evaluate()
