"""The closed loop as one function: every frame and every figure as through frames, to the last bit."""

from __future__ import annotations

import pickle
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import settings as examples
from hypothesis import strategies as st

from aeroloop.service.config import ConfigError, Settings, as_overrides, load
from aeroloop.service.lab import loop_function
from aeroloop.service.lab.experiment import LoopEndedError, experiment, run_experiment
from aeroloop.service.lab.loop_function import BLOCK, Loop, loop_of
from tests.support.ideal import PARTS

TICKS = BLOCK + 90
"""More than a block, and not a whole number of blocks."""

needs_a_compiler = pytest.mark.skipif(not (shutil.which("cc") or shutil.which("gcc")), reason="no C compiler on PATH")

BODY = {"kind": "rigid_body", "rigid_body": {"allocation": [[0.002, 0, 0], [0, 0.002, 0], [0, 0, 0.002]]}}
LAW = {"allocation": [[0.002, 0, 0], [0, 0.002, 0], [0, 0, 0.002]]}
KINDS = ["uniform", "hysteresis-uniform", "logarithmic-uniform"]
SIGNAL = st.fixed_dictionaries(
    {"bits": st.sampled_from(["cont", 3, 5, 8, 12, 16]), "kind": st.sampled_from(KINDS)}
)  # fmt: skip
SENSORS: dict[str, Any] = {
    "attitude": st.sampled_from(["encoders", "perfect"]), "rate": st.sampled_from(["derivative", "gyro", "perfect"]),
    "gyro_noise": st.sampled_from([0.0, 0.02]), "seed": st.integers(0, 3),
    "gyro_bias": st.sampled_from([[0.0, 0.0, 0.0], [0.01, -0.02, 0.0]]),
}  # fmt: skip
REFERENCES = (
    {"kind": "sinusoid"},
    {"kind": "hold", "attitude": [0.0, -20.0, 250.0]},
    {"kind": "points", "times": [0.0, 0.4, 0.9], "attitudes": [[0, 0, 0], [0, 10, -20], [0, -5, 30]]},
    {"kind": "stream"},
)
SIDES = {side: st.sampled_from(["periodic", "on_change"]) for side in ("measurement", "command")}
WIRE = {**dict.fromkeys(("attitude", "rate", "voltage"), SIGNAL), "transmit": st.fixed_dictionaries(SIDES)}
PLANTS = (
    st.fixed_dictionaries({"sensors": st.fixed_dictionaries(SENSORS)}),
    st.just(BODY | {"sensors": {"attitude": "perfect", "rate": "gyro", "gyro_noise": 0.01}}),
    st.just(PARTS),
)
CONFIGURATIONS = st.fixed_dictionaries({
    "wire": st.fixed_dictionaries(WIRE), "reference": st.sampled_from(REFERENCES), "plant": st.one_of(PLANTS),
    "wind": st.fixed_dictionaries({"blowing": st.booleans(), "gust": st.sampled_from([0.0, 0.2])}),
    "voltage_limit": st.sampled_from([24.0, 5.0]), "dead_zone_v": st.sampled_from([0.0, 2.5]),
    "rate_hz": st.sampled_from([500.0, 250.0]),
})  # fmt: skip


def configured(chosen: dict[str, Any]) -> Settings:
    plant = {**chosen["plant"], "wind": chosen["wind"], "voltage_limit": chosen["voltage_limit"]}
    plant["rotor"] = {**plant.get("rotor", {}), "dead_zone_v": chosen["dead_zone_v"]}
    tree = {"wire": chosen["wire"], "plant": plant, "loop": {"rate_hz": chosen["rate_hz"]}}
    if "kind" in plant:
        tree |= {"law": LAW, "wire": {**chosen["wire"], "actuators": 3}}
    tree |= {"reference": chosen["reference"], "controller": {"max_reference_rate": 100}}
    return load(overrides=as_overrides(tree))


def assert_the_same(settings: Settings, loop: Loop | None = None, ticks: int = TICKS) -> None:
    """Figures, the course, and so every frame that is sent."""
    seconds = ticks * settings.loop.period
    figures, course, compiled = experiment(settings, seconds, watch=lambda *_: None)
    assert not compiled
    found = (loop or loop_of(settings)).run(settings, ticks)
    assert found is not None
    for ours, theirs in zip(found, course, strict=True):
        assert ours.tobytes() == theirs.tobytes()
    assert experiment(settings, seconds).figures == figures
    assert experiment(settings, seconds).compiled


