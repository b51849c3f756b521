"""Real-time set-up of a process: scheduling class, locked memory, CPU affinity, no garbage collection, built parsers.

Memory is locked page by page as it is touched (`MCL_ONFAULT`, Linux 4.4): a loop's pages are touched in its first
second, which is warm-up, and stay. Without `MCL_ONFAULT`, every thread's stack and malloc's arenas are made resident in
full, three times what is used. What a process publishes stays in its caches for a minute, so its heap grows for as
long: room for it is touched beforehand, and the heap, which all threads share, never shrinks. So are room for Python's
objects, and all variables of libraries.

An idle CPU that sleeps takes long to wake; on a virtual machine, until the host schedules it again. While a process
keeps /dev/cpu_dma_latency open with 0 µs, idle CPUs poll instead (Linux, Documentation/power/pm_qos_interface.rst).
"""

from __future__ import annotations

import ctypes
import gc
import os
from errno import EINVAL
from pathlib import Path
from typing import Final

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import build_messages
from aeroloop.protocol.wire.loop import LoopSettings

_PR_SET_TIMERSLACK: Final = 29
_MCL_CURRENT: Final = 1
_MCL_FUTURE: Final = 2
_MCL_ONFAULT: Final = 4
_MADV_POPULATE_WRITE: Final = 23  # Linux 5.14
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_M_ARENA_MAX: Final = -8
_HEAP_ROOM: Final = 8 << 20
"""Twice what the caches of an emulator at 500 Hz hold [bytes]."""
_OBJECT: Final = 400
"""Python's own heap holds objects of up to 512 bytes [bytes]."""
_OBJECTS_ROOM: Final = 2 << 20
"""As much as an arena of Python's heap and what the last one has left [bytes]."""
_objects: Final[list[bytes]] = []
"""Those that keep arenas mapped."""
_STACK: Final = 2 << 20
"""Least stack of a thread [bytes]."""
_CPU_LATENCY: Final = Path("/dev/cpu_dma_latency")
_NO_LATENCY: Final = bytes(4)
"""0 µs, as the s32 that the kernel reads."""


class RealtimeError(AeroloopError):
    """`loop.realtime = "strict"`, and this host refused a setting; one line that names it."""


def share_heap() -> None:
    """Let threads that start from now on, Zenoh's, use the one heap in which `prepare_process` makes room.

    Else malloc (glibc's) gives each a heap of its own, which grows page by page as messages come.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_ARENA_MAX, 1)


def prepare_process(settings: LoopSettings) -> list[str]:
    """Prepare this process for a loop: build the parsers of messages, apply the real-time settings.

    The garbage collector is switched off (the loop makes no cycles), the timer slack set to its minimum, memory locked,
    the process bound to `cpus`, SCHED_FIFO requested, idle CPUs kept awake.

    Returns:
        One line for each setting that this host refused; nothing is requested with `realtime = "off"`.

    Raises:
        RealtimeError: A setting other than awake CPUs was refused, and `realtime` is strict.
    """
    build_messages()
    if settings.realtime == "off":
        return []
    gc.collect()
    gc.freeze()
    gc.disable()
    refused = []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0):
        refused.append("timer slack stays at the system's default")
    everything = _MCL_CURRENT | _MCL_FUTURE
    if libc.mlockall(everything | _MCL_ONFAULT) and (ctypes.get_errno() != EINVAL or libc.mlockall(everything)):
        refused.append(f"memory lock: {os.strerror(ctypes.get_errno())} (raise LimitMEMLOCK)")
    _make_room(libc)
    _make_room_for_objects()
    _touch_data(libc)
    try:
        # Every thread: Zenoh's, which carry the frames, must not wait for other work any more than the loop.
        for thread in os.listdir("/proc/self/task"):
            if settings.cpus:
                os.sched_setaffinity(int(thread), settings.cpus)
    except OSError as error:
        refused.append(f"affinity to CPUs {settings.cpus}: {error.strerror}")
    try:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(settings.priority))
    except OSError as error:
        refused.append(f"SCHED_FIFO {settings.priority}: {error.strerror} (raise LimitRTPRIO)")
    if refused and settings.realtime == "strict":
        raise RealtimeError(f"loop.realtime is strict, but this machine refuses: {'; '.join(refused)}")
    try:
        # Never closed: the kernel drops the request with the last descriptor, at the end of this process.
        os.write(os.open(_CPU_LATENCY, os.O_WRONLY), _NO_LATENCY)
    except OSError as error:
        refused.append(f"idle CPUs sleep: {_CPU_LATENCY}: {error.strerror}")
    return refused


def _make_room(libc: ctypes.CDLL) -> None:
    """Touch free memory of the heap, which malloc (glibc's; others are left as they are) then never gives back."""
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, 2 * _HEAP_ROOM)  # below it, memory is of the heap
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
        libc.malloc.restype = ctypes.c_void_p
        room = ctypes.c_void_p(libc.malloc(_HEAP_ROOM))
        ctypes.memset(room, 1, _HEAP_ROOM)
        libc.free(room)


def _make_room_for_objects() -> None:
    """Touch free memory of Python's heap. Of each of its arenas, 1 MiB, an object stays: an empty one is unmapped."""
    objects = [bytes(_OBJECT) for _ in range(_OBJECTS_ROOM // _OBJECT)]
    _objects.extend(objects[:: 2**18 // _OBJECT])


def _touch_data(libc: ctypes.CDLL) -> None:
    """Touch what may be written: variables of libraries, Python's heap, malloc's others; not threads' stacks."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, access, *_ = line.split()
        begin, end = (int(address, 16) for address in addresses.split("-"))
        if access == "rw-p" and end - begin < _STACK:
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_POPULATE_WRITE)
