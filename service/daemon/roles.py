"""Processes beside the controller: the plant end that `plant.via` names, and the router."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Final

from aeroloop.plant_emulator.hosts.bench_lock import can_bench, quanser_bench
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.runtime.node import Node
from aeroloop.service.config import Settings

STATUS_EVERY_S: Final = 1.0


def run_plant(role: Node, settings: Settings) -> None:
    """Run the configured plant end until the role's `stop` is set: emulator, CAN bridge or Quanser board.

    Raises AeroloopError if it cannot run, ValueError if the configuration does not fit it, both in one line.
    """
    loop, wire, plant = settings.loop, settings.wire, settings.plant
    if plant.via == "can":
        from aeroloop.plant_emulator.hosts.can_bridge import Bridge

        with can_bench(settings.can, "controller"):
            Bridge(role, loop, wire, plant, settings.can).run()
        return
    from aeroloop.plant_emulator.hosts import zenoh_network

    with quanser_bench(plant.quanser) if plant.via == "quanser" else nullcontext():
        zenoh_network.run_plant(role, loop, wire, plant)


def run_router(role: Node) -> None:
    """Publish the router's status once a second until the role's `stop` is set; Zenoh's threads route."""
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
