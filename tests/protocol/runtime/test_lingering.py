"""Lingering: no socket of a process that asked for it lingers, whatever sets the option."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

PROGRAM = """
import socket, struct, threading
from aeroloop.protocol.runtime.realtime import no_linger

def lingers():
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        one.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        others = one.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE), one.getsockopt(socket.IPPROTO_TCP, 1)
        print(struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0], *others)

lingers()
print(no_linger())
lingers()
thread = threading.Thread(target=lingers)
thread.start()
thread.join()
"""


@pytest.mark.skipif(
    (platform.system(), platform.machine()) not in {("Linux", "x86_64"), ("Linux", "aarch64")},
    reason="other systems have no such filter",
)
@pytest.mark.processes
def test_no_socket_lingers_and_every_other_option_is_set() -> None:
    """In a process of its own: the filter cannot be taken off."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["1 1 1", "None", "0 1 1", "0 1 1"]
