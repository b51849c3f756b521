"""On-change policy on a CAN bus: an empty frame for a silent tick in lockstep, no frame in real time."""

from __future__ import annotations

from threading import Event, Thread

import numpy as np
import pytest

from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import (
    COMMAND_ID,
    HEARTBEAT_S,
    CanSettings,
    Heartbeat,
    fingerprint,
)
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.figures import Figures, figures
from aeroloop.service.lab.experiment import run_experiment
from tests.support.can_in_process import Stranger, virtual
from tests.support.simulated_link import wire_of
from tests.support.zenoh_network import PATIENCE_S

BOTH = wire_of("on_change", "on_change")
WIRES = {"classic": WireSpec(), "FD": WireSpec().with_bits("12/16"), "on change": BOTH}


@pytest.mark.parametrize("wire", WIRES)
def test_in_lockstep_the_figures_over_a_bus_are_those_of_the_experiment(
    wire: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CanLink, "silent", False)  # a slow machine is no silent peer
    settings = load(overrides=["loop.lockstep=true"]).model_copy(update={"wire": WIRES[wire]})
    on_bus, direct = run_on_bus(virtual(fd=wire == "FD"), settings, 0.5), run_experiment(settings, 0.5)
    assert on_bus.model_dump(exclude={"reasons"}) == direct.model_dump(exclude={"reasons"})


def run_on_bus(bus: CanSettings, settings: Settings, duration_s: float) -> Figures:
    """Run the closed loop for `duration_s` of the law's time [s]. The settings must say lockstep."""
    loop, wire = settings.loop, settings.wire
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    errors, commands = list[Vector](), list[list[float]]()
    silent = [0, 0]  # measurements and commands without a frame
    level = wire.voltage.quantizer().level
    voltages: list[float] = []
    over = Event()
    node = Driver(settings.plant.make(loop.period), loop, wire, settings.plant, over)
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


@pytest.mark.parametrize(("wire", "lockstep"), [(BOTH, True), (BOTH, False), (WireSpec(), True)], ids=str)
def test_an_empty_frame_is_refused_and_displaces_nothing_where_it_is_not_what_silence_sends(
    wire: WireSpec, lockstep: bool
) -> None:
    bus = virtual()
    link = CanLink(bus, wire, "plant", lockstep=lockstep)
    try:
        with Stranger(bus) as stranger:
            frame = bytes(wire.command.size)
            stranger.say(COMMAND_ID + 1, frame)
            stranger.say(COMMAND_ID + 1, UNCHANGED)
            stranger.settle(link)
            arrival = link.take()
            assert arrival is not None
            expected = lockstep and wire == BOTH
            assert (arrival.frame, link.refused) == ((UNCHANGED, 0) if expected else (frame, 1))
    finally:
        link.close()
