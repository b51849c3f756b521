"""Plant end of a Zenoh network, selected by `plant.via`: emulator, CAN bridge or Quanser board."""

from __future__ import annotations

from collections.abc import Callable

from aeroloop.protocol.runtime.role import Role
from aeroloop.service.config import Settings
from aeroloop.service.daemon.reload import reload_on_hangup


def run_plant(role: Role, settings: Settings, load: Callable[[], Settings]) -> None:
    """Run the configured plant end until the role's `stop` is set; `load` reads the configuration again, on SIGHUP.

    Raises:
        AeroloopError: It cannot run, in one line.
        ValueError: The configuration does not fit it, in one line.
    """
    loop, wire, plant = settings.loop, settings.wire, settings.plant
    if plant.via == "can":
        from aeroloop.plant_emulator.hosts.can_bridge import Bridge

        bridge = Bridge(role, loop, wire, plant, settings.can)
        reload_on_hangup(role, settings, load, lambda new: bridge.reconfigure(new.plant))
        bridge.run()
        return
    if plant.via == "emulator":
        from aeroloop.plant_emulator.hosts.emulator import EmulatorOnZenoh

        emulator = EmulatorOnZenoh(role, loop, wire, plant)
        reload_on_hangup(role, settings, load, lambda new: emulator.reconfigure(new.plant))
        emulator.run()
        return
    from aeroloop.plant_emulator.hosts.quanser.board import BoardDriver
    from aeroloop.plant_emulator.hosts.zenoh_front import ZenohFront

    driver = BoardDriver(loop, wire, plant, role.stop)
    reload_on_hangup(role, settings, load, lambda new: driver.reconfigure(new.plant))
    driver.run(ZenohFront(role, loop, driver.endpoint))
