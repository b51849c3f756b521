"""Demo: runs controller, plant and recorder as processes on loopback and reviews their log."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import zenoh
from pydantic import Field

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status, Telemetry
from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures
from aeroloop.service.host.bandwidth import PayloadRate
from aeroloop.service.recording.rolling import log_path, parts
from aeroloop.service.review.report import FaultInterval
from aeroloop.service.review.review import read
from aeroloop.service.testing.process_group import ProcessGroup, ProcessGroupError, standalone

REFRESH_S = 0.1
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


@dataclass
class Progress:
    """Values that the demo shows while it runs, from received telemetry and statuses.

    `waiting_for` says what it waits for, before the first telemetry and after the last; it is empty between.
    """

    settings: Settings
    waiting_for: str = "three processes"
    time_s: float = 0.0
    error_rad: float = 0.0
    voltages: tuple[float, ...] = ()
    statuses: dict[str, Status] = field(default_factory=dict)
    payload: PayloadRate = field(default_factory=PayloadRate)

    def receive(self, sample: zenoh.Sample) -> None:
        """Update from a telemetry or status message."""
        address = topics.read_key(str(sample.key_expr))
        if address is None:
            return
        payload = sample.payload.to_bytes()
        if address.topic.name == "telemetry":
            telemetry = Telemetry.model_validate_json(payload)
            self.waiting_for = ""
            self.time_s = telemetry.tick * self.settings.loop.period
            self.error_rad = angle(*telemetry.attitude_error)
            self.voltages = telemetry.voltages
        elif address.topic.name == "status" and address.role is not None:
            self.statuses[address.role] = status = Status.model_validate_json(payload)
            if address.role == "controller":
                self.payload.receive(status)

    @property
    def rate_hz(self) -> float:
        """Ticks a second in the controller's last status."""
        return self.statuses["controller"].rate_hz if "controller" in self.statuses else 0.0

    @property
    def skipped(self) -> int:
        """Ticks skipped by both ends so far."""
        return sum(status.skipped for status in self.statuses.values())

    @property
    def bits_per_s(self) -> tuple[float, float]:
        """Payload bits a second of measurements and of commands."""
        return self.payload.bits_per_s(self.settings.wire)


def run_demo(
    settings: Settings, duration_s: float, log: Path | None, show: Callable[[Progress], None] | None = None
) -> tuple[DemoFigures, bool]:
    """Run the experiment over Zenoh in three processes and review its log.

    Args:
        settings: The configuration; the rendezvous is replaced by a free one.
        duration_s: Length on the law's clock [s].
        log: Path of the log, or a folder for it; None for the recorder's.
        show: Called ten times a second with the progress.

    Returns:
        The figures, and whether the run is complete (False after ^C).

    Raises:
        ProcessGroupError: A process did not start, or failed, or the log exists.
        ReviewError: The log cannot be reviewed.
    """
    path = log_path(log or settings.recorder.directory, "demo-%Y%m%d-%H%M%S-%f.mcap")
    settings = standalone(settings, path, duration_s=duration_s)
    progress = Progress(settings)
    interrupted = threading.Event()
    show = show or (lambda _: None)
    show(progress)
    with ProcessGroup(settings) as processes, _on_interrupt(interrupted):
        for topic in ("telemetry", "status"):
            processes.zenoh.declare_subscriber(topics.key(topic, settings.vehicle), progress.receive)
        processes.start("recorder")
        processes.start_plant()
        processes.await_role("recorder")
        processes.await_role("plant")
        processes.start("controller")
        progress.waiting_for = "the first command"
        deadline, claimed = time.monotonic() + CLAIM_WAIT_S, False
        while processes.running("controller") and not interrupted.wait(REFRESH_S):
            processes.check()
            claimed = claimed or any(status.session for status in progress.statuses.values())
            if not claimed and time.monotonic() > deadline:
                states = ", ".join(f"{role} {status.state}" for role, status in sorted(progress.statuses.items()))
                raise ProcessGroupError(f"no session began within {CLAIM_WAIT_S:g} s ({states}); try again")
            show(progress)
        processes.check()
    progress.waiting_for = "the review of the log"
    show(progress)
    return DemoFigures.of(parts(path)), not interrupted.is_set()


@contextmanager
def _on_interrupt(event: threading.Event) -> Iterator[None]:
    """Set an event at ^C and SIGTERM. Why not KeyboardInterrupt: a library may catch and drop it at any line."""
    previous = {which: signal.signal(which, lambda *_: event.set()) for which in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for which, handler in previous.items():
            signal.signal(which, handler)
