"""Comparison of laws: what each combination is, that a law which fails is a row, and that margins are edges."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from matplotlib.image import imread

from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load, load_over
from aeroloop.service.control.laws.baselines import response_of
from aeroloop.service.lab import laws as module
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.laws import LAWS, Choice, Late, compare, largest_error_deg, last_good, survived
from aeroloop.service.lab.sweep import with_seed
from aeroloop.service.theorem.certificate import certify
from tests.support.failing_laws import FAILING
from tests.support.in_this_process import run_here

SLOW = load(overrides=["loop.rate_hz=100"])
NO_GAMMA = ", Γ = 0"
RUNAWAY, RAISING = f"{FAILING}:Runaway", f"{FAILING}:Raising"


def compared(settings: Settings, **given: Any) -> dict[Choice, Settings]:
    """The configuration of every combination."""
    plan, choices, *_ = compare(settings, **given, duration_s=1.0)
    return {
        choice: load_over(settings, each.overrides) for choice, each in zip(choices, plan.configurations, strict=True)
    }


def test_by_default_every_law_of_ours_flies_both_plants_calm_and_in_wind_with_two_choices_of_bits() -> None:
    found = compared(SLOW)
    assert {choice.law for choice in found} == {*LAWS, "adaptive, Γ = 0", "adaptive-torque, Γ = 0"}
    assert len(found) == (len(LAWS) + 2) * 2 * 2 * 2
    for choice, settings in found.items():
        law, plant = settings.law, settings.plant
        assert law.kind == {"adaptive, Γ = 0": "nonadaptive"}.get(choice.law, choice.law.removesuffix(", Γ = 0"))
        assert (plant.kind, plant.wind.blowing) == (choice.plant, choice.wind == "wind")
        bits = (8, 8, 6) if choice.bits == "8/6" else (None,) * 3
        wire = settings.wire
        assert (wire.attitude.bits, wire.rate.bits, wire.voltage.bits) == bits
        assert (plant.sensors.attitude == "encoders") == (choice.sensors == "encoders") == (choice.plant == "aero")
        if choice.plant == "rigid_body":
            assert wire.actuators == 3
            assert law.allocation == plant.rigid_body.allocation
            assert plant.wind.torque == (0.0, *SLOW.plant.wind.torque)


def test_others_have_the_response_that_the_configured_gains_give_and_a_configured_law_stays_as_it_is() -> None:
    C1, C2 = (0.5, 0.6, 0.7), (0.2, 0.1, 0.3)
    own = load_over(SLOW, [f"law.C1={[*C1]}", f"law.C2={[*C2]}", "law.inertia=[0.02, 0.03, 0.04]"])
    laws = {choice.law: settings.law.model_dump() for choice, settings in compared(own, plants=["aero"]).items()}
    assert laws["adaptive"] == own.law.model_dump()
    wn, zeta = response_of((0.02, 0.03, 0.04), C1, C2)
    for i, J in enumerate((0.02, 0.03, 0.04)):
        assert laws["pd"]["kp"][i] == pytest.approx(2 * J * wn[i] ** 2, rel=1e-4)
        assert laws["pd"]["kd"][i] == pytest.approx(2 * J * zeta[i] * wn[i], rel=1e-4)
        assert (laws[f"adaptive{NO_GAMMA}"]["C1"][i], laws[f"adaptive{NO_GAMMA}"]["C2"][i]) == (C1[i], C2[i])
    mine = load_over(SLOW, ["law.kind=pd", "law.kp=[1, 2, 3]"])
    [settings] = compared(mine, laws=["pd"], bits=["8/6"], winds=["calm"], plants=["aero"]).values()
    assert settings.law == mine.law


@pytest.mark.parametrize("configured", ["adaptive", "adaptive-torque"])
def test_without_adaptation_a_law_is_the_same_but_for_its_adaptation_gains(configured: str) -> None:
    """And what is known of the damping is the same for all laws, so that their bounds compare."""
    own = load_over(SLOW, [f"law.kind={configured}", "law.damping_bound=0.02", "law.damping_estimate=[0, 0.01, 0.02]"])
    found = compared(own, laws=["adaptive", "adaptive-torque", "pd"], bits=["8/6"], winds=["calm"], plants=["aero"])
    laws = {choice.law: settings.law.model_dump() for choice, settings in found.items()}
    for law in laws.values():
        assert (law["damping_bound"], law["damping_estimate"]) == (0.02, (0.0, 0.01, 0.02))
    for kind in ("adaptive", "adaptive-torque"):
        law, without = laws[kind], laws[kind + NO_GAMMA]
        assert all(any(law[name]) for name in law if name.startswith("Gamma"))
        assert not any(any(without[name]) for name in without if name.startswith("Gamma"))
        assert {name for name in law if law[name] != without.get(name)} == {
            name for name in law if name.startswith("Gamma") or (name, kind) == ("kind", "adaptive")
        }


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"sensors": ["radar"]}, "--sensors takes .*, not 'radar'"),
        ({"winds": ["storm"]}, "--wind takes calm, wind, not 'storm'"),
        ({"bits": ["8"]}, "such as 10/6/6"),
    ],
)
def test_an_unknown_choice_is_one_line(given: dict[str, Any], text: str) -> None:
    with pytest.raises(match=text):
        compare(SLOW, **given, duration_s=1.0)


def test_a_law_that_runs_away_or_raises_is_a_row_with_its_reason_and_the_others_have_their_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here(monkeypatch)  # what workers bring back: test_workers.py
    out, figure = tmp_path / "laws.parquet", tmp_path / "laws.png"
    laws = [word for kind in ("pd", RUNAWAY, RAISING) for word in ("--law", kind)]
    few = ["--bits", "8/6", "--wind", "calm", "--plant", "aero"]
    few += ["--duration", "3", "--seeds", "2", "--set", "loop.rate_hz=100"]
    assert execute(["lab", "laws", *laws, *few, "--out", str(out), "--figure", str(figure), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    pd, runaway, raising = found["rows"]
    # sent on change, which changes no figure but the frames'
    settings = load_over(SLOW, ["law.kind=pd"])
    runs = [run_experiment(with_seed(settings, seed), 3.0) for seed in (0, 1)]
    for name in ("z_track", "u_total", "command_changes_per_s"):
        both = [getattr(run, name) for run in runs]
        assert pd[name] == pytest.approx(sum(both) / 2, rel=1e-4)  # the rule's gains have five digits
        assert pd["spread"][name] == pytest.approx(abs(both[0] - both[1]) / 2**0.5, rel=1e-3)
    for name in ("max_error_deg", "second_half_error_deg"):
        assert pd[name] == pytest.approx(max(getattr(run, name) for run in runs), rel=1e-4)
    assert pd["pointwise_deg"] == pytest.approx(certify(settings, margins=False).pointwise_deg, rel=1e-3)
    assert (pd["holds"], runaway["holds"], runaway["pointwise_deg"]) == (False, None, None)
    always = sum(direction.bits_per_s or 0 for direction in (runs[0].measurement, runs[0].command))
    assert 0 < pd["bits_per_s"] < always
    assert runaway["z_track"] is None
    assert "the loop ended after" in runaway["reason"]
    assert "ZeroDivisionError: by nothing (failing_laws.py, line" in raising["reason"]
    margins = {margin["law"]: margin for margin in found["margins"]}
    assert margins["pd"]["delay_ms"] > 0
    assert margins[RUNAWAY]["delay_ms"] is margins[RAISING]["lost_frames"] is None
    table = pq.read_table(out)
    assert table["law"].to_pylist() == [kind for kind in ("pd", RUNAWAY, RAISING) for _ in range(2)]
    assert table["delay_ms"].to_pylist() == [margins["pd"]["delay_ms"]] * 2 + [None] * 4
    assert imread(figure).size > 1e5

    before = out.read_bytes()
    assert execute(["lab", "laws", *laws, *few, "--within", "5", "--out", str(out)]) == 2  # its margins are others
    assert execute(["lab", "laws", *laws[:2], *few, "--out", str(out)]) == 2
    assert "replace it with --force" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert execute(["lab", "laws", *laws, *few, "--markdown"]) == 0
    text = capsys.readouterr().out
    assert f"| {RUNAWAY} | – | – |" in text
    assert f"{RUNAWAY}, calm: 2 of 2 seeds: the loop ended after" in text
    assert "| none | none |" in text
    [line] = [line for line in text.splitlines() if line.startswith("| pd |")]
    assert line.startswith(f"| pd | {pd['pointwise_deg']:.2f}° | no | {pd['z_track'] * 1e4:.1f} |")
    assert line.endswith(f"| {margins['pd']['delay_ms']:g} ms | {margins['pd']['lost_frames']} |")


def test_what_a_law_survives_is_the_last_step_before_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PUSHED_S", 4.0)
    settings = load_over(SLOW, ["law.kind=pd"])
    found = survived(settings, 10.0)
    delay, lost = found["delay_ms"], found["lost_frames"]
    assert delay
    assert lost
    ticks, frames = round(delay / 10), round(lost)
    for kept, too_late in (((ticks, 0), (ticks + 1, 0)), ((0, frames), (0, frames + 1))):
        errors = [largest_error_deg(settings, *late) for late in (kept, too_late)]
        assert errors[0] <= 10 < errors[1]
    assert survived(settings, 0.01)["delay_ms"] is None


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


@pytest.mark.parametrize("first", [0, 1, 2, 9, 10, 11, 37, 80, 81, 1000])
def test_the_search_finds_the_last_number_before_the_first_that_fails(first: int) -> None:
    last = last_good(lambda ticks: ticks < first, guess=10, most=100)
    assert last == (None if first == 0 else first - 1 if first <= 80 else 100)
