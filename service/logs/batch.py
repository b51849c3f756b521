"""Controller over thousands of ticks at once, bit for bit what it computes tick by tick.

All measurements are in the log, so only the attitude's sign and the law's state carry over from tick to tick. Law and
reference are the loop's own CasADi instructions, run over columns with a row per tick (`law_of_many`,
service/control/columns.py), so the bits are the loop's (tests/service/logs/test_batch.py). A law in Python runs tick by
tick.
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
from aeroloop.protocol.wire.symbolic import Buffer, Compiled
from aeroloop.protocol.wire.transmit import Sender
from aeroloop.service.control.columns import in_columns
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.control.laws.evaluation import configured_gains, law_of_many
from aeroloop.service.control.laws.interface import ExpressionLaw, LawSettings
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
        gains: The law's gains, one beside the other. Shape (n, gains).
        state: Its named state that it used, likewise. Shape (n, states).
        state_next: The same after the tick.
    """

    attitude: Array
    desired: Array
    rate: Array
    attitude_error: Array
    rate_error: Array
    voltages: Array
    gains: Array
    state: Array
    state_next: Array


class Commands(NamedTuple):
    """Codes of the commands, shape (n, actuators), and whether each is sent as a frame or is silent, shape (n,)."""

    codes: Array
    sent: NDArray[np.bool_]


