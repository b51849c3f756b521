"""First code of the command `aeroloop`: ^C ends it without a traceback at any moment, while it imports, too."""

from __future__ import annotations

import io
import os
import sys

INTERRUPTED = 130
"""Exit code after ^C, as of a process that SIGINT ends in a shell."""


def main() -> None:
    """Entry point of the command."""
    try:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # no matrix here is worth a thread on each core
        from aeroloop.service.cli.main import execute

        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="replace")  # of what the terminal's encoding lacks; stderr escapes it
        code = execute(sys.argv[1:])
    except KeyboardInterrupt:
        code = INTERRUPTED
    sys.exit(code)
