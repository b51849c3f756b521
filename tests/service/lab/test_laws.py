"""Comparison of laws: the settings of each, what each survives, that a law which fails is a row; what is printed."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pytest

from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load, load_over
from aeroloop.service.lab.engine import figures_row, run_of
from aeroloop.service.lab.laws import LAWS, compared_laws
from aeroloop.service.lab.margins import WITHIN_DEG, Late, largest_error_deg, survived
from aeroloop.service.theorem.certificate import certify
from tests.support.failing_laws import FAILING
from tests.support.in_this_process import run_here

SLOW = load(overrides=["loop.rate_hz=100"])
PD = load_over(SLOW, ["law.kind=pd"])
S = 4.0
NO_GAMMA = ", Γ = 0"
RUNAWAY, RAISING = f"{FAILING}:Runaway", f"{FAILING}:Failing"


def compared(settings: Settings, *laws: str) -> dict[str, Settings]:
    """The configuration of every law."""
    return {name: load_over(settings, overrides) for name, overrides in compared_laws(settings, laws).items()}


@pytest.mark.parametrize("configured", ["adaptive", "adaptive-torque"])
def test_without_adaptation_a_law_is_the_same_but_for_its_adaptation_gains(configured: str) -> None:
    """And what is known of the damping is the same for all laws, so that their bounds compare."""
    own = load_over(SLOW, [f"law.kind={configured}", "law.damping_bound=0.02", "law.damping_estimate=[0, 0.01, 0.02]"])
    found = compared(own)
    assert found[configured].law == own.law
    assert set(found) == {*LAWS, "adaptive, Γ = 0", "adaptive-torque, Γ = 0"}
    laws = {name: settings.law.model_dump() for name, settings in found.items()}
    for law in laws.values():
        assert (law["damping_bound"], law["damping_estimate"]) == (0.02, (0.0, 0.01, 0.02))
    for kind in ("adaptive", "adaptive-torque"):
        law, without = laws[kind], laws[kind + NO_GAMMA]
        assert all(any(law[name]) for name in law if name.startswith("Gamma"))
        assert not any(any(without[name]) for name in without if name.startswith("Gamma"))
        assert {name for name in law if law[name] != without.get(name)} == {
            name for name in law if name.startswith("Gamma") or (name, kind) == ("kind", "adaptive")
        }


def test_a_law_that_runs_away_or_raises_is_a_row_with_its_reason_and_the_others_have_their_figures(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here(monkeypatch)
    words = [word for kind in ("pd", RUNAWAY, RAISING) for word in ("--law", kind)]
    words += ["--duration", "3", "--seeds", "2", "--set", "loop.rate_hz=100"]
    assert execute(["lab", "laws", *words, "--json"]) == 1
    printed = capsys.readouterr()
    assert "plain Python: " in printed.err
    found = json.loads(printed.out)
    rows = {(row["law"], row["wind"]): row for row in found["rows"]}
    settings = compared(SLOW, "pd")["pd"]
    for wind, blowing in (("calm", "false"), ("wind", "true")):
        runs = [run_of(settings, [f"plant.wind.blowing={blowing}"], seed) for seed in (0, 1)]
        both, pd = [figures_row(run.settings(), 3.0) for run in runs], rows["pd", wind]
        for name in ("z_track", "u_total", "command_changes_per_s"):
            assert pd[name] == pytest.approx((both[0][name] + both[1][name]) / 2)
            assert pd["spread"][name] == pytest.approx(abs(both[0][name] - both[1][name]) / 2**0.5)
        for name in ("max_error_deg", "second_half_error_deg"):
            assert pd[name] == max(row[name] for row in both)
    pd, runaway, raising = (rows[law, "calm"] for law in ("pd", RUNAWAY, RAISING))
    assert (pd["pointwise_deg"], runaway["pointwise_deg"]) == (certify(settings, margins=False).pointwise_deg, None)
    margins = survived(settings, 3.0)
    assert {name: pd[name] for name in margins} == margins
    assert runaway["z_track"] is None
    assert "the loop ended after" in runaway["reason"]
    assert "RuntimeError: the estimator diverged (failing_laws.py, line" in raising["reason"]

    assert execute(["lab", "laws", *words, "--markdown"]) == 1
    text = capsys.readouterr().out
    assert f"{RUNAWAY}, calm: 2 of 2 seeds: the loop ended after" in text
    assert "| none | none |" in text
    [line] = [line for line in text.splitlines() if line.startswith("| pd |")]
    assert line.startswith(f"| pd | {pd['pointwise_deg']:.2f}° | {pd['z_track'] * 1e4:.1f}; ")
    assert line.endswith(f"| {pd['delay_ms']:g} ms | {pd['lost_frames']} |")


# Margins: commands that act late or never


def test_what_a_law_survives_is_the_last_step_before_the_bound() -> None:
    found = survived(PD, S)
    ticks, frames = round(found["delay_ms"] / 10), found["lost_frames"]
    assert min(ticks, frames) > 0
    for kept, too_late in (((ticks, 0), (ticks + 1, 0)), ((0, frames), (0, frames + 1))):
        assert largest_error_deg(PD, S, *kept) <= WITHIN_DEG < largest_error_deg(PD, S, *too_late)


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