class BatchController:
    """Computes many measurements per call.

    The reference holds from tick 0 on, the period is between ticks [s], `rows` is ticks per CasADi call, a multiple of
    `aeroloop.service.control.columns.UNROLLED`. Raises LawError and PluginError as Controller does.
    """

    def __init__(self, wire: WireSpec, law: LawSettings, reference: Reference, period: float, rows: int = ROWS) -> None:
        self._wire, self._period, self._rows = wire, period, rows
        self._controller = Controller(wire, law, reference, period)
        own = self._controller.law
        self._by_tick = not isinstance(own, ExpressionLaw)
        self._gains = configured_gains(own)
        self._state = self._controller.state
        self._states = {name: len(values) for name, values in self._state.law.items()}
        if isinstance(own, ExpressionLaw):
            self._law = Compiled(law_of_many(own, rows))
            desired = {name: self._law.inputs[name] for name in _DESIRED}
            self._reference = Compiled(in_columns(reference_function(), rows), desired)
            # CasADi's buffers as arrays, a column per tick.
            self._given = {name: _table(memory, rows) for name, memory in self._law.inputs.items()}
            self._found = {name: _table(memory, rows) for name, memory in self._law.outputs.items()}
            self._piece = {name: _table(memory, rows) for name, memory in self._reference.inputs.items()}
        self._motion = Motion(reference)
        self._voltage = [wire.voltage.quantizer() for _ in range(wire.actuators)]
        counters = wire.measurement.counters
        heartbeat = wire.transmit.heartbeat_ticks(round(period * 1e9), counters)
        self._sender = Sender(wire.transmit.command, heartbeat, counters)

    @property
    def state(self) -> ControllerSnapshot:
        """State after the last computed measurement and the last encoded command; `held` has the last row's codes."""
        last, at = self._sender.memory
        codes = None if last is None else tuple(map(float, last))
        return self._state.model_copy(update={"sent_codes": codes, "sent_tick": at})

    def restore(self, state: ControllerSnapshot) -> None:
        """Continue from a recorded state; reference and gains stay as they are."""
        self._controller.restore(state)
        fitting = self._controller.law_state
        self._state = state.model_copy(update={"law": fitting})
        for i, quantizer in enumerate(self._voltage):
            quantizer.reset()
            if state.voltage_codes is not None:
                quantizer.resume(state.voltage_codes[i])
        self._sender.resume(state.sent_codes, state.sent_tick)

    def follow(self, other: BatchController) -> None:
        """Copy state, gains and reference of another controller with the same configuration.

        What follows is beside the loop, where no voltages count: a user's code does not run for it. It may never end.
        """
        self._controller.leave_out_law()
        self.restore(other.state)
        self._gains = dict(other._gains)
        self._motion.plan = self._controller.motion.plan = other._motion.plan
        self._controller.set_gains(Gains.model_validate(self._gains))

    def compute_all(self, k: Integers, codes: Array, changes: deque[Change]) -> Computed:
        """Results of `Controller.compute` for measurements at ascending ticks k. Shapes (n,) and (n, 6).

        Changes of gains and reference are in order of tick; those that take effect are removed.
        """
        if self._by_tick:
            return self._compute_by_tick(k, codes, changes)
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
        gains, states = sum(map(len, self._gains.values())), sum(self._states.values())
        widths = (4, 4, 3, 3, 3, self._wire.actuators, gains, states, states)
        return Computed(*(np.full((columns, n), nan).T for columns in widths))

    def _compute(self, k: Integers, vectors: Array, rates: Array, changes: deque[Change]) -> Sequence[Array]:
        """`Computed` with a column per tick, for at most `rows` ticks, all of them valid."""
        n, given, found, state = len(k), self._given, self._found, self._state
        given["eps"][:, :n], given["omega"][:, :n] = vectors, rates
        given["last"][:, 0], given["state"][:, 0] = state.attitude, self._in_a_row(state)
        t: Array = np.asarray(k * self._period, dtype=np.float64)
        since = 0
        while since < n:  # until the next change, the same gains and the same plan
            while changes and changes[0].tick <= k[since]:
                self._apply(changes.popleft())
            until = int(np.searchsorted(k, changes[0].tick)) if changes else n
            self._lay_out(t[since:until], slice(since, until))
            since = until
        self._reference()
        self._law()
        last = np.split(found["state_next"][:, n - 1], np.cumsum(list(self._states.values()))[:-1])
        self._state = state.model_copy(
            update={
                "attitude": tuple(found["q"][:, n - 1].tolist()),
                "law": {name: tuple(values.tolist()) for name, values in zip(self._states, last, strict=False)},
            }
        )
        u = found["u"][:, :n]
        u[:, np.isnan(u.sum(axis=0))] = nan  # ∞ − ∞ is no number either
        q, eps_e, omega_e, state_used, after = (
            found[name] for name in ("q", "eps_e", "omega_e", "state_used", "state_next")
        )
        columns = q, given["q_d"], rates, eps_e, omega_e, u, given["gains"], state_used, after
        return [column[:, :n] for column in columns]

    def _compute_by_tick(self, k: Integers, codes: Array, changes: deque[Change]) -> Computed:
        computed, controller = self._nothing(len(k)), self._controller
        widths = self._wire.measurement.widths
        for i, (tick, row) in enumerate(zip(k.tolist(), codes.tolist(), strict=True)):
            while changes and changes[0].tick <= tick:
                self._apply(changes[0])
                controller.apply(changes.popleft())
            before = self._in_a_row(controller.state)
            exact = [code if width is None else int(code) for code, width in zip(row, widths, strict=True)]
            u = controller.compute(tick % self._wire.measurement.counters, exact, tick)
            if controller.tick_index != tick:
                continue  # no valid value was measured
            q, after = controller, self._in_a_row(controller.state)
            gains = [value for gain in self._gains.values() for value in gain]
            values = q.attitude, q.desired, q.rate, q.attitude_error, q.rate_error, u or nan, gains, before, after
            for column, value in zip(computed, values, strict=True):
                column[i] = value
        now = controller.state
        self._state = self._state.model_copy(update={"attitude": now.attitude, "law": now.law, "held": now.held})
        return computed

    def _in_a_row(self, state: ControllerSnapshot) -> list[float]:
        return [value for name in self._states for value in state.law[name]]

    def _apply(self, change: Change) -> None:
        if change.gains is not None:
            self._gains |= change.gains.named
        self._motion.change(change, self._period)

    def _lay_out(self, t: Array, rows: slice) -> None:
        """Fill in the current gains, and the pieces of the current reference plan at times t [s]."""
        self._given["gains"][:, rows] = np.array([value for gain in self._gains.values() for value in gain])[:, None]
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
