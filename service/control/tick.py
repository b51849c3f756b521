"""One tick of the controller as one CasADi function: codes of a measurement in, codes of the command out.

It is what stands between `FrameFormat.unpack` and `FrameFormat.pack`: the levels of the codes, the reference at time t,
the law, and the quantizers of the command. The parts are inserted as they are written, so every bit is that of the
parts evaluated one after the other.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from aeroloop.protocol.lazy import casadi as ca
from aeroloop.protocol.wire.expressions import as_written, encode, level, saturates
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.symbolic import INTEGER
from aeroloop.service.control.law import LawSettings, law_function
from aeroloop.service.control.reference import reference_function

CARRIED: Final = {"last": "q", "s": "s_next", "theta": "theta_next", "held": "command", "saturated": "saturated_next"}
"""The inputs that carry state, and the output that each takes its next value from."""

REGARDLESS: Final = ("q", "s_next", "theta_next", "q_d", "omega", "eps_e", "omega_e")
"""The outputs of every measurement with valid values; the others only count if u is a number."""


@lru_cache(maxsize=16)  # of a session's end and the next one's begin, and of many experiments with the same law
def controller_function(wire: WireSpec, law: LawSettings, period: float) -> ca.Function:
    """One tick, `period` [s] after the last.

    Inputs:
        codes: Of the measurement. Shape (6,).
        t, start, quintic, amplitude, frequency: Time, and the reference's piece, as for `reference_function`.
        C1, C2, Gamma: Gains.
        last, theta: q and θ̂ after the last measurement.
        s: ±1; 0 before the first measurement, which chooses it.
        held: Codes of the last valid command; NaN before the first. Shape (actuators,).
        saturated: Voltages beyond the range so far.

    Outputs:
        q, s_next, theta_next: State for the next tick.
        q_d, omega, eps_e, omega_e: Desired attitude, rate as received, errors.
        u: Command before quantization [V]. Shape (actuators,).
        command: Its codes. Shape (actuators,).
        saturated_next: The count for the next tick.
        words: command + INTEGER, from which `integers` reads the codes as integers. Shape (actuators,).
        measured: 1 if each code of the measurement has a level. If 0, no output above counts.
        computed: 1 if u is a number, too. If 0, no output from `u` on counts.

    Raises:
        ValueError: The law's B cannot be inverted.
    """
    laws, reference = law_function(law, period), reference_function()
    piece = {name: ca.SX.sym(name, *reference.size_in(name)) for name in reference.name_in()}
    of_law = {name: ca.SX.sym(name, laws.size1_in(name)) for name in ("C1", "C2", "Gamma", "last", "theta", "s")}
    codes, held, saturated = ca.SX.sym("codes", 6), ca.SX.sym("held", wire.actuators), ca.SX.sym("saturated")
    inputs = {"codes": codes} | piece | of_law | {"held": held, "saturated": saturated}
    signals = [wire.attitude.quantizer()] * 3 + [wire.rate.quantizer()] * 3
    voltage = wire.voltage.quantizer()
    with as_written():
        levels = ca.vertcat(*map(level, signals, ca.vertsplit(codes)))
        desired = reference.call(piece)
        given = of_law | desired | {"eps": levels[:3], "omega": levels[3:]}
        found = laws.call(given)
        u = found["u"][3 - wire.actuators :]
        command = ca.vertcat(*(encode(voltage, u[i], held[i]) for i in range(wire.actuators)))
        measured = _is_number(ca.sum1(levels))
        outputs = found | {
            "q_d": desired["q_d"],
            "omega": given["omega"],
            "u": u,
            "command": command,
            "words": command + INTEGER,
            "saturated_next": saturated + sum(saturates(voltage, u[i]) for i in range(wire.actuators)),
            "measured": measured,
            "computed": ca.logic_and(measured, _is_number(ca.sum1(u))),
        }
        names = [*REGARDLESS, "u", "command", "saturated_next", "words", "measured", "computed"]
        ordered = [outputs[name] for name in names]
        return ca.Function("tick", [*inputs.values()], ordered, [*inputs], names, {"cse": True})


def _is_number(x: ca.SX) -> ca.SX:
    return ca.fabs(x) <= ca.inf
