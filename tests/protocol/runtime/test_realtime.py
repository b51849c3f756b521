"""Real-time set-up: what a loop needs is ready before its first tick, and no socket lingers."""

from __future__ import annotations

import json
import platform
import subprocess
import sys

import pytest

PREPARED = """
import ctypes, gc, json, mmap, os
from aeroloop.protocol.runtime.realtime import RealtimeError, prepare_process
from aeroloop.protocol.wire.spec import LoopSettings

def kilobytes(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))

asked = prepare_process(LoopSettings(realtime="off")), gc.isenabled()
refused = prepare_process(LoopSettings())
slack = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)  # PR_GET_TIMERSLACK [ns]
before = kilobytes("VmRSS")
untouched = mmap.mmap(-1, 64 << 20)
memory = [kilobytes("VmLck"), kilobytes("VmRSS") - before]
realtime = os.sched_getscheduler(0) == os.SCHED_FIFO
awake = "/dev/cpu_dma_latency" in [os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")]
try:
    prepare_process(LoopSettings(realtime="strict"))
    strict = ""
except RealtimeError as error:
    strict = str(error)
print(json.dumps([asked, refused, gc.isenabled(), gc.get_freeze_count(), slack, realtime, memory, awake, strict]))
"""


def test_a_prepared_process_is_as_it_reports() -> None:
    # In a process of its own: collector and scheduler are the process's, and pytest needs its own as they are.
    done = subprocess.run([sys.executable, "-c", PREPARED], capture_output=True, text=True, timeout=60, check=True)
    asked, refused, collects, frozen, slack, fifo, (locked_kb, grown_kb), awake, strict = json.loads(done.stdout)
    assert asked == [[], True]  # off: nothing is requested
    assert not collects
    assert frozen > 0
    reported = "\n".join(refused)
    assert ("timer slack" in reported) == (slack > 1)  # a real-time process may be shown 0
    assert ("SCHED_FIFO" in reported) == (not fifo)
    assert ("memory lock" in reported) == (locked_kb == 0)
    assert grown_kb < 32 << 10  # half of what was mapped and not touched: locked, but not resident
    assert ("idle CPUs sleep" in reported) == (not awake)
    grave = [line for line in refused if "idle CPUs sleep" not in line]  # a strict process starts without those
    assert len(refused) == (slack > 1) + (not fifo) + (locked_kb == 0) + (not awake)
    assert strict == (f"loop.realtime is strict, but this machine refuses: {'; '.join(grave)}" if grave else "")


LINGERING = """
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
    done = subprocess.run([sys.executable, "-c", LINGERING], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["1 1 1", "None", "0 1 1", "0 1 1"]
