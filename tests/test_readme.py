"""README: its examples and commands run as printed."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.cli.show import EXAMPLES
from aeroloop.service.config import load
from aeroloop.service.lab.experiment import run_experiment

ROOT = Path(__file__).parent.parent


def python_blocks() -> list[str]:
    """Python in the README: the experiment in three lines, a law, and the test with `hil`."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return [block.split("```")[0] for block in text.split("```python\n")[1:]]


def test_the_python_example_prints_what_the_experiment_gives(capfd: pytest.CaptureFixture[str]) -> None:
    (example, _, _) = python_blocks()
    exec(compile(example, "README.md", "exec"), {})  # noqa: S102  # our own text
    settings = load(overrides=["wire.voltage.bits=8"])
    assert capfd.readouterr().out == f"{run_experiment(settings, 10).z_track}\n"


def test_the_law_in_the_readme_tracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (_, law, _) = python_blocks()
    (tmp_path / "my_laws.py").write_text(law)
    monkeypatch.syspath_prepend(tmp_path)
    figures = run_experiment(load(overrides=["law.kind=my_laws:Mine"]), 10)
    assert figures.max_error_deg is not None
    assert figures.max_error_deg < 10


def test_the_hil_example_is_the_one_that_is_installed() -> None:
    """Which `test_examples.py` runs, and `test_house.py` checks the types of."""
    (_, _, example) = python_blocks()
    assert (EXAMPLES / "test_lockstep_hil.py").read_text(encoding="utf-8").endswith(example)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_example_configuration_makes_a_loop_that_tracks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)  # own_plant.py stands beside its configuration
    settings = load(path)
    if settings.plant.kind == "mujoco":
        pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'aeroloop[mujoco]'")
    if settings.plant.faults:  # of frames, which the experiment has none of; tests/hil tries those
        settings.plant.faults = []
    figures = run_experiment(settings, 4.0)
    assert figures.max_error_deg is not None
    assert figures.max_error_deg < 6


def test_examples_are_listed_and_printed(capfd: pytest.CaptureFixture[str]) -> None:
    assert execute(["show", "examples"]) == 0
    listed = capfd.readouterr().out.splitlines()
    programs = {path.name for path in EXAMPLES.glob("*.[py]*") if path.stem != "__init__"}
    assert [line.split()[0] for line in listed] == sorted({path.stem for path in EXAMPLES.glob("*.toml")} | programs)
    assert execute(["show", "examples", "paper"]) == 0
    assert capfd.readouterr().out == (EXAMPLES / "paper.toml").read_text(encoding="utf-8")
    assert execute(["show", "examples", "nothing"]) == 2
