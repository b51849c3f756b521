"""The exported controller is the Python one: the same commands and, to the last bit, the same voltages before them."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from aeroloop.service.config import load
from aeroloop.service.firmware.configuration import config_header
from aeroloop.service.firmware.export import ExportError, c_source, equations, export, expression_law
from aeroloop.service.firmware.fmu import write_fmu
from aeroloop.service.firmware.machines import MACHINES, InC, Program
from aeroloop.service.lab.experiment import experiment
from aeroloop.service.logs.replay import replay
from tests.support.firmware import COMPILERS, NO_COMPILER, SOURCE
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


@pytest.mark.parametrize("machine", [needs("host")])
@pytest.mark.parametrize("words", CONFIGURATIONS.values(), ids=CONFIGURATIONS)
def test_the_golden_commands_are_computed_in_c(words: list[str], machine: str, tmp_path: Path) -> None:
    export(load(overrides=words), tmp_path)
    assert Program(tmp_path, machine).golden() == SAME


@pytest.mark.parametrize("machine", [needs("host"), needs("aarch64"), needs("cortex-m4")])
@pytest.mark.parametrize("log", ["default", "on-change", "can"])
@pytest.mark.realtime  # no need of real time; some seconds each
def test_stored_logs_with_changes_of_an_operator_replay_on_other_processors(log: str, machine: str) -> None:
    replayed = replay([GOLDEN / f"{log}.mcap"], ends=["controller"], answering=InC(machine))
    assert replayed.complete
    assert replayed.controller is not None
    assert (replayed.controller.ticks, replayed.controller.differ) == (4000 if log == "can" else 5500, 0)


@pytest.mark.parametrize("machine", [needs("host")])
@pytest.mark.realtime
def test_a_replay_whose_voltages_differ_before_quantization_is_refused(
    machine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though all of its commands are those of the log: only the digest is another one."""
    real = Program.answers
    monkeypatch.setattr(Program, "answers", lambda program, script: real(program, script)[:-8] + bytes(8))
    with pytest.raises(ExportError, match="does not compute the voltages of the log, to the last bit"):
        replay([GOLDEN / "default.mcap"], ends=["controller"], answering=InC(machine))


@pytest.mark.parametrize("machine", [needs("aarch64")])
@pytest.mark.realtime
def test_a_contracted_multiplication_shows_in_the_voltages(machine: str, tmp_path: Path) -> None:
    """Which no command shows in these ticks: so the digest is what proves the arithmetic."""
    export(load(), tmp_path)
    leave_out_guard(tmp_path)
    makefile = tmp_path / "Makefile"
    contracting = makefile.read_text().replace("EXACT = -ffp-contract=off", "EXACT = -O2 -ffp-contract=fast")
    makefile.write_text(contracting)
    program = Program(tmp_path, machine)
    with pytest.raises(ExportError, match="0 of 1000 commands differ; the voltages before quantization differ"):
        program.golden()


# ── compilers ──


def leave_out_guard(folder: Path) -> None:
    """Let gcc round as its flags say, and not as `aero_float.h` does."""
    header = folder / "aero_float.h"
    text, pragmas = re.subn(r"^#pragma .*$", "", header.read_text(), flags=re.MULTILINE)
    assert pragmas == 2
    header.write_text(text)


def golden_by_make(folder: Path, compiler: str, flags: str, *more: str) -> tuple[int, str]:
    """Exit code and words of `make test`."""
    words = ["make", "--silent", "clean", "test", f"CC={compiler}", f"CFLAGS=-std=c99 {flags}", *more]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stdout.strip()


HAS_FMA = " fma " in Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else False
NEEDS_FMA = pytest.mark.skipif(not HAS_FMA, reason="this processor multiplies and adds in two roundings only")
FASTEST = "-O3 -march=native"


@pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    ("name", "flags"), [("default", ("-O0", "-O2", FASTEST)), ("friction, no quantizers", (FASTEST,))]
)
def test_commands_and_voltages_are_the_same_at_every_optimization(
    compiler: str, name: str, flags: tuple[str, ...], tmp_path: Path
) -> None:
    export(load(overrides=CONFIGURATIONS[name]), tmp_path)
    for optimization in flags:
        assert golden_by_make(tmp_path, compiler, optimization) == (0, SAME), optimization


@pytest.mark.skipif("gcc" not in COMPILERS, reason="no gcc")
@NEEDS_FMA
def test_without_the_makefiles_flags_the_guard_alone_keeps_the_voltages(tmp_path: Path) -> None:
    """gcc would contract by default then; without the guard the digest shows that it does."""
    export(load(), tmp_path)
    flags = f"{FASTEST} -ffp-contract=fast"
    assert golden_by_make(tmp_path, "gcc", flags, "EXACT=") == (0, SAME)
    leave_out_guard(tmp_path)
    code, said = golden_by_make(tmp_path, "gcc", flags, "EXACT=")
    assert code != 0
    assert said.endswith("the voltages before quantization differ")


