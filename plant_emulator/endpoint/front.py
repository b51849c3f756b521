"""Network interface of a plant end.

A Driver runs a plant; a Front connects it to the network: ZenohFront to Zenoh, CanFront to a CAN bus. Only the driver's
thread calls it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from aeroloop.protocol.runtime.timing import LoopTiming
from aeroloop.protocol.transport.link import Arrival, Link


class Front(ABC):
    """Network side of a driver.

    Attributes:
        timing: Timing of the driver's loop; None in lockstep.
        skipped: Ticks of sessions that the driver missed.
        notes: Real-time settings that the machine refused.
    """

    def __init__(self) -> None:
        self.timing: LoopTiming | None = None
        self.skipped = 0
        self.notes: list[str] = []

    @property
    @abstractmethod
    def link(self) -> Link | None:
        """Link of the session's frames; None without a session."""

    @abstractmethod
    def serve(self) -> None:
        """Start serving the network."""

    @abstractmethod
    def take_inbox(self) -> None:
        """Between two ticks, process what was received: claims, releases, operator commands."""

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send a measurement frame; SILENCE is sent only in lockstep, where the controller cannot detect it by time."""

    @abstractmethod
    def follow_session(self) -> None:
        """Publish events, and close the link of a session that ended."""

    @abstractmethod
    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """After the measurement was sent: write the tick's trace row, publish events and a status that is due.

        Args:
            measurement: The endpoint's frame; SILENCE if it is not to be sent, None if there is none.
            arrival: The command received since the last tick, before any injected fault; None for none.
            sent_ns: When the measurement was sent, on `time.monotonic_ns()`.
        """

    @abstractmethod
    def publish_when_due(self) -> None:
        """Publish the status if it is due."""

    @abstractmethod
    def publish_status(self) -> None:
        """Publish the status."""

    @abstractmethod
    def leave(self) -> None:
        """Publish that the plant stopped at 0 V, and leave the network."""
