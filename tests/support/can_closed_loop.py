"""Closed loop over a CAN bus in one process, in lockstep: an emulated node in a thread, the controller here.

The test replaces the bridge: it sends heartbeats with the granted state and passes frames on unchanged.
"""

from __future__ import annotations

from threading import Event, Thread

import numpy as np

from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.plant_emulator.hosts.emulator import Emulator
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import HEARTBEAT_S, CanSettings, Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.figures import Figures, figures

PATIENCE_S = 20.0


def lockstep_settings(wire: WireSpec) -> Settings:
    """The default configuration in lockstep, with a wire."""
    settings = load(overrides=["loop.lockstep=true", f"plant.answer_timeout_s={PATIENCE_S}"])
    return settings.model_copy(update={"wire": wire})


def run_on_bus(bus: CanSettings, settings: Settings, duration_s: float) -> Figures:
    """Run the closed loop for `duration_s` of the law's time [s]. The settings must say lockstep."""
    loop, wire = settings.loop, settings.wire
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    errors, commands = list[Vector](), list[list[float]]()
    silent = [0, 0]  # measurements and commands without a frame
    level = wire.voltage.quantizer().level
    voltages: list[float] = []
    over = Event()
    node = Emulator(loop, wire, settings.plant, over)
    front = CanNetwork(bus, loop, node.endpoint)
    link = CanLink(bus, wire, "controller", lockstep=True)
    granted = Heartbeat(PlantState.GRANTED, 1, fingerprint(wire, loop.period_ns, lockstep=True))

    def beat() -> None:
        while not over.is_set():
            link.beat(granted)
            over.wait(HEARTBEAT_S)

    threads = [Thread(target=node.run, args=(front,)), Thread(target=beat)]
    for thread in threads:
        thread.start()
    try:
        for k in range(loop.ticks(duration_s)):
            arrival = link.wait(PATIENCE_S)
            assert arrival is not None, f"no measurement {k}: the node is {node.endpoint.cause or node.endpoint.state}"
            command = controller.tick(arrival.frame, k)
            assert command is not None
            if read := wire.command.unpack(command):
                voltages = [level(code) for code in read[1]]
            else:
                assert command == UNCHANGED
            errors.append(controller.attitude_error)
            commands.append(voltages)
            silent[0] += arrival.frame == UNCHANGED
            silent[1] += command == UNCHANGED
            link.send(command)
    finally:
        over.set()
        for thread in threads:
            thread.join()
        link.close()
    ticks = np.arange(len(errors))
    return figures(
        wire, loop.period, (ticks, np.array(errors)), (ticks, np.array(commands)), unsent=(silent[0], silent[1])
    )
