"""Highest rate: the search ends beside the limit, wherever it is; what a run is judged by."""

from __future__ import annotations

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.service.bench import highest_rate
from aeroloop.service.bench.highest_rate import HIGHEST_HZ, LOWEST_HZ, Run, search, stolen_s
from aeroloop.service.config import load

RUN = Run(1000.0, 0.0, 0.0, "", {"plant": 0.5, "controller": 0.4}, 0.0, {"plant": 90.0, "controller": 300.0},
          {"plant": 200.0, "controller": 100.0})  # fmt: skip


@given(limit=st.floats(50, 20_000), start=st.floats(LOWEST_HZ, HIGHEST_HZ), resolution=st.floats(1.01, 2))
def test_the_search_ends_within_its_resolution_below_the_limit(limit: float, start: float, resolution: float) -> None:
    tried: list[float] = []

    def holds(rate_hz: float) -> bool:
        tried.append(rate_hz)
        return rate_hz <= limit

    found = search(holds, start, resolution)
    assert all(LOWEST_HZ <= rate <= HIGHEST_HZ for rate in tried)
    assert len(tried) < 25  # each is a loop of several seconds
    if limit < LOWEST_HZ:
        assert found is None
    else:
        assert found is not None
        assert found <= limit
        assert found == HIGHEST_HZ or found * resolution * (1 + 1e-9) >= min(limit, HIGHEST_HZ)


def test_a_rate_is_held_if_each_end_skips_less_than_a_thousandth_and_nothing_else_happens() -> None:
    assert RUN._replace(plant_skipped=0.9e-3, controller_skipped=0.9e-3).held
    for worse in ({"plant_skipped": 1e-3}, {"controller_skipped": 1e-3}, {"trouble": "3 messages lost: ring"}):
        assert not RUN._replace(**worse).held


def test_the_limit_is_the_processor_where_it_is_used_up_and_else_the_end_that_takes_longest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(highest_rate, "_CORES", 2)
    assert RUN.limit.startswith("the controller: 99.9 % of its wake-ups within 300 µs")
    assert RUN._replace(cpu={"plant": 0.9, "controller": 0.8}).limit.startswith("the processor")
    failed = Run(1000.0, 1.0, 1.0, "no status of plant within 20 s", {}, 0.0, {}, {})
    assert failed.limit == failed.trouble


def test_a_long_run_that_fails_is_repeated_at_a_lower_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[tuple[float, float]] = []

    def run_at(_settings: object, rate_hz: float, seconds: float) -> Run:
        runs.append((rate_hz, seconds))
        limit = 1000.0 if seconds < highest_rate.LONG.confirm_s else 850.0
        return RUN._replace(rate_hz=rate_hz, plant_skipped=0.0 if rate_hz <= limit else 0.5)

    monkeypatch.setattr(highest_rate, "run_at", run_at)
    found = highest_rate.measure(load())
    long = [rate for rate, seconds in runs if seconds == highest_rate.LONG.confirm_s]
    assert found.held is not None
    assert found.missed is not None
    assert found.held.rate_hz == long[-1] <= 850 < found.missed.rate_hz == long[-2]


def test_stolen_time_is_the_eighth_column() -> None:
    assert stolen_s("cpu  100 0 50 900 7 0 2 300 0 0\ncpu0 1 2 3\n") * os.sysconf("SC_CLK_TCK") == 300


@pytest.mark.processes
def test_a_loop_runs_and_is_accounted_for_by_role() -> None:
    """At 100 Hz for a second; skipped ticks are this machine's, and not judged: processes may wait for long."""
    run = highest_rate.run_at(load(), 100.0, 1.0)
    assert run.trouble == ""
    assert set(run.cpu) == {"controller", "plant", "recorder"}
    assert set(run.wake_us) == set(run.tick_us) == {"controller", "plant"}
    assert 0 <= run.plant_skipped < 1
