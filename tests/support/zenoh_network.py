"""Zenoh sessions on loopback that are always closed."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Self

import zenoh

from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.testing.process_group import free_rendezvous

PATIENCE_S = 30.0  # how long to wait for what takes milliseconds: a shared machine can keep a process waiting


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def accepts(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(PATIENCE_S)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def eventually(what: str, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> None:
    """Poll for what another thread or process brings about and announces by no event."""
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen within {within_s:g} s"
        time.sleep(0.005)


class Gathering:
    """Sessions at one rendezvous. A context: leaving it closes those that are still open."""

    def __init__(self) -> None:
        self.settings = NetworkSettings(rendezvous=[free_rendezvous()])
        self.ports = [int(place.rpartition(":")[2]) for place in self.settings.rendezvous_endpoints]
        self._members: list[zenoh.Session] = []

    def join(self, settings: NetworkSettings | None = None) -> zenoh.Session:
        """One more member, with the gathering's settings unless others are given."""
        member = join(settings or self.settings)
        self._members.append(member)
        return member

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for member in self._members:
            if not member.is_closed():
                member.close()
