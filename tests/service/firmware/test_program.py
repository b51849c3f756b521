"""The node in C as a program on this machine, on a bus that is UDP multicast."""

from __future__ import annotations

import signal
import socket
import subprocess
import time
from pathlib import Path
from random import Random
from threading import Event
from typing import Any

import can
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import (
    COMMAND_ID,
    CONTROLLER_HEARTBEAT_ID,
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    CanSettings,
    Heartbeat,
    fingerprint,
)
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.config import Settings
from aeroloop.service.firmware.export import ExportError
from aeroloop.service.firmware.machines import compiled
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


TRACER = r"""
#include <stdio.h>
#include "aero_port.h"
void __real_aero_port_actuate(int64_t k, const double volts[AERO_ACTUATORS]);
void __real_aero_port_enable(int on);
void __real_aero_port_send(uint32_t id, const uint8_t *data, size_t size);
void __wrap_aero_port_actuate(int64_t k, const double volts[AERO_ACTUATORS])
{
    printf("actuate %g %g\n", volts[0], volts[1]);
    __real_aero_port_actuate(k, volts);
}
void __wrap_aero_port_enable(int on)
{
    printf("enable %d\n", on);
    __real_aero_port_enable(on);
}
void __wrap_aero_port_send(uint32_t id, const uint8_t *data, size_t size)
{
    printf("send %x %d\n", (unsigned)id, size ? data[0] : -1);
    __real_aero_port_send(id, data, size);
}
"""


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_a_session_ends_it_with_0_v_first(
    settings: Settings, lockstep: bool, ending: signal.Signals, tmp_path: Path
) -> None:
    """A session that trips while this process is kept waiting is followed by another.

    From the last heartbeat to the signal half a second may pass, after which the node trips: two statements do.
    """
    loop = LoopSettings(lockstep=lockstep)
    patient = settings.model_copy(update={"loop": loop, "plant": PlantSettings(watchdog_s=10)})
    build(patient, tmp_path)
    (tmp_path / "tracer.c").write_text(TRACER)
    sources = [tmp_path / f"{part}.c" for part in ("aero_wire", "aero_node", "aero_linux", "aero_plant", "tracer")]
    wraps = [f"-Wl,--wrap=aero_port_{name}" for name in ("actuate", "enable", "send")]
    program = compiled([*sources, tmp_path / "aero_plant_equations.c"], tmp_path / "traced", "-w", *wraps)
    bus, wire = patient.can, patient.wire
    mark = fingerprint(wire, loop.period_ns, lockstep=lockstep)
    volts = [wire.voltage.quantizer().encode(1.0)] * wire.actuators
    words: list[Any] = [program, "udp_multicast", bus.channel, str(bus.options["port"]), "0"]
    trace = tmp_path / "trace"
    with (
        trace.open("wb") as out,
        subprocess.Popen(words, stdin=subprocess.PIPE, stdout=out) as process,
        can.Bus(interface="udp_multicast", channel=bus.channel, fd=True, **bus.options) as side,
    ):

        def say(identifier: int, data: bytes) -> None:
            side.send(can.Message(arbitration_id=identifier + bus.node, data=data, is_extended_id=False))

        state = PlantState.IDLE
        number = 0
        deadline = time.monotonic() + PATIENCE_S
        while state is not PlantState.DRIVEN:
            assert time.monotonic() < deadline, "it was never driven"
            message = side.recv(0.05)
            if message is None:
                say(CONTROLLER_HEARTBEAT_ID, Heartbeat(PlantState.GRANTED, number, mark).pack())
            elif message.arbitration_id == MEASUREMENT_ID + bus.node:
                counter = wire.measurement.counter(bytes(message.data))
                assert counter is not None
                say(COMMAND_ID, wire.command.pack(counter, volts))
            elif message.arbitration_id == PLANT_HEARTBEAT_ID + bus.node:
                heartbeat = Heartbeat.unpack(bytes(message.data), 0)
                assert heartbeat is not None
                state = heartbeat.state
                if state is PlantState.TRIPPED:
                    number = (number + 1) % 16
                say(CONTROLLER_HEARTBEAT_ID, Heartbeat(PlantState.GRANTED, number, mark).pack())
        process.send_signal(ending)
        assert process.wait(PATIENCE_S) == 0
    calls = trace.read_text().splitlines()
    idle = f"send {PLANT_HEARTBEAT_ID + bus.node:x} 0"
    assert calls[-3:] == ["actuate 0 0", "enable 0", idle]
    enabled = len(calls) - 1 - calls[::-1].index("enable 1")
    acts = [call for call in calls[enabled:] if call.startswith("actuate")]
    assert acts[-1] == "actuate 0 0"
    assert acts[-2] != acts[-1], "the session was driven up to the signal"


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
