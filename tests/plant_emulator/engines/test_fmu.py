"""FMUs as plants: our own Aero, exported by CasADi or as C code, against our emulated one; and FMUs that are none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from aeroloop.plant_emulator.engines.fmu import FmuError, FmuPlant, FmuSettings, body_rate, quaternion_of
from aeroloop.plant_emulator.model.wind import WindSettings
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.service.config import load, with_bits
from aeroloop.service.lab.experiment import experiment, run_experiment
from tests.support.aero_fmu import IDEAL, PERIOD, altered, fmi2, fmi3, fmpy
from tests.support.numpy_twin import rotation

VOLTAGES = ["u2", "u3"]
ELEMENTS = tuple(f"q[{i}]" for i in (1, 2, 3, 4))
BODY: dict[str, Any] = {
    "fmi2": {"quaternion": ELEMENTS, "rate": ("rate.x", "rate.y", "rate.z")},
    "fmi3": {"quaternion": ELEMENTS, "rate": ("omega.x", "omega.y", "omega.z")},
    "joints": {"angles": ("", "pitch", "yaw"), "angle_rates": ("", "pitch_rate", "yaw_rate")},
}
"""Each way to map an Aero: scalar outputs of FMI 2; an array and scalars of FMI 3; angles and their derivatives."""


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


WOBBLE = [(10 * np.sin(0.01 * k), 8 * np.cos(0.013 * k)) for k in range(500)]


def flat(measured: list[Measurement]) -> Any:
    return np.array([(*each.attitude, *each.rate) for each in measured])


def test_our_aero_as_an_fmu_moves_as_our_emulated_one_along_the_papers_experiment(fmus: dict[str, Path]) -> None:
    """On this machine the 25 000 measurements are equal to the last bit: the same operations in the same order.

    1e-12 leaves room for another compiler's library of sines; without closed loop, nothing grows faster than the time.
    """
    course = experiment(with_bits(load(overrides=["plant.ideal=true"]), "8/6"), 50.0).course
    voltages = [(float(u2), float(u3)) for u2, u3 in course.voltages]
    ours = flat(driven(IDEAL.build(PERIOD), voltages))
    assert np.ptp(ours[:, 3]) > 0.1  # it does move: this is sin(ψ/2) cos(θ/2)
    for mapping, file in fmus.items():
        theirs = flat(driven(FmuPlant(settings_of(file, mapping), PERIOD), voltages))
        assert np.abs(theirs - ours).max() < 1e-12, mapping


@pytest.mark.parametrize("mapping", BODY)
def test_two_instances_at_once_with_start_values_are_equal_to_the_last_bit(fmus: dict[str, Path], mapping: str) -> None:
    """Start values are the FMU's parameters: here, loads on the joints, as of our wind."""
    load_pitch, load_yaw = -0.001, 0.004
    settings = settings_of(fmus[mapping], mapping, start={"load_pitch": load_pitch, "load_yaw": load_yaw})
    one, other = (FmuPlant(settings, PERIOD) for _ in range(2))
    theirs = driven(one, WOBBLE)
    assert driven(other, WOBBLE) == theirs
    wind = WindSettings(blowing=True, torque=(load_pitch, load_yaw), gust=0.0)
    ours = driven(IDEAL.effective.model_copy(update={"wind": wind}).build(PERIOD), WOBBLE)
    assert np.abs(flat(theirs) - flat(ours)).max() < 1e-12


def test_voltages_are_zero_at_first_and_go_where_their_names_say(fmus: dict[str, Path]) -> None:
    """Whatever an input starts with; the true state is what is measured, with the voltages."""
    started, still = (FmuPlant(settings_of(fmus["fmi2"], start=start), PERIOD) for start in ({"u2": 5.0}, {}))
    for plant in (started, still):
        plant.advance()
    assert started.truth() == still.truth() == State(*still.measure(), (0.0, 0.0))
    swapped = FmuPlant(settings_of(fmus["fmi2"], voltages=["u3", "u2"]), PERIOD)
    straight = FmuPlant(settings_of(fmus["fmi2"]), PERIOD)
    assert driven(swapped, [(b, a) for a, b in WOBBLE]) == driven(straight, WOBBLE)
    still.actuate((3.0, -2.0))
    assert still.truth() == State(*still.measure(), (3.0, -2.0))
    for plant in (started, still):
        plant.close()


angle = st.floats(-3, 3)


