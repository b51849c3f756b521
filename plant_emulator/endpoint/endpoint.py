"""Plant endpoint, sans-I/O: claims, fresh commands, watchdog, limits, latch, and one tick of a plant.

It uses no socket and no clock; time is the tick index. A command acts from the start of the period in which it was
received until another replaces it. One controller at a time holds the plant, by name:

              claim                first command
  idle ────────────────► granted ───────────────► driven
   ▲  ▲                     │ release                │ release
   │  └─────────────────────┴────────────────────────┤
   │ arm                                             │ watchdog, holder gone, invalid command, limit, operator's stop
   └────────────────────────────────── tripped ◄─────┘

A plant that tripped or started unarmed stays at 0 V and refuses claims with the reason. A claim with `auto_arm` arms
the plant itself, except after `stop`.

Whatever ends a session, the end itself sets 0 V and switches the power stage off, before anybody publishes, logs or
writes that it ended. It does not wait for the next tick, which in lockstep may never come.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from math import isfinite
from typing import Any, Final, Literal, NamedTuple

from aeroloop.plant_emulator.endpoint.limits import LimitMonitor
from aeroloop.plant_emulator.faults.injection import Faults, Transition
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.plant import Plant
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import (
    PROTOCOL_VERSION,
    Claim,
    EventKind,
    FaultStatus,
    Grant,
    Refusal,
    SessionRecord,
    Truth,
)
from aeroloop.protocol.messages.states import PLANT_TABLE, Machine, PlantState, PlantTrigger, TripCause
from aeroloop.protocol.messages.trace import Outcome, PlantChange, PlantChangeKind
from aeroloop.protocol.plugins import exception_line
from aeroloop.protocol.wire.attitude import sent_vector
from aeroloop.protocol.wire.spec import FIRST_COMMAND_S, WATCHDOG_S, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Sender

_FIRST_COMMAND_NS: Final = round(FIRST_COMMAND_S * 1e9)


class Notice(NamedTuple):
    """An event to publish; `tick` is the session's, None before its first measurement."""

    kind: EventKind
    text: str
    session: str | None
    tick: int | None


