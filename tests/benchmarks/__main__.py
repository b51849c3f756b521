"""What the product costs, each figure beside its floor: `uv run python -m tests.benchmarks [PART ...]`.

    … [--turns 3] [--seconds 20] [--rate 500] [--log-s 60] [--set KEY=VALUE] [tick stream loop start cell log]

Product and floor take turns, so that both have the same share of what else the machine does; a row has the medians. A
floor is what nobody could do without: the law's function alone, the `mcap` library's reader. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median

from mcap.reader import make_reader

from aeroloop.protocol.messages.operator import MAX_POINTS, Points, Stream
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller, tick_function
from aeroloop.service.control.laws.registry import law_of
from aeroloop.service.control.reference import Limits, Trajectory
from aeroloop.service.lab import loop_function
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import review
from aeroloop.service.settings import ControllerSettings
from tests.benchmarks import loop
from tests.support.made_log import make_log
from tests.support.operated_loop import Loop

Row = tuple[str, float, float | None, str]
"""A figure, its floor if it has one, and what the floor is."""


def seconds_of(work: Callable[[], object]) -> float:
    """How long some work takes [s]."""
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def in_turns(turns: int, product: Callable[[], object], floor: Callable[[], object]) -> tuple[float, float]:
    """Median times of both [s]."""
    pairs = [(seconds_of(product), seconds_of(floor)) for _ in range(turns)]
    return median(ours for ours, _ in pairs), median(floors for _, floors in pairs)


def tick(given: argparse.Namespace, settings: Settings) -> Iterator[Row]:
    """The controller's tick, from a frame's bytes to a frame's bytes."""
    frames: list[bytes] = []
    run_experiment(settings, 4.0, watch=lambda _k, measurement, _command: frames.append(measurement))
    wire, period = settings.wire, settings.loop.period
    alone = Compiled(tick_function(wire, law_of(settings.law, period, wire.actuators)))

    def ticks() -> None:
        controller = Controller(wire, settings.law, settings.reference, period)
        for k, frame in enumerate(frames):
            controller.tick(frame, k)

    def evaluations() -> None:
        for _ in frames:
            alone()

    ours, floor = in_turns(10 * given.turns, ticks, evaluations)
    yield "controller's tick, µs", 1e6 * ours / len(frames), 1e6 * floor / len(frames), "its CasADi function alone"


def set_points(given: argparse.Namespace, _: Settings) -> Iterator[Row]:
    """The tick that takes up a set-point, however many have come since the last, and the check of a long reference."""
    ticks = 500
    yaws = [20 * math.sin(0.001 * n) for n in range(ticks)]

    def follow(per_tick: int) -> None:
        stream = Loop(Stream())
        stream.begin()
        for yaw in yaws:
            for _ in range(per_tick):
                stream.stream(yaw)
            stream.tick()

    for per_tick in (1, 10):
        ours, floor = in_turns(given.turns, partial(follow, per_tick), partial(follow, 0))
        yield f"tick with {per_tick} set-points, µs", 1e6 * ours / ticks, 1e6 * floor / ticks, "a tick without"
    attitudes = [(0.0, 20 * math.sin(0.03 * n), 40 * math.sin(0.011 * n)) for n in range(MAX_POINTS)]
    points = Points(times=[n / 10 for n in range(MAX_POINTS)], attitudes=attitudes)
    trajectory, limits = Trajectory.of(points), Limits.of(ControllerSettings(), actuators=2)
    ours, floor = in_turns(given.turns, partial(trajectory.check, limits), partial(Trajectory.of, points))
    yield f"check of {MAX_POINTS} points, ms", 1e3 * ours, 1e3 * floor, "their coefficients"


def real_time(given: argparse.Namespace, _: Settings) -> Iterator[Row]:
    """Controller, plant and recorder as processes: what counts is that ticks are answered within the period."""
    overrides = [f"loop.rate_hz={given.rate}", *given.overrides]
    z_track = loop.lockstep(given.seconds, overrides)
    turns = [loop.turn(given.seconds, given.rate, overrides, z_track) for _ in range(given.turns)]
    ticks, in_time, skipped = (sum(getattr(each, name) for each in turns) for name in ("ticks", "in_time", "skipped"))
    for name in ("p50", "p99", "p999", "max"):
        yield f"round trip {name}, µs", median(each.latency_us[name] for each in turns), 1e6 / given.rate, "the period"
    yield f"ticks answered in time, % of {ticks}", 100 * in_time / ticks, 100, "all"
    yield "ticks not answered", skipped, None, ""
    yield "z_track in real time", median(each.over_lockstep for each in turns), 1, "in lockstep"
    yield "memory of the largest process, MB", max(each.memory_mb for each in turns), None, ""
    for note in sorted({note for each in turns for note in each.notes}):
        print(note, file=sys.stderr)


def start_up(given: argparse.Namespace, _: Settings) -> Iterator[Row]:
    """Commands that print and end."""
    bare = [sys.executable, "-c", "import typer, rich.console"]
    for words in (["--help"], ["op", "stop", "--help"], ["lab", "experiment", "--duration=0.1"]):
        ours, floor = in_turns(given.turns, partial(loop.run, *words), partial(subprocess.run, bare, check=True))
        yield f"aeroloop {' '.join(words)}, s", ours, floor, "Python with typer and rich"


def cell(given: argparse.Namespace, settings: Settings) -> Iterator[Row]:
    """A cell of the paper's tables, 50 s, in compiled C; and all 26 cells."""
    while not loop_function.loop_of(settings).in_c:
        run_experiment(settings, 50.0)
    ours = median(seconds_of(partial(run_experiment, settings, 50.0)) for _ in range(5 * given.turns))
    yield "a cell of 50 s with its figures, ms", 1e3 * ours, None, ""
    whole = median(seconds_of(partial(loop.run, "lab", "tables", "--json")) for _ in range(given.turns))
    yield "aeroloop lab tables, s", whole, None, ""


def log(given: argparse.Namespace, settings: Settings) -> Iterator[Row]:
    """A log at 500 Hz, reviewed and replayed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.mcap"
        make_log(path, round(given.log_s / settings.loop.period), settings=settings, chunk_every=500)

        def read() -> None:
            with path.open("rb") as file:
                for _ in make_reader(file).iter_messages():
                    pass

        for what, work in (("review", partial(review, path)), ("replay of both ends", partial(replay, [path]))):
            ours, floor = in_turns(given.turns, work, read)
            yield f"{what} of {given.log_s:g} s of log, s", ours, floor, "its messages read by mcap"


PARTS = {"tick": tick, "stream": set_points, "loop": real_time, "start": start_up, "cell": cell, "log": log}


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=500.0)
    parser.add_argument("--log-s", type=float, default=60.0)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    given = parser.parse_args()
    if unknown := set(given.parts) - PARTS.keys():
        parser.error(f"no such part: {', '.join(unknown)}")
    print("| what | product | floor | ratio | the floor is |\n|---|--:|--:|--:|---|")
    for part in given.parts or PARTS:
        for what, product, floor, floor_is in PARTS[part](given, load(overrides=given.overrides)):
            beside = "– | –" if floor is None else f"{floor:.4g} | {product / floor:.2f}"
            print(f"| {what} | {product:.4g} | {beside} | {floor_is} |", flush=True)


if __name__ == "__main__":
    main()
