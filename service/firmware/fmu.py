"""FMU: the controller or the emulated plant as a co-simulation FMU of FMI 2.0, for Simulink, OpenModelica, FMPy….

It steps by the loop's period alone. The law's FMU takes what the sensors measure and gives the voltages that the wire
carries, quantized both ways; the plant's takes these, and loads such as wind, and gives what its sensors measure.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal, NamedTuple
from xml.sax.saxutils import quoteattr
from zipfile import ZIP_DEFLATED, ZipFile

from aeroloop.service.config import Settings
from aeroloop.service.firmware.configuration import header
from aeroloop.service.firmware.export import SOURCES, export
from aeroloop.service.firmware.machines import compiled
from aeroloop.service.firmware.plant import write_plant

Which = Literal["aero", "law"]

_ATTITUDE: Final = {**{f"q.{part}": "1" for part in "wxyz"}, **{f"omega.{axis}": "rad/s" for axis in "xyz"}}
_SHARED: Final = ("-w", "-fPIC", "-shared", "-fvisibility=hidden")


class _Model(NamedTuple):
    """What makes the FMU of one end."""

    sources: Sequence[Path]
    inputs: Mapping[str, str]  # their units, by name
    outputs: Mapping[str, str]
    starts: Mapping[str, float]  # of inputs, where they are not 0


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
        }
        lines = [f"#define {key} {value}" for key, value in defined.items()]
        (folder / "model_config.h").write_text(header("model_config", lines), encoding="ascii")
        library = compiled([*model.sources, folder / "fmi2.c"], folder / f"{which}.so", *_SHARED)
        with ZipFile(path, "w", ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", _description(settings, which, guid, model))
            archive.write(library, f"binaries/linux64/{library.name}")


def _law(settings: Settings, folder: Path) -> _Model:
    voltages = {f"u{motor}": "V" for motor in settings.wire.motors}
    sources = folder / "law.c", *(folder / f"aero_{part}.c" for part in ("wire", "law", "equations"))
    return _Model(sources, _ATTITUDE, voltages, {"q.w": 1.0})


def _plant(settings: Settings, folder: Path) -> _Model:
    mechanism = settings.plant.mechanism()
    axes = ("pitch", "yaw") if mechanism.axes == 2 else ("x", "y", "z")
    inputs = {**{f"u{motor}": "V" for motor in settings.wire.motors}, **{f"load.{axis}": "N.m" for axis in axes}}
    return _Model([folder / "aero.c", *write_plant(settings, folder)], inputs, _ATTITUDE, {})


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
