"""Margins: the proven age is the edge; fewer bits and a lower rate leave less; simulation within and beyond."""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import StringIO
from itertools import pairwise, product
from math import hypot, inf, sqrt
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load_over
from aeroloop.service.control.controller import Controller
from aeroloop.service.lab import margins
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.margins import (
    BITS,
    DIVERGED,
    NO_SET,
    Ages,
    Late,
    Margin,
    Margins,
    diverges_at,
    largest_ages,
    largest_error,
    measure_margins,
    three_torques,
)
from aeroloop.service.lab.workers import Workers
from aeroloop.service.terminal import margins_table
from aeroloop.service.terminal.console import Console
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import beyond, evaluate

SMALL = ["law.damping_bound=0.0119", "loop.lockstep=true"]
PAPER = load_over(Settings(), SMALL)
FREE = load_over(
    PAPER,
    [
        "plant.kind=rigid_body", "plant.ideal=true", "wire.actuators=3", "law.centre_of_mass=[0, 0, 0]",
        "law.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]", "plant.rigid_body.damping=[0, 0.006, 0.006]",
    ],
)  # fmt: skip
"""A free body of which nothing beyond the paper's equations is configured, so that a certificate may hold."""
STEP_S = 3e-5
"""More than the resolution of the search for an age."""


def with_bits(settings: Settings, out: int | None, inp: int | None) -> Settings:
    return settings.model_copy(update={"wire": settings.wire.with_bits(out, inp)})


def at(settings: Settings, rate_hz: float) -> Settings:
    return settings.model_copy(update={"loop": settings.loop.model_copy(update={"rate_hz": rate_hz})})


@pytest.mark.parametrize("bits", [(8, 6), (12, 12)])
def test_at_the_largest_age_a_certificate_holds_and_just_beyond_it_does_not(bits: tuple[int, int]) -> None:
    settings = with_bits(FREE, *bits)
    found, period = largest_ages(settings), settings.loop.period
    assert found.proven is not None
    assert found.in_range is not None
    assert certify(settings, late_s=found.in_range - period).holds
    larger = evaluate(settings, late_s=found.in_range + STEP_S - period)
    desired, plant, reached = larger.desired, larger.plant, larger.plant_reach
    exceeded = [key for *_, key in beyond(settings, desired, plant, reached)] if reached else [NO_SET]
    assert exceeded == [found.limited_by]
    assert evaluate(settings, late_s=found.proven - period).body_reach is not None
    assert evaluate(settings, late_s=found.proven + STEP_S - period).body_reach is None
    assert (found.in_range < found.proven) == (bits == (8, 6)) == (found.limited_by == "range: wire.rate.limit")


def test_where_there_is_no_set_or_none_in_range_it_is_reported() -> None:
    assert largest_ages(Settings()) == Ages(None, None, NO_SET)  # its k_θ is too large at any bits
    found = largest_ages(PAPER)
    assert found.proven is not None
    assert (found.in_range, found.limited_by) == (None, "saturation: wire.voltage.limit")


class Simulated(Workers):
    """Finds the same limits for every choice, without simulation."""

    def __init__(self) -> None:
        pass

    def __exit__(self, *exception: object) -> None:
        pass

    def each(self, work: Any, jobs: Any, progress: Any = None) -> Any:
        del work, progress
        return [30 if lost else 15 for _, lost, _ in jobs]


