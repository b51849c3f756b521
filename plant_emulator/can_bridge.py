"""The bridge: a plant on a CAN bus, as controllers on Zenoh see it.

On Zenoh it is the plant: it grants and refuses claims, trips, and tells status and events. On the bus it is the
controller's side. Frames pass as they are, byte for byte. It keeps a watchdog of its own, besides the node's, and trips
when the bus fails or the node falls silent, has another wire spec or trips itself; when the bus is back it takes it up
again by itself, and the plant is driven again once it is armed.
"""

from __future__ import annotations

import time
from threading import Condition
from typing import Final, Literal

from plant_emulator.presence import Presence
from plant_emulator.settings import PlantSettings
from plant_emulator.tenancy import Tenancy
from protocol.can_link import HEARTBEAT_S, SILENT_S, CanLink, CanSettings, Heartbeat, fingerprint
from protocol.clock import FIRST_COMMAND_S, LoopSettings, prepare_process
from protocol.role import Role
from protocol.states import PlantState, PlantTrigger, TripCause
from protocol.transmit import SILENCE
from protocol.wire import WireSpec

WAIT_S: Final = 0.01
REOPEN_S: Final = 0.5
SESSIONS: Final = 16


class Relay(Tenancy):
    """Who may drive a plant that is elsewhere, and the watchdog on this side of the wire; sans-I/O.

    Args:
        wire: What the frames are.
        period_ns: Period of a tick [ns].
        lockstep: Whether each answer is waited for.
        watchdog_s: The session ends after this long without a fresh command [s].
        armed: Whether the first claim is granted without anybody arming it.

    Attributes:
        number: Of the session, as the bus knows it.
        counter: Of the last measurement that passed.
    """

    def __init__(self, wire: WireSpec, period_ns: int, *, lockstep: bool, watchdog_s: float, armed: bool) -> None:
        super().__init__(wire, period_ns, lockstep=lockstep, armed=armed)
        self.number = 0
        self.counter = 0
        self.protect(watchdog_s)
        self._echo = -1
        self._begun = False  # the first measurement of a session has counter 0; what comes before is of another
        self._fresh_ns: int | None = None  # when the last fresh command passed, or the session began

    def protect(self, watchdog_s: float) -> None:
        """Use another watchdog time from now on [s]."""
        self._watchdog_ns = round(watchdog_s * 1e9)

    def measurement(self, frame: bytes) -> bytes | None:
        """A frame from the bus; returned if it may pass."""
        if self.session is None:
            return None
        if self._is_silence(frame, "measurement"):
            self.counter = (self.counter + 1) % self.wire.measurement.counters
            return frame if self._begun else None
        read = self.wire.measurement.unpack(frame)
        if read is None:
            self.refused += 1
            return None
        self.counter = read[0]
        self._begun = self._begun or self.counter == 0
        return frame if self._begun else None

    def command(self, frame: bytes, now_ns: int) -> bytes | None:
        """A frame from the controller that has the session; returned if it may pass.

        Whether it is newer than the last is the node's to say; what repeats an echo does not feed the watchdog.
        """
        if self.session is None:
            return None
        if self._is_silence(frame, "command") and self.state is PlantState.DRIVEN:
            self._fresh_ns = now_ns
            return frame
        read = self.wire.command.unpack(frame)
        if read is None:
            self.refused += 1
            return None
        if read[0] != self._echo:
            self._echo, self._fresh_ns = read[0], now_ns
            self._machine.fire(PlantTrigger.COMMAND)
        return frame

    def watch(self, now_ns: int) -> None:
        """End the session when no fresh command came in time. In lockstep the node waits as long as it likes."""
        if self.session is None:
            return
        if self._fresh_ns is None:
            self._fresh_ns = now_ns
        waited_ns = now_ns - self._fresh_ns
        if self.state is PlantState.GRANTED and waited_ns > FIRST_COMMAND_S * 1e9:
            self._trip(TripCause.COMMAND_TIMEOUT, f"no first command within {FIRST_COMMAND_S:g} s")
        elif self.state is PlantState.DRIVEN and waited_ns > self._watchdog_ns and not self.lockstep:
            self._trip(TripCause.COMMAND_TIMEOUT, f"no fresh command for {waited_ns * 1e-6:.0f} ms")

    def _is_silence(self, frame: bytes, direction: Literal["measurement", "command"]) -> bool:
        return frame == SILENCE and self.lockstep and getattr(self.wire.transmit, direction) == "on_change"

    def _begin(self) -> None:
        self.number = (self.number + 1) % SESSIONS
        self._echo, self._fresh_ns, self._begun = -1, None, False