@given(angles=st.tuples(angle, angle, angle), rates=st.tuples(angle, angle, angle))
def test_rates_of_angles_become_the_body_rates_that_turn_the_attitude_so(
    angles: tuple[float, float, float], rates: tuple[float, float, float]
) -> None:
    """Ṙ = R S(ω), with Ṙ from differences of the attitude along the angles."""
    h = 1e-5

    def at(time: float) -> Any:
        return rotation(np.array(quaternion_of(*np.add(angles, time * np.array(rates)))))

    rate = at(0).T @ (at(h) - at(-h)) / (2 * h)
    # central differences: the error is below h² |third derivative| / 6 < 1e-7 for rates up to 3 rad/s
    assert np.allclose([rate[2, 1], rate[0, 2], rate[1, 0]], body_rate((angles[0], angles[1]), rates), atol=1e-7)


# ── what cannot run is one line ──


REFUSED: dict[str, tuple[str, dict[str, Any], str]] = {
    "no file": ("fmi2", {"file": "none.fmu"}, "there is no file none.fmu: set plant.own.file"),
    "no FMU": ("fmi2", {"file": __file__}, "test_fmu.py is not an FMU: File is not a zip file"),
    "a slip": ("fmi2", {"rate": ("rate.X", "rate.y", "rate.z")}, "has no variable rate.X: did you mean rate.x?"),
    "no such": ("fmi2", {"voltages": ["zz"]}, "aero.fmu has no variable zz; it has u2, u3"),
    "causality": ("fmi2", {"voltages": ["u2", "yaw"]}, "yaw is an output of type Real, not an input of type Real; of"),
    "type": ("fmi3", {"voltages": ["time"]}, "time is an independent of type Float64, not an input of type Float64"),
    "input": ("fmi2", {"rate": ("u2", "rate.x", "rate.y")}, "u2 is an input of type Real, not an output of type Real"),
    "element": ("fmi3", {"rate": ("q[5]", "yaw", "yaw")}, "q has 4 elements, and none is q[5]"),
    "element 0": ("fmi3", {"rate": ("q[0]", "yaw", "yaw")}, "q has 4 elements, and none is q[0]"),
    "unit": ("fmi2", {"rate_unit": "deg/s"}, "rate.x is in rad/s, not in deg/s: set angle_unit or rate_unit"),
    "start": ("fmi2", {"start": {"laod_yaw": 1}}, "aero.fmu has no variable laod_yaw: did you mean load_yaw?"),
    "start type": ("fmi2", {"start": {"load_yaw": "much"}}, "plant.own.start.load_yaw: could not convert string to "),
    "start of output": (
        "fmi2",
        {"start": {"yaw": 1.0}},
        "plant.own.start.yaw cannot be set: it is an output of type",
    ),
}


FMI1 = '"1.0" modelIdentifier="aero" numberOfContinuousStates="0" numberOfEventIndicators="0"'
PLATFORM, LIBRARY = fmpy.platform, f"aero{fmpy.sharedLibraryExtension}"
FATAL = 4
BROKEN: dict[str, tuple[str, tuple[tuple[str, str], ...], tuple[str, str], str]] = {
    "no description": ("fmi2", (), ("modelDescription.xml", "x.xml"), 'is not an FMU: "There is no item named'),
    "no XML": ("fmi2", (("<?xml", "xml"),), ("", ""), "is not an FMU: Start tag expected"),
    "FMI 1": ("fmi2", (('"2.0"', FMI1),), ("", ""), "broken.fmu is of FMI 1.0: export it for FMI 2 or 3"),
    "model exchange": (
        "fmi2",
        (("<CoSimulation", "<ModelExchange"),),
        ("", ""),
        "is for model exchange only: export it",
    ),
    "no binary": (
        "fmi2",
        (),
        (PLATFORM, "win99"),
        f"has no binary for {PLATFORM}: export it on this platform, or `fmpy",
    ),
    "GUID": (
        "fmi2",
        (('guid="aero"', 'guid="other"'),),
        ("", ""),
        "instantiate model: the GUID is other, not",
    ),
    "step": (
        "fmi3",
        (('fixedInternalStepSize="0.001"', 'fixedInternalStepSize="0.003"'),),
        ("", ""),
        "has steps of 0.003 s, of which 0.002 s, the loop's period or its part by plant.own.substeps, is no multiple",
    ),
}


def refusal(settings: FmuSettings) -> str:
    with pytest.raises(FmuError) as refused:
        FmuPlant(settings, PERIOD)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("case", REFUSED)
def test_an_fmu_that_does_not_fit_is_one_line(fmus: dict[str, Path], case: str) -> None:
    mapping, changes, line = REFUSED[case]
    assert line in refusal(settings_of(fmus[mapping], mapping, **changes))


