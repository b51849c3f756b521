"""The plant as a node on a CAN bus: what the firmware of a real one would do, watchdog included.

It knows no Zenoh and no claims. While the controller's side says granted on its heartbeat, with the node's own
fingerprint, the node is in the session whose number that heartbeat gives: it counts its measurements from 0, takes
commands, and looks after itself. What it does is on its own heartbeat.
"""

from __future__ import annotations

import logging
import time
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.front import Front
from aeroloop.protocol.messages.models import Claim
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.runtime.throttle import Throttle
from aeroloop.protocol.transport.can_link import (
    HEARTBEAT_S,
    CanLink,
    CanSettings,
    Heartbeat,
    fingerprint,
    number_of,
)
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.loop import LoopSettings

log: Final = logging.getLogger("aeroloop")

REOPEN_S: Final = 0.5
MASTER: Final = "the controller's side"


class CanFront(Front):
    """A plant end on a CAN bus.

    Args:
        settings: The bus, and which node this is.
        loop: The grid.
        endpoint: Who grants, refuses and trips.

    Raises:
        CanError: The bus cannot be opened, or a frame does not fit it.
    """

    def __init__(self, settings: CanSettings, loop: LoopSettings, endpoint: Endpoint) -> None:
        super().__init__()
        self._settings = settings
        self._loop = loop
        self._endpoint = endpoint
        self._bus = CanLink(settings, endpoint.wire, "plant", lockstep=loop.lockstep)
        self._fingerprint = fingerprint(endpoint.wire, loop.period_ns, lockstep=loop.lockstep)
        self._number = -1  # of the session
        self._throttle = Throttle()
        self._beat_due = 0.0
        self._told = endpoint.state
        self._reopen_due = 0.0

    @property
    def link(self) -> Link | None:
        """The session's frames; None while there is no session."""
        return self._bus if self._endpoint.session is not None else None

    def serve(self) -> None:
        """Be there from now on."""
        log.info("node %d waits on %s:%s", self._settings.node, self._settings.interface, self._settings.channel)
        self.publish_status()

    def take_inbox(self) -> None:
        """Follow the controller's side: a session that begins, ends, or whose other end is gone."""
        bus, endpoint = self._bus, self._endpoint
        if bus.fault is not None:
            self._mend(bus.fault)
        heard = bus.peer
        gone = heard is None or bus.silent
        if gone or heard is None or heard.state is not PlantState.GRANTED:
            if endpoint.session is not None:
                if gone:
                    endpoint.lost(MASTER)
                else:
                    endpoint.release(endpoint.session)
                self.follow_session()
            self._number = -1
        elif heard.number != self._number:
            if endpoint.session is not None:
                endpoint.release(endpoint.session)
            self._begin(heard)
            self.follow_session()

    def send(self, frame: bytes) -> None:
        """Send a measurement frame of the session; SILENCE only where it could not be heard, in lockstep."""
        if frame or self._loop.lockstep:
            self._bus.send(frame)

    def follow_session(self) -> None:
        """Tell what happened, on the heartbeat at once and on stderr."""
        for notice in self._endpoint.notices:
            log.log(logging.WARNING if notice.kind == "tripped" else logging.INFO, "node: %s", notice.text)
        self._endpoint.notices.clear()
        self._endpoint.operations.clear()  # the bridge writes the trace
        if self._endpoint.state is not self._told:
            self._told = self._endpoint.state
            self.publish_status()

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """Tell what happened. The trace is written at the bridge."""
        del measurement, arrival, sent_ns
        self.follow_session()
        self.publish_when_due()

    def publish_when_due(self) -> None:
        """Beat, ten times a second."""
        if time.monotonic() >= self._beat_due:
            self.publish_status()

    def publish_status(self) -> None:
        """Beat."""
        self._beat_due = time.monotonic() + HEARTBEAT_S
        self._bus.beat(Heartbeat(self._endpoint.state, number_of(self._endpoint.trip), self._fingerprint))

    def leave(self) -> None:
        """Say idle, and leave the bus."""
        if self._endpoint.session is not None:
            self._endpoint.release(self._endpoint.session)
        self.follow_session()
        self._bus.close()

    def _begin(self, heard: Heartbeat) -> None:
        if heard.fingerprint != self._fingerprint:
            if self._throttle.let_pass("fingerprint") is not None:
                log.warning("node: the controller's side has another wire spec, so it is not followed")
            return
        self._number = heard.number
        self._bus.take()  # what came before the session is not of it
        self._endpoint.claim(
            Claim(
                controller=MASTER,
                session=f"can-{heard.number}",
                period_ns=self._loop.period_ns,
                lockstep=self._loop.lockstep,
                auto_arm=True,  # who may drive is decided at the other side of the bus
                wire=self._endpoint.wire,
            )
        )

    def _mend(self, fault: str) -> None:
        if self._throttle.let_pass("bus") is not None:
            log.warning("node: %s; trying again twice a second", fault)
        if time.monotonic() >= self._reopen_due:
            self._reopen_due = time.monotonic() + REOPEN_S
            self._bus.reopen()
