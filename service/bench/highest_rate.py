"""Highest rate that controller, emulator and recorder hold on this machine, and what limits it.

Short runs bisect between a rate that is held and one that is not; a long one confirms, at a lower rate each time it
fails. A rate is held while each end skips fewer than 0.1 % of the session's ticks, the session lasts, and the recorder
loses nothing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from math import ceil, log2, sqrt
from pathlib import Path
from typing import Final, NamedTuple, Self

from aeroloop.protocol.messages.models import Status
from aeroloop.service.bench.running import ROLES, RunningLoop, running_loop
from aeroloop.service.config import Settings, load
from aeroloop.service.lab.soak import usage_of
from aeroloop.service.testing.process_group import ProcessGroupError

MOST_SKIPPED: Final = 1e-3
"""Largest share of ticks that either end may skip."""
LOWEST_HZ: Final = 100.0
HIGHEST_HZ: Final = 10_000.0
"""The highest that `loop.rate_hz` may be."""
SATURATED: Final = 0.8
"""From this share of all cores on, used by the three processes, the processor is the limit."""
_SETTLE_S: Final = 1.0
"""The first second of a session is warm-up."""
_CORES: Final = os.cpu_count() or 1
_LOWER: Final = 0.75
"""Factor on the rate after a long run that failed."""


class Plan(NamedTuple):
    """How long to search.

    Attributes:
        try_s: Of each run that bisects [s].
        confirm_s: Of the run that confirms [s].
        resolution: Ratio of the rates between which the search ends.
    """

    try_s: float
    confirm_s: float
    resolution: float


LONG: Final = Plan(try_s=3.0, confirm_s=60.0, resolution=1.1)
QUICK: Final = Plan(try_s=2.0, confirm_s=5.0, resolution=1.25)


class Run(NamedTuple):
    """One run at one rate.

    Attributes:
        rate_hz: The rate [Hz].
        plant_skipped: Share of ticks that the plant's grid missed.
        controller_skipped: Share of the plant's ticks that the controller did not answer in time.
        trouble: Why the rate is not held besides, such as a session that was lost; empty if nothing else happened.
        cpu: Processor time of each process, as a share of a core.
        stolen: Time that a virtual machine's host ran something else, as a share of all cores.
        wake_us: p99.9 of each end's wake-ups [µs]: from the deadline, or the arrival of a measurement, to the tick.
        tick_us: p99.9 of the duration of each end's ticks [µs].
    """

    rate_hz: float
    plant_skipped: float
    controller_skipped: float
    trouble: str
    cpu: dict[str, float]
    stolen: float
    wake_us: dict[str, float]
    tick_us: dict[str, float]

    @property
    def held(self) -> bool:
        """Whether the rate was held."""
        return not self.trouble and max(self.plant_skipped, self.controller_skipped) < MOST_SKIPPED

    @property
    def limit(self) -> str:
        """What stands in the way of a higher rate, in words."""
        if not self.tick_us:
            return self.trouble
        shares = ", ".join(f"{role} {share:.0%}" for role, share in self.cpu.items())
        cores = f"of a core {shares}; {self.stolen:.1%} of all cores stolen by the host"
        if sum(self.cpu.values()) >= SATURATED * _CORES:
            return f"the processor: {cores}"
        end = max(self.tick_us, key=lambda role: self.wake_us[role] + self.tick_us[role])
        return (
            f"the {end}: 99.9 % of its wake-ups within {self.wake_us[end]:.0f} µs and of its ticks within "
            f"{self.tick_us[end]:.0f} µs, of {1e6 / self.rate_hz:.0f} µs; {cores}"
        )


class HighestRate(NamedTuple):
    """Result of a search.

    Attributes:
        held: The run that confirmed; None if no rate was held.
        missed: The run at the lowest rate that was not held; None if every rate was.
        seconds: Length of the run that confirmed [s].
    """

    held: Run | None
    missed: Run | None
    seconds: float


def measure(settings: Settings | None = None, *, quick: bool = False) -> HighestRate:
    """Search from the configured rate on: some minutes, or one or two if `quick`."""
    settings, plan = settings or load(), QUICK if quick else LONG
    missed: list[Run] = []

    def holds(rate_hz: float) -> bool:
        run = run_at(settings, rate_hz, plan.try_s)
        if not run.held:  # other work on this machine may have cost it a few ticks
            run = run_at(settings, rate_hz, plan.try_s)
        missed.extend([] if run.held else [run])
        return run.held

    rate_hz = search(holds, settings.loop.rate_hz, plan.resolution)
    held = None
    while held is None and rate_hz is not None and rate_hz >= LOWEST_HZ:
        run = run_at(settings, rate_hz, plan.confirm_s)
        held = run if run.held else None
        missed.extend([] if run.held else [run])
        rate_hz *= _LOWER
    return HighestRate(held, min(missed, key=lambda run: run.rate_hz, default=None), plan.confirm_s)


def search(holds: Callable[[float], bool], start_hz: float, resolution: float) -> float | None:
    """The highest rate that holds, to a factor `resolution`, in LOWEST_HZ…HIGHEST_HZ; None if none does [Hz].

    The rate is doubled, or halved, until one holds and one does not; then the interval between them is bisected.
    """
    low = high = None
    rate_hz = start_hz
    while low is None or high is None or high / low > resolution:
        if holds(rate_hz):
            low = rate_hz
            if low >= HIGHEST_HZ:
                break
        else:
            high = rate_hz
            if high <= LOWEST_HZ:
                break
        if low is None:
            rate_hz = max(rate_hz / 2, LOWEST_HZ)
        else:
            rate_hz = min(2 * low, HIGHEST_HZ) if high is None else sqrt(low * high)
    return low


def run_at(settings: Settings, rate_hz: float, seconds: float) -> Run:
    """Run the loop at a rate. Where the wire's counter is too short for it, the frames have a longer one."""
    patience_s = max(settings.plant.watchdog_s, settings.controller.stale_s)
    counter_bits = max(settings.wire.counter_bits, ceil(log2(2 * patience_s * rate_hz)))
    settings = settings.model_copy(
        update={
            "loop": settings.loop.model_copy(update={"rate_hz": rate_hz}),
            "wire": settings.wire.model_copy(update={"counter_bits": counter_bits}),
        }
    )
    try:
        with running_loop(settings) as running:
            running.await_drive()
            time.sleep(_SETTLE_S)
            before = _Sample.of(running)
            time.sleep(seconds)
            return _run(rate_hz, before, _Sample.of(running))
    except ProcessGroupError as error:
        return Run(rate_hz, 1.0, 1.0, str(error), {}, 0.0, {}, {})


