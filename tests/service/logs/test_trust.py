"""Reading a log imports no code that the reader did not name, and shows all that needs no law.

The log is of a law and a plant of a user's own, in modules that lie in the folder from which it is read. Each module
leaves a file when it is imported.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import aeroloop
from aeroloop.protocol import plugins
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Gains
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings
from aeroloop.service.lab.check import check_logs
from aeroloop.service.lab.fork import fork
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import read
from tests.support import own_laws, own_plants
from tests.support.in_this_process import run_here
from tests.support.made_log import AN_OPERATORS_WORDS, lockstep, made, write
from tests.support.processes import AEROLOOP

TICKS = 300
NAMED = "strange_law:Named"
LAW, PLANT = "strange_law:Python", "strange_plant:Pair"
MODULE = """
from pathlib import Path
from {module} import {name}
Named = {name}
Path(__file__).with_suffix(".imported").touch()
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, with the modules and their log, `run.mcap`; `known.mcap` is the same of the tests' law."""
    for module, of, name in (("strange_law", own_laws, "Python"), ("strange_plant", own_plants, "Pair")):
        (tmp_path / f"{module}.py").write_text(MODULE.format(module=of.__name__, name=name))
    settings = lockstep(f"law.kind={own_laws.PYTHON}", f"plant.kind={own_plants.__name__}:Pair")
    messages = made(settings, TICKS)
    write(tmp_path / "known.mcap", settings, messages)
    write(tmp_path / "run.mcap", with_classes(settings, LAW, PLANT), messages)
    monkeypatch.chdir(tmp_path)
    run_here(monkeypatch)
    path = list(sys.path)
    yield tmp_path
    sys.path[:] = path
    for module in ("strange_law", "strange_plant"):
        sys.modules.pop(module, None)


def with_classes(settings: Settings, law: str, plant: str) -> Settings:
    """A configuration with other classes, which nobody has named: it is not loaded."""
    named = {"law": settings.law.model_copy(update={"kind": law})}
    return settings.model_copy(update={**named, "plant": settings.plant.model_copy(update={"kind": plant})})


