"""Log benchmark: review and replay of a minute at 500 Hz, in µs a tick.

Run with `uv run pytest tests/benchmarks/test_log.py --benchmark-enable`; for another length, such as an hour, set
`BENCHMARK_LOG_S=3600`. No time is asserted.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from time import process_time

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from aeroloop.service.config import load
from aeroloop.service.logs.replay import EndReplay, replay
from aeroloop.service.review.review import review
from tests.support.made_log import make_log

ROUNDS = 3


class Made:
    """A log and how many ticks it holds."""

    def __init__(self, path: Path, seconds: float) -> None:
        settings = load()
        self.path, self.ticks = path, round(seconds / settings.loop.period)
        make_log(path, self.ticks, settings=settings, chunk_every=500)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Made:
    """A log in real time, a chunk a second; a short one where nothing is measured."""
    measured = bool(pytestconfig.getoption("--benchmark-enable"))
    seconds = float(os.environ.get("BENCHMARK_LOG_S", "60")) if measured else 1.0
    return Made(tmp_path_factory.mktemp("log") / "made.mcap", seconds)


def measure(benchmark: BenchmarkFixture, made: Made, read: Callable[[], object]) -> None:
    """Time `read`, and put the processor time of the best round beside it, as µs a tick."""
    cost = []

    def timed() -> None:
        begun = process_time()
        read()
        cost.append(process_time() - begun)

    benchmark.pedantic(timed, rounds=ROUNDS)  # type: ignore[no-untyped-call]  # it has no types
    benchmark.extra_info["cpu_us_per_tick"] = round(min(cost) / made.ticks * 1e6, 2)
    benchmark.extra_info["ticks"] = made.ticks
    print(f"\n{benchmark.name}: {benchmark.extra_info}")  # noqa: T201  # seen with -s


def test_review(benchmark: BenchmarkFixture, made: Made) -> None:
    measure(benchmark, made, lambda: review(made.path))
    assert review(made.path).skipped_ticks == 0


def test_replay_of_the_controller(benchmark: BenchmarkFixture, made: Made) -> None:
    """What-ifs leave the plant out, whose own steps of integration would be most of it."""
    same = [f"loop.rate_hz={load().loop.rate_hz:g}"]
    measure(benchmark, made, lambda: replay([made.path], same))
    assert replay([made.path], same).controller == EndReplay(ticks=made.ticks, differ=0)
