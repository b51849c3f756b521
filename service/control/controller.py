"""Controller end of the loop, sans-I/O: measurement frame in, command frame out, at tick k.

It uses no socket, no clock and no log, so the daemon, the lockstep experiment, the review of a log and the tests all
run this one code path. The law's time is k times the period. A frame that would repeat the last levels need not be
sent; the controller then receives UNCHANGED and computes with the levels it holds.

Between the two frames stands one evaluation of a `Tick`, on memory that stays. Its outputs are one row of doubles;
after a valid tick the row is copied, and the copy is what the next tick and the properties here read.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from math import isnan, nan

from pydantic import BaseModel, ConfigDict

from aeroloop.protocol.messages.operator import Change, Gains, Reference
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector, received_quaternion
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.symbolic import Buffer, integers, parts
from aeroloop.protocol.wire.transmit import UNCHANGED, Sender
from aeroloop.service.control.laws.evaluation import configured_gains
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import law_of
from aeroloop.service.control.motion import Motion
from aeroloop.service.control.tick import Tick

Codes = tuple[float, ...]


class ControllerSnapshot(BaseModel):
    """State carried from tick to tick, besides reference and gains. Its JSON keeps every bit of the floats.

    Attributes:
        attitude: q^Q of the last measurement [1].
        law: The law's named state.
        held: Codes of the last measurement, for silence; None before the first. Shape (6,).
        voltage_codes: Codes of the last valid voltages, for quantizers with a memory; None before the first.
            Shape (actuators,).
        sent_codes: Codes of the last command sent; None where commands are periodic, before the first, and where the
            next command is sent in any case. Shape (actuators,).
        sent_tick: Its tick.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    attitude: Quaternion = IDENTITY
    law: dict[str, tuple[float, ...]]
    held: Codes | None = None
    voltage_codes: Codes | None = None
    sent_codes: Codes | None = None
    sent_tick: int | None = None


