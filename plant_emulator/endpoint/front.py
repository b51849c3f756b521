"""How a plant end is seen: the side of it that controllers, bridges and operators are on.

A Driver runs a plant; a Front connects it to the network: a ZenohFront on Zenoh, a CanFront on a CAN bus.
Everything here is called by the driver's thread, between ticks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from aeroloop.protocol.runtime.timing import LoopTiming
from aeroloop.protocol.transport.link import Arrival, Link


class Front(ABC):
    """What a driver asks of the network.

    Attributes:
        timing: How well the driver's loop keeps time, if it keeps any.
        skipped: Ticks of sessions that the driver missed.
        notes: What the machine refused.
    """

    def __init__(self) -> None:
        self.timing: LoopTiming | None = None
        self.skipped = 0
        self.notes: list[str] = []

    @property
    @abstractmethod
    def link(self) -> Link | None:
        """The session's frames; None while there is no session."""

    @abstractmethod
    def serve(self) -> None:
        """Be there from now on."""

    @abstractmethod
    def take_inbox(self) -> None:
        """Do what has come for the time between two ticks: claims, releases, an operator's words."""

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send a measurement frame of the session; SILENCE only where it could not be heard, in lockstep."""

    @abstractmethod
    def follow_session(self) -> None:
        """Tell what happened, and close the link of a session that ended."""

    @abstractmethod
    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """Account for a tick once its measurement is out: its row of the trace, what happened, a status that is due.

        Args:
            measurement: As the endpoint made it; SILENCE where it has nothing new, None where there is none.
            arrival: What was received since the last tick, before any injected fault; None for nothing.
            sent_ns: When the measurement was sent, on `time.monotonic_ns()`.
        """

    @abstractmethod
    def publish_when_due(self) -> None:
        """Tell how things are, if it is time to."""

    @abstractmethod
    def publish_status(self) -> None:
        """Tell how things are."""

    @abstractmethod
    def leave(self) -> None:
        """Tell that the plant is at 0 V and goes."""
