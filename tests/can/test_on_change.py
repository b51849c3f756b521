"""On-change policy on a CAN bus: an empty frame for a silent tick in lockstep, no frame in real time."""

from __future__ import annotations

from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import (
    COMMAND_ID,
    HEARTBEAT_S,
    MEASUREMENT_ID,
    CanSettings,
    Heartbeat,
    fingerprint,
)
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.figures import Figures, figures
from aeroloop.service.lab.experiment import run_experiment
from tests.support.can_in_process import Stranger, virtual
from tests.support.simulated_link import wire_of
from tests.support.zenoh_network import PATIENCE_S

POLICIES: list[tuple[Policy, Policy]] = [
    ("on_change", "on_change"),
    ("on_change", "periodic"),
    ("periodic", "on_change"),
]


BOTH = wire_of("on_change", "on_change")


WIRES = {"classic": WireSpec(), "FD": WireSpec().with_bits("12/16")} | {"-".join(p): wire_of(*p) for p in POLICIES}


@pytest.mark.parametrize("interface", ["virtual", "socketcan"])
@pytest.mark.parametrize("wire", WIRES)
def test_in_lockstep_the_figures_over_a_bus_are_those_of_the_experiment(
    interface: str, wire: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CanLink, "silent", False)  # a slow machine is no silent peer
    bus = virtual(fd=wire == "FD")
    if interface == "socketcan":
        if not Path("/sys/class/net/vcan0").exists():
            pytest.skip("there is no vcan0: modprobe vcan, ip link add vcan0 mtu 72 type vcan, ip link set vcan0 up")
        bus = CanSettings(interface="socketcan", channel="vcan0", fd=wire == "FD")
    settings = load(overrides=["loop.lockstep=true"]).model_copy(update={"wire": WIRES[wire]})
    on_bus, direct = run_on_bus(bus, settings, 0.5), run_experiment(settings, 0.5)
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


# The link


@pytest.mark.parametrize("end", ["plant", "controller"])
@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("wire", [WireSpec(), *(wire_of(*policies) for policies in POLICIES)], ids=str)
def test_an_empty_frame_is_refused_and_displaces_nothing_where_it_is_not_what_silence_sends(
    wire: WireSpec, lockstep: bool, end: str
) -> None:
    bus = virtual()
    policy = wire.transmit.command if end == "plant" else wire.transmit.measurement
    link = CanLink(bus, wire, end, lockstep=lockstep)  # type: ignore[arg-type]  # is one of both
    try:
        with Stranger(bus) as stranger:
            frame = bytes((wire.command if end == "plant" else wire.measurement).size)
            identifier = COMMAND_ID + 1 if end == "plant" else MEASUREMENT_ID + 1
            stranger.say(identifier, frame)
            stranger.say(identifier, UNCHANGED)
            stranger.settle(link)
            arrival = link.take()
            assert arrival is not None
            expected = lockstep and policy == "on_change"
            assert (arrival.frame, link.refused) == ((UNCHANGED, 0) if expected else (frame, 1))
    finally:
        link.close()
