"""The plant end of the loop, sans-I/O: measure → frame; frame → actuate; claim and watchdog.

It knows no socket and no clock: time is the tick index. Whoever owns it feeds it the newest command frame, once a tick,
and sends what it returns. A command acts from the start of the period in which it arrived; when none has come in time
the watchdog trips: the session ends, and the motors have 0 V until somebody arms the plant and a controller claims it.

              claim                first command
  idle ────────────────► granted ───────────────► driven
   ▲  ▲                     │ release                │ release
   │  └─────────────────────┴────────────────────────┤
   │ arm                                             │ watchdog, holder gone, invalid command, limit, operator's stop
   └────────────────────────────────── tripped ◄─────┘

A tripped plant, and one that starts unarmed, refuse claims and say why. A claim may carry its own arming
(`auto_arm`), which clears anything but an operator's stop.
"""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple

from plant_emulator.limits import Guard
from plant_emulator.plant import Measurement, Plant
from protocol.attitude import sent_vector
from protocol.clock import FIRST_COMMAND_S, WATCHDOG_S
from protocol.frames import COUNTERS, WireSpec
from protocol.messages import PROTOCOL_VERSION, Claim, EventKind, Grant, Refusal
from protocol.states import PLANT_TABLE, Machine, PlantState, PlantTrigger


class Notice(NamedTuple):
    """Something for the `event` topic."""

    kind: EventKind
    text: str
    session: str | None


