"""Loop settings of both ends: tick grid, real-time set-up, trace interval, default time-outs of a session."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import BaseModel, Field

WATCHDOG_S: Final = 0.1
"""0 V after this long without a fresh command [s], unless configured; as industrial drives do."""

FIRST_COMMAND_S: Final = 1.0
"""How long a granted claim may wait for its first command [s]."""


class LoopSettings(BaseModel, extra="forbid"):
    """Tick grid and process set-up of an end."""

    rate_hz: float = Field(default=500.0, ge=1, le=10_000, description="ticks a second [Hz]")
    lockstep: bool = Field(
        default=False, description="the plant waits for each command before it steps: repeatable, as fast as possible"
    )

    realtime: Literal["strict", "try", "off"] = Field(
        default="try",
        description="request SCHED_FIFO, locked memory, affinity, and CPUs that stay awake; strict: refuse to run "
        "without the first three; off: request none",
    )
    priority: int = Field(default=10, ge=1, le=99, description="SCHED_FIFO priority")
    cpus: list[int] = Field(default=[], description="CPUs to run on; all if empty")
    trace_s: float = Field(
        default=0.1, ge=0.01, le=10, description="time between batches of the trace, which the log records [s]"
    )

    @property
    def period_ns(self) -> int:
        """Period of the grid [ns]."""
        return round(1e9 / self.rate_hz)

    @property
    def period(self) -> float:
        """Period of the grid [s]: the law's time step."""
        return self.period_ns * 1e-9

    def ticks(self, seconds: float) -> int:
        """How many ticks make up this time, rounded."""
        return round(seconds * 1e9 / self.period_ns)