def test_fewer_bits_and_a_lower_rate_leave_smaller_margins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(margins, "Workers", Simulated)
    pairs, rates = ((8, 6), (10, 8), (None, None)), (20.0, 100.0, 700.0)
    reports = list[tuple[int, int]]()
    found = measure_margins(FREE, pairs, rates, progress=lambda done, total: reports.append((done, total)))
    assert [(m.bits_out, m.bits_in, m.rate_hz) for m in found.margins] == [(*b, r) for b, r in product(pairs, rates)]
    assert reports == [(done, 21) for done in range(4)]
    rows = {(m.bits_out, m.rate_hz): m for m in found.margins}
    for fewer, more in pairwise(out for out, _ in pairs):
        for rate in rates:
            assert (rows[fewer, rate].age_ms or 0) < (rows[more, rate].age_ms or 0)
            assert (rows[fewer, rate].lost_frames or 0) <= (rows[more, rate].lost_frames or 0)
    for out, _ in pairs:
        slow, middle, fast = (rows[out, rate] for rate in rates)
        assert (slow.delay_ms, slow.lost_frames) == (None, None)  # a period is older than any age that is proven
        for m in (middle, fast):
            assert m.age_ms is not None
            assert m.delay_ms == pytest.approx(m.age_ms - 1e3 / m.rate_hz, abs=2e-3)
            assert m.lost_frames == int((m.delay_ms or 0) * m.rate_hz / 1e3)
        assert (middle.delay_ms or 0) < (fast.delay_ms or 0)
        assert (middle.diverges_delay_ms, middle.diverges_lost_frames) == (150, 30)


class Recording(EmulatedPlant):
    """Keeps what is in force in every period."""

    def __init__(self) -> None:
        self.actuators, self.periods = 3, list[float]()
        self.in_force: tuple[float, ...] = (0.0,)

    def actuate(self, voltages: Sequence[float]) -> None:
        self.in_force = tuple(voltages)

    def advance(self) -> None:
        self.periods.append(self.in_force[0])


@pytest.mark.parametrize(
    ("delay", "lost", "in_force"),
    [
        (0, 0, [1, 2, 3, 4, 5, 6, 7]),
        (2, 0, [0, 0, 1, 2, 3, 4, 5]),
        (0, 2, [1, 1, 1, 4, 4, 4, 7]),
        (1, 1, [0, 0, 2, 2, 4, 4, 6]),
    ],
)
def test_a_command_acts_late_or_until_the_next_that_is_not_lost(delay: int, lost: int, in_force: list[float]) -> None:
    body = Recording()
    plant = Late(body, delay, lost)
    for k in range(1, 8):
        plant.actuate([float(k)] * 3)
        plant.advance()
    assert body.periods == in_force


@pytest.mark.parametrize("late", ["delay", "lost"])
def test_simulated_at_the_proven_margin_the_body_stays_within_its_set(late: str) -> None:
    settings = with_bits(at(FREE, 100.0), 8, 6)
    ages = largest_ages(settings)
    assert ages.in_range is not None
    ticks = int(ages.in_range / settings.loop.period) - 1
    bound = evaluate(settings, late_s=ticks * settings.loop.period).body_reach
    assert bound is not None
    error = largest_error(settings, 20.0, **{late: max(1, ticks)})
    assert 0.02 * bound.radius < error < bound.radius


@pytest.mark.parametrize("lost", [False, True], ids=["delayed", "lost"])
def test_simulation_diverges_at_its_limit_and_not_a_tick_before(lost: bool) -> None:
    settings = with_bits(at(PAPER, 100.0), 12, 12)
    limit = diverges_at(settings.description(), lost, 10.0)
    assert limit is not None
    before, there = (
        largest_error(settings, 10.0, **{"lost" if lost else "delay": ticks}) for ticks in (limit - 1, limit)
    )
    assert before <= DIVERGED < there
    ages = largest_ages(settings)
    assert ages.in_range is not None
    assert limit > ages.in_range * 100  # what is proven never diverges


@pytest.mark.parametrize("first", [0, 1, 2, 9, 10, 11, 37, 100])
@pytest.mark.parametrize("lost", [False, True])
def test_the_search_finds_the_first_tick_that_diverges(monkeypatch: pytest.MonkeyPatch, first: int, lost: bool) -> None:
    def error(_settings: Settings, _duration_s: float, *, delay: int = 0, lost: int = 0) -> float:
        return inf if delay + lost >= first else 0.0

    monkeypatch.setattr(margins, "largest_error", error)
    assert diverges_at(at(PAPER, 100.0).description(), lost, 1.0) == (first if first <= 80 else None)


def test_an_aero_is_simulated_as_the_paper_s_body() -> None:
    """Three torques and what the law assumes of it: nothing is left to err but the hold."""
    body = three_torques(with_bits(PAPER, None, None))
    assert body.plant.rigid_body.allocation == body.law.allocation
    assert [row[1:] for row in body.law.allocation[1:]] == [row[1:] for row in PAPER.law.allocation[1:]]
    assert body.wire.actuators == 3
    assert three_torques(FREE) == FREE
    assert largest_error(at(body, 200.0), 5.0) < 2e-3