class Freshness:
    """Judge of a session's commands: which of them are fresh, and whether the next one is overdue.

    A command echoes the counter of the measurement that it answers, which gives its age in ticks. The wait for the next
    command is measured on the owner's clock [ns]: the Endpoint's is its tick index times the period, the Relay's is
    monotonic.

    Why the first command of a session has a deadline of its own: commands late by a whole round of the counter would
    look fresh, so the first one must be received before the counter is back at 0. A counter shorter than twice the
    watchdog's time cannot detect this, and gets the usual time.
    """

    def __init__(self, counters: int, period_ns: int, watchdog_s: float) -> None:
        self._counters = counters
        watchdog_ns = round(watchdog_s * 1e9)
        self.watchdog_ticks = max(1, round(watchdog_ns / period_ns))  # also the age of a fresh command at the most
        self._watchdog_ns = self.watchdog_ticks * period_ns
        first_ns = _FIRST_COMMAND_NS
        if counters * period_ns >= 2 * watchdog_ns:
            first_ns = min(first_ns, (counters - 1) * period_ns)
        self.first_ticks = max(1, first_ns // period_ns)  # until the first command at the most
        self._first_ns = self.first_ticks * period_ns
        self.reset()

    def reset(self) -> None:
        """Forget the session; the next one has no measurement yet."""
        self.echo = self.answered = -1  # counter and session tick that the last fresh command answers
        self.since_ns: int | None = None  # the next command is waited for; None while there is nothing to answer
        self._limit_ns = _FIRST_COMMAND_NS

    def measured(self, now_ns: int | None) -> None:
        """Wait for the first command from now on: the session has its first measurement."""
        self.since_ns, self._limit_ns = now_ns, self._first_ns

    def judge(self, echo: int, session_tick: int, now_ns: int) -> Outcome:
        """Judge a command, received after the measurement of a session's tick: ACTED if fresh, REPEATED or STALE."""
        age = (session_tick - echo) % self._counters
        if echo == self.echo or session_tick - age <= self.answered:
            return Outcome.REPEATED
        if age > self.watchdog_ticks:
            return Outcome.STALE
        self.echo, self.answered = echo, session_tick - age
        self.since_ns, self._limit_ns = now_ns, self._watchdog_ns
        return Outcome.ACTED

    def overdue(self, now_ns: int) -> str | None:
        """Why the session must end now, in words; None while a command may still be received in time."""
        if self.since_ns is None or now_ns - self.since_ns < self._limit_ns:
            return None
        if self.answered < 0:
            return f"no first command within {self._limit_ns * 1e-9:.3g} s"
        return f"no fresh command for {(now_ns - self.since_ns) * 1e-6:.0f} ms"


class VehicleClaim:
    """A plant that one controller at a time may drive: base of the Endpoint and of the CAN bridge's Relay."""

    def __init__(self, wire: WireSpec, period_ns: int, *, lockstep: bool, watchdog_s: float, armed: bool) -> None:
        self.wire, self.period_ns, self.lockstep = wire, period_ns, lockstep
        self.session: str | None = None
        self.holder: str | None = None
        self.trip: TripCause | None = None  # cause of the last trip, until it is cleared
        self.trips: Counter[TripCause] = Counter()  # so far
        self.cause: str | None = None if armed else "not armed since it was started"  # why the latch refuses claims
        self.operator_only = False  # whether only an operator's `arm` clears the latch
        self.unavailable: str | None = None  # the owner's reason to refuse every claim, such as a bus fault
        self.failure: Exception | None = None  # an exception that ends this process
        self.last: SessionRecord | None = None  # of the last session, for the next controller
        self.notices: list[Notice] = []  # events since the owner last emptied the list
        self.changes: list[PlantChange] = []  # likewise, for the trace
        self.ticked = -1  # index of the last tick
        self.outcome = Outcome.NONE  # how the last tick judged the command received before it
        self.off = (0.0,) * wire.actuators
        self.voltages: tuple[float, ...] = self.off  # in force from the last tick to the next command [V]
        self.refused = self.stale = 0  # frames so far
        self._record: SessionRecord | None = None  # of the running session
        self._machine = Machine(PlantState.IDLE, PLANT_TABLE)
        self._counters = wire.measurement.counters
        self._freshness = Freshness(self._counters, period_ns, watchdog_s)
        self._level = wire.voltage.quantizer().level
        self._silent_commands = lockstep and wire.transmit.command == "on_change"
        self._codes: tuple[float, ...] = ()  # of the last fresh command
        self._start = 0  # tick of the session's first measurement

    @property
    def state(self) -> PlantState:
        """Idle, granted, driven or tripped."""
        return self._machine.state

    @property
    def session_tick(self) -> int:
        """Tick of the last measurement since the session's first, which has 0; −1 before that."""
        return self.ticked - self._start

    @property
    def counter(self) -> int:
        """Counter of the session's last measurement."""
        return self.session_tick % self._counters

    @property
    def answered(self) -> int:
        """Session tick that the command in force answers; −1 for none."""
        return self._freshness.answered

    @property
    def event_tick(self) -> int | None:
        """Session tick for an event now; None without a session and before its first measurement."""
        return self.session_tick if self.session is not None and self.session_tick >= 0 else None

    # ── claim, release, latch ──

    def start_tripped(self, trip: TripCause, cause: str, *, operator_only: bool) -> None:
        """Begin with the latch that an earlier process left. No PlantChange: a replay begins at the first grant."""
        self._machine.fire(PlantTrigger.TRIP)
        self.trip, self.cause, self.operator_only = trip, cause, operator_only

    def claim(self, claim: Claim) -> Grant | Refusal:
        """Grant a claim, or refuse it with the fields that differ, the holder or the latch's reason."""
        differences = self.wire.differences(claim.wire)
        for name, ours in (("protocol", PROTOCOL_VERSION), ("period_ns", self.period_ns), ("lockstep", self.lockstep)):
            if (theirs := getattr(claim, name)) != ours:
                differences.append(f"{name}: {ours}, not {theirs}")
        if self.unavailable is not None:
            return Refusal(reason=self.unavailable)
        if differences:
            return Refusal(reason=f"the plant has {'; '.join(differences)}", differences=differences)
        if self.session is not None:
            return Refusal(reason=f"the plant is held by {self.holder}", holder=self.holder)
        if claim.auto_arm and not self.operator_only:
            self._clear()
        if self.cause is not None:
            return Refusal(reason=f"{self.cause}; `aeroloop op arm` clears it")
        self._machine.fire(PlantTrigger.GRANT)
        self.session, self.holder = claim.session, claim.controller
        self.record_change("claim", claim=claim)
        self._begin()
        self._notice("claimed", f"granted to {claim.controller}")
        return Grant(session=claim.session, last=self.last)

    def keep(self, record: SessionRecord) -> bool:
        """Keep the running session's record; False if it is of another one. It changes no tick, so no PlantChange."""
        if self.session is None or (record.session, record.controller) != (self.session, self.holder):
            return False
        self._record = record
        return True

    def release(self, session: str) -> bool:
        """End the session on its holder's request: 0 V. False if another session or none runs."""
        if session != self.session:
            return False
        self._release(session, f"released by {self.holder}")
        return True

    def leave(self) -> None:
        """End the session, if one runs, because this process ends in order: 0 V. It latches nothing."""
        if self.session is not None:
            self._release(self.session, "released: the plant end stops")

    def fail(self, error: Exception) -> None:
        """Trip for an exception that ends this process, and latch it as a stop. Only the first one counts."""
        if self.failure is not None:
            return
        self.failure = error
        text = str(error) if isinstance(error, AeroloopError) else f"unexpected {exception_line(error)}"
        self.stop(TripCause.PLANT, text)

    def arm(self) -> bool:
        """Clear the latch, so that the next claim is granted. False while a controller holds the plant."""
        if self.session is not None:
            return False
        self.record_change("arm")
        self.operator_only = False
        self._clear()
        self._notice("armed", "armed by an operator: the next claim is granted")
        return True

    def stop(self, cause: TripCause = TripCause.OPERATOR, reason: str = "stopped by an operator") -> None:
        """Trip in any state: 0 V, and no claim, not even one with `auto_arm`, is granted before `arm`.

        An operator's stop of a plant that has tripped keeps the cause of that trip, and is another event only if it
        changes what clears the latch.
        """
        self.record_change("stop", cause=cause, reason=reason)
        if cause is not TripCause.OPERATOR or self.state is not PlantState.TRIPPED:
            self._trip(cause, reason)
        elif not self.operator_only:
            self.cause = f"{self.cause}; then {reason}"
            self._notice("changed", f"{reason} after it tripped: a claim with auto_arm does not clear it any more")
        self.operator_only = True
        if self.last is not None:
            self.last = self.last.model_copy(update={"ended": cause})

    def raise_failure(self) -> None:
        """Raise `failure`, if there is one: its owner calls this where its loop can end."""
        if self.failure is not None:
            raise self.failure

    def lost(self, controller: str) -> None:
        """Trip if this controller, having lost its liveliness token, holds the plant."""
        if controller == self.holder:
            self.record_change("lost", name=controller)
            self._trip(TripCause.HOLDER_GONE, f"{controller} is gone")

    def expire(self, cause: TripCause, reason: str) -> None:
        """Trip for a cause that the owner detects, such as no answer in lockstep. Nothing without a session."""
        if self.session is not None:
            self.record_change("expire", cause=cause, reason=reason)
            self._trip(cause, reason)

    def record_change(self, kind: PlantChangeKind, **what: Any) -> None:
        """Record a change after the last tick; fields as in PlantChange."""
        self.changes.append(PlantChange(tick=self.ticked, kind=kind, **what))

    # ── commands ──

    def _command(self, frame: bytes, now_ns: int) -> Outcome:
        """Put a command's voltages in force if it is well-formed, fresh and valid."""
        if frame == UNCHANGED and self._silent_commands and self._codes:
            read: tuple[int, tuple[float, ...]] | None = (self._freshness.echo + 1) % self._counters, self._codes
        else:
            read = self.wire.command.unpack(frame)
        if read is None:
            self.refused += 1
            return Outcome.MALFORMED
        echo, codes = read
        outcome = self._freshness.judge(echo, self.session_tick, now_ns)
        self.stale += outcome is Outcome.STALE
        if outcome is not Outcome.ACTED:
            return outcome
        voltages = tuple(map(self._level, codes))
        if not isfinite(sum(voltages)):
            if not self._may_be_invalid(echo):
                self._trip(TripCause.INVALID_COMMAND, f"{self.holder} commands 'no valid value'")
                return Outcome.INVALID
            voltages = self.off
        self.voltages, self._codes = voltages, codes
        self._machine.fire(PlantTrigger.COMMAND)
        return Outcome.ACTED

    def _may_be_invalid(self, echo: int) -> bool:  # noqa: ARG002  # the relay has no measurements to judge by
        """Whether a command without a valid value that answers this measurement means 0 V, or trips."""
        return True

    # ── begin and end of a session ──

    def _begin(self) -> None:
        self._start = self.ticked + 1  # of its first measurement

    def _trip(self, cause: TripCause, reason: str) -> None:
        self.cause = f"{reason}: 0 V"
        self.trip = cause
        self.trips[cause] += 1
        self._end(PlantTrigger.TRIP, "tripped", self.cause, cause)

    def _release(self, session: str, text: str) -> None:
        self.record_change("release", name=session)
        self._end(PlantTrigger.RELEASE, "released", text, "released")

    def _clear(self) -> None:
        self.cause = self.trip = None
        self._machine.fire(PlantTrigger.ARM)

    def _end(self, trigger: PlantTrigger, kind: EventKind, text: str, ended: TripCause | Literal["released"]) -> None:
        """Set 0 V, then end the session. Where 0 V could not be set, the plant has failed, which is a trip, too."""
        failure = self._switch_off()
        self._notice(kind, text)
        if self.session is not None:
            how = {"ended": ended, "ended_tick": self.event_tick}
            self.last, self._record = self._record and self._record.model_copy(update=how), None
        self._machine.fire(trigger)
        self.session = self.holder = None
        self.voltages, self._codes = self.off, ()
        self._freshness.reset()
        if failure is not None:
            self.fail(failure)

    def _switch_off(self) -> Exception | None:
        """Bring the motors to 0 V now, by all means there are. Returns what prevented it; None if nothing did."""
        return None

    def _notice(self, kind: EventKind, text: str) -> None:
        self.notices.append(Notice(kind, text, self.session, self.event_tick))


# ── one tick of a plant ──


class Endpoint(VehicleClaim):
    """One plant behind its injected faults. At its `limits`, if there are any, it trips, too.

    Raises ValueError if the wire commands another number of actuators than the plant has.
    """

    def __init__(
        self,
        plant: Plant,
        wire: WireSpec,
        period_ns: int,
        *,
        lockstep: bool = False,
        watchdog_s: float = WATCHDOG_S,
        limits: LimitMonitor | None = None,
        armed: bool = False,
        faults: Faults | None = None,
    ) -> None:
        if plant.actuators != wire.actuators:
            raise ValueError(f"wire.actuators is {wire.actuators}, but the plant has {plant.actuators} actuators")
        super().__init__(wire, period_ns, lockstep=lockstep, watchdog_s=watchdog_s, armed=armed)
        self.plant = plant
        self._closed = False  # whether the plant was closed because it refused 0 V
        self.outgoing: list[bytes] = []  # after a tick: what the faults of frames leave of the measurement, in order
        self._faults, self._limits = faults or Faults(plant.actuators, period_ns * 1e-9), limits
        self._malformed = bytes(wire.command.size + 1)  # stands for every command of a wrong length
        self._quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
        self._no_measurement = [quantizer.invalid for quantizer in self._quantizers]
        heartbeat = wire.transmit.heartbeat_ticks(period_ns, self._counters)
        self._sender = Sender(wire.transmit.measurement, heartbeat, self._counters)
        # On change and without lockstep, a controller learns that values are valid again only from the next frame that
        # it receives in time, a heartbeat later at most: until then its commands may still have no valid value.
        clocked = wire.transmit.measurement == "on_change" and not lockstep
        self._forgiven = heartbeat if clocked else 0
        self._last_session: str | None = None  # of the last tick
        self._measured = False  # whether the session has a measurement
        self._invalid = [False] * self._counters  # whether the last measurement of each counter had no valid value

    @property
    def saturated(self) -> int:
        """Measured values beyond their quantizer's range so far."""
        return sum(quantizer.saturated for quantizer in self._quantizers)

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Apply the newest command, advance the plant to tick k, and measure.

        Args:
            frame: The newest command frame received since the last tick, or None; in lockstep UNCHANGED if the command
                has not changed.
            k: Tick index, from 0, rising. If it skips, the plant advances by all skipped periods. The first call
                ignores the frame: nothing was measured before it.

        Returns:
            The measurement frame, before its faults; UNCHANGED if it would repeat the last one; None without a session.

        Raises:
            Exception: What the plant raises, and `failure`, after which no tick touches the plant.
        """
        self.raise_failure()
        faults = self._faults
        if self.session != self._last_session:
            self._last_session = self.session
            faults.forget_frames()
            if self.session is not None:
                faults.start()
        if frame and len(frame) != self.wire.command.size:
            frame = self._malformed
        commands = faults.passes("command", frame)
        self.outcome = Outcome.NONE if commands or frame is None else Outcome.WITHHELD
        self.plant.enable(self.session is not None)
        measurement = self._advanced(commands[-1] if commands else None, k)
        if measurement == UNCHANGED and not self.lockstep:  # not a frame, so no fault acts on it
            self.outgoing = faults.passes("measurement", None) or [UNCHANGED]
        else:
            self.outgoing = faults.passes("measurement", measurement)
        self._note_faults(faults.transitions())
        return measurement

    def _advanced(self, command: bytes | None, k: int) -> bytes | None:
        """Command in, periods pass, measurement out: without the faults of frames."""
        if self.ticked < 0:
            self.ticked = 0
        elif command is not None and self.session is not None:
            self.outcome = self._command(command, self._now_ns)
        while self.ticked < k:
            if (reason := self._freshness.overdue(self._now_ns)) is not None:
                self._trip(TripCause.COMMAND_TIMEOUT, reason)
            self._actuate()
            self.plant.advance()
            self.ticked += 1
            self._faults.advance(self.plant)
        if self.session is None:
            return None
        if not self._measured:  # the first measurement has counter 0, whichever tick it is
            self._measured = True
            self._start = self.ticked
            self._freshness.measured(self._now_ns)
        seen = self._faults.measure(self.plant)
        if self._limits is not None and (trip := self._limits.check(seen, self.voltages)) is not None:
            self._trip(*trip)
            # The plant has 0 V. Faults by chance draw a number here, as they did in every log so far.
            self._faults.voltages(self.voltages)
            return None
        codes = self._no_measurement
        if valid := isfinite(sum(seen.attitude) + sum(seen.rate)):
            values = (*sent_vector(seen.attitude), *seen.rate)
            codes = [quantizer.encode(value) for quantizer, value in zip(self._quantizers, values, strict=True)]
        self._invalid[self.counter] = not valid
        return self.wire.measurement.pack(self.counter, codes) if self._sender.due(k, codes) else UNCHANGED

    def _actuate(self) -> None:
        """Put the voltages in force, as the motors' faults leave them. Raises `failure`."""
        self.raise_failure()
        self.plant.actuate(self._faults.voltages(self.voltages))

    def _switch_off(self) -> Exception | None:
        """Set 0 V and switch the power stage off, past all injected faults; a plant that refuses either is closed."""
        if self._closed:
            return None
        failure: Exception | None = None
        try:
            self.plant.actuate(self.off)
        except Exception as error:
            failure = error
        try:
            self.plant.enable(False)
        except Exception as error:
            failure = failure or error
        if failure is not None:
            self._closed = True
            with suppress(Exception):  # the first failure is the one to show
                self.plant.close()
        return failure

    @property
    def _now_ns(self) -> int:
        return self.ticked * self.period_ns

    def _may_be_invalid(self, echo: int) -> bool:
        return any(self._invalid[(echo - ago) % self._counters] for ago in range(self._forgiven + 1))

    def _begin(self) -> None:
        super()._begin()
        if self._limits is not None:
            self._limits.reset()
        for quantizer in self._quantizers:
            quantizer.reset()
        self._invalid = [False] * self._counters
        self._measured = False
        self._sender.forget()

    # ── faults and truth ──

    def inject(self, faults: Sequence[Fault], *, clear: bool = False) -> list[str]:
        """As `Faults.inject`. Returns what was done, a line each; they are events, too. Raises FaultError."""
        self._note_faults(self._faults.inject(faults, "injected", clear=clear))
        names = [*([None] if clear else []), *map(str, faults)]
        for name in names:
            self.record_change("inject", name=name)
        done = ["no faults any more" if name is None else f"fault injected: {name}" for name in names]
        self._note_faults([(self._faults.ticks, text) for text in done])
        return done

    def fault_statuses(self) -> list[FaultStatus]:
        """Status of every fault."""
        ticks = self._faults.ticks
        return self._faults.statuses(None if ticks < 0 else self.ticked - ticks)

    def truth(self) -> Truth | None:
        """The present true state, with the tick of the measurement taken of it; None where the plant has none."""
        state = self.plant.truth()
        return state and Truth(
            tick=self.ticked,
            attitude=state.attitude,
            rate=state.rate,
            voltages=state.voltages,
            signals={name: value if isfinite(value) else None for name, value in state.signals.items()},
            session=self.session,
            session_tick=None if self.session is None else self.session_tick,
        )

    def _note_faults(self, transitions: Sequence[Transition]) -> None:
        """Queue events of faults, with the session's tick if there was one then."""
        for at, text in transitions:
            tick = self.event_tick
            if tick is not None:
                tick = max(0, tick + at - self._faults.ticks)
            self.notices.append(Notice("fault", text, self.session, tick))
