"""Controller over thousands of ticks at once, bit for bit what it computes tick by tick.

All measurements are in the log, so only the attitude's sign and θ̂ carry over from tick to tick. The law and the
reference are the loop's own CasADi instructions, run over columns with a row per tick (`law_of_many`,
protocol/wire/symbolic.py), so the bits are the loop's (tests/service/logs/test_batch.py); a tick costs 1 µs, not 15.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.messages.operator import Change, Gains, Reference
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.symbolic import Buffer, Compiled, in_columns
from aeroloop.protocol.wire.transmit import Sender
from aeroloop.service.control.controller import ControllerSnapshot
from aeroloop.service.control.law import LawSettings, law_of_many
from aeroloop.service.control.motion import Motion
from aeroloop.service.control.reference import reference_function
from aeroloop.service.logs.codes import encoded_by, levels
from aeroloop.service.logs.traces import Array, Integers

ROWS: Final = 1024
"""Ticks per CasADi call: enough to make calls cheap, few enough for columns to stay in the CPU cache."""

_DESIRED: Final = ("q_d", "omega_d", "omega_d_dot")


class Computed(NamedTuple):
    """What the controller computed, a row per measurement; all NaN where a measurement has no valid value.

    Attributes:
        attitude: q^Q [1]. Shape (n, 4).
        desired: q_d [1]. Shape (n, 4).
        rate: ω^Q [rad/s]. Shape (n, 3).
        attitude_error: ε̃ [1]. Shape (n, 3).
        rate_error: ω_e [rad/s]. Shape (n, 3).
        voltages: u before quantization [V]; NaN where the law gives no number. Shape (n, actuators).
        sign: ±1, the equilibrium approached. Shape (n, 1).
        gain: C₁'s diagonal [1/s]. Shape (n, 3).
        damping_estimate: θ̂ that the law used [N·m·s/rad]. Shape (n, 3).
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


class Commands(NamedTuple):
    """Codes of the commands, shape (n, actuators), and whether each is sent as a frame or is silent, shape (n,)."""

    codes: Array
    sent: NDArray[np.bool_]


