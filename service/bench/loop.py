"""The loop over Zenoh beside a bare ping-pong of the same payloads: latency in real time, and ticks in lockstep.

The loop is an emulator and a controller, two processes with their default settings; its latency is the one in the
plant's status, from a measurement sent to its command received. This process links to them for the statuses, one a
second, and does nothing else meanwhile. Where the host refuses SCHED_FIFO, the ping-pong runs without it, too.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from statistics import median
from typing import Final, Literal, NamedTuple

from aeroloop.protocol.messages.models import Status
from aeroloop.service.bench.item import Figure, NotMeasuredError, in_turns
from aeroloop.service.bench.ping_pong import ping_pong
from aeroloop.service.bench.running import RunningLoop
from aeroloop.service.config import Settings, load
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous

Transport = Literal["tcp", "unix"]

STATUSES: Final = 11
"""A status' recent latency is of ten windows of a second; with one more, the cold first one is not among them."""
FLOOR_S: Final = 5.0
LOCKSTEP_S: Final = 2.0
TURNS: Final = 3


class Latency(NamedTuple):
    """Medians over the turns, ours and the floor's."""

    p50: Figure
    p99: Figure


@cache
def latency(transport: Transport, quick: bool) -> Latency:
    """From a measurement sent to its command received, at 500 Hz [µs]. Measured once, for two items."""
    found = [_latency(transport) for _ in range(1 if quick else TURNS)]
    ours, floor = zip(*found, strict=True)
    p50, p99 = (Figure(median(o[i] for o in ours), median(f[i] for f in floor)) for i in range(2))
    return Latency(p50, p99)


def _latency(transport: Transport) -> tuple[tuple[float, float], tuple[float, float]]:
    """50th and 99th percentile, ours and the floor's [µs]."""
    with meeting_places(transport) as network, driven_loop(network) as (settings, next_status):
        for _ in range(STATUSES):
            status = next_status()
        ours = status.recent_latency_us
        assert ours is not None  # the plant is driven
        priority = 0 if any("SCHED_FIFO" in note for note in status.notes) else settings.loop.priority
    with meeting_places(transport) as network:
        trips = sorted(_ping_pong(network, settings, settings.loop.rate_hz, FLOOR_S, priority=priority))
    return (ours.p50, ours.p99), (trips[len(trips) // 2], trips[len(trips) * 99 // 100])


def lockstep(quick: bool) -> Figure:
    """Time of a tick in lockstep; of a bare round trip, one after the other [µs]."""

    def ours() -> float:
        with meeting_places("tcp") as network, driven_loop(network, "loop.lockstep=true") as (_, next_status):
            first = last = next_status()
            while last.uptime_s < first.uptime_s + LOCKSTEP_S:
                last = next_status()
        return (last.uptime_s - first.uptime_s) / (last.ticks - first.ticks) * 1e6

    return in_turns(ours, round_trip_us, 1 if quick else TURNS, median)


def round_trip_us() -> float:
    """Mean of bare round trips, one after the other [µs]. Raises NotMeasuredError."""
    with meeting_places("tcp") as network:
        trips = _ping_pong(network, load(), 0, LOCKSTEP_S, priority=0, lossless=True)
    return sum(trips) / len(trips)


def _ping_pong(
    network: list[str], settings: Settings, rate_hz: float, seconds: float, *, priority: int, lossless: bool = False
) -> list[float]:
    payloads = settings.wire.measurement.size, settings.wire.command.size
    try:
        return ping_pong(network[0], rate_hz, seconds, payloads=payloads, priority=priority, lossless=lossless)
    except RuntimeError as error:
        raise NotMeasuredError(str(error)) from None


@contextmanager
def driven_loop(network: Sequence[str], *overrides: str) -> Iterator[tuple[Settings, Callable[[], Status]]]:
    """An emulator and a controller that drives it; their settings, and a function that waits for a plant's status."""
    own = ["controller.auto_arm=true", "controller.after_restart=configured"]
    settings = load(overrides=[*own, f"network.rendezvous={json.dumps(network)}", *overrides])
    with ProcessGroup(settings) as processes:
        running = RunningLoop(processes, settings.vehicle, ["plant"])
        processes.start("plant")
        processes.await_role("plant")
        processes.start("controller")
        running.await_drive()
        yield settings, lambda: running.statuses()["plant"]


@contextmanager
def meeting_places(transport: Transport) -> Iterator[list[str]]:
    """Endpoints at which three processes can meet: on loopback, or sockets in a folder of their own."""
    if transport == "tcp":
        yield [free_rendezvous()]
    else:
        with tempfile.TemporaryDirectory(prefix="aeroloop-") as folder:
            yield [f"unixsock-stream/{folder}/{i}" for i in range(3)]
