"""SocketCAN: frames, links and the closed loop on a `vcan0` from tests/support/kernel.py.

Pytest collects the class of tests on `vcan0` only where `vcan0` is up. The test outside the class runs pytest on this
file once more where it is.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import CanSettings, Heartbeat
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.lab.experiment import run_experiment
from tests.support.can_closed_loop import PATIENCE_S, lockstep_settings, run_on_bus
from tests.support.kernel import NoSocketCan, run_with_socketcan, vcan_is_up
from tests.support.zenoh_network import eventually

ROOT = Path(__file__).parent.parent.parent

TIMEOUT_S = 120.0
"""For what takes 10 s inside: a shared machine can keep a process waiting, and this one is slow to begin with."""

LEAN = ("-p", "no:cacheprovider", "--disable-plugin-autoload", "-o", "addopts=--import-mode=importlib")
"""Leaves nothing in this folder, and loads no plugin: importing them takes seconds inside."""


def test_frames_cross_on_a_real_socketcan() -> None:
    chosen = ("-m", "realtime or not realtime", "-k", "socketcan_inside")
    pytest_inside = [sys.executable, "-m", "pytest", "tests/can/test_socketcan.py", *chosen, *LEAN]
    try:
        done = run_with_socketcan(pytest_inside, ROOT, TIMEOUT_S)
    except NoSocketCan as reason:
        pytest.skip(f"a user-mode kernel with SocketCAN cannot run on this machine: {reason}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout, done.stdout
    assert "skipped" not in done.stdout, done.stdout


WIRES = {False: WireSpec(), True: WireSpec().with_bits("12/16")}
"""For classic CAN, of 7 and 2 bytes; for CAN FD, of 10, which travel as 12, and 5."""


class TestInside:
    """Where `vcan0` is up."""

    __test__ = vcan_is_up()

    @pytest.mark.parametrize("fd", [False, True], ids=["classic", "FD"])
    def test_socketcan_inside_a_link_carries_frames_and_heartbeats(self, fd: bool) -> None:
        bus, wire = CanSettings(interface="socketcan", channel="vcan0", fd=fd), WIRES[fd]
        plant, controller = CanLink(bus, wire, "plant"), CanLink(bus, wire, "controller")
        try:
            for counter in range(16):
                measurement = wire.measurement.pack(counter, [counter - 8, 1, -1, 127, -127, 0])
                command = wire.command.pack(counter, [counter, -counter])
                for sender, receiver, frame in ((plant, controller, measurement), (controller, plant, command)):
                    sender.send(frame)
                    arrival = receiver.wait(PATIENCE_S)
                    assert arrival is not None
                    assert arrival.frame == frame
            plant.beat(Heartbeat(PlantState.TRIPPED, 9, b"fingers"))
            eventually("the heartbeat", lambda: controller.peer is not None)
            assert controller.peer is not None
            assert controller.peer.cause is TripCause.BUS
            assert controller.peer[:3] == (PlantState.TRIPPED, 9, b"fingers")
            assert plant.peer is None
            assert plant.errors == plant.refused == controller.errors == controller.refused == 0
            assert plant.fault is controller.fault is None
        finally:
            plant.close()
            controller.close()

    @pytest.mark.parametrize("fd", [False, True], ids=["classic", "FD"])
    def test_socketcan_inside_the_loop_is_the_experiment(self, fd: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(CanLink, "silent", False)  # a slow machine is no silent peer
        settings = lockstep_settings(WIRES[fd])
        on_bus = run_on_bus(CanSettings(interface="socketcan", channel="vcan0", fd=fd), settings, 0.5)
        alone = run_experiment(settings, 0.5)
        assert on_bus.model_dump(exclude={"reasons"}) == alone.model_dump(exclude={"reasons"})
