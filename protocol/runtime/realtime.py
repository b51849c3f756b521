"""Set-up of a real-time process: scheduling class, locked memory, CPU affinity, garbage between ticks, no lingering."""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import socket
import struct
from contextlib import suppress
from errno import EINVAL
from pathlib import Path
from typing import Final

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.spec import LoopSettings

PRIORITY: Final = 10  # of SCHED_FIFO, above all that is not real-time and below the kernel's own threads, which have 50
_PR_SET_TIMERSLACK: Final = 29
_MCL_ALL: Final = 1 | 2  # MCL_CURRENT | MCL_FUTURE
_MCL_ONFAULT: Final = 4
_YOUNG: Final = 700  # new objects after which the youngest generation is collected, which takes 0.04 to 0.3 ms
_COLLECTIONS: Final = 4  # collections of a generation after which the next older one is collected with it
_CPU_LATENCY: Final = Path("/dev/cpu_dma_latency")


class RealtimeError(AeroloopError):
    """`loop.realtime = "strict"`, and this host refused a setting; one line that names it."""


def prepare_process(settings: LoopSettings) -> list[str]:
    """Prepare this process for a loop: apply the real-time settings, unless `realtime` is off.

    The garbage collector is switched off (see `collect_garbage`), the timer slack set to its minimum, memory locked as
    it is touched, the process bound to `cpus`, SCHED_FIFO requested, idle CPUs kept awake. Returns a line for each
    setting that this host refused. Raises RealtimeError if one other than awake CPUs was, and `realtime` is strict.
    """
    if settings.realtime == "off":
        return []
    gc.collect()
    gc.freeze()
    gc.disable()
    refused = []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0):
        refused.append("timer slack stays at the system's default")
    if libc.mlockall(_MCL_ALL | _MCL_ONFAULT) and (ctypes.get_errno() != EINVAL or libc.mlockall(_MCL_ALL)):
        refused.append(f"memory lock: {os.strerror(ctypes.get_errno())} (raise LimitMEMLOCK)")
    # Every thread: Zenoh's, which carry the frames, must not wait for other work any more than the loop.
    threads = [int(thread) for thread in os.listdir("/proc/self/task")]
    try:
        for thread in threads if settings.cpus else ():
            with suppress(ProcessLookupError):  # a thread that has ended meanwhile
                os.sched_setaffinity(thread, settings.cpus)
    except OSError as error:
        refused.append(f"affinity to CPUs {settings.cpus}: {error.strerror}")
    try:
        for thread in threads:
            with suppress(ProcessLookupError):
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        refused.append(f"SCHED_FIFO {PRIORITY}: {error.strerror} (raise LimitRTPRIO)")
    if refused and settings.realtime == "strict":
        raise RealtimeError(f"loop.realtime is strict, but this machine refuses: {'; '.join(refused)}")
    try:  # Linux, Documentation/power/pm_qos_interface.rst
        # Never closed: the kernel drops the request with the last descriptor, at the end of this process.
        os.write(os.open(_CPU_LATENCY, os.O_WRONLY), bytes(4))  # 0 µs, as the s32 that the kernel reads
    except OSError as error:
        refused.append(f"idle CPUs sleep: {_CPU_LATENCY}: {error.strerror}")
    return refused


def collect_garbage() -> None:
    """Collect what garbage is due, where `prepare_process` switched Python's collector off; called after each tick.

    Hardly anything is, but for reference cycles of a user's law or plant. What was alive in `prepare_process` is not
    looked at, which would take 0.1 s.
    """
    young, collected, older = gc.get_count()
    if young > _YOUNG and not gc.isenabled():
        gc.collect(0 if collected < _COLLECTIONS else 1 if older < _COLLECTIONS else 2)


# ── sockets that do not linger ──

_MACHINES: Final = {"x86_64": (0xC000003E, 54), "aarch64": (0xC00000B7, 208)}
"""AUDIT_ARCH and the number of setsockopt, linux/audit.h and asm/unistd.h."""
_PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS, _MODE_FILTER = 22, 38, 2
_LOAD, _IF_EQUAL, _RETURN = 0x20, 0x15, 0x06  # instructions of BPF
_ALLOW, _DONE = 0x7FFF0000, 0x00050000  # SECCOMP_RET_ALLOW; SECCOMP_RET_ERRNO with no error


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def no_linger() -> str | None:
    """Leave SO_LINGER off on all sockets of this thread and of threads and processes that it starts from now on.

    Why: Zenoh sets it to 10 s on each (zenoh#2350, #2718, open). Closing a link whose peer no longer acknowledges then
    blocks the thread that also carries other peers' frames. A filter of system calls (seccomp(2)) answers that one
    setting with success and leaves it undone. Such processes get no privileges that this one does not have
    (`PR_SET_NO_NEW_PRIVS`). Returns why this host refuses; None if it does not.
    """
    machine = _MACHINES.get(platform.machine())
    if machine is None or platform.system() != "Linux":
        return "sockets linger: no filter of system calls for this system"
    # Offsets into struct seccomp_data: architecture, number of the call, its second and its third argument.
    checks = (4, machine[0]), (0, machine[1]), (24, socket.SOL_SOCKET), (32, socket.SO_LINGER)
    code = b""
    for left, (offset, value) in zip((7, 5, 3, 1), checks, strict=True):  # instructions to skip if it differs
        code += struct.pack("HBBI", _LOAD, 0, 0, offset) + struct.pack("HBBI", _IF_EQUAL, 0, left, value)
    code += struct.pack("HBBI", _RETURN, 0, 0, _DONE) + struct.pack("HBBI", _RETURN, 0, 0, _ALLOW)
    program = ctypes.byref(_Program(len(code) // 8, code))
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or prctl(_PR_SET_SECCOMP, _MODE_FILTER, program, 0, 0):
        return f"sockets linger: filter of system calls: {os.strerror(ctypes.get_errno())}"
    return None
