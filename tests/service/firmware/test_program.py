"""The node in C as a program on this machine, on a bus that is UDP multicast."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path
from random import Random
from threading import Event
from typing import Any

import can
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.transport.can_format import PLANT_HEARTBEAT_ID, CanSettings, Heartbeat
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.config import Settings
from aeroloop.service.firmware.export import ExportError
from aeroloop.service.firmware.node import build, run
from aeroloop.service.lab.demo import run_demo
from aeroloop.service.testing.process_group import private_bus
from tests.support.firmware import COMPILERS, NO_COMPILER
from tests.support.zenoh_network import PATIENCE_S

pytestmark = [pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER), pytest.mark.processes]


@pytest.mark.realtime
@pytest.mark.parametrize(
    "wire",
    [
        {},
        {
            "attitude": {"bits": 10, "limit": 1, "kind": "hysteresis-uniform"},
            "rate": {"bits": 12, "limit": 1, "kind": "logarithmic-uniform"},
            "transmit": "on_change",
        },
    ],
    ids=["the paper's", "on change"],
)
def test_a_run_in_lockstep_has_the_figures_of_the_node_in_python(tmp_path: Path, wire: dict[str, Any]) -> None:
    """Every one of them, to the last bit: so each frame and each step of the plant was the same."""
    figures = []
    for in_c in (False, True):
        settings = Settings.model_validate(
            {
                "loop": LoopSettings(lockstep=True),
                "wire": wire,
                "plant": {"via": "can"},
                "can": {"fd": True, "node_in_c": in_c},
            }
        )
        found, complete = run_demo(settings, 5, tmp_path / f"{in_c}.mcap")
        assert complete
        figures.append(found.model_dump(exclude={"log"}))
    assert figures[0] == figures[1]


@pytest.fixture
def settings() -> Settings:
    return Settings(can=private_bus(CanSettings(fd=True)))


def test_bad_datagrams_do_not_disturb_it_and_it_ends_when_its_parent_has(settings: Settings, tmp_path: Path) -> None:
    bus, random = settings.can, Random(1)
    where = (bus.channel, bus.options["port"])
    good = pack_message(can.Message(arbitration_id=0x201, data=bytes(64), is_extended_id=False, is_fd=True))
    words: list[Any] = [build(settings, tmp_path), "udp_multicast", *map(str, where), "0"]
    with (
        subprocess.Popen(words, stdin=subprocess.PIPE) as program,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hostile,
        can.Bus(interface="udp_multicast", channel=bus.channel, fd=True, **bus.options) as listener,
    ):
        hostile.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)

        def beat() -> Heartbeat | None:
            """The next heartbeat."""
            while (message := listener.recv(PATIENCE_S)) is not None:
                if message.arbitration_id == PLANT_HEARTBEAT_ID + bus.node:
                    return Heartbeat.unpack(bytes(message.data), 0)
            return None

        assert (first := beat()) is not None
        listener.shutdown()  # python-can gives a bus up for what the node ignores
        for _ in range(2000):
            datagram = bytearray(good)
            for _ in range(random.randrange(4)):
                datagram[random.randrange(len(datagram))] = random.randrange(256)
            hostile.sendto(datagram[: random.choice((len(datagram), random.randrange(len(datagram))))], where)
        with can.Bus(interface="udp_multicast", channel=bus.channel, fd=True, **bus.options) as listener:
            assert beat() == first
            assert program.stdin is not None
            program.stdin.close()
            assert program.wait(PATIENCE_S) == 0


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"plant": PlantSettings(faults=["rate:off"])}, "has no plant.faults"),
        ({"can": CanSettings(interface="slcan")}, "not on slcan"),
        ({"can": CanSettings(channel="nowhere")}, "cannot open the CAN bus"),
    ],
)
def test_what_it_cannot_do_is_refused_in_one_line(settings: Settings, changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(ExportError, match=reason) as refusal:
        run(settings.model_copy(update=changed), Event())
    assert "\n" not in str(refusal.value)
