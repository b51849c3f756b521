"""What a controller tells of the tick it has computed last; for the daemon, and for whoever stands in for it."""

from __future__ import annotations

from aeroloop.protocol.messages.models import Telemetry
from aeroloop.service.control.controller import Controller


def telemetry_of(controller: Controller, session: str) -> Telemetry:
    """What the controller computed at its last tick, in a session."""
    return Telemetry(
        session=session,
        tick=controller.tick_index,
        counter=controller.counter,
        attitude_error=controller.attitude_error,
        rate_error=controller.rate_error,
        desired=controller.desired,
        damping_estimate=controller.damping_estimate,
        voltages=tuple(controller.voltages),
        sign=controller.sign,
    )
