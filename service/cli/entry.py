"""First code of the command `aeroloop`: takes ^C over before anything slow is imported.

Until a verb's work begins, and after it ends, ^C ends the process at once, without a traceback. While it works, ^C is a
KeyboardInterrupt, which cleans up (`common.guarded`). Daemons and live views install handlers of their own; SIGTERM
before that ends a daemon at once, with a line.
"""

from __future__ import annotations

import io
import os
import signal
import sys

INTERRUPTED = 130
"""Exit code after ^C, as of a process that SIGINT ends in a shell."""

DAEMONS = ("controller", "plant", "can-node", "router", "recorder")
"""Verbs that run until SIGTERM, with exit code 0."""


def end_at_once(*_: object) -> None:
    """Signal handler: end this process without clean-up, and show the cursor, which a progress bar hides."""
    if os.isatty(2):
        os.write(2, b"\x1b[?25h\n")
    os._exit(INTERRUPTED)


def end_unstarted(*_: object) -> None:
    """Signal handler: end this process, a daemon that has not begun."""
    os.write(2, b"aeroloop: ended by a signal before it had started\n")
    os._exit(0)


def main() -> None:
    """Entry point of the command."""
    if next((word for word in sys.argv[1:] if not word.startswith("--")), "") in DAEMONS:
        signal.signal(signal.SIGTERM, end_unstarted)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in a background job
        signal.signal(signal.SIGINT, end_at_once)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # no matrix here is worth a thread on each core
    from aeroloop.service.cli.main import execute

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # of what the terminal's encoding lacks; stderr escapes it
    sys.exit(execute(sys.argv[1:]))
