"""Callbacks that Zenoh's own threads run, without making Python anew for each message.

A thread that is not Python's is given a state of the interpreter for each call (`PyGILState_Ensure`), with a stack for
its frames, 16 KiB that are mapped, touched and unmapped again: a page fault and three system calls for each message.
A further `PyGILState_Ensure` that nothing releases keeps the state, and with it that stack, for the thread's life.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable

import zenoh
from zenoh import handlers


class _KeptState(threading.local):
    """Of one thread of Zenoh's: made at its first message, for `threading.local` makes one for each thread."""

    def __init__(self) -> None:
        ctypes.pythonapi.PyGILState_Ensure()

    def keep(self) -> None:
        """Keep the calling thread's state: the first use in a thread runs `__init__`."""


_state = _KeptState()


def direct(receive: Callable[[zenoh.Sample], None]) -> handlers.Callback[zenoh.Sample]:
    """Handler that calls `receive` in the thread of Zenoh's that receives; else a further thread of Python would."""

    def call(sample: zenoh.Sample) -> None:
        _state.keep()
        receive(sample)

    return handlers.Callback(call, indirect=False)
