"""Log line of an event: its text, with the event's fields as attributes of the record, for formatters of keys."""

from __future__ import annotations

import logging
from typing import Final

from aeroloop.protocol.messages.models import Event

log: Final = logging.getLogger("aeroloop")

_GRAVE: Final = ("tripped", "lost", "fault", "refused")


def log_event(event: Event, vehicle: str | None) -> None:
    """Log an event of a role; `vehicle` is None where the role does not know its name.

    The record's attributes are `event` (the kind), `role`, `vehicle`, `session` and `tick`.
    """
    log.log(
        logging.WARNING if event.kind in _GRAVE else logging.INFO,
        event.text,
        extra={"event": event.kind, "vehicle": vehicle, **event.model_dump(include={"role", "session", "tick"})},
    )
