"""Sensitivity of the tables to what was not fitted, with a stand-in for the experiments."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from random import Random
from typing import Self

import pytest

from aeroloop.service.cli.main import execute as run
from aeroloop.service.config import Settings, load, load_over
from aeroloop.service.lab import sensitivity, tables
from aeroloop.service.lab.cells import Cell, Result

BENCH = load()


def _result(settings: Settings, cell: Cell) -> Result:
    """Figures of their own for each configuration and cell, but for the bits of the input of calm cells."""
    cell = cell if cell.windy else cell._replace(bits_in=None)
    rng = Random(f"{settings.plant} {settings.loop} {cell}")  # no secret
    return Result(rng.uniform(30, 60), rng.uniform(7000, 9000))


class Pool:
    """`cells.Pool` without processes."""

    path = "compiled"

    def __init__(self, engine: str) -> None:
        del engine

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: Iterable[tuple[Settings, Cell]], progress: Callable[[int], None]) -> list[Result]:
        found = [_result(*job) for job in jobs]
        progress(len(found))
        return found


@pytest.fixture(autouse=True)
def _no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (sensitivity, tables):
        monkeypatch.setattr(module, "Pool", Pool)


@pytest.mark.parametrize("seeds", [1, 2])
def test_every_row_has_the_errors_that_the_tables_have_with_its_change(seeds: int) -> None:
    first, *changes = sensitivity.measure_sensitivity(BENCH, seeds).changes
    assert first.overrides == []
    for change in (first, *changes):
        each = tables.predict(load_over(BENCH, change.overrides), seeds)
        errors = change.z_track, change.u_total, change.windy
        assert errors == pytest.approx((each.C2.mare, each.C3.mare, each.C4.mare), rel=1e-2)  # tables round to 0.01
    # every change does change something, and no two are the same
    assert len({(change.z_track, change.u_total, change.windy) for change in (first, *changes)}) == len(changes) + 1


def test_a_change_leaves_all_else_as_configured() -> None:
    bench = load_over(BENCH, ["plant.friction.viscous=[0.001, 0.5]", "plant.aero.centre_of_mass=[0.01, 0.02, 0.03]"])
    for change in sensitivity.measure_sensitivity(bench).changes:
        plant = load_over(bench, change.overrides).plant
        assert (plant.friction.viscous[0], *plant.aero.centre_of_mass[:2]) == (0.001, 0.01, 0.02)


def test_the_verb_prints_it_as_json_and_as_a_table(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(("lab", "tables", "--sensitivity", "--json")) == 0
    changes = json.loads(capfd.readouterr().out)["changes"]
    assert run(("lab", "tables", "--sensitivity", "--markdown")) == 0
    header, _, *lines = capfd.readouterr().out.splitlines()
    assert header == "| changed alone, nothing refitted | z_track | u_total | windy cell |"
    for change, line in zip(changes, lines, strict=True):
        figures = f"{change['z_track']:.1%} | {change['u_total']:.2%} | {change['windy']:.1%}"
        assert line == f"| {change['name']} | {figures} |"
