"""Search for gains: it finds a known optimum, keeps to limits, never sees what is held out, and says what is worse."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load, load_over, with_law_settings
from aeroloop.service.lab import tune
from aeroloop.service.lab.engine import COLUMNS, Progress, Row
from aeroloop.service.lab.tune import MORE, Case, TuneError, TuneOptions, Tuning
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
FEW = TuneOptions(seeds=1, held_out=1, budget=200, duration_s=0.2)


def own(name: str, *overrides: str, of: str = HERE) -> Settings:
    return with_law_settings(load(overrides=[*AT_REST, f"law.kind={of}:{name}", *overrides]))


def row(**figures: Any) -> Row:
    return dict.fromkeys(COLUMNS) | figures


def optimum(gain: float) -> Row:
    """Costs least at 3, changes its voltage 100 times the gain, trips beyond 4."""
    if gain > 4:
        return row(reason="the loop ended after 1 s: too fast")
    return row(z_track=1e-3 + (gain - 3) ** 2, u_total=0.0, command_changes_per_s=100 * gain)


Asked = list[tuple[float, Case]]


@pytest.fixture
def modelled(monkeypatch: pytest.MonkeyPatch) -> Asked:
    return model(monkeypatch, lambda gain, _: optimum(gain))


def model(monkeypatch: pytest.MonkeyPatch, of: Callable[[float, Case], Row]) -> Asked:
    """Let runs be formulas of the law's offset; what was asked of them, in order."""
    asked = Asked()

    def figures(settings: Settings, duration_s: float) -> Row:
        assert duration_s > 0
        wind, strongest = settings.plant.wind, SLOW.plant.wind.torque[0]
        case = Case(wind.seed, round(wind.torque[0] / strongest, 6) if wind.blowing else 0.0)
        gain = settings.law.model_dump()["offset"]
        asked.append((gain, case))
        return of(gain, case)

    monkeypatch.setattr(tune, "figures_row", figures)
    monkeypatch.setattr(tune, "survived", lambda *_, **__: {"delay_ms": 70.0, "lost_frames": 7})
    return asked


def found(settings: Settings, options: TuneOptions, progress: Progress = lambda *_: None, cores: int = 1) -> Tuning:
    return tune.tune(settings, options, workers_here(cores), progress)


def test_a_search_keeps_to_the_laws_own_bounds_and_to_the_limit_of_its_changes(modelled: Asked) -> None:
    result = found(own("Offset"), FEW)
    limited = result.after
    assert not result.worse
    assert result.candidates * len(result.training) <= FEW.budget
    assert limited["gains"]["offset"] == pytest.approx(0.5 * MORE, rel=1e-2)
    assert limited["training"]["command_changes_per_s"] <= 100 * 0.5 * MORE
    modelled.clear()
    assert found(own("Offset", "law.offset=3.3"), FEW).after["gains"]["offset"] == pytest.approx(3, rel=1e-2)
    assert 4 < max(gain for gain, _ in modelled) <= 5  # it went where it trips, never beyond what the law allows


def test_the_search_never_sees_what_is_held_out(modelled: Asked) -> None:
    result = found(own("Offset"), FEW._replace(seeds=2, held_out=3, budget=400))
    assert result.training == [Case(0, 0.0), Case(1, 0.0), Case(0, 1.0), Case(1, 1.0)]
    assert not {case.seed for case in result.training} & {case.seed for case in result.held_out}
    assert not {case.wind for case in result.training} & {case.wind for case in result.held_out}
    sides = [side["gains"]["offset"] for side in (result.before, result.after)]
    assert modelled[-6:] == [(gain, case) for gain in sides for case in result.held_out]
    assert {case for _, case in modelled[:-6]} == set(result.training)


def test_an_interrupt_ends_the_search_and_keeps_the_best_so_far(modelled: Asked) -> None:
    def interrupt(done: int, _total: int) -> None:
        if done == 40:
            raise KeyboardInterrupt

    result = found(own("Offset", "law.offset=3.3"), FEW, interrupt)
    assert result.interrupted
    assert 0 < 2 * result.candidates < 40
    best = min((gain for gain, _ in modelled[: 2 * (result.candidates + 1)] if gain <= 4), key=lambda g: abs(g - 3))
    assert result.after["gains"]["offset"] == best


def test_a_gain_keeps_the_ratios_between_its_axes_and_one_that_is_0_is_not_searched() -> None:
    settings = load_over(SLOW, ["law.kind=pid", "law.kp=[1, 0.5, 2]", "law.ki=[0, 0, 0]"])
    result = found(settings, FEW._replace(budget=40))
    assert set(result.after["gains"]) == {"kp", "kd"}
    kp = result.after["gains"]["kp"]
    assert (kp[1] / kp[0], kp[2] / kp[0]) == pytest.approx((0.5, 2), rel=1e-3)
    assert load_over(settings, result.overrides).law.model_dump()["kp"] == kp


@pytest.mark.parametrize(
    ("settings", "plan", "text"),
    [
        (SLOW, FEW._replace(names=["C3"]), "law adaptive has no gain 'C3' that is not 0; its settings are .*C1, C2"),
        (load_over(SLOW, ["law.kind=lqr"]), FEW, "law lqr names no gains of its own: give --gain NAME.*rate_weight"),
        (SLOW, FEW._replace(budget=10), "--budget must be at least "),
        (
            own("Runaway", of=FAILING),
            FEW._replace(names=["mass"], duration_s=4.0),
            "no gains were found .* ended after",
        ),
    ],
)
def test_what_cannot_be_searched_is_one_line(settings: Settings, plan: TuneOptions, text: str) -> None:
    with pytest.raises(TuneError, match=text):
        found(settings, plan)


def printed(settings: list[str], *words: str) -> int:
    return execute(["lab", "tune", *(word for each in settings for word in ("--set", each)), *words])


@pytest.mark.usefixtures("modelled")
def test_the_command_prints_json_and_writes_toml(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_here(monkeypatch)
    out = tmp_path / "gains.toml"
    words, law = ["--seeds", "1", "--budget", "200"], [*AT_REST, f"law.kind={HERE}:Offset", "law.offset=3.3"]
    assert printed(law, *words, "--json", "--out", str(out)) == 0
    result = json.loads(capsys.readouterr().out)
    gain = result["after"]["gains"]["offset"]
    assert tomllib.loads(out.read_text()) == {"law": {"kind": f"{HERE}:Offset", "offset": gain}}
    assert result["overrides"] == [f"law.offset={gain}"]
    assert printed(law, *words, "--out", str(out)) == 2
    assert "--force" in capsys.readouterr().err


def test_gains_that_are_worse_in_what_is_held_out_are_named_so_and_exit_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    model(monkeypatch, lambda gain, case: optimum(gain if case.seed == 0 else 6.3 - gain))  # 3.3 is best held out
    run_here(monkeypatch)
    out = tmp_path / "gains.toml"
    law = [*AT_REST, f"law.kind={HERE}:Offset", "law.offset=3.3"]
    assert printed(law, "--seeds", "1", "--budget", "200", "--out", str(out)) == 1
    assert "Not to be used" in capsys.readouterr().out
    assert out.read_text().startswith("# Not to be used")
