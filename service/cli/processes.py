"""Processes that run until a signal: their log lines, how they join the network, and how they end."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from threading import Event, Thread
from typing import TYPE_CHECKING

from aeroloop.service.cli.entry import end_unstarted

if TYPE_CHECKING:
    from aeroloop.protocol.runtime.node import Node
    from aeroloop.service.config import Settings


def run_role(kind: str, settings: Settings, run: Callable[[Node], None]) -> None:
    """Join the network as a role and run until SIGTERM or SIGINT."""
    begun, stop = _stop_on_signals()
    from aeroloop.protocol.runtime.node import Node
    from aeroloop.protocol.runtime.realtime import no_linger
    from aeroloop.protocol.transport.zenoh_config import THREADS
    from aeroloop.service.daemon.claim import controller_name

    os.environ.setdefault("ZENOH_RUNTIME", THREADS)
    if (refused := no_linger()) is not None:
        logging.getLogger("aeroloop").warning("%s", refused)
    name = controller_name() if kind == "controller" else None
    with Node(kind, settings.vehicle, settings.network, settings.description(), name, stop) as role:
        begun.set()
        run(role)


def run_alone(run: Callable[[Event], None]) -> None:
    """Run a process that is no role on the network until SIGTERM or SIGINT."""
    begun, stop = _stop_on_signals()
    begun.set()
    run(stop)


def _stop_on_signals() -> tuple[Event, Event]:
    """Log to stderr, and return events: one to set once the process has begun, one that a signal to stop sets.

    Before the process has begun, a signal ends it. Why a thread waits for signals: a handler would run in the main
    thread, which may wait in Zenoh, or hold the lock of the event that the handler sets: it would never end.
    """
    handler = logging.StreamHandler()
    line = "%(asctime)s %(levelname)s %(role)s: %(message)s"
    handler.setFormatter(logging.Formatter(line, defaults={"role": "aeroloop"}))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    begun, stop, signals = Event(), Event(), {signal.SIGTERM, signal.SIGINT}
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as under nohup; else a closed terminal
        signals.add(signal.SIGHUP)
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)  # in each thread that is started from here on

    def wait() -> None:
        signal.sigwait(signals)
        if not begun.is_set():
            end_unstarted()
        stop.set()

    Thread(target=wait, daemon=True).start()
    return begun, stop