class Controller:
    """The law between a measurement frame and a command frame.

    Args:
        wire: Format of the frames.
        law: Which law, its parameters and gains.
        reference: Reference from tick 0 on.
        period: Time between ticks [s].

    Attributes:
        tick_index: k of the last measurement answered; −1 before the first.
        counter: Its counter.
        motion: The reference as followed; may be changed between two ticks.
        refused: Malformed measurement frames so far.
        fault: Why the law gave no voltages, once it has not; None before.
        invalid: Measurements with the code "no valid value" so far.
        outputs: What the last tick computed, by name as of `controller_function`; `row` has it one beside the other.
        last: The same of the last valid tick.

    Raises:
        LawError: The law cannot be used, such as one for another number of actuators.
        PluginError: There is no such law.
    """

    def __init__(self, wire: WireSpec, law: LawSettings, reference: Reference, period: float) -> None:
        self.wire = wire
        self.period = period
        self.tick_index = -1
        self.counter = 0
        self.refused = 0
        self.invalid = 0
        self.fault: str | None = None
        self.law = law_of(law, period, wire.actuators)
        self._tick = tick = Tick(wire, self.law, period)
        self.row, self._kept, self.outputs, self.last = tick.row, tick.kept_row, tick.found, tick.kept
        self._evaluate, self._codes = tick.evaluate, tick.inputs["codes"]
        self._measured, self._computed = tick.found["measured"], tick.found["computed"]
        self._command: memoryview[int] | Buffer
        self._command = tick.found["command"] if wire.voltage.bits is None else integers(tick.found["words"])
        self._no_command = [wire.voltage.quantizer().invalid] * wire.actuators
        self._regardless = tick.regardless
        self.motion = Motion(reference, shared=tick.inputs)
        self._gains = parts(tick.inputs["gains"], tick.gains)
        self._law_state = parts(tick.kept["state_next"], tick.states)
        self.set_gains(Gains.model_validate(configured_gains(self.law)))
        self._counters = wire.measurement.counters
        heartbeat = wire.transmit.heartbeat_ticks(round(period * 1e9), self._counters)
        self._periodic = wire.transmit.command == "periodic"
        self._sender = Sender(wire.transmit.command, heartbeat, self._counters)
        self._silence_allowed = wire.transmit.measurement == "on_change"
        self._held: Sequence[float] | None  # codes of the last measurement
        self._attitude_level: Callable[[float], float] = wire.attitude.quantizer().level
        self._read, self._write = wire.measurement.unpack, wire.command.pack
        initial: Buffer = memoryview(bytearray(array("d", tick.initial))).cast("d")
        self.restore(ControllerSnapshot(law={name: tuple(part) for name, part in parts(initial, tick.states).items()}))

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Answer a measurement.

        Args:
            frame: The newest measurement frame; UNCHANGED if the plant sent none because its levels have not changed;
                None if none was received since the last tick.
            k: Tick index; the law's time is k·period.

        Returns:
            The command frame; UNCHANGED if it would repeat the last one; None if there is nothing to answer, which
            includes malformed bytes. A measurement without a valid value is answered by a command without
            one: the plant then goes to 0 V.
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
        if self._computed[0]:
            self._kept[:] = self.row
            self.tick_index, self.counter = k, counter
            command: Sequence[float] = self._command.tolist()
        else:
            self._take_no_value(counter, k)
            command = self._no_command
        return self._write(counter, command) if self._periodic or self._sender.due(k, command) else UNCHANGED

    def _take_no_value(self, counter: int, k: int) -> None:
        """Count a measurement without a valid value, or keep what the law gives besides a voltage that is no number."""
        if not self._measured[0]:
            self.invalid += 1
            return
        self.fault = self._tick.fault or f"law {self.law.settings.kind} gave no number"
        self._kept[: self._regardless] = self.row[: self._regardless]
        self.tick_index, self.counter = k, counter

    def hold(self, frame: bytes) -> bool:
        """Hold the levels of a measurement that was received after its tick was over. False if it is malformed."""
        read = self._read(frame)
        if read is None:
            self.refused += 1
            return False
        self._held = read[1]
        return True

    def compute(self, counter: int, codes: Sequence[float], k: int) -> list[float] | None:
        """A tick by codes: the voltages before quantization [V]; None if there is no valid value.

        Shapes (6,) and (actuators,).
        """
        self.tick(self.wire.measurement.pack(counter, codes), k)
        return self.voltages if self._computed[0] else None

    def attitude_of(self, frame: bytes) -> Quaternion | None:
        """The attitude in a measurement; None if it is malformed or has no valid value."""
        read = self._read(frame)
        codes = read[1] if read is not None else self._held if frame == UNCHANGED and self._silence_allowed else None
        if codes is None:
            return None
        x, y, z = map(self._attitude_level, codes[:3])
        return received_quaternion(x, y, z, IDENTITY) if x + y + z == x + y + z else None

    def set_gains(self, gains: Gains) -> None:
        """Use other gains from the next tick on; None leaves a gain unchanged."""
        for name, gain in gains.named.items():
            self._gains[name][:] = memoryview(array("d", gain))

    def leave_out_law(self) -> None:
        """Compute only attitude, desired attitude and errors from now on, where the law is in Python."""
        self._tick.without_law = True

    def apply(self, change: Change) -> None:
        """Apply a recorded change; the next tick must be its first, or later."""
        if change.gains is not None:
            self.set_gains(change.gains)
        self.motion.change(change, self.period)

    @property
    def state(self) -> ControllerSnapshot:
        """State for the next tick, besides reference and gains."""
        sent_codes, sent_tick = self._sender.memory
        held, codes = self._held, tuple(self.last["command"])
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
        codes = state.voltage_codes or [nan] * self.wire.actuators
        rows = {"q": state.attitude, "command": codes}
        for name, values in rows.items():
            self.last[name][:] = memoryview(array("d", values))
        for name, part in self._law_state.items():
            if len(values := state.law.get(name, ())) == len(part):  # that of another law does not count
                part[:] = memoryview(array("d", values))
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
        return {name: tuple(part) for name, part in self._law_state.items()}

    @property
    def attitude(self) -> Quaternion:
        """q^Q of the last measurement [1]."""
        return tuple(self.last["q"])  # type: ignore[return-value]  # four elements

    @property
    def rate(self) -> Vector:
        """ω^Q of the last measurement, body frame [rad/s]."""
        return tuple(self.last["omega"])  # type: ignore[return-value]  # three elements

    @property
    def attitude_error(self) -> tuple[float, float, float]:
        """ε̃ at the last measurement [1]."""
        return tuple(self.last["eps_e"])  # type: ignore[return-value]  # three elements

    @property
    def rate_error(self) -> tuple[float, float, float]:
        """ω_e at the last measurement, body frame [rad/s]."""
        return tuple(self.last["omega_e"])  # type: ignore[return-value]  # three elements

    @property
    def desired(self) -> Quaternion:
        """q_d at the last measurement [1]."""
        return tuple(self.last["q_d"])  # type: ignore[return-value]  # four elements

    @property
    def voltages(self) -> list[float]:
        """The last u before quantization [V]. Shape (actuators,)."""
        return list(self.last["u"])

    @property
    def saturated(self) -> int:
        """Commanded voltages beyond the quantizer's range so far."""
        return int(self.last["saturated_next"][0])