def test_the_error_is_the_largest_z_of_the_second_half() -> None:
    """Without quantization the controller's own errors are the true ones."""
    body = three_torques(with_bits(at(PAPER, 100.0), None, None))
    controller = Controller(body.wire, body.law, body.reference, body.loop.period)
    norms = list[float]()

    def watch(_k: int, _measurement: bytes, _command: bytes) -> None:
        eps, omega, gains = controller.attitude_error, controller.rate_error, with_theorem(body).law.C1
        z2 = [w + c * e for w, c, e in zip(omega, gains, eps, strict=True)]
        norms.append(hypot(1 - sqrt(1 - hypot(*eps) ** 2), *eps, *z2))

    run_experiment(body, 0.3, watch=watch, controller=controller)
    assert largest_error(body, 0.3) == pytest.approx(max(norms[15:]), rel=1e-9)
    assert max(norms[15:]) < 0.5 * max(norms)


def made_up() -> Margins:
    rows = list[Margin]()
    for (out, inp), rate in product(BITS, (100.0, 500.0)):
        proven = out not in (8, 10)
        margin = Margin(
            bits_out=out,
            bits_in=inp,
            rate_hz=rate,
            set_age_ms=None if out == 8 else 28.2,
            age_ms=14.7 if proven else None,
            limited_by=NO_SET if out == 8 else "saturation: wire.voltage.limit",
            delay_ms=14.7 - 1e3 / rate if proven else None,
            lost_frames=int(14.7 * rate / 1e3) - 1 if proven else None,
            diverges_delay_ms=None if out == 16 else 150.0,
            diverges_lost_frames=None if out == 16 else int(0.28 * rate),
        )
        rows.append(margin)
    return Margins(duration_s=20, diverged=DIVERGED, watchdog_ms=100, damping_bound=0.05, margins=rows)


def test_the_tables_fit_a_terminal_and_name_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Console(width=80, file=StringIO())
    monkeypatch.setattr(margins_table, "Console", lambda: screen)
    margins_table.margins_table(made_up())
    assert isinstance(screen.file, StringIO)
    text = screen.file.getvalue()
    proven = text.partition("proven up to")[2].partition("diverges from")[0].splitlines()
    assert "12/12       4.7 (0)    12.7 (6)" in [line.rstrip() for line in proven]
    assert any(line.startswith("8/6") and line.count(NO_SET) == 2 for line in proven)
    assert any(line.startswith("10/8") and line.count("–") == 2 for line in proven)
    assert "law.damping_bound = 0.05" in text
    assert "float64" in text
    assert "150 (28)" in text


def test_the_command_prints_json_draws_and_refuses_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    asked = list[object]()

    def measure(_settings: Settings, pairs: object, **_options: object) -> Margins:
        asked.append(pairs)
        return made_up()

    monkeypatch.setattr(margins, "measure_margins", measure)
    command, figure = ["lab", "certify", "--margins"], str(tmp_path / "margins.png")
    assert execute([*command, "--bits-out", "12", "--json", "--figure", figure]) == 0
    found = json.loads(capfd.readouterr().out)
    assert list(found) == ["duration_s", "diverged", "watchdog_ms", "damping_bound", "margins"]
    assert list(found["margins"][0]) == [
        "bits_out", "bits_in", "rate_hz", "set_age_ms", "age_ms", "limited_by", "delay_ms", "lost_frames",
        "diverges_delay_ms", "diverges_lost_frames",
    ]  # fmt: skip
    picture = imread(figure)
    assert picture.shape[1] > 4000
    assert picture.std() > 0.05
    assert asked == [[(12, 6)]]
    for wrong, names in (
        (["--late", "0.01"], "--late"),
        (["--figure", "a.txt"], "a.txt"),
        (["--figure", figure], "--force"),
    ):
        assert execute([*command, *wrong]) == 2
        error = capfd.readouterr().err
        assert len(error.splitlines()) == 1
        assert names in error
