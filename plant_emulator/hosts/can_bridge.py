"""Bridge between Zenoh and a plant on a CAN bus.

On Zenoh it is the plant, on the bus the controller's side. Frames pass unchanged, byte for byte, and a tick is a
forwarded measurement. It runs its own watchdog besides the node's and trips when the bus fails or the node is silent,
has another wire spec or trips. It reopens a failed bus by itself; the plant is driven again once it is armed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Condition
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import VehicleClaim
from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.runtime.realtime import collect_garbage, prepare_process
from aeroloop.protocol.transport.can_format import HEARTBEAT_S, CanSettings, Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.frames import TickCounter
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED

WAIT_S: Final = 0.01
SESSIONS: Final = 16


class Relay(VehicleClaim):
    """Claims, sessions and watchdog for a plant on a bus, sans-I/O; `number` is the session's on the bus."""

    def __init__(self, wire: WireSpec, period_ns: int, *, lockstep: bool, watchdog_s: float, armed: bool) -> None:
        super().__init__(wire, period_ns, lockstep=lockstep, watchdog_s=watchdog_s, armed=armed)
        self.release_node: Callable[[], None] = lambda: None  # called first of all when a session ends
        self.number = 0
        self._ticks = self._tick_counter()
        self._silent_measurements = lockstep and wire.transmit.measurement == "on_change"
        self._judged = Outcome.NONE  # of the last command since the last tick

    def measurement(self, frame: bytes, at_ns: int) -> bytes | None:
        """Take a frame that the bus delivered at `at_ns` on the monotonic clock [ns].

        Returns it if it is to be forwarded, which makes a tick. A session begins with counter 0; frames before it are
        of another session. A frame that repeats the last one, or that a newer one has overtaken, is no tick; the rule
        is that of the controller's own counter.
        """
        if self.session is None:
            return None
        begun = self.session_tick >= 0
        if frame == UNCHANGED and self._silent_measurements:
            if not begun:
                return None
            self._ticks.tick += 1
        else:
            counter = self.wire.measurement.counter(frame)
            if counter is None:
                self.refused += 1
                return None
            if not begun and counter != 0:
                return None
            if self._ticks.advance(counter, at_ns) is None:
                return None
        if not begun:
            self._freshness.measured(None)  # the wait for the first command begins with the next `watch`
        self._count(self._ticks.tick - self.session_tick)
        return frame

    def command(self, frame: bytes, now_ns: int) -> bytes | None:
        """Take a controller's frame; returns it to forward, even if stale: the node judges it again."""
        if self.session is None:
            return None
        self._judged = self._command(frame, now_ns)
        return None if self._judged is Outcome.MALFORMED else frame

    def watch(self, now_ns: int) -> bool:
        """Trip if no fresh command was received in time; in lockstep only the first has a deadline. It is a tick."""
        if self.session is None or (self.lockstep and self.state is PlantState.DRIVEN):
            return False
        if self._freshness.since_ns is None:
            self._freshness.since_ns = now_ns
        if (reason := self._freshness.overdue(now_ns)) is None:
            return False
        self._count(1)
        self._trip(TripCause.COMMAND_TIMEOUT, reason)
        return True

    def _tick_counter(self) -> TickCounter:
        return TickCounter(self.period_ns, self._counters, lockstep=self.lockstep)

    def _switch_off(self) -> Exception | None:
        try:
            self.release_node()
        except Exception as error:
            return error
        return None

    def _count(self, ticks: int) -> None:
        self.ticked += ticks
        self.outcome, self._judged = self._judged, Outcome.NONE

    def _begin(self) -> None:
        super()._begin()
        self.number = (self.number + 1) % SESSIONS
        self._ticks = self._tick_counter()
        self._judged = Outcome.NONE