class BatchController:
    """Computes many measurements per call.

    The reference holds from tick 0 on, the period is between ticks [s], `rows` is ticks per CasADi call, a multiple of
    `aeroloop.protocol.wire.symbolic.UNROLLED`. Raises ValueError if the law's B cannot be inverted.
    """

    def __init__(self, wire: WireSpec, law: LawSettings, reference: Reference, period: float, rows: int = ROWS) -> None:
        self._wire, self._period, self._rows = wire, period, rows
        self._law = Compiled(law_of_many(law, period, rows))
        desired = {name: self._law.inputs[name] for name in _DESIRED}
        self._reference = Compiled(in_columns(reference_function(), rows), desired)
        # CasADi's buffers as arrays, a column per tick.
        self._given = {name: _table(memory, rows) for name, memory in self._law.inputs.items()}
        self._found = {name: _table(memory, rows) for name, memory in self._law.outputs.items()}
        self._piece = {name: _table(memory, rows) for name, memory in self._reference.inputs.items()}
        self._motion = Motion(reference)
        self._gains = {name: np.array(getattr(law, name)) for name in Gains.model_fields}
        self._voltage = [wire.voltage.quantizer() for _ in range(wire.actuators)]
        counters = wire.measurement.counters
        heartbeat = wire.transmit.heartbeat_ticks(round(period * 1e9), counters)
        self._sender = Sender(wire.transmit.command, heartbeat, counters)
        self.restore(ControllerSnapshot(damping_estimate=law.damping_estimate))

    @property
    def state(self) -> ControllerSnapshot:
        """State after the last computed measurement and the last encoded command; `held` has the last row's codes."""
        last, at = self._sender.memory
        codes = None if last is None else tuple(map(float, last))
        return self._state.model_copy(update={"sent_codes": codes, "sent_tick": at})

    def restore(self, state: ControllerSnapshot) -> None:
        """Continue from a recorded state; reference and gains stay as they are."""
        self._state = state
        for i, quantizer in enumerate(self._voltage):
            quantizer.reset()
            if state.voltage_codes is not None:
                quantizer.resume(state.voltage_codes[i])
        self._sender.resume(state.sent_codes, state.sent_tick)

    def follow(self, other: BatchController) -> None:
        """Copy state, gains and reference of another controller with the same configuration."""
        self.restore(other.state)
        self._gains = dict(other._gains)
        self._motion.plan = other._motion.plan

    def compute_all(self, k: Integers, codes: Array, changes: deque[Change]) -> Computed:
        """Results of `Controller.compute` for measurements at ascending ticks k. Shapes (n,) and (n, 6).

        Changes of gains and reference are in order of tick; those that take effect are removed.
        """
        if not len(k):
            return self._nothing(0)
        with np.errstate(all="ignore"):  # a float64 wire may carry 1e200
            vectors, rates = levels(self._wire.attitude, codes[:, :3]).T, levels(self._wire.rate, codes[:, 3:]).T
            valid = np.flatnonzero(~(np.isnan(vectors).any(axis=0) | np.isnan(rates).any(axis=0)))
            computed = self._nothing(len(k))
            for start in range(0, len(valid), self._rows):
                these = valid[start : start + self._rows]
                whole = these[-1] - these[0] == len(these) - 1  # a slice is cheaper than a list of rows
                some = slice(these[0], these[-1] + 1) if whole else these
                found = self._compute(k[some], vectors[:, some], rates[:, some], changes)
                for column, values in zip(computed, found, strict=True):
                    column[some] = values.T
        self._state = self._state.model_copy(update={"held": tuple(codes[-1].tolist())})
        return computed

    def commands(self, k: Integers, voltages: Array) -> Commands:
        """Commands of `Controller.answer` to the law's output [V] at ascending ticks k. Shapes (n,), (n, actuators).

        Rows of NaN have no valid value.
        """
        pairs = zip(self._voltage, voltages.T, strict=True)
        codes = np.stack([encoded_by(quantizer, column) for quantizer, column in pairs], axis=1)
        for last in codes[~np.isnan(voltages).any(axis=1)][-1:].tolist():
            self._state = self._state.model_copy(update={"voltage_codes": tuple(last)})
        if self._wire.transmit.command == "periodic":
            return Commands(codes, np.ones(len(k), dtype=np.bool_))
        due = self._sender.due
        sent = [due(tick, row) for tick, row in zip(k.tolist(), codes.tolist(), strict=True)]
        return Commands(codes, np.array(sent, dtype=np.bool_))

    def _nothing(self, n: int) -> Computed:
        # The values of one element are contiguous in memory, since readers take them by element.
        return Computed(*(np.full((columns, n), nan).T for columns in (4, 4, 3, 3, 3, self._wire.actuators, 1, 3, 3)))

    def _compute(self, k: Integers, vectors: Array, rates: Array, changes: deque[Change]) -> Sequence[Array]:
        """`Computed` with a column per tick, for at most `rows` ticks, all of them valid."""
        n, given, found, state = len(k), self._given, self._found, self._state
        given["eps"][:, :n], given["omega"][:, :n] = vectors, rates
        given["last"][:, 0], given["theta"][:, 0] = state.attitude, state.damping_estimate
        t: Array = np.asarray(k * self._period, dtype=np.float64)
        since = 0
        while since < n:  # until the next change, the same gains and the same plan
            while changes and changes[0].tick <= k[since]:
                self._apply(changes.popleft())
            until = int(np.searchsorted(k, changes[0].tick)) if changes else n
            self._lay_out(t[since:until], slice(since, until))
            since = until
        self._reference()
        given["s"][:] = state.sign or 1
        self._law()
        if not state.sign and not found["eta_e"][0, 0] >= 0:  # Assumption 3, as at the loop's first measurement
            given["s"][:] = -1
            self._law()
        self._state = state.model_copy(
            update={
                "attitude": tuple(found["q"][:, n - 1].tolist()),
                "sign": int(given["s"][0, 0]),
                "damping_estimate": tuple(found["theta_next"][:, n - 1].tolist()),
            }
        )
        u = found["u"][3 - self._wire.actuators :, :n]
        u[:, np.isnan(u.sum(axis=0))] = nan  # ∞ − ∞ is no number either
        q, eps_e, omega_e, theta = (found[name] for name in ("q", "eps_e", "omega_e", "theta_before"))
        columns = q, given["q_d"], rates, eps_e, omega_e, u, given["s"], given["C1"], theta
        return [column[:, :n] for column in columns]

    def _apply(self, change: Change) -> None:
        if change.gains is not None:
            changed = change.gains.model_dump(exclude_none=True)
            self._gains |= {name: np.array(diagonal) for name, diagonal in changed.items()}
        self._motion.change(change, self._period)

    def _lay_out(self, t: Array, rows: slice) -> None:
        """Fill in the current gains, and the pieces of the current reference plan at times t [s]."""
        for name, diagonal in self._gains.items():
            self._given[name][:, rows] = diagonal[:, np.newaxis]
        plan = self._motion.plan
        # A plan of one piece needs no search.
        piece = np.maximum(0, np.searchsorted(plan.starts, t, side="right") - 1) if len(plan.starts) > 1 else [0]
        self._piece["t"][0, rows] = t
        for name in ("start", "quintic", "amplitude", "frequency"):
            values = plan.starts if name == "start" else getattr(plan, name)
            self._piece[name][:, rows] = values[piece].reshape(len(piece), -1).T


def _table(memory: Buffer, rows: int) -> Array:
    """A buffer as an array, a column per tick; one column if it has no row per tick. Shape (n, rows) or (n, 1)."""
    width = rows if len(memory) % rows == 0 else 1
    return np.asarray(memory).reshape(-1, width)
