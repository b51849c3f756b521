"""Bench lock: one process of a host at a time drives a bench, which is a node on a CAN bus or Quanser's board.

The lock is a listening Unix socket with an abstract name. The kernel frees it when its process ends, however it ends,
and it needs no file, so it holds between users and across units with a private /tmp. It is of this host's network
namespace: a container with one of its own does not see it.
"""

from __future__ import annotations

import hashlib
import socket
import struct
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from errno import EADDRINUSE
from pathlib import Path
from typing import Final, Literal

from aeroloop.plant_emulator.settings import QuanserSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.transport.can_format import CanSettings

_CREDENTIALS: Final = struct.Struct("3i")  # pid, uid, gid: `struct ucred` of unix(7)
_WITHIN_A_PROCESS: Final = frozenset({"virtual"})
"""Interfaces of python-can that connect threads of one process, and so no bench."""


class BenchError(AeroloopError):
    """Another process of this host drives the bench."""


def can_bench(can: CanSettings, end: Literal["plant", "controller"]) -> AbstractContextManager[None]:
    """Hold one end of a node on a CAN bus. Raises BenchError if another process of this host holds it."""
    if can.interface in _WITHIN_A_PROCESS:
        return nullcontext()
    port = can.options.get("port")  # of UDP multicast: buses of one group differ by it
    channel = can.channel if port is None else f"{can.channel}:{port}"
    return exclusive(f"node {can.node} on {can.interface}:{channel}", f"the {end}'s end of it")


def quanser_bench(quanser: QuanserSettings) -> AbstractContextManager[None]:
    """Hold Quanser's board. Raises BenchError if another process of this host holds it."""
    return exclusive(f"board {quanser.card_identifier} of type {quanser.card_type}", "it")


@contextmanager
def exclusive(bench: str, what: str) -> Iterator[None]:
    """Hold the lock of a bench, named for people, or of a part of it, until the context ends. Raises BenchError."""
    digest = hashlib.sha256(f"{bench} {what}".encode()).hexdigest()
    name = f"\0aeroloop-bench-{digest[:32]}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as lock:
        try:
            lock.bind(name)
        except OSError as error:
            if error.errno != EADDRINUSE:
                raise
            raise BenchError(f"{bench}: {_holder(name)} drives {what}; end that one first") from None
        lock.listen()
        yield


def _holder(name: str) -> str:
    """The process that holds a lock, in words."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(name)
        except OSError:  # it has just ended, or not yet begun to listen
            return "another process of this host"
        credentials = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, _, _ = _CREDENTIALS.unpack(credentials)
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return f"pid {pid}"
    command = " ".join(word.decode(errors="replace") for word in words if word)
    return f"pid {pid} ({command})"