class Bridge:
    """The bridge's loop. Raises CanError: the bus cannot be opened, or a frame does not fit it."""

    def __init__(
        self, role: Node, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, bus: CanSettings
    ) -> None:
        self._role, self._loop, self._node = role, loop, f"node {bus.node}"
        self._relay = Relay(
            wire, loop.period_ns, lockstep=loop.lockstep, watchdog_s=settings.watchdog_s, armed=settings.armed_at_start
        )
        self._changed = Condition()
        self._bus = CanLink(bus, wire, "controller", self._changed, lockstep=loop.lockstep)
        self._network = ZenohNetwork(role, loop, self._relay, settings, self._changed)
        self._relay.release_node = self._release_node
        self._fingerprint = fingerprint(wire, loop.period_ns, lockstep=loop.lockstep)
        self._number = self._relay.number  # of the last session that the node was sent
        self._arrival: Arrival | None = None  # the last command since the last tick
        self._granted_ns = 0

    def run(self) -> None:
        """Run until the role stops; then release the node and publish a last status."""
        relay, bus = self._relay, self._bus
        try:
            self._forward()
        except Exception as error:
            relay.fail(error)
            raise
        finally:
            relay.leave()
            bus.close()
            self._network.leave()

    def _forward(self) -> None:
        """Forward frames until the role stops."""
        network, relay, bus = self._network, self._relay, self._bus
        network.notes = machine = [] if self._loop.lockstep else prepare_process(self._loop)
        network.serve()
        while not self._role.stop.is_set():
            with self._changed:
                self._changed.wait_for(self._frame_pending, WAIT_S)
            relay.unavailable = self._unavailable()
            network.take_inbox()
            relay.raise_failure()
            self._follow_state()
            self._pass_frames()
            if relay.watch(now_ns := time.monotonic_ns()):
                self._account(None, now_ns)
            self._watch_node()
            self._follow_state()
            if bus.errors or bus.refused:
                network.notes = [*machine, f"the bus: {bus.errors} errors, {bus.refused} malformed frames"]
            network.follow_session()
            collect_garbage()

    def _frame_pending(self) -> bool:
        link = self._network.link
        return self._bus.pending or (link is not None and link.pending)

    def _pass_frames(self) -> None:
        measured, link = self._bus.take(), self._network.link
        if link is None:
            return
        if measured is not None and self._relay.measurement(measured.frame, measured.at_ns) is not None:
            sent_ns = time.monotonic_ns()
            link.send(measured.frame)
            self._network.sent += measured.frame != UNCHANGED
            self._account(measured.frame, sent_ns)
        if (arrival := link.take()) is not None:
            self._arrival = arrival
            if (frame := self._relay.command(arrival.frame, time.monotonic_ns())) is not None:
                self._bus.send(frame)

    def _account(self, measurement: bytes | None, sent_ns: int) -> None:
        arrival, self._arrival = self._arrival, None
        self._network.after_tick(measurement, arrival, sent_ns)

    def _watch_node(self) -> None:
        """Trip when the bus fails, or the node is silent, tripped, restarted or of another wire spec."""
        relay, bus, node, peer = self._relay, self._bus, self._node, self._bus.peer
        if bus.fault is not None:
            relay.expire(TripCause.BUS, bus.fault)
            self._role.warn("bus", "fault", f"{bus.fault}; trying again twice a second")
            if bus.reopen():
                self._role.event("changed", "the bus is open again")
        elif relay.session is None or peer is None:
            return
        elif bus.silent:
            relay.expire(TripCause.NODE, f"{node} has been silent for {bus.silent_s() * 1e3:.0f} ms")
        elif peer.at_ns >= self._granted_ns:
            if peer.fingerprint != self._fingerprint:
                relay.expire(TripCause.NODE, f"{node} has another wire spec now")
            elif peer.state is PlantState.IDLE:
                relay.expire(TripCause.NODE, f"{node} was started again")
            elif peer.state is PlantState.TRIPPED:
                relay.expire(peer.cause or TripCause.NODE, f"{node} tripped: {peer.cause or 'no cause reported'}")

    def _unavailable(self) -> str | None:
        bus = self._bus
        if bus.fault is not None or bus.peer is None or bus.silent:
            return bus.fault or f"{self._node} is silent on the bus"
        if bus.peer.fingerprint != self._fingerprint:
            return f"{self._node} has another wire spec, period or lockstep setting than the bridge"
        return None

    def _follow_state(self) -> None:
        """Send a heartbeat when it is due, and at once when a session begins or ends: the node follows it."""
        relay = self._relay
        if relay.number != self._number:
            self._number = relay.number
            self._bus.take()  # drop a frame from before the session
            self._arrival = None
            # The node sends its state ten times a second and at every change. Until it has received the first
            # heartbeat of this session, it may still send its state of before.
            self._granted_ns = time.monotonic_ns() + round(HEARTBEAT_S * 1e9)
        state = PlantState.GRANTED if relay.session else PlantState.IDLE
        self._bus.beat_when_due(Heartbeat(state, relay.number, self._fingerprint))

    def _release_node(self) -> None:
        """Send the node the end of the session, at which it sets 0 V."""
        self._bus.beat(Heartbeat(PlantState.IDLE, self._relay.number, self._fingerprint))
