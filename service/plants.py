"""What can stand at the plant end of a Zenoh network, by the name that `plant.via` has for it."""

from __future__ import annotations

from collections.abc import Callable

from protocol.role import Role
from service.config import Settings
from service.reload import reload_on_hangup


def run_plant(role: Role, settings: Settings, load: Callable[[], Settings]) -> None:
    """Run the plant end that the configuration names until the role is told to stop.

    Args:
        role: Its name on the network.
        settings: The configuration.
        load: Reads it again, on SIGHUP.

    Raises:
        AeroloopError: It cannot be run, in one line.
        ValueError: The same, of the configuration.
    """
    loop, wire, plant = settings.loop, settings.wire, settings.plant
    if plant.via == "can":
        from plant_emulator.can_bridge import Bridge

        bridge = Bridge(role, loop, wire, plant, settings.can)
        reload_on_hangup(role, settings, load, lambda new: bridge.reconfigure(new.plant))
        bridge.run()
        return
    if plant.via == "emulator":
        from plant_emulator.emulator import EmulatorOnZenoh

        emulator = EmulatorOnZenoh(role, loop, wire, plant)
        reload_on_hangup(role, settings, load, lambda new: emulator.reconfigure(new.plant))
        emulator.run()
        return
    from plant_emulator.presence import Presence
    from plant_emulator.quanser_board import BoardDriver

    driver = BoardDriver(loop, wire, plant, role.stop)
    reload_on_hangup(role, settings, load, lambda new: driver.reconfigure(new.plant))
    driver.run(Presence(role, loop, driver.endpoint))
