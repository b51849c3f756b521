"""FMUs as plants: our own Aero, exported by CasADi or as C code, against our emulated one; and FMUs that are none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from aeroloop.plant_emulator.engines.fmu import FmuPlant, FmuSettings, quaternion_of
from aeroloop.plant_emulator.model.emulated import WindSettings
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.plugins import PluginError
from tests.support import ideal
from tests.support.aero_fmu import PERIOD, altered, fmi2, fmi3, fmpy
from tests.support.numpy_twin import rotation

VOLTAGES = ["u2", "u3"]
BODY: dict[str, Any] = {
    "fmi2": {"quaternion": [f"q[{i}]" for i in (1, 2, 3, 4)], "rate": ("rate.x", "rate.y", "rate.z")},
    "fmi3": {"quaternion": ("q.w", "q.x", "q.y", "q.z"), "rate": ("omega.x", "omega.y", "omega.z")},
    "joints": {"angles": ("", "pitch", "yaw"), "rate": ("omega.x", "omega.y", "omega.z")},
}
"""Each way to map an Aero: outputs of FMI 2; of FMI 3; its joints' angles."""


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("fmus")
    co_simulation = fmi3(folder / "3")
    return {"fmi2": fmi2(folder / "2"), "fmi3": co_simulation, "joints": co_simulation}