class Bridge:
    """The bridge as a process.

    Args:
        role: Its name on Zenoh.
        loop: The grid.
        wire: What the frames are.
        settings: How the plant end looks after itself.
        bus: The CAN bus, and which node of it the plant is.

    Raises:
        CanError: The bus cannot be opened, or a frame does not fit it.
    """

    def __init__(
        self, role: Role, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, bus: CanSettings
    ) -> None:
        self._role = role
        self._loop = loop
        self._node = bus.node
        self._relay = Relay(
            wire,
            loop.period_ns,
            lockstep=loop.lockstep,
            watchdog_s=settings.watchdog_s,
            armed=settings.armed_at_start,
        )
        self._changed = Condition()
        self._bus = CanLink(bus, wire, "controller", self._changed, lockstep=loop.lockstep)
        self._presence = Presence(role, loop, self._relay, latest_s=settings.watchdog_s, changed=self._changed)
        self._fingerprint = fingerprint(wire, loop.period_ns, lockstep=loop.lockstep)
        self._beat_due = 0.0
        self._reopen_due = 0.0
        self._told = self._relay.state
        self._passed = 0
        self._machine_notes: list[str] = []
        self._granted_ns = 0

    def run(self) -> None:
        """Run until the role is told to stop; then the node is released, and a last status told."""
        presence, relay = self._presence, self._relay
        if not self._loop.lockstep:
            presence.notes = self._machine_notes = prepare_process(self._loop)
        presence.serve()
        try:
            while not self._role.stop.is_set():
                with self._changed:
                    self._changed.wait_for(self._frame_came, WAIT_S)
                relay.unavailable = self._unavailable()
                presence.take_inbox()
                self._follow()
                self._pass_frames()
                relay.watch(time.monotonic_ns())
                self._watch_node()
                self._follow()
                if self._bus.errors or self._bus.refused:
                    count = f"the bus: {self._bus.errors} errors, {self._bus.refused} malformed frames"
                    presence.notes = [*self._machine_notes, count]
                presence.after_tick(self._passed - 1)
        finally:
            if relay.session is not None:
                relay.release(relay.session)
            self._beat()
            self._bus.close()
            presence.leave()

    def reconfigure(self, settings: PlantSettings) -> None:
        """Take over what can change between two ticks: the watchdog."""
        self._relay.protect(settings.watchdog_s)

    def _frame_came(self) -> bool:
        link = self._presence.link
        return self._bus.pending or (link is not None and link.pending)

    def _pass_frames(self) -> None:
        arrival = self._bus.take()
        if arrival is not None and self._relay.measurement(arrival.frame) is not None:
            self._presence.send(arrival.frame, self._relay.counter)
            self._passed += 1
        arrival = self._presence.link.take() if self._presence.link else None
        if arrival is not None and self._presence.arrived(arrival):
            frame = self._relay.command(arrival.frame, time.monotonic_ns())
            if frame is not None:
                self._bus.send(frame)

    def _watch_node(self) -> None:
        """Trip when the bus or the node cannot be relied on any more."""
        relay, bus = self._relay, self._bus
        if bus.fault is not None:
            relay.expire(TripCause.BUS, bus.fault)
            self._mend(bus.fault)
            return
        heard = bus.heard
        if relay.session is None or heard is None:
            return
        if bus.silent_s() > SILENT_S:
            relay.expire(TripCause.NODE, f"node {self._node} has been silent for {bus.silent_s() * 1e3:.0f} ms")
        elif heard.at_ns < self._granted_ns:
            return  # it speaks of what was before this session
        elif heard.fingerprint != self._fingerprint:
            relay.expire(TripCause.NODE, f"node {self._node} has another wire spec now")
        elif heard.state is PlantState.IDLE:
            relay.expire(TripCause.NODE, f"node {self._node} was started again")
        elif heard.state is PlantState.TRIPPED:
            relay.expire(heard.cause or TripCause.NODE, f"node {self._node} tripped: {heard.cause or 'no cause told'}")

    def _unavailable(self) -> str | None:
        bus = self._bus
        if bus.fault is not None:
            return bus.fault
        if bus.heard is None or bus.silent_s() > SILENT_S:
            return f"node {self._node} is silent on the bus"
        if bus.heard.fingerprint != self._fingerprint:
            return f"node {self._node} has another wire spec, period or lockstep setting than the bridge"
        return None

    def _follow(self) -> None:
        """Beat when it is due, and at once when the state has changed: the node follows it."""
        relay = self._relay
        if relay.state is not self._told:
            if relay.state is PlantState.GRANTED:
                self._bus.take()  # what came before the session is not of it
                # The node's state is told ten times a second, and at once when it changes: what it says from here on
                # may still be of before for as long as the first of our heartbeats takes.
                self._granted_ns = time.monotonic_ns() + round(HEARTBEAT_S * 1e9)
            self._told = relay.state
            self._beat()
        elif time.monotonic() >= self._beat_due:
            self._beat()

    def _beat(self) -> None:
        driven = self._relay.session is not None
        state = PlantState.GRANTED if driven else PlantState.IDLE
        self._beat_due = time.monotonic() + HEARTBEAT_S
        self._bus.beat(Heartbeat(state, self._relay.number, self._fingerprint))

    def _mend(self, fault: str) -> None:
        self._role.warn("bus", "fault", f"{fault}; trying again twice a second")
        if time.monotonic() >= self._reopen_due:
            self._reopen_due = time.monotonic() + REOPEN_S
            if self._bus.reopen():
                self._role.event("changed", "the bus is open again")
