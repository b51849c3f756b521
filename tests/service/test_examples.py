"""Examples of the public API: each runs unchanged in a process, as its opening docstring shows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import aeroloop
from aeroloop.service import examples
from tests.support.made_log import make_log

pytestmark = pytest.mark.processes

EXAMPLES = Path(examples.__path__[0])
PATIENCE_S = 120
"""For what takes up to 10 s here; CI may have other work."""


def run(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_log_is_read_back_into_numpy(tmp_path: Path) -> None:
    make_log(tmp_path / "run.mcap", 500)
    printed = run(tmp_path, str(EXAMPLES / "read_log.py"), "run.mcap")
    assert printed.startswith("500 ticks of 2 ms, 0.998 s\n")
    read = aeroloop.read_run(tmp_path / "run.mcap")
    assert read.ticks.attitude.shape == (500, 4)
    assert read.time[-1] == pytest.approx(0.998)
    assert f"z_track = {read.figures.z_track}, " in printed


def test_the_lockstep_test_passes_where_it_is_copied_to(tmp_path: Path) -> None:
    name = "test_lockstep_hil.py"
    (tmp_path / name).write_text((EXAMPLES / name).read_text())
    assert "1 passed" in run(tmp_path, "-m", "pytest", "-q", "--hil-lockstep", name)


PUBLIC = """
    AeroloopError Certificate Controller Figures Hil HilError HysteresisQuantizer LogarithmicQuantizer Measurement Plant
    RecordedRun Settings SignalSpec State Ticks UniformQuantizer WireSpec
    ExpressionLaw Gain Gains3 LawSettings Now PositiveGain PythonLaw
    certify gravity_torque load_settings read_run run_experiment voltages_for
"""
"""Names that users write. One that is missing here is added on purpose, and none is ever taken away in passing."""


def test_the_public_names_are_those_and_each_is_documented() -> None:
    assert set(aeroloop.__all__) == set(dir(aeroloop)) == set(PUBLIC.split())
    for name in aeroloop.__all__:
        assert getattr(aeroloop, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        aeroloop.nonsense  # noqa: B018  # the access is what is tested


def test_importing_the_package_imports_nothing_heavy() -> None:
    heavy = "import sys, aeroloop; print({'casadi', 'numpy', 'zenoh', 'pydantic'} & set(sys.modules))"
    assert run(Path.cwd(), "-c", heavy) == "set()\n"


def test_an_experiment_takes_a_plant_and_a_controller_of_ones_own() -> None:
    settings = aeroloop.load_settings(overrides={"wire.voltage.bits": 8})
    controller = aeroloop.Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
    plant = settings.plant.build(settings.loop.period)
    seen: list[int] = []
    figures = aeroloop.run_experiment(
        settings, 0.5, plant=plant, controller=controller, watch=lambda k, *_: seen.append(k)
    )
    assert figures == aeroloop.run_experiment(settings, 0.5)
    assert seen == list(range(250))
    assert controller.tick_index == 249


def test_a_certificate_is_that_of_the_configuration() -> None:
    assert aeroloop.certify(aeroloop.load_settings(EXAMPLES / "rigid-body.toml")).holds
    assert not aeroloop.certify(aeroloop.load_settings()).holds
