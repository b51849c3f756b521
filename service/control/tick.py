"""One tick of the controller: codes of a measurement in, codes of the command out, on memory that stays.

It is what stands between `FrameFormat.unpack` and `FrameFormat.pack`: the levels of the codes, the reference at time t,
the law, and the quantizers of the command. With a law of expressions all of it is one CasADi function; a law in Python
stands between two. The parts are inserted as they are written, so every bit is that of the parts evaluated one after
the other.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import lru_cache
from math import nan
from typing import Any, Final

import casadi as ca
import numpy as np

from aeroloop.protocol.wire.expressions import as_written, encode, level, saturates
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.symbolic import INTEGER, Buffer, Compiled, buffer, parts
from aeroloop.service.control.laws.evaluation import (
    check_voltages,
    configured_gains,
    initial_state,
    law_function,
    received,
    tracking_errors,
)
from aeroloop.service.control.laws.interface import ExpressionLaw, Law, Now, PythonLaw
from aeroloop.service.control.laws.registry import LawError, words_of
from aeroloop.service.control.reference import reference_function

CARRIED: Final = {"last": "q", "state": "state_next", "held": "command", "saturated": "saturated_next"}
"""The inputs that carry state, and the output that each takes its next value from."""

REGARDLESS: Final = ("q", "state_next", "q_d", "omega", "eps_e", "omega_e")
"""The outputs of every measurement with valid values; the others only count if u is a number."""

NAMES: Final = (*REGARDLESS, "u", "command", "saturated_next", "words", "measured", "computed")


class Tick:
    """One tick of a law between codes and codes.

    Attributes:
        inputs: Memory of the inputs of `controller_function`, by name; gains one below the other.
        found: Memory of its outputs, and of all of them in a row.
        kept: The same for the last valid tick: what the next one continues from. The caller copies it.
        states, gains: Sizes of the law's named state and gains.
        initial: The state before the first tick, in a row.
        evaluate: Computes `found` from `inputs`.
        without_law: Whether a law in Python is left out: only what is received is computed, and no voltages.
        fault: Why a law in Python gave no voltages at the last tick that failed; None before.

    Raises:
        LawError: The law cannot be used.
    """

    evaluate: Callable[[], None]

    def __init__(self, wire: WireSpec, law: Law[Any], period: float) -> None:
        kind = law.settings.kind
        try:
            gains, states = configured_gains(law), initial_state(law)
        except Exception as error:
            raise LawError(words_of(kind, error)) from None
        self.gains = {name: len(gain) for name, gain in gains.items()}
        self.states = {name: len(values) for name, values in states.items()}
        self.initial = [value for values in states.values() for value in values]
        m = wire.actuators
        sizes = {"q": 4, "state_next": len(self.initial), "q_d": 4, "omega": 3, "eps_e": 3, "omega_e": 3}
        sizes |= {"u": m, "command": m, "saturated_next": 1, "words": m, "measured": 1, "computed": 1}
        self.regardless = sum(sizes[name] for name in REGARDLESS)
        self.row, self.kept_row = buffer(sum(sizes.values())), buffer(sum(sizes.values()))
        self.found, self.kept = parts(self.row, sizes), parts(self.kept_row, sizes)
        self.fault: str | None = None
        self.without_law = False
        carried = {name: self.kept[output] for name, output in CARRIED.items()}
        if isinstance(law, PythonLaw):
            self._python(wire, law, carried)
            return
        try:
            function = controller_function(wire, type(law), law.settings.model_dump_json(), period)
        except Exception as error:
            raise LawError(words_of(kind, error)) from None
        self._compiled = Compiled(function, self.found | carried)
        self.inputs, self.evaluate = self._compiled.inputs, self._compiled.evaluate

    def _python(self, wire: WireSpec, law: PythonLaw[Any], carried: dict[str, Buffer]) -> None:
        """Evaluate a law in Python between what is received and what is sent."""
        before = Compiled(received_function(wire), self.found | carried)
        after = Compiled(sent_function(wire), self.found | carried)
        self.inputs = {**after.inputs, **before.inputs, "gains": buffer(sum(self.gains.values()))}
        gains, state = parts(self.inputs["gains"], self.gains), parts(self.kept["state_next"], self.states)
        found, seen, kind = self.found, before.outputs, law.settings.kind

        def evaluate() -> None:
            before.evaluate()
            found["computed"][0] = 0.0
            if self.without_law or not found["measured"][0]:
                found["state_next"][:] = self.kept["state_next"]
                return
            # Copies: the law may keep or change them.
            law.state = {name: np.array(values) for name, values in state.items()}
            now = Now(
                attitude=np.array(seen["q"]),
                rate=np.array(seen["omega"]),
                desired_attitude=np.array(seen["q_d"]),
                desired_rate=np.array(seen["omega_d"]),
                desired_acceleration=np.array(seen["omega_d_dot"]),
                attitude_error=np.array(seen["e"]),
                rate_error=np.array(seen["omega_e"]),
                gains={name: np.array(gain) for name, gain in gains.items()},
                state=law.state,
            )
            try:
                u = np.asarray(law.step(now), dtype=np.float64).ravel()
                check_voltages(law, u.size)
                after_tick = self._state_of(law)
                found["u"][:] = memoryview(array("d", u.tolist()))
                found["state_next"][:] = memoryview(array("d", after_tick))
            except Exception as error:  # a user's code may raise anything
                self.fault = words_of(kind, error)
                found["u"][:] = memoryview(array("d", [nan] * len(found["u"])))
                found["state_next"][:] = self.kept["state_next"]
                return
            after.evaluate()

        self.evaluate = evaluate

    def _state_of(self, law: PythonLaw[Any]) -> list[float]:
        row = {name: np.asarray(values, dtype=np.float64).ravel() for name, values in law.state.items()}
        if {name: values.size for name, values in row.items()} != self.states:
            raise ValueError(f"its state after a tick is not that of `reset`: {', '.join(self.states) or 'none'}")
        return [value for name in self.states for value in row[name].tolist()]


@lru_cache(maxsize=16)  # of a session's end and the next one's begin, and of many experiments with the same law
def controller_function(wire: WireSpec, law: type[ExpressionLaw[Any]], settings: str, period: float) -> ca.Function:
    """One tick of a law of expressions, with its settings as JSON, `period` [s] after the last.

    Inputs:
        codes: Of the measurement. Shape (6,).
        t, start, quintic, amplitude, frequency: Time, and the reference's piece, as for `reference_function`.
        gains: The law's gains, one below the other.
        last, state: q and the law's state after the last measurement.
        held: Codes of the last valid command; NaN before the first. Shape (actuators,).
        saturated: Voltages beyond the range so far.

    Outputs:
        q, state_next: State for the next tick.
        q_d, omega, eps_e, omega_e: Desired attitude, rate as received, errors.
        u: Command before quantization [V]. Shape (actuators,).
        command: Its codes. Shape (actuators,).
        saturated_next: The count for the next tick.
        words: command + INTEGER, from which `integers` reads the codes as integers. Shape (actuators,).
        measured: 1 if each code of the measurement has a level. If 0, no output above counts.
        computed: 1 if u is a number, too. If 0, no output from `u` on counts.

    Raises:
        ValueError: The law does not fit so many actuators.
    """
    laws = law_function(law(law.Settings.model_validate_json(settings), period, wire.actuators))
    reference = reference_function()
    piece = {name: ca.SX.sym(name, *reference.size_in(name)) for name in reference.name_in()}
    of_law = {name: ca.SX.sym(name, laws.size1_in(name)) for name in ("gains", "last", "state")}
    codes, held, saturated = ca.SX.sym("codes", 6), ca.SX.sym("held", wire.actuators), ca.SX.sym("saturated")
    inputs = {"codes": codes} | piece | of_law | {"held": held, "saturated": saturated}
    with as_written():
        levels = _levels(wire, codes)
        desired = reference.call(piece)
        given = of_law | desired | {"eps": levels[:3], "omega": levels[3:]}
        found = laws.call(given)
        measured = _is_number(ca.sum1(levels))
        outputs = found | {
            "q_d": desired["q_d"],
            "omega": given["omega"],
            "measured": measured,
            **_sent(wire, found["u"], held, saturated),
        }
        outputs["computed"] = ca.logic_and(measured, outputs["computed"])
        ordered = [outputs[name] for name in NAMES]
        return ca.Function("tick", [*inputs.values()], ordered, [*inputs], list(NAMES), {"cse": True})


@lru_cache(maxsize=4)
def received_function(wire: WireSpec) -> ca.Function:
    """What a law in Python computes a tick from.

    Inputs: codes, last, and those of `reference_function`, as for `controller_function`. Outputs: q, q_d, omega, eps_e,
    omega_e, measured as there, and omega_d, omega_d_dot, e.
    """
    reference = reference_function()
    piece = {name: ca.SX.sym(name, *reference.size_in(name)) for name in reference.name_in()}
    codes, last = ca.SX.sym("codes", 6), ca.SX.sym("last", 4)
    eps, q, omega = ca.SX.sym("eps", 3), ca.SX.sym("q", 4), ca.SX.sym("omega", 3)
    q_d, omega_d = ca.SX.sym("q_d", 4), ca.SX.sym("omega_d", 3)
    attitude = ca.Function("attitude", [last, eps], [received(eps, last)])
    errors = ca.Function("errors", [q, omega, q_d, omega_d], tracking_errors(q, omega, q_d, omega_d))
    with as_written():
        levels = _levels(wire, codes)
        desired = reference.call(piece)
        q = attitude(last, levels[:3])
        e, omega_e = errors(q, levels[3:], desired["q_d"], desired["omega_d"])
        outputs = {"q": q, **desired, "omega": levels[3:], "e": e, "eps_e": e[1:4], "omega_e": omega_e}
        outputs["measured"] = _is_number(ca.sum1(levels))
        inputs = {"codes": codes, "last": last} | piece
        return ca.Function("received", [*inputs.values()], [*outputs.values()], [*inputs], [*outputs], {"cse": True})


@lru_cache(maxsize=4)
def sent_function(wire: WireSpec) -> ca.Function:
    """u, held, saturated ↦ command, saturated_next, words and computed, as of `controller_function`."""
    u, held, saturated = ca.SX.sym("u", wire.actuators), ca.SX.sym("held", wire.actuators), ca.SX.sym("saturated")
    with as_written():
        outputs = _sent(wire, u, held, saturated)
        inputs = [u, held, saturated]
        return ca.Function("sent", inputs, [*outputs.values()], ["u", "held", "saturated"], [*outputs])


def _levels(wire: WireSpec, codes: ca.SX) -> ca.SX:
    signals = [wire.attitude.quantizer()] * 3 + [wire.rate.quantizer()] * 3
    return ca.vertcat(*map(level, signals, ca.vertsplit(codes)))


def _sent(wire: WireSpec, u: ca.SX, held: ca.SX, saturated: ca.SX) -> dict[str, ca.SX]:
    voltage = wire.voltage.quantizer()
    command = ca.vertcat(*(encode(voltage, u[i], held[i]) for i in range(wire.actuators)))
    return {
        "command": command,
        "words": command + INTEGER,
        "saturated_next": saturated + sum(saturates(voltage, u[i]) for i in range(wire.actuators)),
        "computed": _is_number(ca.sum1(u)),
    }


def _is_number(x: ca.SX) -> ca.SX:
    return ca.fabs(x) <= ca.inf
