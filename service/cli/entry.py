"""The command as a process: its first code, daemons that run until a signal, and how each ends without a traceback.

^C is a KeyboardInterrupt, which cleans up. A daemon waits for signals in a thread of its own once it has its settings;
SIGTERM before that ends it at once, with a line.
"""

from __future__ import annotations

import io
import logging
import os
import signal
import sys
from collections.abc import Callable
from select import select
from threading import Event, Thread
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aeroloop.protocol.runtime.node import Node
    from aeroloop.service.config import Settings

INTERRUPTED = 130
"""Exit code after ^C, as of a process that SIGINT ends in a shell."""

DAEMONS = ("controller", "plant", "can-node", "router", "recorder")
"""Verbs that run until SIGTERM, with exit code 0."""


def end_unstarted(*_: object) -> None:
    """Signal handler: end this process, a daemon that has not begun."""
    if select([], [2], [], 0)[1]:  # else nothing reads stderr, and the write would wait
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


def run_role(kind: str, settings: Settings, run: Callable[[Node], None]) -> None:
    """Join the network as a role and run until SIGTERM or SIGINT."""
    begun, stop = _stop_on_signals()
    from aeroloop.protocol.runtime.node import Node
    from aeroloop.protocol.runtime.realtime import no_linger
    from aeroloop.protocol.runtime.stderr_log import flush_log
    from aeroloop.protocol.transport.zenoh_config import THREADS
    from aeroloop.service.daemon.claim import controller_name

    os.environ.setdefault("ZENOH_RUNTIME", THREADS)
    if (refused := no_linger()) is not None:
        logging.getLogger("aeroloop").warning("%s", refused)
    name = controller_name() if kind == "controller" else None
    try:
        with Node(kind, settings.vehicle, settings.network, settings.description(), name, stop) as role:
            begun.set()
            run(role)
    finally:
        flush_log()


def run_alone(run: Callable[[Event], None]) -> None:
    """Run a process that is no role on the network until SIGTERM or SIGINT."""
    begun, stop = _stop_on_signals()
    from aeroloop.protocol.runtime.stderr_log import flush_log

    begun.set()
    try:
        run(stop)
    finally:
        flush_log()


def _stop_on_signals() -> tuple[Event, Event]:
    """Log to stderr, and return events: one to set once the process has begun, one that a signal to stop sets.

    Before the process has begun, a signal ends it. Why a thread waits for signals: a handler would run in the main
    thread, which may wait in Zenoh, or hold the lock of the event that the handler sets: it would never end.
    """
    from aeroloop.protocol.runtime.stderr_log import log_to_stderr

    begun, stop, signals = Event(), Event(), {signal.SIGTERM, signal.SIGINT}
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as under nohup; else a closed terminal
        signals.add(signal.SIGHUP)
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)  # in each thread that is started from here on
    log_to_stderr()

    def wait() -> None:
        signal.sigwait(signals)
        if not begun.is_set():
            end_unstarted()
        stop.set()

    Thread(target=wait, daemon=True).start()
    return begun, stop
