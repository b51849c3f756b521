"""Examples of a law and of a plant of one's own: they work in a folder of the user's own, as their texts say.

Real-time tests wait up to half a minute for an event; on an idle machine each comes within 3 s.
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest

from aeroloop.protocol.messages.models import Truth
from aeroloop.service import examples
from aeroloop.service.testing.hil import Hil, HilError
from tests.support.processes import aeroloop

pytestmark = pytest.mark.processes


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder, into which the examples are printed as the README says."""
    for name, file in (("own_law.py", "own_law.py"), ("own_plant.py", "own_plant.py"), ("own-plant", "own-plant.toml")):
        (tmp_path / file).write_text(run(tmp_path, "show", "examples", name), encoding="utf-8")
    return tmp_path


def run(folder: Path, *words: str, code: int = 0) -> str:
    return aeroloop(*words, code=code, cwd=folder)


@pytest.mark.parametrize("name", ["own_law.py", "own_plant.py"])
def test_an_example_has_under_60_lines(name: str) -> None:
    text = (Path(examples.__path__[0]) / name).read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60


def test_law_and_plant_run_as_processes_and_their_log_replays(folder: Path) -> None:
    both = "--config", "own-plant.toml", "--set", "law.kind=own_law:OwnPythonLaw"
    run(folder, "demo", "--lockstep", "--duration", "2", "--log", "run.mcap", *both)
    replayed = json.loads(run(folder, "log", "replay", "run.mcap", "--json"))
    assert replayed["controller"] == {"ticks": 1000, "differ": 0}
    assert replayed["plant"]["differ"] == 0
    assert "No theorem for this law, own_law:OwnPythonLaw." in " ".join(
        run(folder, "log", "review", "run.mcap").split()
    )
    run(folder, "log", "export", "run.mcap", "--format", "csv")
    (table,) = folder.glob("*.csv")
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1000
    assert any("error_integral" in name for name in rows[0])
    experiment = json.loads(run(folder, "lab", "experiment", "--duration", "2", "--json", *both))
    assert experiment["max_error_deg"] < 3


@pytest.mark.parametrize("kind", ["OwnLaw", "OwnPythonLaw"])
def test_the_law_tracks_the_papers_reference(folder: Path, kind: str) -> None:
    found = json.loads(
        run(folder, "lab", "experiment", "--duration", "4", "--json", "--set", f"law.kind=own_law:{kind}")
    )
    assert found["max_error_deg"] < 6
    wrong = "--set", f"law.kind=own_law:{kind}", "--set", "law.stifness=[1,1,1]"
    assert "did you mean law.stiffness?" in run(folder, "lab", "experiment", *wrong, code=2)


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("Raising", "law tests.support.failing_laws:Raising: ZeroDivisionError: by nothing (failing_laws.py, line "),
        ("Hanging", "law tests.support.failing_laws:Hanging has not ended a tick for "),
        ("Slow", "law tests.support.failing_laws:Slow took 0."),  # with a stall of the machine it may be more than 0.3
    ],
)
def test_a_law_that_fails_faults_by_name_and_the_plant_is_at_0_v(hil: Hil, kind: str, fault: str) -> None:
    law = f"tests.support.failing_laws:{kind}"
    hil.start(settings={"law.kind": law, "plant.truth_rate_hz": 500}, drive=False)
    hil.processes.start("controller")
    hil.eventually("the fault is an event", lambda: hil.happened("fault", fault))
    # It trips by the command without a value, or is released before it has read that, and then waits for a claim.
    hil.eventually("the plant is not driven", lambda: hil.state("plant") in ("tripped", "idle"))
    if kind == "Raising":
        hil.eventually(
            "the status says why",
            lambda: hil.state("controller") is not None and (hil.status("controller").cause or "").startswith(fault),
        )
        with pytest.raises(HilError, match=rf"is faulted: {re.escape(fault)}.*; `aeroloop op arm` lets it"):
            hil.set_gains(stiffness=[1.0, 1.0, 1.0])
    assert hil.processes.stop("controller") == (1 if kind == "Hanging" else 0)
    truths = [truth for _, truth in hil.log.messages(Truth)]
    assert not any(truths[-1].voltages)
    assert any(any(truth.voltages) for truth in truths)
