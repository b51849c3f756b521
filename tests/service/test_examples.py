"""Examples: each runs unchanged, as its opening docstring shows.

Real-time tests wait up to half a minute for an event; on an idle machine each comes within 3 s.
"""

from __future__ import annotations

import csv
import json
import re
import runpy
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
from tests.support.processes import LONGEST_S, PATIENT
from tests.support.processes import aeroloop as aeroloop_command

EXAMPLES = Path(examples.__path__[0])


def printed_by(name: str, *words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """What an example prints as a program, in this process."""
    monkeypatch.setattr(sys, "argv", [name, *words])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_a_log_is_read_back_into_numpy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_log(log := tmp_path / "run.mcap", 500)
    printed = printed_by("read_log.py", str(log), capsys=capsys, monkeypatch=monkeypatch)
    assert printed.startswith("500 ticks of 2 ms, 0.998 s\n")
    read = aeroloop.read_run(log)
    assert read.ticks.attitude.shape == (500, 4)
    assert read.time[-1] == pytest.approx(0.998)
    assert f"z_track = {read.figures.z_track}, " in printed


def test_faults_are_searched_at_the_hardest_instants_of_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_log(log := tmp_path / "run.mcap", 600)
    printed = printed_by("fork_faults.py", str(log), capsys=capsys, monkeypatch=monkeypatch).splitlines()
    assert len(printed) == 4  # of one second, four faults
    assert all(re.fullmatch(r"tick \d+, [\w.:=@]+: [1-9]\d?\.\d\d° .*", line) for line in printed), printed


@pytest.mark.processes
@pytest.mark.realtime  # pytest in pytest, which starts processes
@pytest.mark.parametrize(("name", "options"), [("test_logs.py", ()), ("test_lockstep_hil.py", ("--hil-lockstep",))])
def test_the_tests_pass_where_they_are_copied_to(tmp_path: Path, name: str, options: tuple[str, ...]) -> None:
    (tmp_path / name).write_text((EXAMPLES / name).read_text())
    (tmp_path / "logs").mkdir()
    make_log(tmp_path / "logs" / "a.mcap", 200)
    command = [sys.executable, "-m", "pytest", "-q", *options, name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=LONGEST_S)
    assert "1 passed" in done.stdout, done.stdout + done.stderr


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


@pytest.mark.processes
@pytest.mark.realtime
def test_laws_track_and_law_and_plant_run_as_processes_whose_log_replays(tmp_path: Path) -> None:
    """In a folder of the user's own, into which the examples are printed as the README says."""
    command = partial(aeroloop_command, cwd=tmp_path)
    for name in ("own_law.py", "own_plant.py", "own-plant.toml"):
        (tmp_path / name).write_text(command("show", "examples", name), encoding="utf-8")
    both = "--config", "own-plant.toml", "--set", "law.kind=own_law:OwnPythonLaw"
    command("demo", "--lockstep", "--duration", "2", "--log", "run.mcap", *both)
    replayed = json.loads(command("log", "replay", "run.mcap", "--json", "--trust-law"))
    assert replayed["controller"] == {"ticks": 1000, "differ": 0}
    assert replayed["plant"]["differ"] == 0
    review = command("log", "review", "run.mcap", "--trust-law")
    assert "–  No theorem for this law, own_law:OwnPythonLaw." in review
    assert "without its law" not in review
    command("log", "export", "run.mcap", "--out", "run.csv", "--trust-law")
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


@pytest.mark.processes
@pytest.mark.realtime
def test_a_demo_whose_law_raises_says_so_and_does_not_blame_the_machine() -> None:
    failing = ["--set", f"law.kind={FAILING}:Failing", "--set", "law.at=50"]
    said = aeroloop_command("demo", "--duration", "5", *failing, code=1)
    assert "RuntimeError: the estimator diverged" in said
    assert "too busy" not in said


@pytest.mark.processes
@pytest.mark.parametrize(
    ("failure", "fault"),
    [
        ("raises", ": RuntimeError: the estimator diverged (failing_laws.py, line "),
        pytest.param("hangs", " has not ended a tick for ", marks=pytest.mark.realtime),
    ],
)
def test_a_law_that_fails_faults_by_name_and_the_plant_is_at_0_v(hil: Hil, failure: str, fault: str) -> None:
    kind, fault = f"{FAILING}:Failing", f"law {FAILING}:Failing{fault}"
    failing = {"law.kind": kind, "law.failure": failure, "law.at": 50, "plant.truth_rate_hz": 500}
    # A machine that stalls must not end the session before its law fails, and 50 ticks have a true state with voltages.
    hil.start(settings={**PATIENT, **failing}, drive=False)
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
