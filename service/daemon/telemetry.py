"""Telemetry message of the controller's last tick."""

from __future__ import annotations

from aeroloop.protocol.messages.models import Telemetry
from aeroloop.service.control.controller import Controller


def telemetry_of(controller: Controller, session: str) -> Telemetry:
    """The controller's last tick in a session."""
    return Telemetry(
        session=session,
        tick=controller.tick_index,
        counter=controller.counter,
        attitude_error=controller.attitude_error,
        rate_error=controller.rate_error,
        desired=controller.desired,
        state=controller.law_state,
        voltages=tuple(controller.voltages),
    )
