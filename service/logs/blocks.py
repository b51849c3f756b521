"""The controller over a thousand ticks at once, bit for bit what it computes a tick at a time.

A log has all the measurements, so only θ̂ goes from tick to tick: levels, received quaternions and codes are rows of
numpy, the reference is mapped over the rows, and the law runs down them within CasADi with θ̂ carried along. Every
operation keeps the loop's order, so the bits are the loop's (tests/service/logs/test_blocks.py); a tick costs 7 µs
instead of 20.
"""

from __future__ import annotations

from collections import deque
from math import nan
from typing import Final, NamedTuple

import numpy as np

from protocol.attitude import Quaternion
from protocol.symbolic import Buffer, Compiled
from protocol.verbs import Change, Reference
from protocol.wire import WireSpec
from service.controller import Controller
from service.law import LawSettings
from service.logs.codes import encoded_by, levels
from service.logs.report import Array
from service.logs.tallies import Integers
from service.reference import reference_function

ROWS: Final = 1024
"""Ticks that CasADi is given at once."""

_DESIRED: Final = ("q_d", "omega_d", "omega_d_dot")


class Computed(NamedTuple):
    """What the controller made of measurements, a row each; NaN throughout where one had no valid value.

    Attributes:
        attitude: q^Q [1]. Shape (n, 4).
        desired: q_d [1]. Shape (n, 4).
        rate: ω^Q [rad/s]. Shape (n, 3).
        attitude_error: ε̃ [1]. Shape (n, 3).
        rate_error: ω_e [rad/s]. Shape (n, 3).
        voltages: u before quantization [V]; NaN where the law gave no number. Shape (n, actuators).
        sign: ±1, the equilibrium approached. Shape (n, 1).
        gain: C₁'s diagonal [1/s]. Shape (n, 3).
        damping_estimate: θ̂ that the law went by [N·m·s/rad]. Shape (n, 3).
    """

    attitude: Array
    desired: Array
    rate: Array
    attitude_error: Array
    rate_error: Array
    voltages: Array
    sign: Array
    gain: Array
    damping_estimate: Array


