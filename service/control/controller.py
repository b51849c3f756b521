"""Controller end of the loop, sans-I/O: measurement frame in, command frame out, at tick k.

Daemon, lockstep experiment, review of a log and tests all run this one code path. The law's time is k times the
period. Between the codes of the one frame and those of the other stands one CasADi function, `tick_function`. Its
outputs are one row of doubles. After a valid tick the row is copied; the copy is what the next tick continues from.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from math import isnan, nan
from typing import Any, Final

import casadi as ca
import numpy as np
from pydantic import BaseModel, ConfigDict

from aeroloop.protocol.messages.operator import Change, Gains, Reference
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector, received_quaternion
from aeroloop.protocol.wire.expressions import as_written, encode, level, saturates
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.symbolic import Buffer, Compiled, buffer, parts
from aeroloop.protocol.wire.transmit import UNCHANGED, Sender
from aeroloop.service.control.laws.interface import ExpressionLaw, Law, LawSettings, Now, PythonLaw
from aeroloop.service.control.laws.registry import (
    LawError,
    check_answer,
    configured_gains,
    initial_state,
    law_function,
    law_of,
    no_number,
    no_such_gain,
    words_of,
)
from aeroloop.service.control.motion import Motion
from aeroloop.service.control.reference import reference_function

Codes = tuple[float, ...]

_OF_MEASUREMENT: Final = 6  # of its outputs are kept of every measurement with valid values; all only if u is a number


def tick_function(wire: WireSpec, law: Law[Any]) -> ca.Function:
    """One tick: codes of a measurement in, codes of the command out. Raises LawError as `law_function`.

    Inputs are those of `reference_function` and `law_function`; the codes of the measurement, shape (6,); `held`, those
    of the last valid command, NaN before the first, shape (actuators,); and how many voltages were `saturated` so far.

    Outputs:
        q, state_next, saturated_next: State for the next tick.
        q_d, omega, eps_e, omega_e: Desired attitude, rate as received, errors.
        u, command: Voltages before quantization [V], and their codes. Shapes (actuators,).
        measured: 1 if each code of the measurement has a level. If 0, no output above counts.
        computed: 1 if u is a number, too. If 0, u, command and saturated_next do not count.
        eta_e, omega_d, omega_d_dot: The rest of what a law in Python computes from.
    """
    laws = law_function(law)
    reference = reference_function()
    piece = {name: ca.SX.sym(name, *reference.size_in(name)) for name in reference.name_in()}
    computed_here = ("eps", "omega", "q_d", "omega_d", "omega_d_dot")
    of_law = {name: ca.SX.sym(name, laws.size1_in(name)) for name in laws.name_in() if name not in computed_here}
    codes, held, saturated = ca.SX.sym("codes", 6), ca.SX.sym("held", wire.actuators), ca.SX.sym("saturated")
    signals = [wire.attitude.quantizer()] * 3 + [wire.rate.quantizer()] * 3
    voltage = wire.voltage.quantizer()
    with as_written():
        levels = ca.vertcat(*map(level, signals, ca.vertsplit(codes)))
        desired = reference.call(piece)
        found = laws.call(of_law | desired | {"eps": levels[:3], "omega": levels[3:]})
        u = ca.vertsplit(found["u"])
        measured = _is_number(ca.sum1(levels))
        outputs = {
            "q": found["q"],
            "state_next": found["state_next"],
            "q_d": desired["q_d"],
            "omega": levels[3:],
            "eps_e": found["eps_e"],
            "omega_e": found["omega_e"],
            "u": found["u"],
            "command": ca.vertcat(*(encode(voltage, u[i], held[i]) for i in range(wire.actuators))),
            "saturated_next": saturated + sum(saturates(voltage, volts) for volts in u),
            "measured": measured,
            "computed": ca.logic_and(measured, _is_number(ca.sum1(found["u"]))),
            "eta_e": found["eta_e"],
            "omega_d": desired["omega_d"],
            "omega_d_dot": desired["omega_d_dot"],
        }
        inputs = {"codes": codes} | piece | of_law | {"held": held, "saturated": saturated}
        return ca.Function("tick", [*inputs.values()], [*outputs.values()], [*inputs], [*outputs], {"cse": True})


def _is_number(x: ca.SX) -> ca.SX:
    return ca.fabs(x) <= ca.inf


@lru_cache(maxsize=16)  # 20 ms; of a session's end and the next one's begin, and of many runs with the same law
def _expressions_function(wire: WireSpec, law: type[ExpressionLaw[Any]], settings: str, period: float) -> ca.Function:
    return tick_function(wire, law(law.Settings.model_validate_json(settings), period, wire.actuators))


def _last(name: str) -> Any:
    """A property of the controller: an output of `tick_function` at the last valid tick."""
    return property(lambda self: tuple(self.last_valid[name]))


class ControllerSnapshot(BaseModel):
    """State carried from tick to tick, besides reference and gains. Its JSON keeps every bit of the floats."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    attitude: Quaternion = IDENTITY  # q^Q of the last measurement [1]
    law: dict[str, tuple[float, ...]]  # named state
    held: Codes | None = None  # of the last measurement, for silence; None before the first
    voltage_codes: Codes | None = None  # of the last valid voltages, for quantizers with a memory
    sent_codes: Codes | None = None  # of the last command sent; None where the next one is sent in any case
    sent_tick: int | None = None