def imported(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.imported"))


@pytest.mark.parametrize(
    "words",
    [
        ["review", "run.mcap"],
        ["review", "run.mcap", "--html", "page.html"],
        ["step", "run.mcap", "--at", "0.2"],
        ["export", "run.mcap", "--format", "csv", "--out", "a.csv"],
        ["compare", "run.mcap", "known.mcap"],
        ["replay", "run.mcap"],
        ["check", "run.mcap"],
        ["fork", "run.mcap", "--at", "0.2"],
    ],
    ids=lambda words: "-".join(words[:1] + words[2:3]),
)
def test_no_verb_imports_what_only_a_log_names_unless_it_is_trusted(
    folder: Path, words: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    needs_the_law = words[0] in ("replay", "check", "fork")
    code = 0
    if needs_the_law:
        code = 1 if words[0] == "check" else 2
    assert execute(["log", *words]) == code
    said = "".join(capfd.readouterr())
    kind = f"plant.kind = '{PLANT}'" if words[0] == "fork" else f"law.kind = '{LAW}'"
    assert f"{kind} is not imported, as only a log names it: give --trust-law" in " ".join(said.split())
    assert imported(folder) == []
    force = ["--force"] if {"--out", "--html"} & {*words} else []
    assert execute(["log", *words, "--trust-law", *force]) == 0
    assert "strange_law" in imported(folder)
    assert ("strange_plant" in imported(folder)) == needs_the_law


def test_without_its_law_a_log_shows_everything_but_the_laws_own_columns(folder: Path) -> None:
    without, whole = read(folder / "run.mcap"), read(folder / "known.mcap")
    assert imported(folder) == []
    assert without.findings.law_unknown is not None
    for name in ("k", "attitude", "desired", "rate", "attitude_error", "rate_error", "voltages", "wall_ns"):
        assert np.array_equal(getattr(without.ticks, name), getattr(whole.ticks, name), equal_nan=True), name
    for name in ("z_track", "u_total", "max_error_deg", "duration_s", "command_changes_per_s"):
        assert getattr(without.figures, name) == getattr(whole.figures, name), name
    assert (without.ticks.gains.shape, without.ticks.state.shape) == ((TICKS, 0), (TICKS, 0))
    assert np.isnan(without.ticks.unquantized).all()
    assert not np.isnan(whole.ticks.unquantized).all()
    assert whole.findings.law_unknown is None
    columns: list[list[dict[str, str]]] = []
    for name in ("run", "known"):
        assert execute(["log", "export", f"{name}.mcap", "--format", "csv", "--out", f"{name}.csv"]) == 0
        with Path(f"{name}.csv").open() as file:
            columns.append(list(csv.DictReader(file)))
    missing = columns[1][0].keys() - columns[0][0].keys()
    assert missing == {"sum_1", "sum_2", "sign"}
    for row, other in zip(*columns, strict=True):
        assert {name for name in row if row[name] != other[name]} == {
            "unquantized_voltage_2_V", "unquantized_voltage_3_V"
        }  # fmt: skip


def test_an_operators_gains_of_an_unknown_law_are_no_obstacle(folder: Path) -> None:
    settings = lockstep(f"law.kind={own_laws.PYTHON}")
    messages = made(settings, 400, {120: (Gains(kp=7.0), None), 250: AN_OPERATORS_WORDS[250]})
    log = write(folder / "changed.mcap", settings, messages)
    without = write(folder / "gone.mcap", with_classes(settings, "gone_law:Python", "aero"), messages)
    assert read(without).findings.law_unknown is not None
    assert read(without).figures.z_track == read(log).figures.z_track


def test_a_gain_that_the_law_does_not_have_any_more_is_a_note(folder: Path) -> None:
    settings = lockstep(f"law.kind={own_laws.PYTHON}")
    messages = made(settings, 200, {120: (Gains(kp=7.0), None)})
    log = write(folder / "renamed.mcap", lockstep(f"law.kind={own_laws.HERE}:Bare"), messages)
    assert read(log).findings.law_unknown == f"law {own_laws.HERE}:Bare has no gain kp of 1 number"
    with pytest.raises(AeroloopError, match="has no gain kp of 1 number"):
        replay([log], ends=["controller"])


def test_a_law_that_is_gone_or_wrong_is_a_note_and_a_log_stays_one_of_this_version(folder: Path) -> None:
    for text, why in (
        ("raise RuntimeError('broken')", "its module raised RuntimeError: broken"),
        ("def f(:", "its module raised SyntaxError"),
        ("", "strange_law has no Python"),
        (None, "there is no module strange_law here"),
    ):
        module = folder / "strange_law.py"
        module.unlink(missing_ok=True)
        sys.modules.pop("strange_law", None)
        if text is not None:
            module.write_text(text)
        with plugins.trusting():
            found = read(folder / "run.mcap")
        assert why in (found.findings.law_unknown or "")
        assert found.figures.z_track is not None
        assert execute(["log", "export", "run.mcap", "--format", "csv", "--force", "--trust-law"]) == 0


def test_a_law_that_the_command_names_is_imported_and_a_plant_that_it_does_not_is_not(folder: Path) -> None:
    assert execute(["log", "fork", "run.mcap", "--at", "0", "--set", f"law.kind={NAMED}"]) == 2  # for want of its plant
    assert imported(folder) == []  # the plant is computed first
    changed = replay([folder / "run.mcap"], [f"law.kind={NAMED}"])
    assert changed.controller is not None
    assert (changed.controller.ticks, changed.controller.differ) == (TICKS, 0)
    assert imported(folder) == ["strange_law"]
    again = replay([folder / "run.mcap"])  # the module is imported already
    assert again.controller is not None
    assert not again.complete
    assert again.plant is None
    assert "strange_plant" in again.reasons["plant"]
    assert imported(folder) == ["strange_law"]


def test_a_log_of_ones_own_is_read_from_python_by_trusting_it_or_by_importing_its_law(folder: Path) -> None:
    log = folder / "run.mcap"
    assert aeroloop.read_run(log).ticks.state.shape == (TICKS, 0)
    (checked,) = check_logs([log])
    assert not checked.same
    with pytest.raises(AeroloopError, match="is not imported, as only a log names it"):
        fork([log], 100)
    assert imported(folder) == []
    run = aeroloop.read_run(log, trust_law=True)
    assert run.ticks.state.shape == (TICKS, 3)
    assert run.fork(100).parts is None
    (checked,) = check_logs([log], trust_law=True)
    assert checked.same


@pytest.mark.processes
def test_what_lies_beside_the_reader_does_not_pass_for_installed(folder: Path) -> None:
    """In a process of its own, whose path begins with the folder, as `python -m` has it."""
    command = [AEROLOOP[0], "-m", "aeroloop", "log", "replay", "run.mcap", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert imported(folder) == []
    assert "is not imported" in done.stderr
    command = [*AEROLOOP, "log", "replay", "run.mcap", "--json", "--trust-law"]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=True, timeout=60,
        env={**os.environ, "PYTHONPATH": str(Path(own_laws.__file__).parents[2])},
    )  # fmt: skip
    assert json.loads(done.stdout)["controller"] == {"ticks": TICKS, "differ": 0}


def test_what_is_installed_beside_aeroloop_is_trusted_and_the_standard_library_is_not() -> None:
    assert plugins.is_trusted("numpy.testing:Law")
    assert plugins.is_trusted("aeroloop.service.examples.own_law:OwnLaw")
    assert not plugins.is_trusted("antigravity:Law")
    assert not plugins.is_trusted("nowhere_at_all:Law")