@pytest.fixture(autouse=True)
def unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder that FMUs are unpacked in: after any test it is empty, and the working folder the same."""
    folder = tmp_path / "unpacked"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    at = Path.cwd()
    yield folder
    assert not list(folder.iterdir())
    assert Path.cwd() == at


def settings_of(fmu: Path, mapping: str = "fmi2", **more: Any) -> FmuSettings:
    return FmuSettings.model_validate({"file": fmu, "voltages": VOLTAGES, **BODY[mapping], **more})


def driven(plant: Plant, voltages: list[tuple[float, float]]) -> list[Measurement]:
    measured = [plant.measure()]
    for volts in voltages:
        plant.actuate(volts)
        plant.advance()
        measured.append(plant.measure())
    plant.close()
    return measured


WOBBLE = [(10 * np.sin(0.01 * k), 8 * np.cos(0.013 * k)) for k in range(2000)]


def flat(measured: list[Measurement]) -> Any:
    return np.array([(*each.attitude, *each.rate) for each in measured])


@pytest.mark.parametrize("mapping", BODY)
def test_our_aero_as_an_fmu_moves_as_our_emulated_one_with_its_start_values(
    fmus: dict[str, Path], mapping: str
) -> None:
    """Start values are the FMU's parameters: here, loads on the joints, as of our wind.

    On this machine the measurements are equal to the last bit: the same operations in the same order. 1e-12 leaves room
    for another compiler's library of sines; without closed loop, nothing grows faster than the time.
    """
    load_pitch, load_yaw = -0.001, 0.004
    settings = settings_of(fmus[mapping], mapping, start={"load_pitch": load_pitch, "load_yaw": load_yaw})
    one, other = (FmuPlant(settings, PERIOD) for _ in range(2))
    theirs = driven(one, WOBBLE)
    assert driven(other, WOBBLE) == theirs  # two instances at once
    wind = WindSettings(blowing=True, torque=(load_pitch, load_yaw), gust=0.0)
    ours = flat(driven(ideal.PLANT.model_copy(update={"wind": wind}).build(PERIOD), WOBBLE))
    assert np.ptp(ours[:, 3]) > 0.1  # it does move: this is sin(ψ/2) cos(θ/2)
    assert np.abs(flat(theirs) - ours).max() < 1e-12


def test_voltages_are_zero_at_first_and_go_where_their_names_say(fmus: dict[str, Path]) -> None:
    """Whatever an input starts with; the true state is what is measured, with the voltages."""
    started, still = (FmuPlant(settings_of(fmus["fmi2"], start=start), PERIOD) for start in ({"u2": 5.0}, {}))
    for plant in (started, still):
        plant.advance()
    assert started.truth() == still.truth() == State(*still.measure(), (0.0, 0.0))
    for plant in (started, still):
        plant.close()
    swapped = FmuPlant(settings_of(fmus["fmi2"], voltages=["u3", "u2"]), PERIOD)
    straight = FmuPlant(settings_of(fmus["fmi2"]), PERIOD)
    assert driven(swapped, [(b, a) for a, b in WOBBLE]) == driven(straight, WOBBLE)


def test_what_an_fmu_declares_in_degrees_is_converted(fmus: dict[str, Path], tmp_path: Path) -> None:
    declared = altered(fmus["fmi2"], tmp_path / "degrees.fmu", ('unit="rad/s"', 'unit="deg/s"'))
    in_degrees, in_radians = (driven(FmuPlant(settings_of(fmu), PERIOD), WOBBLE) for fmu in (declared, fmus["fmi2"]))
    assert [m.rate for m in in_degrees] == [tuple(np.radians(m.rate)) for m in in_radians]


@given(angles=st.tuples(*[st.floats(-3, 3)] * 3))
def test_angles_are_yaw_then_pitch_then_roll(angles: tuple[float, float, float]) -> None:
    theirs = Rotation.from_euler("ZYX", angles[::-1]).as_matrix()
    assert np.allclose(rotation(np.array(quaternion_of(*angles))), theirs, atol=1e-14)


# ── what cannot run is one line ──

FMI1 = '"1.0" modelIdentifier="aero" numberOfContinuousStates="0" numberOfEventIndicators="0"'
EXPORT = "export it for co-simulation by FMI 2 or 3"
REFUSED: dict[str, tuple[dict[str, Any], tuple[tuple[str, str], ...], tuple[str, str], str]] = {
    "no file": ({"file": "none.fmu"}, (), ("", ""), "there is no file none.fmu: set plant.own.file"),
    "no FMU": ({"file": __file__}, (), ("", ""), "test_fmu.py is not an FMU: File is not a zip file"),
    "no such": ({"voltages": ["zz"]}, (), ("", ""), "broken.fmu has no input zz of type Real; it has u2, u3"),
    "start": ({"start": {"laod": 1}}, (), ("", ""), "broken.fmu has no parameter or start value laod: see plant.own."),
    "no XML": ({}, (("<?xml", "xml"),), ("", ""), "is not an FMU: Start tag expected"),
    "FMI 1": ({}, (('"2.0"', FMI1),), ("", ""), f"broken.fmu is of FMI 1.0: {EXPORT}"),
    "model exchange": ({}, (("<CoSimulation", "<ModelExchange"),), ("", ""), f"broken.fmu is of FMI 2.0: {EXPORT}"),
    "no binary": ({}, (), (fmpy.platform, "win99"), "it does not start: Cannot find shared library /"),
    "GUID": ({}, (('guid="aero"', 'guid="other"'),), ("", ""), "instantiate model: the GUID is other, not"),
}


def refusal(settings: FmuSettings) -> str:
    with pytest.raises(PluginError) as refused:
        FmuPlant(settings, PERIOD)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("case", REFUSED)
def test_an_fmu_that_cannot_run_is_one_line(fmus: dict[str, Path], tmp_path: Path, case: str) -> None:
    changes, edits, files, line = REFUSED[case]
    broken = altered(fmus["fmi2"], tmp_path / "broken.fmu", *edits, files=files)
    assert line in refusal(settings_of(broken, **changes))


def test_without_fmpy_the_line_says_what_to_install(fmus: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    line = "an FMU needs FMPy, which is not installed: pip install 'aeroloop[fmi]'"
    assert refusal(settings_of(fmus["fmi2"])) == line


def test_a_step_that_fails_is_one_line_with_its_time_and_the_fmus_own_words(
    fmus: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    freed: list[None] = []
    monkeypatch.setattr("fmpy.fmi2.FMU2Slave.freeInstance", lambda _: freed.append(None))
    for status, name in ((3, "error"), (4, "fatal")):
        plant = FmuPlant(settings_of(fmus["fmi2"], start={"fails_at": 0.1, "fails_with": status}), PERIOD)
        with pytest.raises(PluginError) as failed:
            driven(plant, WOBBLE)
        assert str(failed.value) == (
            f"aero.fmu: it failed at 0.1 s: fmi2DoStep failed with status {status} ({name}): the motor burnt at 0.1 s"
        )
        plant.close()
        plant.close()
    assert len(freed) == 1  # after the fatal status, FMI forbids any call
    plant = FmuPlant(settings_of(fmus["fmi3"], "joints", start={"load_pitch": 5.0}), PERIOD)
    with pytest.raises(PluginError, match=r"aero.fmu: it ended by itself at 0\.1\d+ s"):
        driven(plant, WOBBLE)
    plant.close()


def test_settings_that_contradict_each_other_are_refused() -> None:
    for changes, line in (({"angles": ("a", "b", "c")}, "quaternion or angles"), ({"voltages": ["u2"] * 2}, "once")):
        with pytest.raises(ValidationError, match=line):
            settings_of(Path("x.fmu"), **changes)
