"""CAN buses inside one process: python-can's virtual interface on a channel per test, and a bus that fails on request.

The virtual interface keeps the order of frames and loses none, which `Stranger.settle` relies on.
"""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Self

import can
from can.interfaces.virtual import VirtualBus

from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import CONTROLLER_HEARTBEAT_ID, PLANT_HEARTBEAT_ID, CanSettings, Heartbeat
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.zenoh_network import PATIENCE_S, eventually

PAPER = WireSpec()


def virtual(*, fd: bool = False, node: int = 1, channel: str | None = None) -> CanSettings:
    return CanSettings(interface="virtual", channel=channel or uuid.uuid4().hex, fd=fd, node=node)


class Stranger:
    """One more on the bus: sees every frame as it is, and says whatever a test wants. A context."""

    def __init__(self, settings: CanSettings) -> None:
        self._node = settings.node
        self._bus = VirtualBus(settings.channel)
        self._marks = itertools.count(1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def say(self, identifier: int, data: bytes, **how: Any) -> None:
        kind: dict[str, Any] = {"is_extended_id": False, "is_fd": len(data) > 8, **how}
        self._bus.send(can.Message(arbitration_id=identifier, data=data, **kind))

    def receive(self, wanted: Callable[[can.Message], bool] = lambda _: True) -> can.Message:
        while True:
            message = self._bus.recv(PATIENCE_S)
            assert message is not None, f"nothing of the kind came within {PATIENCE_S:g} s"
            if wanted(message):
                return message

    def everything(self) -> list[can.Message]:
        return list(iter(lambda: self._bus.recv(0), None))

    def settle(self, *links: CanLink) -> None:
        """Wait until links have received all that was sent before, by a heartbeat that comes after it."""
        mark = Heartbeat(PlantState.IDLE, 0, next(self._marks).to_bytes(7, "big"))
        for base in (PLANT_HEARTBEAT_ID, CONTROLLER_HEARTBEAT_ID):
            self.say(base + self._node, mark.pack())
        for link in links:
            eventually("the mark", lambda link=link: link.peer is not None and link.peer[:3] == mark[:3])  # type: ignore[misc]


class Flaws:
    """What is wrong with every `FlawedBus` now: it takes no frame, is lost, cannot be opened; what was tried."""

    def __init__(self) -> None:
        self.full = self.lost = self.gone = False
        self.opened = self.sent = 0

    def bus(self, channel: str, **options: Any) -> FlawedBus:
        self.opened += 1
        if self.gone:
            raise can.CanInitializationError(f"could not open {channel}:\nno such device")
        return FlawedBus(self, channel, **{name: value for name, value in options.items() if name != "interface"})


class FlawedBus(VirtualBus):
    """A virtual bus that fails as its `Flaws` say."""

    def __init__(self, flaws: Flaws, channel: str, **options: Any) -> None:
        self._flaws = flaws
        super().__init__(channel, **options)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._flaws.sent += 1
        if self._flaws.lost:
            raise OSError("no such device")
        if self._flaws.full:
            raise can.CanOperationError("transmit queue is full")
        super().send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self._flaws.lost:
            raise can.CanOperationError("adapter was unplugged")
        return super()._recv_internal(0.005 if timeout is None else min(timeout, 0.005))


@contextmanager
def both_ends(settings: CanSettings, wire: WireSpec = PAPER) -> Iterator[tuple[CanLink, CanLink, Stranger]]:
    plant, controller = CanLink(settings, wire, "plant"), CanLink(settings, wire, "controller")
    try:
        with Stranger(settings) as stranger:
            yield plant, controller, stranger
    finally:
        with ThreadPoolExecutor() as both:  # each waits for its receiver, up to 0.1 s
            list(both.map(CanLink.close, (plant, controller)))
