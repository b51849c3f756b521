"""Controller end of the loop, sans-I/O: measurement frame in, command frame out, at tick k.

It uses no socket, no clock and no log, so the daemon, the lockstep experiment, the review of a log and the tests all
run this one code path. The law's time is k times the period. A frame that would repeat the last levels need not be
sent; the controller then receives SILENCE and computes with the levels it holds.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict

from aeroloop.protocol.messages.operator import Change, Gains, Reference
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector, received_quaternion
from aeroloop.protocol.wire.quantizer import Quantizer
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.protocol.wire.transmit import SILENCE, Sender
from aeroloop.service.control.law import LawSettings, law_function
from aeroloop.service.control.motion import Motion

Codes = tuple[float, ...]


class ControllerSnapshot(BaseModel):
    """State carried from tick to tick, besides reference and gains. Its JSON keeps every bit of the floats.

    Attributes:
        attitude: q^Q of the last measurement [1].
        sign: ±1, the equilibrium that is approached; 0 before the first measurement (Assumption 3).
        damping_estimate: θ̂ [N·m·s/rad].
        held: Codes of the last measurement, for silence; None before the first. Shape (6,).
        voltage_codes: Codes of the last valid voltages, for quantizers with a memory; None before the first.
            Shape (actuators,).
        sent_codes: Codes of the last command sent; None where commands are periodic, before the first, and where the
            next command is sent in any case. Shape (actuators,).
        sent_tick: Its tick.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    attitude: Quaternion = IDENTITY
    sign: Literal[-1, 0, 1] = 0
    damping_estimate: Vector
    held: Codes | None = None
    voltage_codes: Codes | None = None
    sent_codes: Codes | None = None
    sent_tick: int | None = None


def resume(quantizers: Sequence[Quantizer], codes: Sequence[float] | None) -> None:
    """Set quantizers to the state after these codes, one each; to the initial state if None."""
    for i, quantizer in enumerate(quantizers):
        quantizer.reset()
        if codes is not None:
            quantizer.resume(codes[i])


