"""Ticks of a session as the controller saw them: one, or a block of them in columns.

The review computes and reduces whole blocks; who watches a log tick by tick is given each by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from protocol.attitude import Quaternion, Vector
from service.logs.report import Array
from service.logs.tallies import Integers


class Tick(NamedTuple):
    """One tick of a session as the controller saw it.

    Attributes:
        k: Tick of the law; its time is k·period.
        published_ns: When its measurement was published, on the plant's wall clock [ns].
        latency_ns: From then until the command that answered it was published [ns]; None if none did.
        attitude: q as measured. The other quantities of the law likewise, in its units.
        voltages: What was commanded, or, of a measurement that was passed over, what the next command said [V]; NaN
            where a command had no valid value.
        sign: ±1, the equilibrium approached.
        gain: C₁'s diagonal [1/s].
        damping_estimate: θ̂ as the law used it [N·m·s/rad].
    """

    k: int
    published_ns: int
    latency_ns: int | None
    attitude: Quaternion
    desired: Quaternion
    rate: Vector
    desired_rate: Vector
    attitude_error: Vector
    rate_error: Vector
    voltages: tuple[float, ...]
    sign: float
    gain: Vector
    damping_estimate: Vector


class Ticks(NamedTuple):
    """The same of many, a row each: k, times [ns] and what else a `Tick` has; a latency that there is not is NaN."""

    k: Integers
    published_ns: Integers
    latency_ns: Array
    attitude: Array
    desired: Array
    rate: Array
    desired_rate: Array
    attitude_error: Array
    rate_error: Array
    voltages: Array
    sign: Array
    gain: Array
    damping_estimate: Array

    @classmethod
    def joined(cls, blocks: Sequence[Self]) -> Self:
        """Blocks, at least one, as one."""
        return cls(*(np.concatenate(columns) for columns in zip(*blocks, strict=True)))

    def where(self, chosen: npt.NDArray[np.bool_]) -> Self:
        """Some of them. Shape (n,)."""
        return type(self)(*(column[chosen] for column in self))  # type: ignore[arg-type]  # as they were

    def each(self) -> Iterator[Tick]:
        """One after the other."""
        latencies = [None if ns != ns else int(ns) for ns in self.latency_ns.tolist()]
        rows = (column.tolist() if column.ndim == 1 else map(tuple, column.tolist()) for column in self[3:])
        return map(Tick, self.k.tolist(), self.published_ns.tolist(), latencies, *rows)
