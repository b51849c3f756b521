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

from typing import NamedTuple

from protocol.messages import PROTOCOL_VERSION, Claim, EventKind, Grant, Refusal
from protocol.states import PLANT_TABLE, Machine, PlantState, PlantTrigger, TripCause
from protocol.wire import WireSpec


class Notice(NamedTuple):
    """Something for the `event` topic."""

    kind: EventKind
    text: str
    session: str | None


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
        refused: Malformed frames so far.
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
        self.refused = 0
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
        self._begin()
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
        self._trip(TripCause.OPERATOR, "stopped by an operator")
        self._operator_stop = True

    def lost(self, controller: str) -> None:
        """A controller's liveliness token went; if it held the plant, its session ends: 0 V."""
        if controller == self.holder:
            self._trip(TripCause.HOLDER_GONE, f"{controller} is gone")

    def expire(self, cause: TripCause, reason: str) -> None:
        """End a session for a reason that only its owner can see, such as no answer in lockstep: 0 V."""
        if self.session is not None:
            self._trip(cause, reason)

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
        self.notices.append(Notice(kind, text, self.session))
