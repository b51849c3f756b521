"""Lingering: makes closing any TCP socket of this process return at once.

Zenoh sets SO_LINGER to 10 s on each (zenoh#2350, #2718, open). Closing a link whose peer no longer acknowledges then
blocks the thread that also carries other peers' frames, for up to 10 s. A filter of system calls (seccomp(2)) answers
that one setting with success and leaves it undone; it looks at nothing else.
"""

from __future__ import annotations

import ctypes
import os
import platform
import socket
import struct
from typing import Final

_MACHINES: Final = {"x86_64": (0xC000003E, 54), "aarch64": (0xC00000B7, 208)}
"""AUDIT_ARCH and the number of setsockopt, linux/audit.h and asm/unistd.h."""
_PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS, _MODE_FILTER = 22, 38, 2
_LOAD, _IF_EQUAL, _RETURN = 0x20, 0x15, 0x06  # instructions of BPF
_ALLOW, _DONE = 0x7FFF0000, 0x00050000  # SECCOMP_RET_ALLOW; SECCOMP_RET_ERRNO with no error


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def no_linger() -> str | None:
    """Leave SO_LINGER off on all sockets of this thread and of threads and processes that it starts from now on.

    Those processes get no privileges that this one does not have (`PR_SET_NO_NEW_PRIVS`). Returns why this host
    refuses; None if it does not.
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
