"""Set-points that an operator streams on `reference`: the newest since the last tick, those refused, and silence."""

from __future__ import annotations

from typing import Final

from zenoh.handlers import RingChannel

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Hold, MessageError, Setpoint, Stream
from aeroloop.protocol.runtime.node import Node
from aeroloop.service.control.reference import FollowError, Limits, Plan

SETPOINTS: Final = 4
"""Set-points of a stream that are read before a tick; of more, the newest."""


class SetpointStream:
    """Set-points received for a role's vehicle, read in the loop.

    Attributes:
        session: The session that events name.
        refused: Set-points so far that were malformed, or beyond the limits.
    """

    def __init__(self, role: Node) -> None:
        self._role = role
        self._received = role.zenoh.declare_subscriber(topics.key("reference", role.vehicle), RingChannel(SETPOINTS))
        self._last_s = 0.0  # when the last one was read, or the stream begun; 0 once its silence was an event
        self.session = ""
        self.refused = 0

    def discard(self) -> None:
        """Discard those received before now, which are of the previous stream or session."""
        while self._received.try_recv() is not None:
            pass

    def begin(self) -> None:
        """Begin a stream: silence counts from now on."""
        self.discard()
        self._last_s = self._role.clock.monotonic()

    def newest(self, stream: Stream, limits: Limits, k: int) -> tuple[Hold, Plan] | None:
        """The newest set-point received since the last tick that is not refused; silence of `timeout_s` is an event."""
        now, newest = self._role.clock.monotonic(), None
        for _ in range(SETPOINTS):
            if (sample := self._received.try_recv()) is None:
                break
            try:
                hold = Hold(attitude=Setpoint.decode(sample.payload.to_bytes()).attitude)
                plan = Plan.of(hold)
                plan.check(limits)
            except (MessageError, FollowError) as error:
                self.refuse(error)
            else:
                newest = hold, plan
        if newest is not None:
            self._last_s = now
        elif self._last_s and now - self._last_s > stream.timeout_s:
            self._last_s = 0.0
            text = f"no set-point for {stream.timeout_s:g} s: holds the last one"
            self._role.event("lost", text, self.session, k)
        return newest

    def refuse(self, error: AeroloopError) -> None:
        """Count a set-point that is not followed, and report it."""
        self.refused += 1
        self._role.warn("set-point", "fault", f"set-point refused: {error}", self.session)
