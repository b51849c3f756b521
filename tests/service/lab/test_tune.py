"""Search for gains: it finds a known optimum, keeps to limits, never sees what is held out, and says what is worse."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Sequence
from math import exp, log
from pathlib import Path

import numpy as np
import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load, load_over, with_law_settings
from aeroloop.service.lab import laws, loop_function, tune
from aeroloop.service.lab.loop_function import Loop
from aeroloop.service.lab.sweep import Progress
from aeroloop.service.lab.tune import (
    MORE,
    Case,
    Limits,
    Ran,
    Search,
    TuneError,
    TuneOptions,
    Tuning,
    rank,
    run_case,
    sheets,
    with_case,
)
from aeroloop.service.terminal.show import show_all
from tests.support.failing_laws import FAILING
from tests.support.ideal import IDEAL
from tests.support.in_this_process import run_here, workers_here
from tests.support.own_laws import HERE

SLOW = load(overrides=["loop.rate_hz=100"])
AT_REST = [
    "loop.rate_hz=100", "plant.kind=rigid_body", *IDEAL, "wire.actuators=3", "reference.kind=hold",
    "law.centre_of_mass=[0, 0, 0]", "plant.rigid_body.centre_of_mass=[0, 0, 0]", 'wire.voltage.bits="cont"',
]  # fmt: skip
"""A body that stays where it is without a voltage."""


def own(name: str, *overrides: str, of: str = HERE) -> Settings:
    return with_law_settings(load(overrides=[*AT_REST, f"law.kind={of}:{name}", *overrides]))


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(laws, "PUSHED_S", 0.2)


def optimum(gain: float) -> Ran:
    """Costs least at 3, changes its voltage 100 times the gain, trips beyond 4."""
    if gain > 4:
        return Ran(0, 0, 0, 0, 0, 0.5, reason="the loop ended after 1 s: too fast")
    return Ran(1e-3 + (gain - 3) ** 2, 0.0, 0.0, 100 * gain, 1.0)


@pytest.fixture
def modelled(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, list[Case]]]:
    """Runs that are formulas of the first gain, of x; what was asked of them, in order."""
    asked = list[tuple[float, list[Case]]]()

    def runs(settings: Settings, cases: Sequence[Case], duration_s: float) -> list[Ran]:
        gain = first_gain(settings)
        asked.append((gain, list(cases)))
        assert duration_s > 0
        return [optimum(gain) for _ in cases]

    survives(monkeypatch, {"delay_ms": 70.0, "lost_frames": 7})
    monkeypatch.setattr(tune, "run_cases", runs)
    return asked


def first_gain(settings: Settings) -> float:
    law = settings.law.model_dump()
    gain = law["C1"][0] if "C1" in law else law["offset"]
    assert isinstance(gain, float)
    return gain


def survives(monkeypatch: pytest.MonkeyPatch, found: dict[str, float | int | None]) -> None:
    def survived(_settings: Settings, within_deg: float) -> dict[str, float | int | None]:
        assert within_deg > 0
        return found

    monkeypatch.setattr(tune, "survived", survived)


NOTHING: dict[str, float | int | None] = {"delay_ms": None, "lost_frames": None}


def found(settings: Settings, options: TuneOptions, progress: Progress = lambda *_: None, count: int = 1) -> Tuning:
    return tune.tune(settings, options, workers_here(count), progress)


FEW = TuneOptions(seeds=1, winds=(0.0,), held_out=1, budget=200, duration_s=0.2)
MASS = FEW._replace(names=["mass"])


@pytest.mark.parametrize(("law", "budget"), [("Offset", 120), ("OffsetInPython", 60)])
def test_a_law_whose_optimum_is_known_comes_near_it_in_expressions_and_in_python(law: str, budget: int) -> None:
    result = found(own(law), FEW._replace(budget=budget, weight=1.0))
    assert result.after["gains"]["offset"] == pytest.approx(2, rel=0.02 if budget > 100 else 0.1)
    assert result.before["gains"] == {"offset": 0.5}
    assert result.worse is None
    assert result.after["held_out"]["cost"] < 0.02 * result.before["held_out"]["cost"]
    assert result.experiments <= budget


def test_a_search_ends_at_the_bounds_of_the_settings_and_at_the_limits_of_its_constraints(
    modelled: list[tuple[float, list[Case]]],
) -> None:
    plan = FEW._replace(max_chatter=1e9)
    assert found(own("Offset"), plan).after["gains"]["offset"] == pytest.approx(3, rel=1e-2)
    assert 4 < max(gain for gain, _ in modelled) <= 5  # it went where it trips, never beyond what the law allows
    limited = found(own("Offset"), plan._replace(max_chatter=250.0)).after
    assert limited["gains"]["offset"] == pytest.approx(2.5, rel=1e-2)
    assert limited["training"]["changes_per_s"] <= 250
    assert limited["training"]["changes_per_s"] == limited["held_out"]["changes_per_s"]
    assert found(own("Offset"), FEW).limits.changes_per_s == 100 * 0.5 * MORE


def test_what_trips_or_exceeds_a_limit_ranks_behind_anything_that_does_not() -> None:
    limits = Limits(saturated=None, changes_per_s=100.0)
    worse = Ran(50.0, 1e9, 1.0, 100.0, 180.0)
    ordered = [
        worse._replace(z_track=49.0),
        worse,
        Ran(0, 0, 0, 100.1, 0),
        Ran(0, 0, 0, 101.0, 0),
        Ran(0, 0, 0, 0, 0, 0.9, reason="late"),
        Ran(0, 0, 0, 0, 0, 0.1, reason="early"),
    ]
    ranks = [rank([ran], limits, FEW.weight) for ran in ordered]
    assert ranks == sorted(set(ranks))
    assert rank([ordered[-1]] * 2, limits, FEW.weight) == 1 + 2 * 1.9


def test_the_search_never_sees_what_is_held_out(modelled: list[tuple[float, list[Case]]]) -> None:
    plan = FEW._replace(seeds=2, winds=(0.0, 1.0, -0.5), held_out=3, budget=400)
    result = found(own("Offset"), plan)
    assert len(result.training) == 6
    assert not {case.seed for case in result.training} & {case.seed for case in result.held_out}
    assert not {case.wind for case in result.training} & {case.wind for case in result.held_out}
    searched = modelled[: result.candidates]
    assert all(cases == result.training for _, cases in searched)
    after = [(gain, case) for gain, cases in modelled[result.candidates :] for case in cases]
    sides = [side["gains"]["offset"] for side in (result.before, result.after)]
    assert after == [(gain, case) for gain in sides for case in result.held_out]


def test_a_case_is_a_seed_and_a_wind_of_the_plant() -> None:
    wind = with_case(SLOW, Case(seed=3, wind=0.5)).plant.wind
    assert (wind.seed, wind.blowing) == (3, True)
    assert wind.torque == tuple(value / 2 for value in SLOW.plant.wind.torque)
    assert not with_case(SLOW, Case(seed=3, wind=0.0)).plant.wind.blowing
    assert with_case(SLOW, Case(seed=3, wind=0.5)).plant.sensors.seed == 3


def test_the_same_seed_finds_the_same_in_whatever_order_runs_end(modelled: list[tuple[float, list[Case]]]) -> None:
    plan = FEW._replace(budget=100, max_chatter=1e9)
    first, again = found(SLOW, plan), found(SLOW, plan, count=8)
    assert first == again
    assert first.after["gains"] != found(SLOW, plan._replace(seed=1)).after["gains"]
    assert modelled


def test_an_interrupt_ends_the_search_and_keeps_the_best_so_far(modelled: list[tuple[float, list[Case]]]) -> None:
    def interrupt(done: int, _total: int) -> None:
        if done == 30:
            raise KeyboardInterrupt

    result = found(own("Offset"), FEW._replace(max_chatter=1e9), interrupt)
    assert (result.interrupted, result.candidates) == (True, 30)
    best = min((gain for gain, _ in modelled[:30] if gain <= 4), key=lambda gain: abs(gain - 3))
    assert result.after["gains"]["offset"] == best
    assert result.after["held_out"]["cost"] == pytest.approx(1e-3 + (best - 3) ** 2)


def test_a_scaled_gain_keeps_its_ratios_0_stays_and_what_has_no_effect_stays(
    modelled: list[tuple[float, list[Case]]],
) -> None:
    settings = load_over(SLOW, ["law.kind=pid", "law.kp=[1, 0.5, 2]", "law.ki=[0, 0, 0.1]"])
    search = Search(settings, FEW, workers_here(), lambda *_: None)
    assert [one.name for one in search.dimensions] == [
        "kp[0]", "kp[1]", "kp[2]", "kd[0]", "kd[1]", "kd[2]", "ki[2]"
    ]  # fmt: skip
    scaled = Search(settings, FEW._replace(scale=True), workers_here(), lambda *_: None)
    assert [one.name for one in scaled.dimensions] == ["kp", "kd", "ki"]
    assert scaled.gains(np.array([log(3), 0.0, 0.0]))["kp"] == pytest.approx((3, 1.5, 6))
    assert scaled.dimensions[0].high == pytest.approx(log(10), abs=1e-4)  # 20 is the largest gain
    assert exp(search.dimensions[0].high) == pytest.approx(10)
    result = found(SLOW, FEW)
    assert result.searched == ["C1[0]"]
    assert len(result.without_effect) == 8
    assert result.after["gains"]["C2"] == SLOW.law.model_dump()["C2"]
    assert modelled


@pytest.mark.parametrize(
    ("settings", "plan", "text"),
    [
        (SLOW, FEW._replace(names=["C3"]), "law adaptive has no gain 'C3'; its settings are .*C1, C2"),
        (load_over(SLOW, ["law.kind=lqr"]), FEW, "law lqr names no gains of its own: give --gain NAME.*rate_weight"),
        (load_over(SLOW, ["law.kind=pd", "law.kp=[0, 0, 0]"]), FEW._replace(names=["kp"]), "nothing to search"),
        (SLOW, FEW._replace(budget=20), "--budget must be at least 82"),
        (own("Runaway", of=FAILING), MASS, "no gains were found that do not trip; .*the loop ended"),
        (own("Raising", of=FAILING), MASS, r"no gains were found .*ZeroDivisionError: by nothing"),
    ],
)
def test_where_there_is_nothing_to_search_or_nothing_flies_it_is_one_line(
    settings: Settings, plan: TuneOptions, text: str
) -> None:
    with pytest.raises(TuneError, match=text):
        found(settings, plan._replace(duration_s=2.0))


@pytest.mark.parametrize("overrides", [[], ["wire.transmit=on_change", "wire.voltage.limit=6", "wire.voltage.bits=3"]])
def test_a_run_has_the_same_figures_as_one_function_and_frame_by_frame(
    overrides: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_over(SLOW, [*overrides, "plant.limits.max_saturated_s=10"])
    compiled = run_case(settings, 2.0)
    monkeypatch.setattr(Loop, "run", lambda *_: None)  # so through frames
    frames = run_case(settings, 2.0)
    assert compiled == frames
    assert compiled.saturated > 0.01


def test_a_run_that_trips_lasted_until_then() -> None:
    ran = run_case(own("Runaway", of=FAILING), 4.0)
    assert ran.reason is not None
    assert f"the loop ended after {4 * ran.lasted:g} s" in ran.reason


def printed(settings: Sequence[str], *words: str) -> int:
    return execute(["lab", "tune", *(word for each in settings for word in ("--set", each)), *words])


def test_the_command_prints_json_writes_toml_and_opens_no_network(
    modelled: list[tuple[float, list[Case]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def opened(*_: object) -> None:
        raise AssertionError("a network")

    monkeypatch.setattr("zenoh.open", opened)
    run_here(monkeypatch)
    out = tmp_path / "gains.toml"
    words = ["--seeds", "1", "--winds", "0", "--budget", "100", "--max-chatter", "1e9"]
    law = [*AT_REST, f"law.kind={HERE}:Offset"]
    assert printed(law, *words, "--json", "--out", str(out)) == 0
    result = json.loads(capsys.readouterr().out)
    gain = result["after"]["gains"]["offset"]
    assert tomllib.loads(out.read_text()) == {"law": {"kind": f"{HERE}:Offset", "offset": gain}}
    assert result["overrides"] == [f"law.offset={gain}"]
    assert load(overrides=[*law, *result["overrides"]]).law.model_dump()["offset"] == gain
    assert (result["after"]["delay_ms"], result["after"]["lost_frames"]) == (70.0, 7)
    assert printed(law, *words) == 0
    text = capsys.readouterr().out
    assert f"--set 'law.offset={gain}'" in text
    assert "Better gains found: in the held-out set the cost changes by -100.0%" in text
    assert printed(law, *words, "--out", str(out)) == 2
    assert "--force" in capsys.readouterr().err
    assert printed(law, *words, "--winds", "calm") == 2
    assert "--winds must be numbers" in capsys.readouterr().err
    assert modelled


def test_gains_that_are_worse_in_what_is_held_out_are_named_so_and_exit_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def runs(settings: Settings, cases: Sequence[Case], duration_s: float) -> list[Ran]:
        """Seed 0 likes 3, and the others do not."""
        assert duration_s > 0
        gain = first_gain(settings)
        return [optimum(gain if case.seed == 0 else 3.4 - gain) for case in cases]  # 0.5: 2.9

    monkeypatch.setattr(tune, "run_cases", runs)
    survives(monkeypatch, NOTHING)
    run_here(monkeypatch)
    out = tmp_path / "gains.toml"
    words = ["--seeds", "1", "--winds", "0", "--budget", "100", "--max-chatter", "1e9", "--out", str(out)]
    assert printed([*AT_REST, f"law.kind={HERE}:Offset"], *words) == 1
    assert "Not to be used: in the held-out set the cost rises from 0.011 to " in capsys.readouterr().out
    assert out.read_text().startswith("# Not to be used")


def test_a_limit_that_is_exceeded_in_what_is_held_out_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def runs(settings: Settings, cases: Sequence[Case], duration_s: float) -> list[Ran]:
        assert duration_s > 0
        ran = optimum(first_gain(settings))
        return [ran._replace(changes_per_s=(1 + case.seed) * ran.changes_per_s) for case in cases]

    monkeypatch.setattr(tune, "run_cases", runs)
    survives(monkeypatch, NOTHING)
    result = found(own("Offset"), FEW._replace(max_chatter=500.0))
    assert (result.exceeded, result.worse) == (["changes_per_s"], None)
    show_all(sheets(result))
    assert "exceed a limit in the held-out set: changes_per_s" in capsys.readouterr().out


def test_without_scipy_one_line_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    run_here(monkeypatch)
    assert printed(["loop.rate_hz=100"]) == 1
    assert "this needs scipy, which is not installed: pip install 'aeroloop[" in capsys.readouterr().err


def test_one_loop_serves_a_search_and_gains_of_its_settings_are_another(monkeypatch: pytest.MonkeyPatch) -> None:
    built = list[Loop]()
    build = Loop.__init__

    def counted(self: Loop, settings: Settings) -> None:
        built.append(self)
        build(self, settings)

    monkeypatch.setattr(Loop, "__init__", counted)
    monkeypatch.setattr(loop_function, "_loops", {})
    for law, loops in (("Offset", 1), ("Stubborn", 2)):
        built.clear()
        runs = [run_case(own(law, f"law.offset={offset}"), 0.2) for offset in (0.5, 1.5)]
        assert runs[0].u_total == pytest.approx(9 * runs[1].u_total)
        assert len(built) == loops