class _Sample(NamedTuple):
    """Counters of a running loop.

    Attributes:
        at_s: When, on the monotonic clock.
        statuses: Of each role.
        cpu_s: Processor time of each role.
        stolen_s: Time that the host ran something else, all cores summed.
    """

    at_s: float
    statuses: dict[str, Status]
    cpu_s: dict[str, float]
    stolen_s: float

    @classmethod
    def of(cls, running: RunningLoop) -> Self:
        statuses = running.statuses()
        cpu_s: dict[str, float] = {role: usage_of(running.processes.pid(role)).cpu_s for role in ROLES}
        return cls(time.monotonic(), statuses, cpu_s, stolen_s(Path("/proc/stat").read_text()))


def stolen_s(stat: str) -> float:
    """Time that the host ran something else than this virtual machine, all cores summed [s]; of /proc/stat, proc(5)."""
    return int(stat.split()[8]) / os.sysconf("SC_CLK_TCK")


def _run(rate_hz: float, before: _Sample, after: _Sample) -> Run:
    """What happened between two samples."""
    elapsed_s = after.at_s - before.at_s
    plant, controller = after.statuses["plant"], after.statuses["controller"]
    ticks = max(1, plant.ticks - before.statuses["plant"].ticks)  # of the grid, skipped or not
    trouble = list(after.statuses["recorder"].notes)
    if plant.session is None or plant.session != before.statuses["plant"].session:
        trouble.append(f"the session was lost{': ' + plant.cause if plant.cause else ''}")
    timings = {status.role: status.timing for status in (controller, plant) if status.timing}
    return Run(
        rate_hz=rate_hz,
        plant_skipped=(plant.skipped - before.statuses["plant"].skipped) / ticks,
        controller_skipped=(controller.skipped - before.statuses["controller"].skipped) / ticks,
        trouble="; ".join(trouble),
        cpu={role: (after.cpu_s[role] - before.cpu_s[role]) / elapsed_s for role in ROLES},
        stolen=(after.stolen_s - before.stolen_s) / (elapsed_s * _CORES),
        wake_us={role: timing.recent_wake.p999 for role, timing in timings.items() if timing.recent_wake},
        tick_us={role: timing.recent_busy.p999 for role, timing in timings.items() if timing.recent_busy},
    )
