"""Places: endpoints at which a process may be met, as text and as sockets of this host."""

from __future__ import annotations

import re
import select
import socket
import time
from contextlib import suppress
from typing import Final

from aeroloop.protocol.transport.security import is_plain

ACCEPT_S: Final = 0.25
"""How long `accepting` waits for a connection [s]."""
DATAGRAMS: Final = ("udp", "quic")
"""Protocols over UDP."""
_PLACE = re.compile(r"(?P<protocol>[a-z]+)/(?P<host>[^/]+):(?P<port>\d+)(?P<rest>[?#].*)?")


def accepting(places: list[str]) -> list[str]:
    """Those of some endpoints of TCP or TLS at which a process accepts connections; waits briefly for the others."""
    attempts: dict[int, tuple[socket.socket, str]] = {}
    found = []
    for place in places:
        if (parts := _PLACE.fullmatch(place)) and parts["protocol"] in ("tcp", "tls"):
            attempt = socket.socket(_family(parts))
            attempt.setblocking(False)
            with suppress(OSError):
                attempt.connect_ex((parts["host"].strip("[]"), int(parts["port"])))
            attempts[attempt.fileno()] = attempt, place
    deadline = time.monotonic() + ACCEPT_S
    waiting = select.poll()
    for number in attempts:
        waiting.register(number, select.POLLOUT)
    while attempts and (left := deadline - time.monotonic()) > 0:
        for number, _ in waiting.poll(left * 1000):
            waiting.unregister(number)
            attempt, place = attempts.pop(number)
            with suppress(OSError):
                attempt.getpeername()  # raises if it is not connected
                found.append(place)
            attempt.close()
    for attempt, _ in attempts.values():
        attempt.close()
    return found


def ports_of(first: str, ports: int) -> list[str]:
    """The endpoints of consecutive ports from an endpoint's on; itself where it has no port, as a Unix socket."""
    parts = _PLACE.fullmatch(first)
    if parts is None:
        return [first]
    head, rest = f"{parts['protocol']}/{parts['host']}", parts["rest"] or ""
    start = int(parts["port"])
    return [f"{head}:{port}{rest}" for port in range(start, min(start + ports, 1 << 16))]


def leaves_host(place: str) -> bool:
    """Whether an endpoint is one of TCP or TLS beyond loopback."""
    protocol, _, address = place.partition("/")
    return protocol in ("tcp", "tls") and is_plain(f"tcp/{address}")


def is_free(place: str) -> bool:
    """Whether this process could listen at an endpoint: it is an address of this host, and its port is free."""
    parts = _PLACE.fullmatch(place)
    if parts is None:
        return True  # only Zenoh can find out
    address, family = (parts["host"].strip("[]"), int(parts["port"])), _family(parts)
    with suppress(OSError):
        if parts["protocol"] in DATAGRAMS:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.bind(address)
        else:
            socket.create_server(address, family=family).close()
        return True
    return False


def is_own(place: str) -> bool:
    """Whether an endpoint's address is this host's."""
    return is_free(at_port(place, 0))


def at_port(endpoint: str, port: int) -> str:
    """An endpoint with another port; itself where it has none."""
    parts = _PLACE.fullmatch(endpoint)
    return endpoint if parts is None else f"{parts['protocol']}/{parts['host']}:{port}{parts['rest'] or ''}"


def _family(parts: re.Match[str]) -> socket.AddressFamily:
    return socket.AF_INET6 if parts["host"].startswith("[") else socket.AF_INET
