"""Plant as a node on a CAN bus: does what the firmware of a real node does, watchdog included.

While the controller side's heartbeat says granted, with the node's own fingerprint, the node is in the session with
that heartbeat's number: it counts its measurements from 0, applies commands, and trips on its own watchdog and limits.
The node's own heartbeat carries its state.
"""

from __future__ import annotations

import time
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.driver import PlantNetwork
from aeroloop.protocol.messages.models import Claim, Event, EventKind
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.runtime.node import log_event
from aeroloop.protocol.runtime.timing import Throttle
from aeroloop.protocol.transport.can_format import CanSettings, Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.spec import LoopSettings

MASTER: Final = "the controller's side"


class CanNetwork(PlantNetwork):
    """A plant end on a CAN bus. Raises CanError: the bus cannot be opened, or a frame does not fit it."""

    def __init__(self, settings: CanSettings, loop: LoopSettings, endpoint: Endpoint) -> None:
        super().__init__()
        self._settings, self._loop, self._endpoint = settings, loop, endpoint
        self._bus = CanLink(settings, endpoint.wire, "plant", lockstep=loop.lockstep)
        self._fingerprint = fingerprint(endpoint.wire, loop.period_ns, lockstep=loop.lockstep)
        self._number: int | None = None  # of the session
        self._throttle = Throttle()

    @property
    def link(self) -> Link | None:
        return self._bus if self._endpoint.session is not None else None

    def serve(self) -> None:
        bus = self._settings
        self._log("started", f"node {bus.node} waits on {bus.interface}:{bus.channel}")
        self.follow_session()

    def take_inbox(self) -> None:
        """Follow the controller side's heartbeat: begin, end or lose a session."""
        bus, endpoint = self._bus, self._endpoint
        if bus.fault is not None:
            endpoint.lost(MASTER)  # before the bus is opened again, which may take longer than the watchdog
            self._warn("bus", "fault", f"{bus.fault}; trying again twice a second")
            bus.reopen()
        peer = bus.peer
        if peer is None or bus.silent:
            endpoint.lost(MASTER)
            self._number = None
        elif peer.state is not PlantState.GRANTED or peer.number != self._number:
            if endpoint.session is not None:
                endpoint.release(endpoint.session)
            self._number = None
            if peer.state is PlantState.GRANTED:
                self._begin(peer)
        self.follow_session()

    def wait_for_inbox(self, timeout_s: float) -> None:
        """Sleep: the bus has no event for what it receives."""
        time.sleep(timeout_s)

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        del measurement, arrival, sent_ns
        self.follow_session()

    def follow_session(self) -> None:
        endpoint = self._endpoint
        for notice in endpoint.notices:
            self._log(*notice)
        endpoint.notices.clear()
        endpoint.changes.clear()  # they belong to the trace
        self.publish_status()

    def publish_status(self) -> None:
        """Send a heartbeat that is due, or that says something new."""
        endpoint = self._endpoint
        cause = endpoint.trip.number if endpoint.trip else 0
        self._bus.beat_when_due(Heartbeat(endpoint.state, cause, self._fingerprint))

    def leave(self) -> None:
        try:
            self.follow_session()
        finally:
            self._bus.close()

    def _begin(self, peer: Heartbeat) -> None:
        if peer.fingerprint != self._fingerprint:
            self._warn("fingerprint", "refused", "the controller's side has another wire spec, so it is not followed")
            return
        self._number, session = peer.number, f"can-{peer.number}"
        self._bus.take()  # drop a frame from before the session
        # It arms the node: the bridge holds the latch and decides on claims.
        period_ns, lockstep, wire = self._loop.period_ns, self._loop.lockstep, self._endpoint.wire
        self._endpoint.claim(
            Claim(controller=MASTER, session=session, period_ns=period_ns, lockstep=lockstep, auto_arm=True, wire=wire)
        )

    def _log(self, kind: EventKind, text: str, session: str | None = None, tick: int | None = None) -> None:
        """Log an event; on the bus there is no place for its text, and none for the vehicle's name."""
        log_event(Event(role="node", kind=kind, text=text, session=session, tick=tick), None)

    def _warn(self, about: str, kind: EventKind, text: str) -> None:
        if self._throttle.let_pass(about) is not None:
            self._log(kind, text)
