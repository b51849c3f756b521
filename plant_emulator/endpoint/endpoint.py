"""Plant endpoint, sans-I/O: measures into frames, actuates from frames, runs the watchdog.

It uses no socket and no clock; time is the tick index. Once a tick its owner passes in the newest command frame and
sends the measurement frame that it returns. A command acts from the start of the period in which it was received until
another replaces it.
Without a fresh command the watchdog trips: the session ends, and the motors stay at 0 V until the plant is armed and
claimed.

Freshness is counted in ticks: a command echoes the counter of the measurement that it answers, which gives its age.
"""

from __future__ import annotations

from math import isfinite

from aeroloop.plant_emulator.endpoint.envelope import Guard
from aeroloop.plant_emulator.endpoint.tenancy import Tenancy
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.states import PlantState, PlantTrigger, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.wire.attitude import sent_vector
from aeroloop.protocol.wire.loop import WATCHDOG_S
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import SILENCE, Sender


class Endpoint(Tenancy):
    """One plant, one controller at a time.

    After `watchdog_s` without a fresh command [s] the plant gets 0 V; `guard` trips it at its limits, if there are any.
    The other arguments are Tenancy's.

    Raises:
        ValueError: The wire commands another number of actuators than the plant has.

    Attributes:
        accepted: Commands applied so far.
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
        super().__init__(wire, period_ns, lockstep=lockstep, armed=armed)
        self.plant = plant
        self.accepted = 0
        self._quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
        self._encode = tuple(quantizer.encode for quantizer in self._quantizers)
        self._level = wire.voltage.quantizer().level
        self._no_measurement = [quantizer.invalid for quantizer in self._quantizers]
        self._read, self._write = wire.command.unpack, wire.measurement.pack
        transmit = wire.transmit
        self._counters = wire.measurement.counters
        heartbeat = transmit.heartbeat_ticks(period_ns, self._counters)
        self._sender = Sender(transmit.measurement, heartbeat, self._counters)
        self._silence_commands = lockstep and transmit.command == "on_change"
        # On change and without lockstep, a controller learns that values are valid again only from the next frame that
        # it receives in time, a heartbeat later at most: until then its commands may still have no valid value.
        clocked = transmit.measurement == "on_change" and not lockstep
        self._forgiven = heartbeat if clocked else 0
        self.protect(watchdog_s, guard)
        self._start = 0  # tick of the session's first measurement
        self._unmeasured_yet = False
        self._fresh_tick = 0  # tick of the last fresh command, or of the session's first measurement
        self._unmeasured = [False] * self._counters  # whether the last measurement of each counter had no valid value
        self._codes: tuple[float, ...] = ()  # of the last fresh command
        self._echo = -1  # of the last fresh command
        self._answered = -1  # tick of the measurement that it answers; before the session's first for none

    def protect(self, watchdog_s: float, guard: Guard | None) -> None:
        """Set the watchdog's time [s] and the limits."""
        watchdog_ns = round(watchdog_s * 1e9)
        self._watchdog = max(1, round(watchdog_ns / self.period_ns))
        self._first_command = max(1, self.first_command_ns(watchdog_ns) // self.period_ns)
        self._guard = guard

    @property
    def saturated(self) -> int:
        """Measured values beyond their quantizer's range so far."""
        return sum(quantizer.saturated for quantizer in self._quantizers)

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Apply the newest command, advance the plant to tick k, and measure.

        Args:
            frame: The newest command frame received since the last tick, or None; in lockstep SILENCE if the command
                has not changed.
            k: Tick index, from 0, rising. If it skips, the plant advances by all skipped periods. The first call
                ignores the frame: nothing was measured before it.

        Returns:
            The measurement frame; SILENCE if it would repeat the last one and need not be sent; None without a session.
        """
        if self.ticked < 0:
            self.ticked, self.outcome = 0, Outcome.NONE
        else:
            self.outcome = Outcome.NONE if frame is None or self.session is None else self._command(frame)
        while self.ticked < k:
            self._watch(self.ticked + 1)
            self.plant.actuate(self.voltages)
            self.plant.advance()
            self.ticked += 1
        if self.session is None:
            return None
        if self._unmeasured_yet:
            self._unmeasured_yet = False
            self._start = self._fresh_tick = self.ticked
            self._answered = self.ticked - 1
        seen = self.plant.measure()
        if self._guard is not None and (trip := self._guard.check(seen, self.voltages)) is not None:
            self._trip(*trip)
            self.plant.actuate(self.voltages)
            return None
        codes = self._encoded(seen)
        counter = self.counter
        self._unmeasured[counter] = codes is self._no_measurement
        return self._write(counter, codes) if self._sender.due(k, codes) else SILENCE

    @property
    def session_tick(self) -> int:
        """Tick of the last measurement since the session's first, which has 0; −1 before that."""
        return self.ticked - self._start

    @property
    def answered(self) -> int:
        """Session tick that the command in force answers; −1 for none."""
        return self._answered - self._start

    @property
    def counter(self) -> int:
        """Counter of the last measurement."""
        return (self.ticked - self._start) % self._counters

    def _encoded(self, seen: Measurement) -> list[float]:
        (w, x, y, z), (a, b, c) = seen
        if not isfinite((w + x + y + z) + (a + b + c)):
            return self._no_measurement
        x, y, z = sent_vector((w, x, y, z))
        of_x, of_y, of_z, of_a, of_b, of_c = self._encode  # by name: a loop over them costs as much as they do
        return [of_x(x), of_y(y), of_z(z), of_a(a), of_b(b), of_c(c)]

    def _command(self, frame: bytes) -> Outcome:
        """Apply a command frame if it is well-formed, fresh and valid."""
        if frame == SILENCE and self._silence_commands and self._codes:
            read: tuple[int, tuple[float, ...]] | None = ((self._echo + 1) % self._counters, self._codes)
        else:
            read = self._read(frame)
        if read is None:
            self.refused += 1
            return Outcome.MALFORMED
        echo, codes = read
        # The echo is a tick modulo `counters` and means the latest measurement with that counter. A repeated echo is
        # refused: after a whole round of the counter it would look fresh again.
        age = (self.ticked - self._start - echo) % self._counters
        answered = self.ticked - age
        if echo == self._echo or answered <= self._answered:
            return Outcome.REPEATED
        if age > self._watchdog:
            self.stale += 1
            return Outcome.STALE
        voltages = tuple(map(self._level, codes))
        if not isfinite(sum(voltages)):
            if any(self._unmeasured[(echo - ago) % self._counters] for ago in range(self._forgiven + 1)):
                voltages = self.off  # the right answer to an invalid measurement; the guard limits how long it lasts
            else:
                self._trip(TripCause.INVALID_COMMAND, f"{self.holder} commands 'no valid value'")
                return Outcome.INVALID
        self.voltages = voltages
        self._codes, self._echo, self._answered = codes, echo, answered
        self._fresh_tick = self.ticked
        if self.state is not PlantState.DRIVEN:
            self._machine.fire(PlantTrigger.COMMAND)
        self.accepted += 1
        return Outcome.ACTED

    def _watch(self, tick: int) -> None:
        """Trip if no fresh command was received in time."""
        if self.session is None or self._unmeasured_yet:
            return
        driven, waited = self.state is PlantState.DRIVEN, tick - 1 - self._fresh_tick
        if waited < (self._watchdog if driven else self._first_command):
            return
        text = f"no fresh command for {waited * self.period_ns * 1e-6:.0f} ms"
        if not driven:
            text = f"no first command within {self._first_command * self.period_ns * 1e-9:.3g} s"
        self._trip(TripCause.COMMAND_TIMEOUT, text)

    def _begin(self) -> None:
        if self._guard is not None:
            self._guard.reset()
        for quantizer in self._quantizers:
            quantizer.reset()
        self._start = self._fresh_tick = self.ticked + 1
        self._unmeasured = [False] * self._counters
        self._unmeasured_yet = True  # the first measurement has counter 0, whichever tick it is
        self._codes, self._echo, self._answered = (), -1, self.ticked
        self._sender.forget()

    def _rest(self) -> None:
        self.voltages = self.off
        self._answered = self._start - 1
