"""Demo: runs controller, plant and recorder as processes on loopback and reviews their log."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Self

from pydantic import Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.transport.can_format import SILENT_S
from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures
from aeroloop.service.recording.rolling import log_path, parts
from aeroloop.service.review.report import FaultInterval
from aeroloop.service.review.review import read
from aeroloop.service.testing.process_group import ProcessGroup, standalone

REFRESH_S = 0.1
POLL_S = 0.01
CLAIM_WAIT_S = 60.0
"""The controller claims the plant within a second here; a machine may stall."""


class DemoFigures(Figures):
    """Figures of merit, and the faults that acted."""

    faults: list[FaultInterval] = Field(default_factory=list, description="faults of the emulated plant that acted")

    @classmethod
    def of(cls, log: Sequence[Path]) -> Self:
        """Those of a log. Raises ReviewError if it cannot be reviewed."""
        found = read(*log)
        return cls(**dict(found.figures), faults=found.findings.faults)


def run_demo(
    settings: Settings, duration_s: float, log: Path | None, show: Callable[[str, ProcessGroup], None] | None = None
) -> tuple[DemoFigures, bool]:
    """Run the experiment over Zenoh in three processes and review its log.

    Args:
        settings: The configuration; the rendezvous is replaced by a free one.
        duration_s: Length on the law's clock [s].
        log: Path of the log, or a folder for it; None for the recorder's.
        show: Called over and over with what it waits for, empty while the controller drives, and the processes.

    Returns:
        The figures, and whether the run is complete (False after ^C).

    Raises:
        HilError: A process did not start, or failed, or the log exists.
        ReviewError: The log cannot be reviewed.
        KeyboardInterrupt: ^C before there was anything to review.
    """
    path = log_path(log or settings.recorder.path, "demo-%Y%m%d-%H%M%S-%f.mcap")
    settings = standalone(settings, path, duration_s=duration_s)
    interrupted = threading.Event()
    show = show or (lambda *_: None)
    with ProcessGroup(settings) as processes, _on_interrupt(interrupted):
        show("three processes", processes)
        processes.start_loop(own_node=settings.plant.via == "can" and not node_is_on_the_bus(settings))

        def begun() -> bool:
            show("the first command", processes)
            session = any(status.session for status in processes.statuses.values())
            return session or interrupted.is_set() or not processes.running("controller")

        processes.eventually("a session", begun, CLAIM_WAIT_S)
        while processes.running("controller") and not interrupted.wait(REFRESH_S):
            processes.check()
            show("" if processes.telemetry else "the first command", processes)
        processes.check()
        show("the review of the log", processes)
    try:
        return DemoFigures.of(parts(path)), not interrupted.is_set()
    except AeroloopError:
        if interrupted.is_set():
            raise KeyboardInterrupt from None  # before there was anything to review
        raise


def node_is_on_the_bus(settings: Settings) -> bool:
    """Whether the node of `[can]` is on its bus, by its heartbeats; waits for `SILENT_S`. Raises CanError."""
    from aeroloop.protocol.transport.can_link import CanLink

    with closing(CanLink(settings.can, settings.wire, "controller")) as bus:
        deadline = time.monotonic() + SILENT_S
        while bus.peer is None and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return bus.peer is not None


@contextmanager
def _on_interrupt(event: threading.Event) -> Iterator[None]:
    """Set an event at ^C and SIGTERM. Why not KeyboardInterrupt: a library may catch and drop it at any line."""
    previous = {which: signal.signal(which, lambda *_: event.set()) for which in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for which, handler in previous.items():
            signal.signal(which, handler)