class Endpoint:
    """One plant, one controller at a time.

    Args:
        plant: What to measure and to actuate.
        wire: How frames are read and written here.
        period_ns: Period of a tick [ns].
        lockstep: Whether each answer is waited for; a claim must say the same.
        watchdog_s: 0 V after this long without a fresh command [s].
        guard: What else makes it trip; None for nothing.
        armed: Whether the first claim is granted without anybody arming it.

    Raises:
        ValueError: The wire commands another number of actuators than the plant has.

    Attributes:
        session: Name of the session it is in, or None.
        holder: Controller that holds it, or None.
        notices: What happened since the owner last emptied this list.
        refused: Malformed command frames so far.
        accepted: Commands acted upon so far.
    """

    def __init__(
        self,
        plant: Plant,
        wire: WireSpec,
        period_ns: int,
        *,
        lockstep: bool = False,
        watchdog_s: float = WATCHDOG_S,
        guard: Guard | None = None,
        armed: bool = False,
    ) -> None:
        if plant.actuators != wire.actuators:
            raise ValueError(f"wire.actuators is {wire.actuators}, but the plant has {plant.actuators} actuators")
        self.plant = plant
        self.wire = wire
        self.period_ns = period_ns
        self.lockstep = lockstep
        self._machine = Machine(PlantState.IDLE, PLANT_TABLE)
        self.session: str | None = None
        self.holder: str | None = None
        self.notices: list[Notice] = []
        self.refused = 0
        self.accepted = 0
        self._quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
        self._encode = [quantizer.encode for quantizer in self._quantizers]
        self._level = wire.voltage.quantizer().level
        self._no_measurement = [quantizer.invalid for quantizer in self._quantizers]
        self._off = (0.0,) * wire.actuators
        self._voltages: tuple[float, ...] = self._off
        self._latch: str | None = None if armed else "not armed since it was started"
        self._operator_stop = False
        self.protect(watchdog_s, guard)
        self._first_command = max(1, round(FIRST_COMMAND_S * 1e9 / period_ns))
        self._tick = -1
        self._session_tick = 0  # tick of the session's first measurement
        self._fresh_tick = 0  # tick of the last fresh command, or of the grant
        self._unmeasured = [False] * COUNTERS  # whether the last measurement of each counter had no valid value
        self._echo = -1  # the last fresh command's echo
        self._answered = -1  # and the tick of the measurement that it answered

    def protect(self, watchdog_s: float, guard: Guard | None) -> None:
        """Use another watchdog time [s] and other limits from now on."""
        self._watchdog = max(1, round(watchdog_s * 1e9 / self.period_ns))
        self._guard = guard

    @property
    def state(self) -> PlantState:
        """What it is doing."""
        return self._machine.state

    @property
    def cause(self) -> str | None:
        """Why claims are held back, or None."""
        return self._latch

    @property
    def saturated(self) -> int:
        """Measured values beyond their quantizer's range so far."""
        return sum(quantizer.saturated for quantizer in self._quantizers)

    def claim(self, claim: Claim) -> Grant | Refusal:
        """Grant a claim, or say which field differs or who holds the plant. The next tick measures first."""
        differences = self.wire.differences(claim.wire)
        if claim.protocol != PROTOCOL_VERSION:
            differences.append(f"protocol: {PROTOCOL_VERSION}, not {claim.protocol}")
        if claim.period_ns != self.period_ns:
            differences.append(f"period_ns: {self.period_ns}, not {claim.period_ns}")
        if claim.lockstep != self.lockstep:
            differences.append(f"lockstep: {self.lockstep}, not {claim.lockstep}")
        if differences:
            return Refusal(reason=f"the plant has {'; '.join(differences)}", differences=differences)
        if self.session is not None:
            return Refusal(reason=f"the plant is held by {self.holder}", holder=self.holder)
        if claim.auto_arm and not self._operator_stop:
            self._clear()
        if self._latch is not None:
            return Refusal(reason=f"{self._latch}; `aeroloop op arm` clears it")
        if self._guard is not None:
            self._guard.reset()
        self._machine.fire(PlantTrigger.GRANT)
        self.session, self.holder = claim.session, claim.controller
        self._voltages = self._off
        self._session_tick = self._fresh_tick = self._tick + 1
        self._echo = self._answered = -1
        self._notice("claimed", f"granted to {claim.controller}")
        return Grant(session=claim.session)

    def release(self, session: str) -> bool:
        """End a session at its holder's wish: 0 V. False if it is not the session that runs."""
        if session != self.session:
            return False
        self._end(PlantTrigger.RELEASE, "released", f"released by {self.holder}")
        return True

    def arm(self) -> bool:
        """Clear what holds claims back; the next one is granted. False while a controller holds the plant."""
        if self.session is not None:
            return False
        self._operator_stop = False
        self._clear()
        self._notice("armed", "armed by an operator: the next claim is granted")
        return True

    def stop(self) -> None:
        """An operator's stop, from any state: 0 V, and no claim is granted before `arm`."""
        self._trip("stopped by an operator")
        self._operator_stop = True

    def lost(self, controller: str) -> None:
        """A controller's liveliness token went; if it held the plant, its session ends: 0 V."""
        if controller == self.holder:
            self._trip(f"{controller} is gone")

    def expire(self, reason: str) -> None:
        """End a session for a reason that only its owner can see, such as no answer in lockstep: 0 V."""
        if self.session is not None:
            self._trip(reason)

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Let the time since the last tick pass under the newest command, and measure.

        Args:
            frame: The newest command frame that came since the last tick, or None.
            k: Tick index, rising; where it skips, the plant's time passes all the same. The very first only measures.

        Returns:
            The measurement frame, or None while no session runs.
        """
        if self._tick >= 0:
            if frame is not None:
                self._command(frame)
            for tick in range(self._tick + 1, k + 1):
                self._watch(tick)
                self.plant.actuate(self._voltages)
                self.plant.advance()
        self._tick = k
        if self.session is None:
            return None
        seen = self.plant.measure()
        if self._guard is not None and (reason := self._guard.check(seen, self._voltages)) is not None:
            self._trip(reason)
            self.plant.actuate(self._voltages)
            return None
        codes = self._encoded(seen)
        self._unmeasured[self.counter] = codes is self._no_measurement
        return self.wire.measurement.pack(self.counter, codes)

    @property
    def counter(self) -> int:
        """Counter of the last measurement."""
        return (self._tick - self._session_tick) % COUNTERS

    def _encoded(self, seen: Measurement) -> list[float]:
        attitude, rate = seen
        if not isfinite(sum(attitude) + sum(rate)):
            return self._no_measurement
        values = (*sent_vector(attitude), *rate)
        return [encode(value) for encode, value in zip(self._encode, values, strict=True)]

    def _command(self, frame: bytes) -> None:
        """Act on a command frame if it is well-formed, newer than the last, and valid."""
        if self.session is None:
            return
        read = self.wire.command.unpack(frame)
        if read is None:
            self.refused += 1
            return
        echo, codes = read
        # The echo is a tick modulo 16: the latest measurement with that counter. Newer than the last one answered is
        # fresh. An echo that never changes is a sender that repeats itself, however long ago it began.
        answered = self._tick - (self.counter - echo) % COUNTERS
        if echo == self._echo or answered <= self._answered:
            return
        voltages = tuple(self._level(code) for code in codes)
        if not isfinite(sum(voltages)):
            if self._unmeasured[echo]:
                voltages = self._off  # the right answer; how long it may go on is the guard's to say
            else:
                self._trip(f"{self.holder} commands 'no valid value'")
                return
        self._voltages = voltages
        self._echo, self._answered = echo, answered
        self._fresh_tick = self._tick
        self._machine.fire(PlantTrigger.COMMAND)
        self.accepted += 1

    def _watch(self, tick: int) -> None:
        """End the session when no fresh command came in time."""
        if self.session is None:
            return
        waited = tick - 1 - self._fresh_tick
        if self.state is PlantState.DRIVEN and waited >= self._watchdog:
            text = f"no fresh command for {waited * self.period_ns * 1e-6:.0f} ms"
        elif self.state is PlantState.GRANTED and waited >= self._first_command:
            text = f"no first command within {FIRST_COMMAND_S:g} s"
        else:
            return
        self._trip(text)

    def _trip(self, reason: str) -> None:
        self._end(PlantTrigger.TRIP, "tripped", f"{reason}: 0 V")
        self._latch = f"{reason}: 0 V"

    def _clear(self) -> None:
        self._latch = None
        self._machine.fire(PlantTrigger.ARM)

    def _end(self, trigger: PlantTrigger, kind: EventKind, text: str) -> None:
        self._notice(kind, text)
        self._machine.fire(trigger)
        self.session = self.holder = None
        self._voltages = self._off

    def _notice(self, kind: EventKind, text: str) -> None:
        self.notices.append(Notice(kind, text, self.session))
