"""Figures of measurements that several items share, or that need a floor from another one."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

from aeroloop.service.bench import highest_rate, memory, wake_up
from aeroloop.service.bench.item import Figure, NotMeasuredError
from aeroloop.service.bench.loop import round_trip_us

Reading: TypeAlias = Callable[[bool], Figure]


def lateness(rate_hz: float, loaded: bool) -> Reading:
    """99.9th percentile of a wake-up's lateness at a rate; cyclictest's [µs]."""

    def read(quick: bool) -> Figure:
        found = _wake_ups(quick)[rate_hz, loaded]
        if found.floor != wake_up.CYCLICTEST:
            beside = f"beside {found.floor} the ratio is {found.ours_us / found.floor_us:.2f}"
            raise NotMeasuredError(f"no cyclictest (Debian's rt-tests) with real-time priority; {beside}")
        return Figure(found.ours_us, found.floor_us)

    return read


def resident(role: str, locked: bool) -> Reading:
    """Resident memory of a daemon; of an idle interpreter with the same libraries and a Zenoh session [MB]."""

    def read(quick: bool) -> Figure:
        found = _memories(quick)[role, locked]
        if locked and found.refused:
            raise NotMeasuredError("; ".join(found.refused))
        return Figure(found.resident_mb, found.floor_mb)

    return read


def page_faults(role: str) -> Reading:
    """Page faults of a loop's process, all threads, after its warm-up; ticks meanwhile."""

    def read(quick: bool) -> Figure:
        found = _memories(quick)[role, True]
        return Figure(found.faults, found.ticks)

    return read


def shortest_period(quick: bool) -> Figure:
    """Period of the highest rate that is held; a bare round trip [µs]."""
    found = highest_rate.measure(quick=quick)
    limit = f"a higher rate is limited by {found.missed.limit}" if found.missed else "no rate was missed"
    if found.held is None:
        raise NotMeasuredError(f"no rate is held; {limit}")
    rate_hz = found.held.rate_hz
    return Figure(1e6 / rate_hz, round_trip_us(), f"{rate_hz:.0f} Hz held for {found.seconds:g} s; {limit}")


@cache
def _wake_ups(quick: bool) -> dict[tuple[float, bool], wake_up.WakeUp]:
    return {(found.rate_hz, found.loaded): found for found in wake_up.measure(quick=quick)}


@cache
def _memories(quick: bool) -> dict[tuple[str, bool], memory.Memory]:
    return {(found.role, found.locked): found for found in memory.measure(quick=quick)}
