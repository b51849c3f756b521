"""Bytes that frames take on a Zenoh link, counted where they pass.

Two sessions, configured as the roles' are, speak through a relay on loopback, and the relay counts what TCP carries:
the payload and all that Zenoh puts around it (lengths, key, quality of service), without the headers of TCP and IP.
What joins the two is not counted. A link keeps itself alive with 3 bytes, four times a lease, in a direction that says
nothing else; frames leave no time for that.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Final, NamedTuple, Self

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.link import Mailbox, ZenohLink
from aeroloop.protocol.transport.network import NetworkSettings, join

_VEHICLE: Final = "aero"
_SESSION: Final = "1ab0ra70"
"""As long as the names that controllers make up: a key's length can tell in the bytes."""
_PATIENCE_S: Final = 20.0
_POLL_S: Final = 0.02
_CHUNK: Final = 1 << 16


class CountError(AeroloopError):
    """The link over loopback did not carry what it was given; one line."""


class LinkBytes(NamedTuple):
    """Bytes on the link, by direction."""

    measurement: int
    command: int


class CountingRelay:
    """Passes one TCP connection on, and counts. A context; the connection may come at any time within it.

    Args:
        port: Where it is passed on to, on loopback.

    Attributes:
        port: Where it is taken from, on loopback.
        there: Bytes from who connected, so far.
        back: Bytes to who connected, so far.
    """

    def __init__(self, port: int) -> None:
        self._to = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._sockets = [self._listener]
        self.port: int = self._listener.getsockname()[1]
        self.there = self.back = 0
        self._threads = [threading.Thread(target=self._run, daemon=True)]
        self._threads[0].start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for one in self._sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)  # wakes who waits in it; close alone does not
        for thread in self._threads:
            thread.join()
        for one in self._sockets:
            one.close()

    def _run(self) -> None:
        with suppress(OSError):
            near, _ = self._listener.accept()
            self._sockets.append(near)
            far = socket.create_connection(("127.0.0.1", self._to))
            self._sockets.append(far)
            for one in (near, far):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            answers = threading.Thread(target=self._pass_back, args=(far, near), daemon=True)
            answers.start()
            self._threads.append(answers)
            while chunk := near.recv(_CHUNK):
                self.there += len(chunk)
                far.sendall(chunk)
            far.shutdown(socket.SHUT_WR)

    def _pass_back(self, far: socket.socket, near: socket.socket) -> None:
        with suppress(OSError):
            while chunk := far.recv(_CHUNK):
                self.back += len(chunk)
                near.sendall(chunk)
            near.shutdown(socket.SHUT_WR)


def count_bytes(network: NetworkSettings, measurements: Sequence[bytes], commands: Sequence[bytes]) -> LinkBytes:
    """Send frames over a Zenoh link, first all of one direction, then all of the other, and count their bytes.

    Express messages each go in a batch of their own, so what they take does not depend on the pace at which they are
    sent. They are sent as in lockstep, blocking rather than dropped; that is one bit of a byte that is there anyway.

    Args:
        network: All that is not an address.
        measurements: The frames of one direction, in their order.
        commands: The frames of the other.

    Raises:
        CountError: A frame did not arrive.
        NetworkError: A session cannot be opened.
    """
    port = _free_port()
    here = {"rendezvous": "", "gossip": False}  # two need neither, and they would be counted
    plant_side = network.model_copy(update={**here, "listen": [f"tcp/127.0.0.1:{port}"], "connect": []})
    with CountingRelay(port) as relay, join(plant_side) as plant:
        other_side = network.model_copy(update={**here, "listen": [], "connect": [f"tcp/127.0.0.1:{relay.port}"]})
        with join(other_side) as controller:
            to_controller, to_plant = (Mailbox(depth=max(1, len(frames))) for frames in (measurements, commands))
            keys = [topics.key(name, _VEHICLE, session=_SESSION) for name in ("measurement", "command")]
            link = partial(ZenohLink, lossless=True)
            plant_end = link(plant, keys[0], keys[1], mailbox=to_plant)
            controller_end = link(controller, keys[1], keys[0], mailbox=to_controller)
            _meet(plant, controller)
            before = relay.back
            _send(plant_end, measurements, to_controller)
            measured = relay.back - before
            before = relay.there
            _send(controller_end, commands, to_plant)
            return LinkBytes(measured, relay.there - before)


def _send(link: ZenohLink, frames: Sequence[bytes], other: Mailbox) -> None:
    for frame in frames:
        link.send(frame)
    for _ in frames:
        if other.wait(_PATIENCE_S) is None:
            raise CountError(f"a Zenoh link over loopback did not carry {len(frames)} frames")


def _meet(plant: zenoh.Session, controller: zenoh.Session) -> None:
    """Return once each knows what the other has declared: a claim and its grant, as Zenoh keeps the order on a link."""
    key = topics.key("claim", _VEHICLE)
    plant.declare_queryable(key, lambda query: query.reply(key, b""))
    deadline = time.monotonic() + _PATIENCE_S
    while not list(controller.get(key)):
        if time.monotonic() > deadline:
            raise CountError("two Zenoh sessions over loopback did not find each other")
        time.sleep(_POLL_S)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
