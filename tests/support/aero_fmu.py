"""FMUs of our own Aero, the ideal one, built with CasADi and a C compiler.

*FMI 3*: CasADi's `DaeBuilder` exports the equations of motion. Its export is for model exchange only, so
`aero_fmi3.c` adds co-simulation: Runge–Kutta steps over the exported code. *FMI 2*, which CasADi does not export:
`aero_fmi2.c` around the C code of one period of the emulated plant.
"""

from __future__ import annotations

import shutil
import subprocess
from contextlib import chdir
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import casadi as ca
import pytest

from aeroloop.plant_emulator.model.emulated import SUBSTEPS, step_function
from tests.support import ideal

COMPILER = shutil.which("cc") or shutil.which("gcc")
if COMPILER is None:
    pytest.skip("no C compiler on PATH to build an FMU with", allow_module_level=True)
fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: it comes with aeroloop[fmi]")
PERIOD = 0.002

_HERE = Path(__file__).parent
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_FMI2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="aero" guid="aero">
  <CoSimulation modelIdentifier="aero"/>
  <DefaultExperiment stepSize="{period}"/>
  <ModelVariables>{variables}</ModelVariables>
  <ModelStructure/>
</fmiModelDescription>"""


def fmi3(folder: Path) -> Path:
    """The Aero through `DaeBuilder`.

    Inputs u2, u3 [V]; parameters load_pitch, load_yaw [N·m]; outputs pitch, yaw [rad], pitch_rate, yaw_rate [rad/s],
    q.w…, omega.x….
    """
    folder.mkdir()
    dae = ca.DaeBuilder("aero")
    dae.add("time", "independent")
    x = [dae.add(name, "output", {"start": 0.0}) for name in ("pitch", "yaw", "pitch_rate", "yaw_rate")]
    u = [dae.add(name, "input", {"start": 0.0, "unit": "V"}) for name in ("u2", "u3")]
    load = [dae.add(name, "parameter", "tunable", {"start": 0.0}) for name in ("load_pitch", "load_yaw")]
    outputs = [dae.add(name, "output") for name in (*(f"q.{part}" for part in "wxyz"), *(f"omega.{i}" for i in "xyz"))]
    values = ca.vertsplit(_equations()(ca.vertcat(*x), ca.vertcat(*u), ca.vertcat(*load)))
    for variable, value in zip([*map(dae.der, x), *outputs], values, strict=True):
        dae.eq(variable, value)
    with chdir(folder):
        dae.export_fmu({"no_warning": True, "with_serialization": False})
    description = (folder / "modelDescription.xml").read_text()
    step = PERIOD / SUBSTEPS
    interface = f'<CoSimulation modelIdentifier="aero" fixedInternalStepSize="{step}"/>'
    description = description.replace("<ModelVariables>", f"{interface}<ModelVariables>")
    library = _compiled(folder, [folder / "aero.c", _HERE / "aero_fmi3.c"], STEP=step)
    return _packed(folder, description, {f"binaries/{fmpy.platform_tuple}/{library.name}": library})


def _equations() -> ca.Function:
    """ẋ, q and ω of the ideal Aero's state, voltages and loads."""
    x, u, load = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("load", 2)
    aero = ideal.PLANT.mechanism()
    outputs = aero.derivative(x, u, load), *aero.outputs(x)[:2]
    return ca.Function("equations", [x, u, load], [ca.vertcat(*outputs)])


def fmi2(folder: Path) -> Path:
    """The Aero's period as C code: inputs u2, u3 [V]; outputs q[1]…q[4], rate.x…, pitch, yaw; it fails on request."""
    folder.mkdir()
    step = step_function(ideal.PLANT.mechanism(), ideal.PLANT.rotor, ideal.PLANT.friction, PERIOD)
    with chdir(folder):
        step.generate("step.c")
    inputs, loads, settings = ("u2", "u3"), ("load_pitch", "load_yaw"), ("fails_at", "fails_with")
    outputs = (*(f"q[{i}]" for i in range(1, 5)), *(f"rate.{axis}" for axis in "xyz"), "pitch", "yaw")
    units = {"pitch": ' unit="rad"', "yaw": ' unit="rad"'} | {f"rate.{axis}": ' unit="rad/s"' for axis in "xyz"}
    kinds = {"input": inputs, "parameter": loads + settings, "output": outputs}
    starts = {"input": ' start="0"', "parameter": ' start="0"', "output": ""}
    variability = {"input": "continuous", "parameter": "fixed", "output": "continuous"}
    described = [
        f'<ScalarVariable name="{name}" valueReference="{(inputs + loads + outputs + settings).index(name)}" '
        f'causality="{kind}" variability="{variability[kind]}"><Real{starts[kind]}{units.get(name, "")}/>'
        "</ScalarVariable>"
        for kind, names in kinds.items()
        for name in names
    ]
    library = _compiled(
        folder, [folder / "step.c", _HERE / "aero_fmi2.c"], step="period", PERIOD=PERIOD, WORK=step.sz_w() + 1
    )
    description = _FMI2.format(period=PERIOD, variables="".join(described))
    return _packed(folder, description, {f"binaries/{fmpy.platform}/{library.name}": library})


def _compiled(folder: Path, sources: list[Path], **macros: float | str) -> Path:
    library = folder / f"aero{fmpy.sharedLibraryExtension}"
    defined = [f"-D{name}={value}" for name, value in macros.items()]
    flags = ["-O1", "-w", "-shared", "-fPIC", "-ffp-contract=off", f"-I{_HEADERS}", f"-I{folder}", *defined]
    subprocess.run([str(COMPILER), *flags, *sources, "-o", library, "-lm"], check=True)
    return library


def _packed(folder: Path, description: str, files: dict[str, Path]) -> Path:
    path = folder / "aero.fmu"
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", description)
        for name, file in files.items():
            archive.write(file, name)
    return path


def altered(fmu: Path, path: Path, *edits: tuple[str, str], files: tuple[str, str] = ("", "")) -> Path:
    with ZipFile(fmu) as old, ZipFile(path, "w", ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            for was, now in edits if name.endswith(".xml") else ():
                assert was in content.decode()
                content = content.replace(was.encode(), now.encode())
            new.writestr(name.replace(*files), content)
    return path