@pytest.mark.parametrize("case", BROKEN)
def test_an_fmu_that_cannot_run_here_is_one_line(fmus: dict[str, Path], tmp_path: Path, case: str) -> None:
    mapping, edits, files, line = BROKEN[case]
    broken = altered(fmus[mapping], tmp_path / "broken.fmu", *edits, files=files)
    assert line in refusal(settings_of(broken, mapping))


def test_a_library_that_cannot_be_loaded_is_one_line(fmus: dict[str, Path], tmp_path: Path) -> None:
    broken = altered(fmus["fmi2"], tmp_path / "broken.fmu", files=(LIBRARY, "other"))
    with ZipFile(broken, "a") as archive:
        archive.writestr(f"binaries/{PLATFORM}/{LIBRARY}", "no library")
    assert "broken.fmu: it does not start: Failed to load shared library" in refusal(settings_of(broken))


def test_without_fmpy_the_line_says_what_to_install(fmus: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    line = "an FMU needs FMPy, which is not installed: pip install 'aeroloop[fmi]'"
    assert refusal(settings_of(fmus["fmi2"])) == line


@pytest.mark.parametrize("status", [2, 3, FATAL])
def test_a_step_that_fails_is_one_line_with_its_time_and_the_fmus_own_words(
    fmus: dict[str, Path], status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = {"fails_at": 0.1, "fails_with": status}
    plant = FmuPlant(settings_of(fmus["fmi2"], start=start), PERIOD)
    freed: list[None] = []
    monkeypatch.setattr("fmpy.fmi2.FMU2Slave.freeInstance", lambda _: freed.append(None))
    with pytest.raises(FmuError) as failed:
        driven(plant, WOBBLE)
    name = {2: "discard", 3: "error", FATAL: "fatal"}[status]
    assert str(failed.value) == (
        f"aero.fmu: it failed at 0.1 s: fmi2DoStep failed with status {status} ({name}): the motor burnt at 0.1 s"
    )
    plant.close()
    plant.close()
    assert len(freed) == (status != FATAL)  # after that, FMI forbids any call


def test_a_step_of_another_length_than_it_prefers_says_which(fmus: dict[str, Path]) -> None:
    plant = FmuPlant(settings_of(fmus["fmi2"]), 0.004)
    with pytest.raises(
        FmuError,
        match=r"0 s: .*: no step but 0.002 s \(steps are of 0.004 s, and it prefers 0.002 s: see plant.own.subs",
    ):
        plant.advance()
    plant.close()


def test_substeps_are_equal_communication_steps_of_a_period(fmus: dict[str, Path]) -> None:
    """An FMU that takes only steps of 2 ms runs at 4 ms, and is then where two periods of 2 ms lead."""
    slow = FmuPlant(settings_of(fmus["fmi2"], substeps=2), 2 * PERIOD)
    fast = FmuPlant(settings_of(fmus["fmi2"]), PERIOD)
    assert driven(slow, WOBBLE) == driven(fast, [volts for volts in WOBBLE for _ in range(2)])[::2]


def test_an_fmu_that_ends_by_itself_says_when(fmus: dict[str, Path]) -> None:
    plant = FmuPlant(settings_of(fmus["fmi3"], "joints", start={"load_pitch": 5.0}), PERIOD)
    with pytest.raises(FmuError, match=r"aero.fmu: it ended by itself at 0\.1\d+ s"):
        driven(plant, WOBBLE)
    plant.close()


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"angles": ("a", "b", "c")}, "set either quaternion or angles"),
        ({"quaternion": None}, "set either quaternion or angles"),
        ({"rate": None}, "set either rate or angle_rates"),
        ({"rate": None, "angle_rates": ("a", "b", "c")}, "angle_rates needs angles"),
        ({"voltages": ["u2", "u2"]}, "voltages must name each input once"),
        ({"voltages": []}, "at least 1 item"),
        ({"voltages": [f"u{i}" for i in range(9)]}, "at most 8 items"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(ValidationError, match=line):
        settings_of(Path("x.fmu"), **changes)


# ── behind the loop ──


@pytest.mark.parametrize("mapping", BODY)
def test_an_experiment_gives_the_figures_of_our_ideal_aero(fmus: dict[str, Path], mapping: str) -> None:
    settings = with_bits(load(overrides=["plant.ideal=true"]), "cont")
    own = {"file": str(fmus[mapping]), "voltages": VOLTAGES, **BODY[mapping]}
    theirs = run_experiment(settings.model_copy(update={"plant": PlantSettings(kind="fmu", own=own)}), 4.0)
    ours = run_experiment(settings, 4.0)
    for name in ("z_track", "u_total", "max_error_deg"):  # compiled or frame by frame: sums differ in the last place
        assert getattr(theirs, name) == pytest.approx(getattr(ours, name), rel=1e-9)
