"""Soak test: runs the three processes for long and reports growth of memory, threads and files, and lost sessions.

The usage of a process is read from /proc, the figures of the loop from the roles' statuses.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Percentiles, Status
from aeroloop.service.config import Settings
from aeroloop.service.recording.rolling import parts
from aeroloop.service.testing.process_group import ProcessGroup, RoleName, standalone

ROLES: Final[tuple[RoleName, ...]] = ("controller", "plant", "recorder")
WARM_UP: Final = 0.1
"""Share of the time before growth is measured."""
MAX_GROWTH: Final = 0.05
"""Largest growth of memory after warm-up that counts as steady, as a share."""
PAGE_BYTES: Final = os.sysconf("SC_PAGE_SIZE")


class Usage(BaseModel):
    """Usage of a process."""

    model_config = ConfigDict(frozen=True)

    memory_mb: float = Field(description="resident memory [MB]")
    threads: int
    files: int = Field(description="open file handles")
    cpu_s: float = Field(description="processor time since it started [s]")


class Minute(BaseModel):
    """Sample of a soak: counters since the start, latencies of the last 10 s, usage."""

    model_config = ConfigDict(frozen=True)

    at_s: float
    skipped: int = Field(description="ticks missed by the plant's grid so far")
    unanswered: int = Field(description="measurements without a command so far")
    latency_us: Percentiles | None = Field(description="from measurement to command, last 10 s [µs]")
    wake_us: Percentiles | None = Field(description="the plant's wake-up latency, last 10 s [µs]")
    usage: dict[str, Usage]


class Soak(BaseModel):
    """Result of a soak."""

    model_config = ConfigDict(frozen=True)

    rate_hz: float
    minutes: list[Minute]
    findings: list[str] = Field(description="deviations, a line each; empty if there were none")
    log: str
    log_mb: float


def run_soak(settings: Settings, minutes: float, log: Path, progress: Callable[[float], None] | None = None) -> Soak:
    """Run controller, emulator and recorder on a network of their own; `progress` is called at each sample [s].

    Raises:
        ProcessGroupError: A process did not start, or failed, or the log exists.
    """
    settings = standalone(settings, log)
    statuses: dict[str, Status] = {}
    sessions: list[str] = []

    def receive(sample: zenoh.Sample) -> None:
        status = Status.model_validate_json(sample.payload.to_bytes())
        statuses[status.role] = status
        if status.role == "plant" and status.session and status.session not in sessions:
            sessions.append(status.session)

    samples: list[Minute] = []
    total_s, every_s = minutes * 60, min(60.0, max(2.0, minutes * 60 / 10))
    with ProcessGroup(settings) as processes:
        processes.zenoh.declare_subscriber(topics.key("status", settings.vehicle), receive)
        processes.start("recorder")
        processes.start_plant()
        processes.start("controller")
        processes.await_role("plant")
        processes.await_role("recorder")
        start = time.monotonic()
        while (reached := time.monotonic() - start) < total_s:
            time.sleep(min(every_s, total_s - reached))
            processes.check()
            samples.append(_sample(processes, statuses, time.monotonic() - start))
            if progress is not None:
                progress(samples[-1].at_s)
    return Soak(
        rate_hz=settings.loop.rate_hz,
        minutes=samples,
        findings=_findings(samples, sessions),
        log=str(log),
        log_mb=round(sum(path.stat().st_size for path in parts(log)) / 1e6, 2),
    )


def _sample(processes: ProcessGroup, statuses: dict[str, Status], at_s: float) -> Minute:
    plant = statuses.get("plant")
    return Minute(
        at_s=round(at_s, 1),
        skipped=plant.skipped if plant else 0,
        unanswered=plant.sent - plant.received if plant else 0,
        latency_us=plant.recent_latency_us if plant else None,
        wake_us=plant.timing.recent_wake if plant and plant.timing else None,
        usage={role: usage_of(processes.pid(role)) for role in ROLES},
    )


def usage_of(pid: int) -> Usage:
    """Usage of a process now, from /proc."""
    proc = Path(f"/proc/{pid}")
    pages = int((proc / "statm").read_text().split()[1])
    fields = (proc / "stat").read_text().rpartition(")")[2].split()
    return Usage(
        memory_mb=round(pages * PAGE_BYTES / 1e6, 2),
        threads=int(fields[17]),
        files=len(list((proc / "fd").iterdir())),
        cpu_s=(int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"),
    )


def _findings(samples: list[Minute], sessions: list[str]) -> list[str]:
    found = []
    if len(sessions) != 1:
        found.append(f"{len(sessions)} sessions instead of one: see the log's events")
    settled = samples[int(len(samples) * WARM_UP) :]
    for role in ROLES:
        first, last = settled[0].usage[role], settled[-1].usage[role]
        if last.memory_mb > first.memory_mb * (1 + MAX_GROWTH):
            found.append(f"the {role}'s memory grew from {first.memory_mb:.1f} to {last.memory_mb:.1f} MB")
        for what, before, after in (("threads", first.threads, last.threads), ("open files", first.files, last.files)):
            if after > before:
                found.append(f"the {role}'s {what} grew from {before} to {after}")
    return found