class BlockController(Controller):
    """A controller that also takes many measurements at once, and then stands as after the last of them.

    Args:
        wire: How frames are read and written.
        law: Parameters and gains.
        reference: What the body shall do from tick 0 on.
        period: Time between ticks [s].
        rows: Ticks that CasADi is given at once.

    Raises:
        ValueError: The law's B cannot be inverted.
    """

    def __init__(self, wire: WireSpec, law: LawSettings, reference: Reference, period: float, rows: int = ROWS) -> None:
        super().__init__(wire, law, reference, period)
        self._rows = rows
        one = self._law.function
        self._laws = Compiled(one.mapaccum("laws", rows, [one.index_in("theta")], [one.index_out("theta_next")]))
        desired = {name: self._laws.inputs[name] for name in _DESIRED}
        self._motions = Compiled(reference_function().map(rows), desired)
        # The memory of both as arrays, a row a tick; θ̂ goes in once.
        self._given = {name: _table(memory, rows) for name, memory in self._laws.inputs.items() if name != "theta"}
        self._found = {name: _table(memory, rows) for name, memory in self._laws.outputs.items()}
        self._piece = {name: _table(memory, rows) for name, memory in self._motions.inputs.items()}

    def compute_all(self, k: Integers, codes: Array, changes: deque[Change]) -> Computed:
        """What `compute` makes of measurements, one after another; it is not told their counters.

        Args:
            k: Ticks, rising. Shape (n,).
            codes: Of each measurement. Shape (n, 6).
            changes: What is followed from which tick on, in order; those that it has come to follow are taken out.
        """
        with np.errstate(all="ignore"):  # a float64 wire may say 1e200
            vectors, rates = levels(self.wire.attitude, codes[:, :3]), levels(self.wire.rate, codes[:, 3:])
            valid = np.flatnonzero(~np.isnan(np.hstack([vectors, rates])).any(axis=1))
            self.invalid += len(k) - len(valid)
            shape = (4, 4, 3, 3, 3, self.wire.actuators, 1, 3, 3)
            computed = Computed(*(np.full((len(k), columns), nan) for columns in shape))
            for start in range(0, len(valid), self._rows):
                some = valid[start : start + self._rows]
                for column, values in zip(
                    computed, self._compute(k[some], vectors[some], rates[some], changes), strict=True
                ):
                    column[some] = values
        return computed

    def commands(self, voltages: Array) -> Array:
        """The codes of the commands that `answer` sends, one after another. Shape (n, actuators).

        Args:
            voltages: What the law commands [V]; rows of NaN for no valid value. Shape (n, actuators).
        """
        pairs = zip(self._voltage, voltages.T, strict=True)
        return np.stack([encoded_by(quantizer, column) for quantizer, column in pairs], axis=1)

    def sent(self, codes: Array) -> None:
        """Go on as after commands with these codes, whatever was computed. Shape (n, actuators)."""
        for quantizer, column in zip(self._voltage, codes.T, strict=True):
            quantizer.reset()
            for code in column[~np.isnan(column) & (column != quantizer.invalid)][-1:].tolist():
                quantizer.resume(code)

    def follow(self, k: int, changes: deque[Change]) -> None:
        """Follow, and take out, the changes up to tick k."""
        while changes and changes[0].tick <= k:
            self.apply(changes.popleft())

    def _compute(self, k: Integers, vectors: Array, rates: Array, changes: deque[Change]) -> Computed:
        """As many as there are rows, or fewer; all of them valid."""
        n, given, found = len(k), self._given, self._found
        attitude = given["q"][:n] = received_quaternions(vectors, self._attitude)
        given["omega"][:n] = rates
        t: Array = np.asarray(k * self.period, dtype=np.float64)
        since = 0
        while since < n:  # until the next change, the same gains and the same plan
            self.follow(int(k[since]), changes)
            until = int(np.searchsorted(k, changes[0].tick)) if changes else n
            self._lay_out(t[since:until], slice(since, until))
            since = until
        self._motions()
        if self.tick_index < 0:
            self._stand_at(0)
            self._choose_sign()
        given["s"][:n] = self.sign
        self._laws.inputs["theta"][:] = self._theta
        began_with = np.array(self._theta)
        self._laws()
        self._stand_at(n - 1)
        self._theta[:] = self._theta_next
        self._attitude = tuple(attitude[-1].tolist())
        self.tick_index = int(k[-1])
        u = found["u"][:n, self._first_motor :].copy()
        u[np.isnan(u.sum(axis=1))] = nan  # ∞ − ∞ is no number either
        self.failed |= bool(np.isnan(u).any())
        theta = np.vstack([began_with, found["theta_next"][: n - 1]])
        computed = attitude, given["q_d"][:n], rates, found["eps_e"][:n], found["omega_e"][:n]
        return Computed(*computed, u, given["s"][:n], given["C1"][:n], theta)

    def _lay_out(self, t: Array, rows: slice) -> None:
        """The gains of now, and of the plan of now the pieces that hold at times t [s]."""
        for name in ("C1", "C2", "Gamma"):
            self._given[name][rows] = self._law.inputs[name]
        plan = self.motion.plan
        piece = np.maximum(0, np.searchsorted(plan.starts, t, side="right") - 1)
        self._piece["t"][rows, 0] = t
        self._piece["start"][rows, 0] = plan.starts[piece]
        for name in ("quintic", "amplitude", "frequency"):
            self._piece[name][rows] = getattr(plan, name)[piece].reshape(len(t), -1)

    def _stand_at(self, row: int) -> None:
        """Have the law of one tick say what it said at a row."""
        for one, many in ((self._law.inputs, self._given), (self._law.outputs, self._found)):
            for name, table in many.items():
                one[name][:] = memoryview(table[row])


def received_quaternions(vectors: Array, last: Quaternion) -> Array:
    """`received_quaternion` of one ε after the other. Shapes (n, 3) and (n, 4)."""
    x, y, z = vectors.T
    square = x * x + y * y + z * z
    inside = square <= 1.0
    length = np.where(inside, 1.0, np.sqrt(square))
    w = np.sqrt(np.where(inside, 1.0 - square, 0.0))
    q = np.column_stack([w, x / length, y / length, z / length])
    before = np.vstack([last, q[:-1]])
    products = q * before
    towards = products[:, 0] + products[:, 1] + products[:, 2] + products[:, 3]
    # Each is turned as the one before, and once more where the two point apart; a right angle turns back to η ≥ 0.
    turns = np.cumsum(towards < 0.0)
    turns -= np.maximum.accumulate(np.where((towards < 0.0) | (towards > 0.0), 0, turns))
    return np.where(turns[:, np.newaxis] % 2 == 1, -q, q)


def _table(memory: Buffer, rows: int) -> Array:
    return np.asarray(memory).reshape(rows, -1)
