"""Loop over a CAN bus on real processes, of which one dies.

UDP multicast carries classic CAN and CAN FD without a kernel module; test_bridge.py covers a bus that fails. A test in
real time states its slack: the suite must pass on a shared machine with two cores, where a process may wait for
hundreds of milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple, Self

import can
import pytest

from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import CanSettings, Heartbeat
from aeroloop.service.testing.hil import Hil

WATCHDOG_S: Final = 0.1
SLACK_S: Final = 0.3
"""For a loop that other work on the machine keeps waiting, in five processes on two cores."""


@pytest.fixture
def hil(tmp_path: Path) -> Iterator[Hil]:
    """Real processes on a UDP multicast bus of their own, in real time."""
    with Hil(tmp_path, plant="can-node") as loop:
        yield loop


class Said(NamedTuple):
    """A frame on the bus, and when the kernel had it, on the wall clock [s]."""

    at: float
    identifier: int
    data: bytes


class BusMonitor(can.Listener):
    """Records the frames on the bus of a loop and sends none. A context."""

    def __init__(self, bus: CanSettings) -> None:
        self.received: list[Said] = []
        self._bus = can.Bus(interface=bus.interface, channel=bus.channel, fd=True, **bus.options)
        self._notifier = can.Notifier(self._bus, [self], timeout=0.1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._notifier.stop()
        self._bus.shutdown()

    def on_message_received(self, msg: can.Message) -> None:
        self.received.append(Said(msg.timestamp, msg.arbitration_id, bytes(msg.data)))

    def last_command(self) -> float:
        """When the last one came [s]."""
        return max(said.at for said in self.received if said.identifier == 0x201)

    def node(self, *states: PlantState) -> tuple[float, TripCause | None] | None:
        """The node's first heartbeat with one of these states: its time and its cause."""
        for said in self.received:
            if said.identifier == 0x301:
                beat = Heartbeat.unpack(said.data, 0)
                if beat is not None and beat.state in states:
                    return said.at, beat.cause
        return None


@pytest.mark.smoke
def test_a_controller_that_dies_leaves_the_node_at_rest_in_time(hil: Hil) -> None:
    """Its bridge releases it, or its own watchdog trips it: whichever is first, it is at 0 V then."""
    hil.start()
    with BusMonitor(hil.settings.can) as monitor:
        hil.run(0.3)
        hil.kill("controller")
        hil.eventually("rest", lambda: monitor.node(PlantState.IDLE, PlantState.TRIPPED) is not None)
        hil.eventually("the trip", lambda: hil.happened("tripped"))
        rest = monitor.node(PlantState.IDLE, PlantState.TRIPPED)
        assert rest is not None
        assert rest[1] in (None, TripCause.COMMAND_TIMEOUT)
        assert rest[0] - monitor.last_command() < WATCHDOG_S + SLACK_S


def test_a_bridge_that_dies_leaves_a_node_whose_own_watchdog_trips_it(hil: Hil) -> None:
    hil.start()
    with BusMonitor(hil.settings.can) as monitor:
        hil.run(0.3)
        hil.kill("plant")
        hil.eventually("the trip", lambda: monitor.node(PlantState.TRIPPED) is not None)
        trip = monitor.node(PlantState.TRIPPED)
        assert trip is not None
        assert trip[1] is TripCause.COMMAND_TIMEOUT
        assert trip[0] - monitor.last_command() < WATCHDOG_S + SLACK_S
