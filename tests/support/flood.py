"""What a host without a good certificate does to the ports of a network: connections, half-open ones, QUIC handshakes.

As a process: `python -m tests.support.flood KIND COUNT KEYS ENDPOINT...`, until SIGTERM. `tcp` opens COUNT connections
a second to each endpoint and closes each after 0.05 s; `half-open` holds COUNT of them at each; `quic` makes COUNT real
handshakes a second at each, with the foreign operator's certificate in KEYS.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import time
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

import zenoh

from aeroloop.protocol.transport.network_settings import Endpoint
from tests.support.certified_link import tls

HELD_S: Final = 0.05  # how long a connection of `tcp` stays open
RETRY_MS: Final = 950  # pause of a session of `quic` after a refused handshake
SETTLE_S: Final = 1.0
AGAIN_S: Final = 0.5  # pause of `half-open` before it opens again what the other end has closed


def _announce() -> None:
    """Print that the flood has run for `SETTLE_S`."""
    sys.stdout.write("flooding\n")
    sys.stdout.flush()


def _begin_connection(address: tuple[str, int]) -> socket.socket:
    """A socket that connects, whether or not the other end ever accepts."""
    connection = socket.socket()
    connection.setblocking(False)
    connection.connect_ex(address)
    return connection


def connect_and_close(addresses: list[tuple[str, int]], per_s: float) -> None:
    """Open so many connections a second to each address, without a handshake."""
    open_connections: deque[tuple[float, socket.socket]] = deque()
    due = time.monotonic()
    rounds = 0
    while True:
        rounds += 1
        if rounds == round(SETTLE_S * per_s):
            _announce()
        for address in addresses:
            with suppress(OSError):
                open_connections.append((time.monotonic(), _begin_connection(address)))
        due += 1 / per_s
        while time.monotonic() < due:
            while open_connections and time.monotonic() - open_connections[0][0] > HELD_S:
                open_connections.popleft()[1].close()
            time.sleep(min(0.01, 1 / per_s))


def hold_open(addresses: list[tuple[str, int]], count: int) -> None:
    """Hold so many connections to each address open, without a handshake."""
    held = [(address, _begin_connection(address)) for address in addresses for _ in range(count)]
    time.sleep(SETTLE_S)
    _announce()
    while True:
        time.sleep(AGAIN_S)
        for i, (address, connection) in enumerate(held):
            try:
                is_closed = connection.recv(1) == b""
            except BlockingIOError:
                is_closed = False
            except OSError:
                is_closed = True
            if is_closed:
                connection.close()
                held[i] = address, _begin_connection(address)


def shake_hands(endpoints: list[Endpoint], per_s: float, keys: Path) -> None:
    """Have so many sessions begin a QUIC handshake once a second with each endpoint, which refuses the certificate.

    A listener that falls behind keeps them waiting: so many handshakes are then under way at a time.
    """
    retry = {"period_init_ms": RETRY_MS, "period_max_ms": RETRY_MS, "period_increase_factor": 1}
    with ExitStack() as stack:
        for place in endpoints:
            tree = {
                "mode": "peer",
                "connect": {
                    "endpoints": [f"quic/{place.host}:{place.port}?rel=1;mixed_rel=1"],
                    "retry": retry,
                },
                "listen": {"endpoints": []},
                "open": {"return_conditions": {"connect_scouted": False}},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "transport": {"link": {"tls": tls(keys / "operator.pem")}},
            }
            for _ in range(round(per_s)):
                stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(tree))))
        time.sleep(SETTLE_S)
        _announce()
        signal.pause()


def main() -> None:
    kind, count, keys, *texts = sys.argv[1:]
    endpoints = [Endpoint.parse(text) for text in texts]
    addresses = [endpoint.address for endpoint in endpoints]
    if kind == "tcp":
        connect_and_close(addresses, float(count))
    elif kind == "half-open":
        hold_open(addresses, int(count))
    else:
        shake_hands(endpoints, float(count), Path(keys))


if __name__ == "__main__":
    main()
