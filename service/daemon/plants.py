"""Plant end of a Zenoh network, selected by `plant.via`: emulator, CAN bridge or Quanser board."""

from __future__ import annotations

from aeroloop.protocol.runtime.node import Node
from aeroloop.service.config import Settings


def run_plant(role: Node, settings: Settings) -> None:
    """Run the configured plant end until the role's `stop` is set.

    Raises:
        AeroloopError: It cannot run, in one line.
        ValueError: The configuration does not fit it, in one line.
    """
    loop, wire, plant = settings.loop, settings.wire, settings.plant
    if plant.via == "can":
        from aeroloop.plant_emulator.hosts.can_bridge import Bridge

        Bridge(role, loop, wire, plant, settings.can).run()
        return
    if plant.via == "emulator":
        from aeroloop.plant_emulator.hosts.emulator import EmulatorOnZenoh

        EmulatorOnZenoh(role, loop, wire, plant).run()
        return
    from aeroloop.plant_emulator.hosts.quanser_board import BoardDriver
    from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork

    driver = BoardDriver(loop, wire, plant, role.stop)
    driver.run(ZenohNetwork(role, loop, driver.endpoint, plant.state_directory))
