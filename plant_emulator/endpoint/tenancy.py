"""Who may drive a plant: claims, sessions and the latch that a trip leaves behind, sans-I/O.

One controller at a time, by name. Whoever stands at the plant end of a wire builds on this: the endpoint of a plant,
and the bridge to one that is elsewhere.

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

from typing import Any, NamedTuple

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Claim, EventKind, Grant, Refusal
from aeroloop.protocol.messages.states import PLANT_TABLE, Machine, PlantState, PlantTrigger, TripCause
from aeroloop.protocol.messages.trace import Operation, OperationKind, Outcome
from aeroloop.protocol.wire.loop import FIRST_COMMAND_S
from aeroloop.protocol.wire.spec import WireSpec


class Notice(NamedTuple):
    """Something for the `event` topic; `tick` is the session's, None before its first measurement."""

    kind: EventKind
    text: str
    session: str | None
    tick: int | None


class Trip(NamedTuple):
    """A reason to go to 0 V: its kind, and what exactly."""

    cause: TripCause
    reason: str


class Tenancy:
    """A plant that one controller at a time may drive.

    Args:
        wire: How frames are read and written here.
        period_ns: Period of a tick [ns].
        lockstep: Whether each answer is waited for; a claim must say the same.
        armed: Whether the first claim is granted without anybody arming it.

    Attributes:
        session: Name of the session it is in, or None.
        holder: Controller that holds it, or None.
        trip: The cause of the last trip, until it is cleared.
        notices: What happened since the owner last emptied this list.
        operations: What changed this end between its ticks since the owner last emptied this list.
        ticked: Index of the last tick; −1 before the first.
        outcome: What was done at the last tick with the command received before it.
        voltages: In force from the last tick to the next command [V]. Shape (actuators,).
        refused: Malformed frames so far.
        stale: Commands so far that answered a measurement older than the watchdog's time.
        unavailable: Why no claim can be granted now, for a reason that only the owner can see; None if there is none.
    """

    def __init__(self, wire: WireSpec, period_ns: int, *, lockstep: bool = False, armed: bool = False) -> None:
        self.wire = wire
        self.period_ns = period_ns
        self.lockstep = lockstep
        self.session: str | None = None
        self.holder: str | None = None
        self.trip: TripCause | None = None
        self.notices: list[Notice] = []
        self.operations: list[Operation] = []
        self.ticked = -1
        self.outcome = Outcome.NONE
        self.off = (0.0,) * wire.actuators
        self.voltages: tuple[float, ...] = self.off
        self.refused = self.stale = 0
        self.unavailable: str | None = None
        self._machine = Machine(PlantState.IDLE, PLANT_TABLE)
        self._latch: str | None = None if armed else "not armed since it was started"
        self._operator_stop = False

    @property
    def state(self) -> PlantState:
        """What it is doing."""
        return self._machine.state

    @property
    def cause(self) -> str | None:
        """Why claims are held back, or None."""
        return self._latch

    @property
    def session_tick(self) -> int:
        """Tick of the last measurement since the session's first, which has 0; −1 before that."""
        return -1

    @property
    def answered(self) -> int:
        """Session tick that the command in force answers; −1 for none."""
        return -1

    @property
    def event_tick(self) -> int | None:
        """The session tick of what happens now; None without a session and before its first measurement."""
        return self.session_tick if self.session is not None and self.session_tick >= 0 else None

    @property
    def saturated(self) -> int:
        """Values beyond their quantizer's range so far, where they are quantized here."""
        return 0

    def claim(self, claim: Claim) -> Grant | Refusal:
        """Grant a claim, or say which field differs or who holds the plant. The next tick measures first."""
        differences = self.wire.differences(claim.wire)
        if claim.protocol != PROTOCOL_VERSION:
            differences.append(f"protocol: {PROTOCOL_VERSION}, not {claim.protocol}")
        if claim.period_ns != self.period_ns:
            differences.append(f"period_ns: {self.period_ns}, not {claim.period_ns}")
        if claim.lockstep != self.lockstep:
            differences.append(f"lockstep: {self.lockstep}, not {claim.lockstep}")
        if self.unavailable is not None:
            return Refusal(reason=self.unavailable)
        if differences:
            return Refusal(reason=f"the plant has {'; '.join(differences)}", differences=differences)
        if self.session is not None:
            return Refusal(reason=f"the plant is held by {self.holder}", holder=self.holder)
        if claim.auto_arm and not self._operator_stop:
            self._clear()
        if self._latch is not None:
            return Refusal(reason=f"{self._latch}; `aeroloop op arm` clears it")
        self._machine.fire(PlantTrigger.GRANT)
        self.session, self.holder = claim.session, claim.controller
        self.operated("claim", claim=claim)
        self._begin()
        self._notice("claimed", f"granted to {claim.controller}")
        return Grant(session=claim.session)

    def release(self, session: str) -> bool:
        """End a session at its holder's wish: 0 V. False if it is not the session that runs."""
        if session != self.session:
            return False
        self.operated("release", name=session)
        self._end(PlantTrigger.RELEASE, "released", f"released by {self.holder}")
        return True

    def arm(self) -> bool:
        """Clear what holds claims back; the next one is granted. False while a controller holds the plant."""
        if self.session is not None:
            return False
        self.operated("arm")
        self._operator_stop = False
        self._clear()
        self._notice("armed", "armed by an operator: the next claim is granted")
        return True

    def stop(self) -> None:
        """An operator's stop, from any state: 0 V, and no claim is granted before `arm`."""
        self.operated("stop")
        self._trip(TripCause.OPERATOR, "stopped by an operator")
        self._operator_stop = True

    def lost(self, controller: str) -> None:
        """A controller's liveliness token went; if it held the plant, its session ends: 0 V."""
        if controller == self.holder:
            self.operated("lost", name=controller)
            self._trip(TripCause.HOLDER_GONE, f"{controller} is gone")

    def expire(self, cause: TripCause, reason: str) -> None:
        """End a session for a reason that only its owner can see, such as no answer in lockstep: 0 V."""
        if self.session is not None:
            self.operated("expire", cause=cause, reason=reason)
            self._trip(cause, reason)

    def operated(self, kind: OperationKind, **what: Any) -> None:
        """Note something that changed this end after its last tick; fields as in Operation."""
        self.operations.append(Operation(tick=self.ticked, kind=kind, **what))

    def first_command_ns(self, watchdog_ns: int) -> int:
        """How long a granted claim may wait for its first command [ns].

        An echo counts as fresh by its age modulo the counter. A stream that is late by a whole round of it would look
        fresh from its first command on, so that has to come before the counter is back at 0. A counter that is short
        by configuration cannot tell, and gets the usual time.

        Args:
            watchdog_ns: The watchdog's time [ns].
        """
        usual, counters = round(FIRST_COMMAND_S * 1e9), self.wire.measurement.counters
        if counters * self.period_ns < 2 * watchdog_ns:
            return usual
        return min(usual, (counters - 1) * self.period_ns)

    def _begin(self) -> None:
        """A session begins."""

    def _rest(self) -> None:
        """A session has ended: 0 V."""

    def _trip(self, cause: TripCause, reason: str) -> None:
        self._end(PlantTrigger.TRIP, "tripped", f"{reason}: 0 V")
        self._latch, self.trip = f"{reason}: 0 V", cause

    def _clear(self) -> None:
        self._latch = self.trip = None
        self._machine.fire(PlantTrigger.ARM)

    def _end(self, trigger: PlantTrigger, kind: EventKind, text: str) -> None:
        self._notice(kind, text)
        self._machine.fire(trigger)
        self.session = self.holder = None
        self._rest()

    def _notice(self, kind: EventKind, text: str) -> None:
        self.notices.append(Notice(kind, text, self.session, self.event_tick))