REFUSED = [
    ("gcc", "-ffast-math", "-ffast-math"),
    ("gcc", "-Ofast", "-ffast-math"),
    ("gcc", "-ffinite-math-only", "-ffast-math"),
    ("gcc", "-fno-signed-zeros", "-ffast-math"),
    ("gcc", "-freciprocal-math", "-ffast-math"),
    ("gcc", "-D__FLT_EVAL_METHOD__=2", "doubles must be computed as doubles"),
    ("gcc", "-D__FLT_EVAL_METHOD__=-1", "doubles must be computed as doubles"),
    ("gcc", "-D__DBL_MANT_DIG__=24", "double must be IEEE 754 binary64"),
    ("gcc", "-D__DBL_MAX_EXP__=128", "double must be IEEE 754 binary64"),
    ("clang", "-ffast-math", "-ffast-math"),
    ("clang", "-ffinite-math-only", "-ffast-math"),
]
"""What no build may have, and words of the refusal. The macros stand for processors with other doubles."""


@pytest.mark.parametrize(("compiler", "flag", "reason"), REFUSED)
def test_arithmetic_that_drops_nan_or_rounds_otherwise_does_not_compile(
    compiler: str, flag: str, reason: str, tmp_path: Path
) -> None:
    if compiler not in COMPILERS:
        pytest.skip(f"no {compiler}")
    (tmp_path / "aero_config.h").write_text(config_header(load()))
    (tmp_path / "equations.c").write_text(c_source(equations(expression_law(load()))))
    for source in (SOURCE / "aero_wire.c", SOURCE / "aero_node.c", tmp_path / "equations.c"):
        words = [compiler, "-std=c99", "-w", f"-I{tmp_path}", f"-I{SOURCE}", "-fsyntax-only", str(source)]
        assert subprocess.run(words).returncode == 0
        refused = subprocess.run([*words, flag], capture_output=True, text=True)
        assert refused.returncode != 0
        assert reason in refused.stderr


def test_a_law_in_python_and_a_missing_compiler_are_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ExportError, match="is in Python: only a law of expressions has a form in C"):
        export(load(overrides=[f"law.kind={PYTHON}"], runs_law=True), tmp_path / "own")
    export(load(), tmp_path / "c")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ExportError, match=r"install gcc-arm-none-eabi .* make$"):
        Program(tmp_path / "c", "cortex-m4")


@pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)
def test_fmus_of_law_and_plant_give_the_voltages_of_the_experiment(tmp_path: Path) -> None:
    """FMPy checks both files, and connects them; nothing is shared with the experiment but the sources.

    A logger is given, as FMPy's own may have been freed: it keeps the one set last in this process, of any FMU.
    """
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: it comes with aeroloop[fmi]")
    settings, ticks, said = load(), 1000, list[bytes]()
    period, fmus = settings.loop.period, dict[str, Any]()

    def log(*message: Any) -> None:
        said.append(message[-1])

    for which in ("aero", "law"):
        write_fmu(settings, which, file := tmp_path / f"{which}.fmu")
        assert import_module("fmpy.validation").validate_fmu(str(file)) == []
        described = fmpy.read_model_description(str(file))
        folder = fmpy.extract(str(file), str(tmp_path / which))
        fmus[which] = fmpy.instantiate_fmu(folder, described, "CoSimulation", logger=log)
        fmus[which].setupExperiment(startTime=0)
        fmus[which].enterInitializationMode()
        fmus[which].exitInitializationMode()
    plant, law, voltages = fmus["aero"], fmus["law"], list[list[float]]()
    inputs = [0, 1]  # u2, u3 of the plant; its loads are 2 and 3, and what it measures follows
    for k in range(ticks):
        q, omega = plant.getReal(range(4, 8)), plant.getReal(range(8, 11))
        sign = 1 if k % 2 else -1  # q and -q are the same attitude
        law.setReal(range(7), [*(sign * part for part in q), *omega])
        law.doStep(k * period, period)
        voltages.append(law.getReal([7, 8]))
        plant.setReal(inputs, voltages[-1])
        plant.doStep(k * period, period)
    assert voltages == experiment(settings, ticks * period).course.voltages.tolist()
    with pytest.raises(import_module("fmpy.fmi1").FMICallException):
        plant.doStep(0.0, 2 * period)
    assert said == [b"the step is not the loop's period"]
