"""Endpoint of Zenoh, as text and as a socket of this host: `PROTOCOL/HOST:PORT`, and Zenoh's words after `?` or `#`."""

from __future__ import annotations

import re
import select
import socket
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from ipaddress import ip_address
from typing import Final

ACCEPT_S: Final = 0.25
"""How long `accepting` waits for a connection [s]."""
TLS: Final = ("tls", "quic")
"""Protocols whose links are encrypted, both ends with a certificate."""
DATAGRAMS: Final = ("udp", "quic")
"""Protocols over UDP."""
LOCAL: Final = ("unixsock-stream", "unixpipe", "shm")
"""Protocols that stay on this host, where the file's mode says who may connect."""
_FORM: Final = re.compile(
    r"(?P<protocol>[a-z][a-z0-9_-]*)/(?P<host>\[[^]]*\]|[^:?#\s]+)(:(?P<port>\d+))?(?P<words>[?#]\S*)?"
)


@dataclass(frozen=True)
class Endpoint:
    """An endpoint.

    Attributes:
        protocol: Such as `tcp`.
        host: Name or address, one of IPv6 in brackets; a path for a Unix socket.
        port: None where it has none.
        words: What follows, from `?` or `#` on.
    """

    protocol: str
    host: str
    port: int | None
    words: str = ""

    @staticmethod
    @lru_cache(maxsize=256)
    def parse(text: str) -> Endpoint:
        """The endpoint that a text names. Raises ValueError if it names none."""
        if (found := _FORM.fullmatch(text)) is None:
            raise ValueError("must be a Zenoh endpoint, PROTOCOL/ADDRESS:PORT such as tcp/127.0.0.1:7447")
        port = found["port"]
        return Endpoint(found["protocol"], found["host"], None if port is None else int(port), found["words"] or "")

    def __str__(self) -> str:
        port = "" if self.port is None else f":{self.port}"
        return f"{self.protocol}/{self.host}{port}{self.words}"

    def at_port(self, port: int) -> Endpoint:
        """The same with another port; itself where it has none."""
        return self if self.port is None else replace(self, port=port)

    def ports(self, count: int) -> list[Endpoint]:
        """The endpoints of consecutive ports from this one's on; itself where it has no port."""
        if self.port is None:
            return [self]
        return [self.at_port(port) for port in range(self.port, min(self.port + count, 1 << 16))]

    @property
    def address(self) -> tuple[str, int]:
        """Host and port as sockets take them; port 0 where it has none."""
        return self.host.strip("[]"), self.port or 0

    @property
    def family(self) -> socket.AddressFamily:
        """Family of its sockets."""
        return socket.AF_INET6 if self.host.startswith("[") else socket.AF_INET

    @property
    def on_loopback(self) -> bool:
        """Whether its links stay within this host."""
        if self.protocol in LOCAL or self.host == "localhost":
            return True
        try:
            return ip_address(self.address[0]).is_loopback
        except ValueError:  # a name
            return False

    @property
    def is_plain(self) -> bool:
        """Whether its links are plain text that leaves this host, or may."""
        return self.protocol not in TLS and not self.on_loopback

    @property
    def leaves_host(self) -> bool:
        """Whether it is one of TCP or TLS beyond loopback."""
        return self.protocol in ("tcp", "tls") and not self.on_loopback

    @property
    def is_free(self) -> bool:
        """Whether this process could listen at it: it is an address of this host, and its port is free."""
        if self.port is None:
            return True  # only Zenoh can find out
        with suppress(OSError):
            if self.protocol in DATAGRAMS:
                with socket.socket(self.family, socket.SOCK_DGRAM) as probe:
                    probe.bind(self.address)
            else:
                socket.create_server(self.address, family=self.family).close()
            return True
        return False

    @property
    def is_own(self) -> bool:
        """Whether its address is this host's."""
        return self.at_port(0).is_free


def accepting(endpoints: list[str]) -> list[str]:
    """Those of some endpoints of TCP or TLS at which a process accepts connections; waits briefly for the others."""
    attempts: dict[int, tuple[socket.socket, str]] = {}
    found = []
    for text in endpoints:
        endpoint = Endpoint.parse(text)
        if endpoint.protocol in ("tcp", "tls") and endpoint.port is not None:
            attempt = socket.socket(endpoint.family)
            attempt.setblocking(False)
            with suppress(OSError):
                attempt.connect_ex(endpoint.address)
            attempts[attempt.fileno()] = attempt, text
    deadline = time.monotonic() + ACCEPT_S
    waiting = select.poll()
    for number in attempts:
        waiting.register(number, select.POLLOUT)
    while attempts and (left := deadline - time.monotonic()) > 0:
        for number, _ in waiting.poll(left * 1000):
            waiting.unregister(number)
            attempt, text = attempts.pop(number)
            with suppress(OSError):
                attempt.getpeername()  # raises if it is not connected
                found.append(text)
            attempt.close()
    for attempt, _ in attempts.values():
        attempt.close()
    return found