class Controller:
    """The adaptive law between a measurement frame and a command frame.

    Args:
        wire: Format of the frames.
        law: Parameters and gains.
        reference: Reference from tick 0 on.
        period: Time between ticks [s].

    Attributes:
        tick_index: k of the last measurement answered; −1 before the first.
        counter: Its counter.
        voltages: The last u before quantization [V]. Shape (actuators,).
        motion: The reference as followed; may be changed between two ticks.
        refused: Malformed measurement frames so far.
        failed: Whether the law has returned NaN.
        invalid: Measurements with the code "no valid value" so far.

    Raises:
        ValueError: The law's B cannot be inverted.
    """

    def __init__(self, wire: WireSpec, law: LawSettings, reference: Reference, period: float) -> None:
        self.wire = wire
        self.period = period
        self.tick_index = -1
        self.counter = 0
        self.voltages: list[float] = [0.0] * wire.actuators
        self.refused = 0
        self.invalid = 0
        self.failed = False
        self._law = Compiled(law_function(law, period))
        inputs, outputs = self._law.inputs, self._law.outputs
        desired = {name: inputs[name] for name in ("q_d", "omega_d", "omega_d_dot")}
        self.motion = Motion(reference, shared=desired)
        self._eps, self._omega, self._sign = inputs["eps"], inputs["omega"], inputs["s"]
        self._last, self._q = inputs["last"], outputs["q"]
        self._theta, self._theta_next = inputs["theta"], outputs["theta_next"]
        self._u, self._eta_e, self._eps_e = outputs["u"], outputs["eta_e"], outputs["eps_e"]
        self.set_gains(Gains(C1=law.C1, C2=law.C2, Gamma=law.Gamma))
        self._first_motor = 3 - wire.actuators
        self._voltage = [wire.voltage.quantizer() for _ in range(wire.actuators)]
        self._encode = [q.encode for q in self._voltage]
        self._no_command: list[float] = [q.invalid for q in self._voltage]
        self._counters = wire.measurement.counters
        heartbeat = wire.transmit.heartbeat_ticks(round(period * 1e9), self._counters)
        self._sender = Sender(wire.transmit.command, heartbeat, self._counters)
        self._silence_allowed = wire.transmit.measurement == "on_change"
        self._held: Sequence[float] | None  # codes of the last measurement
        self._voltage_codes: Sequence[float] | None
        self._read, self._write = wire.measurement.unpack, wire.command.pack
        self._attitude_level: Callable[[float], float] = wire.attitude.quantizer().level
        self._rate_level: Callable[[float], float] = wire.rate.quantizer().level
        self.restore(ControllerSnapshot(damping_estimate=law.damping_estimate))

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Answer a measurement.

        Args:
            frame: The newest measurement frame; SILENCE if the plant sent none because its levels have not changed;
                None if none was received since the last tick.
            k: Tick index; the law's time is k·period.

        Returns:
            The command frame; SILENCE if it would repeat the last one and need not be sent; None if there is nothing to
            answer, which includes malformed bytes. A measurement without a valid value is answered by a command without
            one: the plant then goes to 0 V.
        """
        if frame is None:
            return None
        if frame == SILENCE and self._silence_allowed and self._held is not None:
            return self.answer(k % self._counters, self._held, k)
        read = self._read(frame)
        if read is None:
            self.refused += 1
            return None
        self._held = read[1]
        return self.answer(*read, k)

    def hold(self, frame: bytes) -> bool:
        """Hold the levels of a measurement that was received after its tick was over. False if it is malformed."""
        read = self._read(frame)
        if read is None:
            self.refused += 1
            return False
        self._held = read[1]
        return True

    def answer(self, counter: int, codes: Sequence[float], k: int) -> bytes:
        """The command frame that answers a measurement with this counter and these codes; see `tick`."""
        voltages = self.compute(counter, codes, k)
        if voltages is None:
            command = self._no_command
        else:
            command = self._voltage_codes = [encode(u) for encode, u in zip(self._encode, voltages, strict=True)]
        return self._write(counter, command) if self._sender.due(k, command) else SILENCE

    def compute(self, counter: int, codes: Sequence[float], k: int) -> list[float] | None:
        """The voltages of `answer` before quantization [V]; None if there is no valid value. Shape (actuators,)."""
        attitude, rate = self._attitude_level, self._rate_level
        x, y, z = attitude(codes[0]), attitude(codes[1]), attitude(codes[2])
        wx, wy, wz = rate(codes[3]), rate(codes[4]), rate(codes[5])
        if (total := x + y + z + wx + wy + wz) != total:  # NaN: no valid value
            self.invalid += 1
            return None
        self._eps[0], self._eps[1], self._eps[2] = x, y, z
        self._omega[0], self._omega[1], self._omega[2] = wx, wy, wz
        self.motion.at(k * self.period)
        if not self._sign[0]:
            self._choose_sign()
        self._law()
        self._last[:], self._theta[:] = self._q, self._theta_next
        self.tick_index, self.counter = k, counter
        voltages: list[float] = self._u.tolist()[self._first_motor :]  # type: ignore[assignment]  # doubles
        if (total := sum(voltages)) != total:
            self.failed = True
            return None
        self.voltages = voltages
        return voltages

    def attitude_of(self, frame: bytes) -> Quaternion | None:
        """The attitude in a measurement; None if it is malformed or has no valid value."""
        read = self._read(frame)
        codes = read[1] if read is not None else self._held if frame == SILENCE and self._silence_allowed else None
        if codes is None:
            return None
        x, y, z = (self._attitude_level(code) for code in codes[:3])
        return received_quaternion(x, y, z, IDENTITY) if x + y + z == x + y + z else None

    def set_gains(self, gains: Gains) -> None:
        """Use other gains from the next tick on; None leaves a gain unchanged."""
        for name in ("C1", "C2", "Gamma"):
            if (diagonal := getattr(gains, name)) is not None:
                self._law.inputs[name][:] = memoryview(array("d", diagonal))

    def apply(self, change: Change) -> None:
        """Apply a recorded change; the next tick must be its first, or later."""
        if change.gains is not None:
            self.set_gains(change.gains)
        self.motion.change(change, self.period)

    @property
    def state(self) -> ControllerSnapshot:
        """State for the next tick, besides reference and gains."""
        sent_codes, sent_tick = self._sender.memory
        held, encoded = self._held, self._voltage_codes
        return ControllerSnapshot(
            attitude=self.attitude,
            sign=self.sign,  # type: ignore[arg-type]  # one of the three
            damping_estimate=self.damping_estimate,
            held=None if held is None else tuple(held),
            voltage_codes=None if encoded is None else tuple(encoded),
            sent_codes=None if sent_codes is None else tuple(sent_codes),
            sent_tick=sent_tick,
        )

    def restore(self, state: ControllerSnapshot) -> None:
        """Continue bit for bit from this state, given the same reference and gains."""
        self._last[:] = memoryview(array("d", state.attitude))
        self._sign[0] = state.sign
        self._theta[:] = memoryview(array("d", state.damping_estimate))
        widths = self.wire.measurement.widths
        self._held = state.held and [
            code if width is None else int(code) for code, width in zip(state.held, widths, strict=True)
        ]
        self._voltage_codes = state.voltage_codes
        resume(self._voltage, state.voltage_codes)
        self._sender.resume(state.sent_codes, state.sent_tick)

    @property
    def gains(self) -> Gains:
        """The gains now."""
        return Gains.model_validate({name: tuple(self._law.inputs[name]) for name in ("C1", "C2", "Gamma")})

    def _choose_sign(self) -> None:
        """Choose z₁₊ or z₁₋ by the sign of η̃ at the first measurement, once per session (Assumption 3)."""
        self._sign[0] = 1.0
        self._law()
        self._sign[0] = 1.0 if self._eta_e[0] >= 0 else -1.0

    @property
    def sign(self) -> int:
        """±1, the equilibrium that is approached; 0 before the first measurement."""
        return int(self._sign[0])

    @property
    def attitude(self) -> Quaternion:
        """q^Q of the last measurement [1]."""
        return tuple(self._last)  # type: ignore[return-value]  # four elements

    @property
    def rate(self) -> Vector:
        """ω^Q of the last measurement, body frame [rad/s]."""
        return tuple(self._omega)  # type: ignore[return-value]  # three elements

    @property
    def attitude_error(self) -> tuple[float, float, float]:
        """ε̃ at the last measurement [1]."""
        return tuple(self._eps_e)  # type: ignore[return-value]  # three elements

    @property
    def rate_error(self) -> tuple[float, float, float]:
        """ω_e at the last measurement, body frame [rad/s]."""
        return tuple(self._law.outputs["omega_e"])  # type: ignore[return-value]  # three elements

    @property
    def desired(self) -> Quaternion:
        """q_d at the last measurement [1]."""
        return tuple(self._law.inputs["q_d"])  # type: ignore[return-value]  # four elements

    @property
    def damping_estimate(self) -> tuple[float, float, float]:
        """θ̂ after the last measurement [N·m·s/rad]."""
        return tuple(self._theta)  # type: ignore[return-value]  # three elements

    @property
    def saturated(self) -> int:
        """Commanded voltages beyond the quantizer's range so far."""
        return sum(q.saturated for q in self._voltage)
