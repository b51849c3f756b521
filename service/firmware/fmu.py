"""FMU: the controller or the emulated plant as a co-simulation FMU of FMI 2.0, for Simulink, OpenModelica, FMPy….

It steps by the loop's period alone. The law's FMU takes what the sensors measure and gives the voltages that the wire
carries, quantized both ways; the plant's takes these and gives what its sensors measure. Wind and the gyro's noise are
the importing tool's: the plant has inputs for loads.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal, NamedTuple
from xml.sax.saxutils import quoteattr
from zipfile import ZIP_DEFLATED, ZipFile

from aeroloop.plant_emulator.model.emulated import Sensors, initially, sensor_function, step_function
from aeroloop.service.config import Settings
from aeroloop.service.firmware.export import SOURCES, ExportError, braced, c_source, export, header

Which = Literal["aero", "law"]

_ATTITUDE: Final = {**{f"q.{part}": "1" for part in "wxyz"}, **{f"omega.{axis}": "rad/s" for axis in "xyz"}}
_COMPILE: Final = ("cc", "-std=c99", "-O2", "-ffp-contract=off", "-w", "-fPIC", "-shared", "-fvisibility=hidden")


class _Model(NamedTuple):
    """What makes the FMU of one end."""

    sources: Sequence[Path]
    inputs: Mapping[str, str]  # their units, by name
    outputs: Mapping[str, str]
    starts: Mapping[str, float]  # of inputs, where they are not 0
    defined: Mapping[str, object]  # macros of the sources


def write_fmu(settings: Settings, which: Which, path: Path) -> None:
    """Write the FMU of one end. Raises ExportError without a compiler, and as `export`."""
    with TemporaryDirectory(prefix="aeroloop-") as name:
        folder = Path(name)
        files = [*export(settings, folder), *(Path(shutil.copy(source, folder)) for source in SOURCES.glob("fmu/*"))]
        model = _law(settings, folder) if which == "law" else _plant(settings, folder)
        texts = [file.read_bytes() for file in sorted({*files, *model.sources})] + [repr(model[1:]).encode()]
        guid = sha256(b"".join(texts)).hexdigest()[:32]
        values = [*model.inputs, *model.outputs]
        defined = {
            "MODEL_VALUES": len(values),
            "MODEL_INPUTS": len(model.inputs),
            "MODEL_STEP_S": settings.loop.period.hex(),
            "MODEL_GUID": f'"{guid}"',
            **model.defined,
        }
        lines = [f"#define {key} {value}" for key, value in defined.items()]
        (folder / "model_config.h").write_text(header("model_config", lines), encoding="ascii")
        library = folder / f"{which}.so"
        command = [*_COMPILE, *map(str, [*model.sources, folder / "fmi2.c", "-o", library]), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603  # ours
        except (OSError, subprocess.CalledProcessError) as error:
            why = getattr(error, "stderr", "") or str(error)
            raise ExportError(f"an FMU needs a C compiler, cc: {why.strip().splitlines()[0]}") from None
        with ZipFile(path, "w", ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", _description(settings, which, guid, model))
            archive.write(library, f"binaries/linux64/{library.name}")


def _law(settings: Settings, folder: Path) -> _Model:
    voltages = {f"u{motor}": "V" for motor in settings.wire.motors}
    sources = folder / "law.c", *(folder / f"aero_{part}.c" for part in ("wire", "law", "equations"))
    return _Model(sources, _ATTITUDE, voltages, {"q.w": 1.0}, {})


def _plant(settings: Settings, folder: Path) -> _Model:
    """Also writes the plant's equations."""
    plant, period = settings.plant, settings.loop.period
    mechanism = plant.mechanism()
    step = step_function(mechanism, plant.rotor, plant.friction, period)
    sensors, sensing = Sensors(plant.sensors, period), sensor_function(plant.sensors, period)
    source = folder / "plant_equations.c"
    source.write_text(c_source(step, sensing), encoding="ascii")
    attitude, rate, angles = initially(mechanism)
    states = step.numel_in("x")
    defined = {
        "ACTUATORS": mechanism.actuators,
        "AXES": mechanism.axes,
        "STATES": states,
        "INITIAL": braced([*mechanism.initial, *[0.0] * (states - len(mechanism.initial))]),
        "INITIAL_SEEN": braced([*attitude, *rate, *angles, 0.0, 0.0]),
        "ZEROS": braced(sensors.zeros),
        "VOLTAGE_LIMIT": plant.voltage_limit.hex(),
        "SCRATCH": max(1, step.sz_w(), sensing.sz_w()),
        "SCRATCH_ARGUMENTS": max(step.sz_arg(), sensing.sz_arg()),
        "SCRATCH_RESULTS": max(step.sz_res(), sensing.sz_res()),
    }
    axes = ("pitch", "yaw") if mechanism.axes == 2 else ("x", "y", "z")
    inputs = {**{f"u{motor}": "V" for motor in settings.wire.motors}, **{f"load.{axis}": "N.m" for axis in axes}}
    macros = {f"PLANT_{name}": value for name, value in defined.items()}
    return _Model([folder / "plant.c", source], inputs, _ATTITUDE, {}, macros)


def _description(settings: Settings, which: Which, guid: str, model: _Model) -> str:
    variables = list[str]()
    kinds = [*((name, "input", unit) for name, unit in model.inputs.items())]
    kinds += [(name, "output", unit) for name, unit in model.outputs.items()]
    for reference, (name, causality, unit) in enumerate(kinds):
        start = f' start="{model.starts.get(name, 0.0)!r}"' if causality == "input" else ""
        initial = ' initial="calculated"' if causality == "output" else ""
        variables.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" variability="discrete"'
            f'{initial}><Real unit="{unit}"{start}/></ScalarVariable>'
        )
    first = len(model.inputs) + 1
    unknowns = "".join(f'<Unknown index="{first + i}"/>' for i in range(len(model.outputs)))
    units = "".join(f'<Unit name="{unit}"/>' for unit in sorted({unit for _, _, unit in kinds}))
    kind = settings.law.kind if which == "law" else settings.plant.kind
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName="{which}" guid="{guid}" generationTool="aeroloop" '
        f"description={quoteattr(kind)}>\n"
        f'<CoSimulation modelIdentifier="{which}" canHandleVariableCommunicationStepSize="false" '
        'canGetAndSetFMUstate="true"/>\n'
        f"<UnitDefinitions>{units}</UnitDefinitions>\n"
        f'<DefaultExperiment startTime="0" stepSize="{settings.loop.period!r}"/>\n'
        f"<ModelVariables>{chr(10).join(variables)}</ModelVariables>\n"
        f"<ModelStructure><Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure>\n"
        "</fmiModelDescription>\n"
    )
