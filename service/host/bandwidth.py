"""Bandwidth: estimates payload bits a second in each direction from the counters in controller statuses.

A direction with a frame per tick has the rate of the ticks; one that sends on change has the frames counted between two
statuses.
"""

from __future__ import annotations

from typing import Final

from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.wire.spec import WireSpec

APART_S: Final = 0.5
"""Least time between two statuses for a rate; closer ones count too few frames [s]."""


class PayloadRate:
    """Payload bits a second in each direction."""

    def __init__(self) -> None:
        self._rate_hz = 0.0
        self._before: Status | None = None
        self._frames_per_s: tuple[float, float] | None = None  # measurements and commands

    def receive(self, status: Status) -> None:
        """Add a status of the controller."""
        self._rate_hz = status.rate_hz
        before, passed_s = self._before, 0.0
        if before is not None and (passed_s := status.uptime_s - before.uptime_s) >= APART_S:
            self._frames_per_s = (
                (status.received - before.received) / passed_s,
                (status.sent - before.sent) / passed_s,
            )
        if before is None or passed_s >= APART_S or passed_s < 0:  # negative: the controller was restarted
            self._before = status

    def bits_per_s(self, wire: WireSpec) -> tuple[float, float]:
        """Payload bits a second of measurements and of commands, padding included; at first the maximum."""
        counted = self._frames_per_s or (self._rate_hz, self._rate_hz)
        measurements = counted[0] if wire.transmit.measurement == "on_change" else self._rate_hz
        commands = counted[1] if wire.transmit.command == "on_change" else self._rate_hz
        return 8 * wire.measurement.size * measurements, 8 * wire.command.size * commands
