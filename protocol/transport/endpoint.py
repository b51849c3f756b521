"""Endpoint of Zenoh, `PROTOCOL/HOST:PORT` with Zenoh's words after `?` or `#`: as text, and as a socket to probe."""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from ipaddress import ip_address
from typing import Final

TLS: Final = ("tls", "quic")  # links are encrypted, both ends with a certificate
STREAMS: Final = ("tcp", "tls")
LOCAL: Final = ("unixsock-stream", "unixpipe", "shm")  # stays on this host; the file's mode says who may connect
ACCEPT_S: Final = 0.25  # how long `accepting` waits for a connection
_FORM: Final = re.compile(
    r"(?P<protocol>[a-z][a-z0-9_-]*)/(?P<host>\[[^]]*\]|[^:?#\s]+)(:(?P<port>\d+))?(?P<words>[?#]\S*)?"
)


@dataclass(frozen=True)
class Endpoint:
    """An endpoint. An IPv6 `host` is in brackets, that of a Unix socket is a path; `words` begin with `?` or `#`."""

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
        return self.protocol in STREAMS and not self.on_loopback

    @property
    def is_free(self) -> bool:
        """Whether this process could listen at it: it is an address of this host, and its port is free."""
        if self.port is None:
            return True  # only Zenoh can find out
        family = socket.AF_INET6 if self.host.startswith("[") else socket.AF_INET
        with suppress(OSError):
            if self.protocol in ("udp", "quic"):
                with socket.socket(family, socket.SOCK_DGRAM) as probe:
                    probe.bind(self.address)
            else:
                socket.create_server(self.address, family=family).close()
            return True
        return False

    @property
    def is_own(self) -> bool:
        """Whether its address is this host's."""
        return self.at_port(0).is_free


def accepting(endpoints: Sequence[str]) -> list[str]:
    """Those of some endpoints of TCP or TLS at which a process accepts connections; waits briefly for the others."""

    def accepts(text: str) -> bool:
        endpoint = Endpoint.parse(text)
        if endpoint.protocol in STREAMS and endpoint.port is not None:
            with suppress(OSError), socket.create_connection(endpoint.address, ACCEPT_S):
                return True
        return False

    with ThreadPoolExecutor(max(1, len(endpoints))) as pool:
        found = pool.map(accepts, endpoints)
        return [text for text, accepted in zip(endpoints, found, strict=True) if accepted]