@given(CONFIGURATIONS)
@examples(max_examples=12)
def test_frames_and_figures_are_those_of_the_loop_through_frames(chosen: dict[str, Any]) -> None:
    try:
        settings = configured(chosen)
    except ConfigError:  # too few bits for a logarithmic quantizer
        reject()
    try:
        assert_the_same(settings)
    except LoopEndedError:
        assert loop_of(settings).run(settings, TICKS) is None


VARIED = (
    ("plant.wind.blowing=true", "wire.attitude.kind=hysteresis-uniform", "plant.sensors.rate=gyro"),
    ('wire.voltage.bits="cont"', "wire.rate.kind=logarithmic-uniform", "wire.transmit=on_change"),
)


@needs_a_compiler
@pytest.mark.parametrize("overrides", VARIED)
def test_c_gives_the_same_bits_and_leaves_no_file(
    overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(loop_function, "COMPILED_FROM", 1)
    loop = Loop(settings := load(overrides=overrides))
    assert_the_same(settings, loop)
    assert loop.in_c
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compiler", [None, "#!/bin/sh\nexit 0\n"])
def test_without_a_compiler_or_with_a_broken_one_the_virtual_machine_runs_it(
    compiler: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(loop_function, "COMPILED_FROM", 1)
    if compiler is not None:
        (tmp_path / "cc").write_text(compiler)
        (tmp_path / "cc").chmod(0o755)
    loop = Loop(load())
    assert_the_same(load(), loop)
    assert not loop.in_c


def test_one_function_serves_all_cells_that_differ_in_bits_seeds_and_wind() -> None:
    coarse = load(overrides=["wire.attitude.bits=5", "wire.voltage.bits=4", "plant.wind.blowing=true"])
    assert loop_of(load()) is loop_of(coarse)
    assert loop_of(load()) is not loop_of(load(overrides=["plant.friction.width=0.02"]))
    assert_the_same(coarse, loop_of(load()))


@pytest.mark.parametrize(
    "overrides",
    [
        ["plant.limits.max_rate=0.3"],
        ["wire.voltage.limit=2", "plant.limits.max_saturated_s=0.1"],
        ["loop.rate_hz=10", "plant.limits.max_rate=1e300", "plant.limits.max_tilt_deg=180",
         "plant.friction.viscous=[90, 90]"],  # diverges until no number is left
    ],
    ids=["rate", "saturation", "not a number"],
)  # fmt: skip
def test_a_run_that_trips_ends_as_through_frames_with_its_reason(overrides: list[str]) -> None:
    settings = load(overrides=overrides)
    with pytest.raises(LoopEndedError) as known:
        run_experiment(settings, 4.0, watch=lambda *_: None)
    assert loop_of(settings).run(settings, settings.loop.ticks(4.0)) is None
    with pytest.raises(LoopEndedError) as found:
        experiment(settings, 4.0)
    assert str(found.value) == str(known.value)


def test_why_a_loop_ended_survives_the_way_from_a_worker_process() -> None:
    ended = LoopEndedError(0.25, ["tilted by 91°: 0 V"])
    again = pickle.loads(pickle.dumps(ended))  # noqa: S301  # it is what was pickled here
    assert (type(again), str(again), again.after_s) == (LoopEndedError, str(ended), 0.25)
    assert str(ended) == "the loop ended after 0.25 s: tilted by 91°: 0 V"
    assert str(LoopEndedError(0.25, [])) == "the loop ended after 0.25 s: no answer"


def test_a_value_within_a_rounding_of_a_limit_is_left_to_the_frames() -> None:
    speeds = []
    settings = load(overrides=["plant.sensors.rate=gyro"])
    plant = settings.plant.build(settings.loop.period)
    run_experiment(settings, 1.0, watch=lambda *_: speeds.append(np.linalg.norm(plant.measure().rate)), plant=plant)
    limits = settings.plant.limits
    for excess, as_one_function in ((1e-12, False), (1e-6, True)):
        near = limits.model_copy(update={"max_rate": max(speeds) * (1 + excess)})
        changed = settings.model_copy(update={"plant": settings.plant.model_copy(update={"limits": near})})
        assert experiment(changed, 1.0).compiled == as_one_function


def test_a_fault_runs_frame_by_frame() -> None:
    faulty = load(overrides=['plant.faults=["rate:bias=0.1@0.1"]'])
    assert not experiment(faulty, 0.3).compiled
    assert run_experiment(faulty, 0.3).z_track != run_experiment(load(), 0.3).z_track
