"""The exported controller is the Python one: the same commands and, to the last bit, the same voltages before them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from aeroloop.service.config import load
from aeroloop.service.firmware.export import ExportError, export
from aeroloop.service.firmware.machines import MACHINES, InC, Program
from aeroloop.service.logs.replay import replay
from tests.support.own_laws import PYTHON

GOLDEN = Path(__file__).parents[2] / "golden"
SAME = "0 of 1000 commands differ; the voltages before quantization are the same to the last bit"
CONFIGURATIONS: dict[str, list[str]] = {
    "default": [],
    "sliding, logarithmic": ["law.kind=sliding", "wire.voltage.kind=logarithmic-uniform"],
    "lqr, hysteresis, on change": ["law.kind=lqr", "wire.voltage.kind=hysteresis-uniform", "wire.transmit=on_change"],
    "friction, no quantizers": [
        "law.kind=adaptive-torque",
        "wire.attitude.bits=cont",
        "wire.rate.bits=cont",
        "wire.voltage.bits=cont",
    ],
}
"""Other laws, kinds and policies, each of them once."""


def needs(machine: str) -> Any:
    """Skip where a machine's programs are not installed; CI installs them."""
    programs = [MACHINES[machine].compiler, "make", *MACHINES[machine].start[:1]]
    missing = [program for program in programs if shutil.which(program) is None]
    return pytest.param(machine, marks=pytest.mark.skipif(bool(missing), reason=f"no {', '.join(missing)} here"))


@pytest.mark.parametrize("words", CONFIGURATIONS.values(), ids=CONFIGURATIONS)
def test_the_golden_commands_are_computed_in_c(words: list[str], tmp_path: Path) -> None:
    export(load(overrides=words), tmp_path)
    assert Program(tmp_path, "host").golden() == SAME


@pytest.mark.parametrize("machine", [needs("host"), needs("aarch64"), needs("cortex-m4")])
@pytest.mark.parametrize("log", ["default", "on-change", "can"])
@pytest.mark.realtime  # no need of real time; some seconds each
def test_stored_logs_with_changes_of_an_operator_replay_on_other_processors(log: str, machine: str) -> None:
    replayed = replay([GOLDEN / f"{log}.mcap"], ends=["controller"], answering=InC(machine))
    assert replayed.complete
    assert replayed.controller is not None
    assert (replayed.controller.ticks, replayed.controller.differ) == (4000 if log == "can" else 5500, 0)


@pytest.mark.parametrize("machine", [needs("aarch64")])
@pytest.mark.realtime
def test_a_contracted_multiplication_shows_in_the_voltages(machine: str, tmp_path: Path) -> None:
    """Which no command shows in these ticks: so the digest is what proves the arithmetic."""
    export(load(), tmp_path)
    makefile = tmp_path / "Makefile"
    makefile.write_text(makefile.read_text().replace("-Os -ffp-contract=off", "-O2 -ffp-contract=fast"))
    program = Program(tmp_path, machine)
    with pytest.raises(ExportError, match="0 of 1000 commands differ; the voltages before quantization differ"):
        program.golden()


def test_a_law_in_python_and_a_missing_compiler_are_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ExportError, match="is in Python: only a law of expressions has a form in C"):
        export(load(overrides=[f"law.kind={PYTHON}"], runs_law=True), tmp_path / "own")
    export(load(), tmp_path / "c")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ExportError, match=r"install gcc-arm-none-eabi .* make$"):
        Program(tmp_path / "c", "cortex-m4")
