"""Router process: routes between clients until it is stopped, and publishes its status once a second."""

from __future__ import annotations

from typing import Final

from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.runtime.node import Node

STATUS_EVERY_S: Final = 1.0


def run_router(role: Node) -> None:
    """Run until the role's `stop` is set; Zenoh's threads route."""
    role.announce()
    role.event("started", "routing")
    while True:
        stopped = role.stop.is_set()
        role.status(Status(
            role=role.role, state="stopped" if stopped else "routing", uptime_s=role.uptime_s, ticks=0, rate_hz=0.0,
            skipped=0,
        ))  # fmt: skip
        if stopped:
            return
        role.stop.wait(STATUS_EVERY_S)
