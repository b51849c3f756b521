"""Processes that run until a signal: their log lines, how they join the network, and how they end.

A log line is plain text, or one JSON object for a log collector; the keys are in `service/host/README.md`, and stable.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from aeroloop.service.cli.common import guarded, log, logged_as
from aeroloop.service.cli.entry import end_unstarted

if TYPE_CHECKING:
    from threading import Event

    from aeroloop.protocol.runtime.node import Node
    from aeroloop.service.config import Settings

_KEYS: Final = ("event", "role", "vehicle", "session", "tick")
"""Keys of `log_event`'s records."""


class JsonLines(logging.Formatter):
    """A record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            **{key: getattr(record, key, None) for key in _KEYS},
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def log_as(role: str, *, as_json: bool) -> None:
    """Log to stderr from `info` up, in text or in JSON; so is the error that ends the process."""
    handler = logging.StreamHandler()
    text = logging.Formatter("%(asctime)s %(levelname)s %(role)s: %(message)s", defaults={"role": "aeroloop"})
    handler.setFormatter(JsonLines() if as_json else text)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logged_as[:] = [role] if as_json else []


def run_role(kind: str, settings: Settings, run: Callable[[Node], None]) -> None:
    """Join the network as a role and run until SIGTERM or SIGINT."""
    begun, stop = _stop_on_signals()
    from aeroloop.protocol.runtime.node import Node
    from aeroloop.protocol.runtime.realtime import no_linger
    from aeroloop.protocol.transport.zenoh_config import THREADS
    from aeroloop.service.daemon.claim import controller_name

    os.environ.setdefault("ZENOH_RUNTIME", THREADS)
    if (refused := no_linger()) is not None:
        log.warning("%s", refused)
    name = controller_name() if kind == "controller" else None
    with guarded(), Node(kind, settings.vehicle, settings.network, settings.description(), name, stop) as role:
        begun.set()
        run(role)


def run_alone(run: Callable[[Event], None]) -> None:
    """Run a process that is no role on the network until SIGTERM or SIGINT."""
    begun, stop = _stop_on_signals()
    begun.set()
    with guarded():
        run(stop)


def _stop_on_signals() -> tuple[Event, Event]:
    """Events to set once the process has begun, and set by a signal to stop, which before that ends the process.

    Why a thread waits for them: a handler would run in the main thread, where Zenoh may be waiting for a peer, and
    which may hold the lock of the event that the handler sets: then the process would never end.
    """
    from threading import Event, Thread

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