class Controller:
    """The law between a measurement frame and a command frame.

    It follows the reference from tick 0 on; `period` is the time between ticks [s]. Raises as `law_of`.

    Attributes:
        tick_index: k of the last measurement answered, −1 before the first; `counter` is that measurement's.
        motion: The reference as followed; may be changed between two ticks.
        refused: Malformed measurement frames so far; `invalid`, those with the code "no valid value".
        fault: Why the law gave no voltages, once it has not; None before.
        outputs: What the last tick computed, by name as of `tick_function`; `row` has them one beside the other.
        last_valid: The same of the last valid tick.
    """

    attitude: Quaternion = _last("q")
    desired: Quaternion = _last("q_d")
    attitude_error: Vector = _last("eps_e")
    rate_error: Vector = _last("omega_e")
    voltages: tuple[float, ...] = _last("u")

    def __init__(self, wire: WireSpec, law: LawSettings, reference: Reference, period: float) -> None:
        self.wire, self.period = wire, period
        self.tick_index, self.counter, self.refused, self.invalid = -1, 0, 0, 0
        self.fault: str | None = None
        self.law = law_of(law, period, wire.actuators)
        gains, state = configured_gains(self.law), initial_state(self.law)
        if isinstance(self.law, ExpressionLaw):
            settings = self.law.settings.model_dump_json()
            function = _expressions_function(wire, type(self.law), settings, period)
        else:
            function = tick_function(wire, self.law)

        sizes = {name: function.numel_out(name) for name in function.name_out()}
        self.row, self._last_row = buffer(sum(sizes.values())), buffer(sum(sizes.values()))
        self.outputs, self.last_valid = parts(self.row, sizes), parts(self._last_row, sizes)
        self._of_measurement = slice(sum([*sizes.values()][:_OF_MEASUREMENT]))
        last = self.last_valid
        carried = {"last": last["q"], "state": last["state_next"], "held": last["command"]}
        memory = self.outputs | carried | {"saturated": last["saturated_next"]}
        self._function = Compiled(function, memory)
        self._evaluate, self._codes = self._function.evaluate, self._function.inputs["codes"]
        self._measured, self._computed = self.outputs["measured"], self.outputs["computed"]
        self._gains = parts(self._function.inputs["gains"], {name: len(gain) for name, gain in gains.items()})
        self._state = parts(last["state_next"], {name: len(values) for name, values in state.items()})
        self._runs_python = isinstance(self.law, PythonLaw)
        self._without_law = False
        self.motion = Motion(reference, self._function.inputs)

        self._as_codes: Callable[[float], float] = float if wire.voltage.bits is None else int
        self._no_command = [wire.voltage.quantizer().invalid] * wire.actuators
        self._counters = wire.measurement.counters
        heartbeat = wire.transmit.heartbeat_ticks(round(period * 1e9), self._counters)
        self._sender = Sender(wire.transmit.command, heartbeat, self._counters)
        self._silence_allowed = wire.transmit.measurement == "on_change"
        self._held: Sequence[float] | None  # codes of the last measurement
        self._read, self._write = wire.measurement.unpack, wire.command.pack
        self.set_gains(Gains.model_validate(gains))
        self.restore(ControllerSnapshot(law={name: tuple(values) for name, values in state.items()}))

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Answer the measurement of tick k: a frame, UNCHANGED if its levels have not changed, or None for none.

        Returns the command frame; UNCHANGED if it would repeat the last one; None for none and for malformed bytes. A
        measurement without a valid value is answered by a command without one: the plant then goes to 0 V.
        """
        if frame is None:
            return None
        read = self._read(frame)
        if read is not None:
            counter, self._held = read
        elif frame == UNCHANGED and self._silence_allowed and self._held is not None:
            counter = k % self._counters
        else:
            self.refused += 1
            return None
        codes = self._codes
        codes[0], codes[1], codes[2], codes[3], codes[4], codes[5] = self._held  # the quickest way for so few
        self.motion.set(k * self.period)
        self._evaluate()
        if self._runs_python:
            self._step_python()
            self._evaluate()
        if self._measured[0]:
            self.tick_index, self.counter = k, counter
        command: Sequence[float] = self._no_command
        if self._computed[0]:
            self._last_row[:] = self.row
            command = [*map(self._as_codes, self.outputs["command"])]
        elif self._measured[0]:
            self.fault = self.fault or no_number(self.law)
            self._last_row[self._of_measurement] = self.row[self._of_measurement]
        else:
            self.invalid += 1
        return self._write(counter, command) if self._sender.due(k, command) else UNCHANGED

    def _step_python(self) -> None:
        """Compute voltages and next state of a law in Python, from what the function has computed so far."""
        law, seen, inputs = self.law, self.outputs, self._function.inputs
        assert isinstance(law, PythonLaw)
        _write_to(inputs["law_voltages"], [nan] * self.wire.actuators)
        inputs["law_state"][:] = self.last_valid["state_next"]
        if self._without_law or not self._measured[0]:
            return
        # Copies: the law may keep or change them.
        law.state = {name: np.array(values) for name, values in self._state.items()}
        now = Now(
            attitude=np.array(seen["q"]),
            rate=np.array(seen["omega"]),
            desired_attitude=np.array(seen["q_d"]),
            desired_rate=np.array(seen["omega_d"]),
            desired_acceleration=np.array(seen["omega_d_dot"]),
            attitude_error=np.concatenate([seen["eta_e"], seen["eps_e"]]),
            rate_error=np.array(seen["omega_e"]),
            gains={name: np.array(gain) for name, gain in self._gains.items()},
            state=law.state,
        )
        try:
            u = np.asarray(law.step(now), dtype=np.float64).ravel()
            after = {name: np.asarray(values, dtype=np.float64).ravel() for name, values in law.state.items()}
            first = {name: len(part) for name, part in self._state.items()}
            check_answer(law, u.size, {name: values.size for name, values in after.items()}, first)
        except Exception as error:  # a user's code may raise anything
            self.fault = words_of(law.settings.kind, error, law.step)
            return
        _write_to(inputs["law_voltages"], u)
        _write_to(inputs["law_state"], (value for name in self._state for value in after[name]))

    def hold(self, frame: bytes) -> bool:
        """Hold the levels of a measurement that was received after its tick was over. False if it is malformed."""
        read = self._read(frame)
        if read is None:
            self.refused += 1
            return False
        self._held = read[1]
        return True

    def attitude_of(self, frame: bytes) -> Quaternion | None:
        """The attitude in a measurement; None if it is malformed or has no valid value."""
        read = self._read(frame)
        codes = read[1] if read is not None else self._held if frame == UNCHANGED and self._silence_allowed else None
        if codes is None:
            return None
        x, y, z = map(self.wire.attitude.quantizer().level, codes[:3])
        return None if isnan(x + y + z) else received_quaternion(x, y, z, IDENTITY)

    def leave_out_law(self) -> None:
        """Compute only attitude, desired attitude and errors from now on, where the law is in Python."""
        self._without_law = True

    # ── gains, reference and state ──

    def set_gains(self, gains: Gains) -> None:
        """Use other gains from the next tick on; None leaves a gain unchanged. Raises LawError if the law has none."""
        for name, gain in gains.named.items():
            if len(self._gains.get(name, ())) != len(gain):
                raise no_such_gain(self.law.settings.kind, name, len(gain))
        for name, gain in gains.named.items():
            _write_to(self._gains[name], gain)

    def apply(self, change: Change) -> None:
        """Apply a recorded change; the next tick must be its first, or later.

        Raises LawError if the law does not have such gains.
        """
        if change.gains is not None:
            for name, gain in change.gains.named.items():
                if name not in self._gains or len(gain) != len(self._gains[name]):
                    raise LawError(f"law {self.law.settings.kind} has no gain {name} of {len(gain)} numbers")
            self.set_gains(change.gains)
        self.motion.change(change, self.period)

    @property
    def state(self) -> ControllerSnapshot:
        """State for the next tick, besides reference and gains."""
        sent_codes, sent_tick = self._sender.memory
        held, codes = self._held, tuple(self.last_valid["command"])
        return ControllerSnapshot(
            attitude=self.attitude,
            law=self.law_state,
            held=None if held is None else tuple(held),
            voltage_codes=None if isnan(codes[0]) else codes,
            sent_codes=None if sent_codes is None else tuple(sent_codes),
            sent_tick=sent_tick,
        )

    def restore(self, state: ControllerSnapshot) -> None:
        """Continue bit for bit from this state, given the same reference and gains."""
        _write_to(self.last_valid["q"], state.attitude)
        _write_to(self.last_valid["command"], state.voltage_codes or [nan] * self.wire.actuators)
        for name, part in self._state.items():
            if len(values := state.law.get(name, ())) == len(part):  # that of another law does not count
                _write_to(part, values)
        widths = self.wire.measurement.widths
        self._held = state.held and [
            code if width is None else int(code) for code, width in zip(state.held, widths, strict=True)
        ]
        self._sender.resume(state.sent_codes, state.sent_tick)

    @property
    def gains(self) -> Gains:
        """The gains now."""
        return Gains.model_validate({name: tuple(gain) for name, gain in self._gains.items()})

    @property
    def law_state(self) -> dict[str, tuple[float, ...]]:
        """The law's named state after the last measurement."""
        return {name: tuple(part) for name, part in self._state.items()}

    @property
    def saturated(self) -> int:
        """Commanded voltages beyond the quantizer's range so far."""
        return int(self.last_valid["saturated_next"][0])


def _write_to(memory: Buffer, values: Iterable[float]) -> None:
    memory[:] = memoryview(array("d", values))
