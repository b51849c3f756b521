"""MuJoCo plant: the Aero's twin agrees with ours, bodies fly through full turns, runs repeat, errors are one line.

The twin is written in MuJoCo's own terms and stepped by its integrator. What differs is Coulomb friction: ours changes
its torque smoothly within 0.01 rad/s, MuJoCo's is a constraint that holds still. So without it the two agree tightly.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from math import degrees
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from aeroloop.plant_emulator.engines.mujoco import SHIPPED, MujocoPlant, MujocoSettings
from aeroloop.plant_emulator.model.emulated import FrictionSettings, RotorSettings
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.plugins import PluginError
from aeroloop.service.cli.show import EXAMPLES
from aeroloop.service.config import Settings, load
from aeroloop.service.lab.experiment import run_experiment
from tests.support import ideal

mujoco = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'aeroloop[mujoco]'")

PERIOD = 0.002
DURATION = 12.0
"""Of a run along the paper's experiment [s]: pitch and yaw each turn back once."""

AERO = SHIPPED["aero"].read_text()
SMOOTH = AERO.replace(' frictionloss="0.003040"', "").replace(' frictionloss="0.0009"', "")
"""The Aero without Coulomb friction."""


FLIGHT = load(EXAMPLES / "quadrotor.toml")
QUADROTOR = MujocoSettings.model_validate(FLIGHT.plant.own)


class Recorded:
    """The voltages that a plant is given from now on, and its state after each period."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.voltages: list[tuple[float, ...]] = []
        self.states: list[State] = []
        actuate, advance = plant.actuate, plant.advance

        def act(voltages: Sequence[float]) -> None:
            self.voltages.append(tuple(voltages))
            actuate(voltages)

        def step() -> None:
            advance()
            self.states += filter(None, [plant.truth()])

        plant.actuate, plant.advance = act, step  # type: ignore[method-assign]  # of this one


def _driven(plant: Plant, voltages: Sequence[Sequence[float]]) -> list[Measurement]:
    seen = []
    for each in voltages:
        plant.actuate(each)
        plant.advance()
        seen.append(plant.measure())
    return seen


def _apart(some: Sequence[State], others: Sequence[State]) -> float:
    """The largest angle between two courses of attitudes [deg]; precise near 0, where an arc cosine is not."""
    p, q = (np.array([state.attitude for state in states]) for states in (some, others))
    chord = np.minimum(np.linalg.norm(p - q, axis=1), np.linalg.norm(p + q, axis=1))
    return degrees(4 * np.arcsin(chord / 2).max())


def _experiment(coulomb: bool, bits: int | str) -> Settings:
    """The paper's experiment on our Aero with perfect sensors."""
    edge = {"attitude": 1.0, "rate": 1.0, "voltage": 24.0}
    return Settings.model_validate(
        {
            "plant": {
                "friction": FrictionSettings() if coulomb else FrictionSettings(coulomb=()),
                "sensors": ideal.PLANT.sensors,
            },
            "wire": {signal: {"bits": bits, "limit": limit} for signal, limit in edge.items()},
            "controller": {"after_restart": "configured"},
        }
    )


@pytest.mark.parametrize(
    ("coulomb", "bits", "held_deg", "closed_deg"),
    [
        (False, "cont", 0.001, 0.0002),  # our steps across the rotors' change of lag, and the twin's lag held over 1 ms
        (True, 8, 0.6, 0.2),
    ],
)
def test_the_aero_follows_ours_along_the_papers_experiment(
    coulomb: bool, bits: int | str, held_deg: float, closed_deg: float
) -> None:
    settings = _experiment(coulomb, bits)
    twin = MujocoSettings(model=AERO if coulomb else SMOOTH, rotor=RotorSettings())

    ours = Recorded(settings.plant.build(PERIOD))
    figures = run_experiment(settings, DURATION, plant=ours.plant)

    same_voltages = Recorded(MujocoPlant(twin, PERIOD))
    _driven(same_voltages.plant, ours.voltages)
    assert _apart(ours.states, same_voltages.states) < held_deg

    same_law = Recorded(MujocoPlant(twin, PERIOD))
    other_figures = run_experiment(settings, DURATION, plant=same_law.plant)
    assert _apart(ours.states, same_law.states) < closed_deg
    within = 0.02 if coulomb else 1e-4
    assert other_figures.z_track == pytest.approx(figures.z_track, rel=within)
    assert other_figures.u_total == pytest.approx(figures.u_total, rel=within)


def test_a_free_body_flies_through_full_turns() -> None:
    """Roll by one turn and yaw by two at once; half a turn of the error would be the wrong way round."""
    plant = Recorded(MujocoPlant(QUADROTOR, PERIOD))
    figures = run_experiment(FLIGHT, 20.0, plant=plant.plant)
    assert figures.max_error_deg is not None
    assert figures.max_error_deg < 6  # at the start: the reference begins at full speed
    turned = np.array([state.attitude[0] for state in plant.states])
    assert turned.min() < -0.6 < 0.9 < turned.max()  # beyond half a turn, where the scalar part is negative


def test_controls_at_0_v_are_the_keyframes_and_close_goes_there() -> None:
    """At hover the weight is carried, so nothing moves."""
    plant = MujocoPlant(QUADROTOR, PERIOD)
    plant.actuate((1.0, 2.0, 3.0))
    plant.close()
    plant.advance()
    assert plant.measure() == Measurement((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_a_simulation_that_diverges_measures_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo would begin anew at the start, as if nothing had happened."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    plant = MujocoPlant(MujocoSettings(model=SMOOTH.replace('damping="0.0220"', 'damping="-1e4"')), PERIOD)
    (*_, last) = _driven(plant, [(1.0, 1.0)] * 20)
    assert np.isnan(last.attitude).all()


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"model": "no.xml"}, "there is no MJCF file no.xml; ours are aero, quadrotor"),
        ({"model": "<mujoco><worl/></mujoco>"}, "MuJoCo refuses the MJCF given: .* 'worl', line 1"),
        ({"body": "rotor"}, "the MJCF has no such body: Invalid name 'rotor'. Valid names: .'body'"),
        ({"allocation": [[1.0], [1.0, 2.0]]}, "allocation needs 2 rows of one length"),
    ],
)
def test_what_does_not_fit_is_one_line(changed: dict[str, object], text: str) -> None:
    with pytest.raises((PluginError, ValidationError), match=text) as refused:
        MujocoPlant(MujocoSettings.model_validate(changed), PERIOD)
    assert isinstance(refused.value, ValidationError) or "\n" not in str(refused.value)


def test_without_mujoco_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(PluginError, match=r"not installed: pip install 'aeroloop\[mujoco\]'"):
        MujocoPlant(MujocoSettings(), PERIOD)
