"""Processes of this host: names a role's process, and finds the process that listens at a TCP port."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from glob import iglob
from pathlib import Path
from typing import Final, NamedTuple

from aeroloop.protocol.transport.endpoint import Endpoint

_SUFFIX: Final = "@aeroloop"
_NAME_LENGTH: Final = 15
_PR_SET_NAME: Final = 15
_LISTENS: Final = "0A"
_ROLES: Final = ("plant", "controller", "recorder", "router")


class Listener(NamedTuple):
    """A process that listens at a port.

    Attributes:
        pid: Process id.
        role: `plant`, `controller`, `recorder`, `router`, or None where it is not a role of this program.
    """

    pid: int
    role: str | None

    def __str__(self) -> str:
        return f"{self.role or 'process'} with pid {self.pid}"


def name_process(role: str) -> None:
    """Name this process after its role, for `ps`, `top` and `listener`; at most 15 characters, see prctl(2)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_NAME, f"{role}{_SUFFIX}"[:_NAME_LENGTH].encode(), 0, 0, 0)


def listener(endpoint: str) -> Listener | None:
    """The process of this host that listens at a Zenoh endpoint of TCP or TLS; None where that cannot be found out.

    A process of another user is not found, nor one on another host.
    """
    place = Endpoint.parse(endpoint)
    if place.protocol not in ("tcp", "tls"):
        return None
    inodes = set()
    for table in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in Path("/proc/net", table).read_text().splitlines()[1:]:
                cells = line.split()
                if cells[3] == _LISTENS and int(cells[1].rpartition(":")[2], 16) == place.port:
                    inodes.add(f"socket:[{cells[9]}]")
    for file in map(Path, iglob("/proc/[0-9]*/fd/*") if inodes else ()):
        with suppress(OSError):  # closed, or ended, in the meantime
            if os.readlink(file) in inodes:
                process = file.parent.parent
                name, _, _ = (process / "comm").read_text().strip().partition("@")
                return Listener(int(process.name), name if name in _ROLES else None)
    return None
