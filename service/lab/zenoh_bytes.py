"""Bytes that frames take on a Zenoh link, counted by a relay.

Two sessions, configured like those of the roles, connect through a TCP relay on loopback. The relay counts the bytes
that TCP carries: payload and Zenoh's envelope (lengths, key, quality of service), without the headers of TCP and IP.
The handshake is not counted. An idle direction carries a keep-alive of 3 bytes four times a lease; frames replace it.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import Final, NamedTuple, Self

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.link import Mailbox, ZenohLink
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.testing.process_group import free_rendezvous

_VEHICLE: Final = "aero"
_SESSION: Final = "1ab0ra70"
"""As long as a controller's session names: the length of a key counts in the bytes."""
_PATIENCE_S: Final = 20.0
_POLL_S: Final = 0.02
_CHUNK: Final = 1 << 16


class CountError(AeroloopError):
    """The link over loopback did not carry every frame; one line."""


class LinkBytes(NamedTuple):
    """Bytes on the link, by direction."""

    measurement: int
    command: int


class CountingRelay:
    """Forwards one TCP connection to a port on loopback and counts its bytes. A context.

    Attributes:
        port: Port to connect to.
        there: Bytes from the connecting side, so far.
        back: Bytes to the connecting side, so far.
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

    def __exit__(self, *exception: object) -> None:
        for one in self._sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)  # wakes a thread blocked in it; close alone does not
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

    Express messages go one per batch, so their size does not depend on the rate. They are sent as in lockstep, blocking
    rather than dropping; that sets one bit and adds no byte. The addresses in the settings are replaced.

    Raises:
        CountError: A frame did not arrive.
        NetworkError: A session cannot be opened.
    """
    address = free_rendezvous()
    here = {"mode": "peer", "rendezvous": [], "gossip": False}  # two peers need neither, and their bytes would count
    plant_side = network.model_copy(update={**here, "listen": [address], "connect": []})
    with CountingRelay(int(address.rpartition(":")[2])) as relay, join(plant_side) as plant:
        other_side = network.model_copy(update={**here, "listen": [], "connect": [f"tcp/127.0.0.1:{relay.port}"]})
        with join(other_side) as controller:
            to_controller, to_plant = (Mailbox(depth=max(1, len(frames))) for frames in (measurements, commands))
            keys = [topics.key(name, _VEHICLE, session=_SESSION) for name in ("measurement", "command")]
            link = partial(ZenohLink, lossless=True)
            plant_end = link(plant, keys[0], keys[1], mailbox=to_plant)
            controller_end = link(controller, keys[1], keys[0], mailbox=to_controller)
            _await_declarations(plant, controller)
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


def _await_declarations(plant: zenoh.Session, controller: zenoh.Session) -> None:
    """Wait until each session has the other's declarations: a query and its reply, since a link keeps the order."""
    key = topics.key("claim", _VEHICLE)
    plant.declare_queryable(key, lambda query: query.reply(key, b""))
    deadline = time.monotonic() + _PATIENCE_S
    while not list(controller.get(key)):
        if time.monotonic() > deadline:
            raise CountError("two Zenoh sessions over loopback did not find each other")
        time.sleep(_POLL_S)
