"""First code of the command `aeroloop`: ^C, and SIGTERM of a daemon, end it without a traceback at any moment.

^C is a KeyboardInterrupt, which cleans up. A daemon installs handlers of its own once it has its settings; SIGTERM
before that ends it at once, with a line.
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


def end_unstarted(*_: object) -> None:
    """Signal handler: end this process, a daemon that has not begun."""
    os.write(2, b"aeroloop: ended by a signal before it had started\n")
    os._exit(0)


def main() -> None:
    """Entry point of the command."""
    try:
        if next((word for word in sys.argv[1:] if not word.startswith("--")), "") in DAEMONS:
            signal.signal(signal.SIGTERM, end_unstarted)
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # no matrix here is worth a thread on each core
        from aeroloop.service.cli.main import execute

        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="replace")  # of what the terminal's encoding lacks; stderr escapes it
        code = execute(sys.argv[1:])
    except KeyboardInterrupt:
        code = INTERRUPTED
    sys.exit(code)
