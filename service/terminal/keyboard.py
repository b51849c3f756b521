"""Keys of a live view, read one by one as they are pressed."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

_BYTES: Final = 64


@contextmanager
def keyboard() -> Iterator[Callable[[float], str] | None]:
    """A function that waits up to a time [s] for keys and returns them; None where stdin is no terminal.

    The terminal's mode is restored at the end. Keys that send an escape sequence, such as arrows, are left out; where
    the terminal is gone, the key is `q`.
    """
    if not sys.stdin.isatty():
        yield None
        return
    terminal = sys.stdin.fileno()

    def read(wait_s: float) -> str:
        if not select.select([terminal], [], [], wait_s)[0]:
            return ""
        pressed = os.read(terminal, _BYTES).decode(errors="ignore") or "q"
        return "" if pressed.startswith("\x1b") else pressed

    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield read
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
