"""Examples: each runs unchanged in a process, as its opening docstring shows.

Real-time tests wait up to half a minute for an event; on an idle machine each comes within 3 s.
"""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

import aeroloop
from aeroloop.protocol.messages.models import Truth
from aeroloop.service import examples
from aeroloop.service.testing.hil import Hil, HilError
from tests.support.failing_laws import FAILING
from tests.support.made_log import make_log
from tests.support.processes import LONGEST_S
from tests.support.processes import aeroloop as aeroloop_command

pytestmark = pytest.mark.processes

EXAMPLES = Path(examples.__path__[0])


def run(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, capture_output=True, text=True, check=False, timeout=LONGEST_S
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


def test_faults_are_searched_at_the_hardest_instants_of_a_log(tmp_path: Path) -> None:
    make_log(tmp_path / "run.mcap", 600)
    printed = run(tmp_path, str(EXAMPLES / "fork_faults.py"), "run.mcap").splitlines()
    assert len(printed) == 4  # of one second, four faults
    assert all(re.fullmatch(r"tick \d+, [\w.:=@]+: [1-9]\d?\.\d\d° .*", line) for line in printed), printed


def test_logs_are_checked_where_the_test_is_copied_to(tmp_path: Path) -> None:
    (tmp_path / "test_logs.py").write_text((EXAMPLES / "test_logs.py").read_text())
    (tmp_path / "logs").mkdir()
    make_log(tmp_path / "logs" / "a.mcap", 200)
    assert "1 passed" in run(tmp_path, "-m", "pytest", "-q", "test_logs.py")


def test_the_lockstep_test_passes_where_it_is_copied_to(tmp_path: Path) -> None:
    name = "test_lockstep_hil.py"
    (tmp_path / name).write_text((EXAMPLES / name).read_text())
    assert "1 passed" in run(tmp_path, "-m", "pytest", "-q", "--hil-lockstep", name)


PUBLIC = """
    AeroloopError Certificate Controller Figures Fork Hil HilError HysteresisQuantizer Instant LogCheck
    LogarithmicQuantizer Measurement Plant RecordedRun Settings SignalSpec State Ticks UniformQuantizer WireSpec
    ExpressionLaw Gain Gains3 LawSettings Now PositiveGain PythonLaw
    certify check_logs gravity_torque load_settings read_run run_experiment voltages_for
"""
"""Names that users write. One that is missing here is added on purpose, and none is ever taken away in passing."""


def test_the_public_names_are_those_and_each_is_documented() -> None:
    assert set(aeroloop.__all__) == set(dir(aeroloop)) == set(PUBLIC.split())
    for name in aeroloop.__all__:
        assert getattr(aeroloop, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        aeroloop.nonsense  # noqa: B018  # the access is what is tested


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


@pytest.mark.realtime
def test_laws_track_and_law_and_plant_run_as_processes_whose_log_replays(tmp_path: Path) -> None:
    """In a folder of the user's own, into which the examples are printed as the README says."""
    command = partial(aeroloop_command, cwd=tmp_path)
    for name in ("own_law.py", "own_plant.py", "own-plant.toml"):
        (tmp_path / name).write_text(command("show", "examples", name), encoding="utf-8")
    both = "--config", "own-plant.toml", "--set", "law.kind=own_law:OwnPythonLaw"
    command("demo", "--lockstep", "--duration", "2", "--log", "run.mcap", *both)
    replayed = json.loads(command("log", "replay", "run.mcap", "--json"))
    assert replayed["controller"] == {"ticks": 1000, "differ": 0}
    assert replayed["plant"]["differ"] == 0
    review = command("log", "review", "run.mcap")
    assert "–  No theorem for this law, own_law:OwnPythonLaw." in review
    command("log", "export", "run.mcap", "--format", "csv", "--out", "run.csv")
    with (tmp_path / "run.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1000
    assert any("error_integral" in name for name in rows[0])
    law = "--set", "law.kind=own_law:OwnLaw"
    for words, bound_deg in ((("2", *both), 3), (("4", *law), 6)):
        experiment = json.loads(command("lab", "experiment", "--json", "--duration", *words))
        assert experiment["max_error_deg"] < bound_deg
    wrong = command("lab", "experiment", *law, "--set", "law.stifness=[1,1,1]", code=2)
    assert "did you mean law.stiffness?" in wrong


@pytest.mark.parametrize(
    ("failure", "fault"),
    [
        ("raises", ": RuntimeError: the estimator diverged (failing_laws.py, line "),
        pytest.param("hangs", " has not ended a tick for ", marks=pytest.mark.realtime),
    ],
)
def test_a_law_that_fails_faults_by_name_and_the_plant_is_at_0_v(hil: Hil, failure: str, fault: str) -> None:
    kind, fault = f"{FAILING}:Failing", f"law {FAILING}:Failing{fault}"
    hil.start(settings={"law.kind": kind, "law.failure": failure, "plant.truth_rate_hz": 500}, drive=False)
    hil.processes.start("controller")
    hil.eventually("the fault is an event", lambda: hil.happened("fault", fault))
    # It trips by the command without a value, or is released before it has read that, and then waits for a claim.
    hil.eventually("the plant is not driven", lambda: hil.state("plant") in ("tripped", "idle"))
    if failure == "raises":
        hil.eventually("its status", lambda: hil.state("controller") == "faulted")
        assert (hil.status("controller").cause or "").startswith(fault)
        with pytest.raises(HilError, match=rf"is faulted: {re.escape(fault)}.*; `aeroloop op arm` lets it"):
            hil.set_gains(stiffness=[1.0, 1.0, 1.0])
    assert hil.processes.stop("controller") == (1 if failure == "hangs" else 0)
    *before, last = [truth.voltages for _, truth in hil.log.messages(Truth)]
    assert not any(last)
    assert any(map(any, before))
