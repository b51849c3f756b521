"""Export: a configuration as C for firmware. The files of `c` as they are, and what is generated for it beside them.

aero_config.h      wire, limits and node: configuration.py
aero_names.h       state and gains of the law as structs, the reference, and the scratch of its equations
aero_equations.c   reference and law, from the expressions that the Python controller evaluates, by CasADi
aero_version.h     what it was exported from
golden.h           the first commands of the loop in lockstep, with the measurements that they answer
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import casadi as ca

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import PROTOCOL_VERSION
from aeroloop.protocol.runtime.host import versions
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.interface import ExpressionLaw
from aeroloop.service.control.laws.registry import configured_gains, initial_state, law_function, law_of
from aeroloop.service.control.reference import Trajectory, reference_function
from aeroloop.service.firmware.configuration import config_header, config_number, exact, header, settings_digest
from aeroloop.service.firmware.script import ScriptedController
from aeroloop.service.lab.experiment import LoopEndedError, experiment
from aeroloop.service.theorem.certificate import promise

SOURCES: Final = Path(__file__).parent / "c"
GOLDEN_TICKS: Final = 1000
_EQUATIONS: Final = "aero_equations"


class ExportError(AeroloopError):
    """The configuration has no form in C; one line with the reason."""


def export(settings: Settings, folder: Path) -> list[Path]:
    """Write everything of a configuration into a folder. Returns the files.

    Raises ExportError for a law in Python, LawError and PluginError as `law_of`, PlantError as the plant.
    """
    generated = equations_files(settings) | {
        "aero_config.h": config_header(settings),
        "aero_version.h": _version_header(settings),
        "golden.h": _golden_header(golden(settings)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    copied = [Path(shutil.copy(source, folder)) for source in SOURCES.iterdir() if source.is_file()]
    for name, text in generated.items():
        (folder / name).write_text(text, encoding="ascii")
    return [*copied, *(folder / name for name in generated)]


def expression_law(settings: Settings) -> ExpressionLaw[Any]:
    """The configured law. Raises ExportError if it is one in Python, LawError and PluginError as `law_of`."""
    law = law_of(settings.law, settings.loop.period, settings.wire.actuators)
    if not isinstance(law, ExpressionLaw):
        raise ExportError(f"law {settings.law.kind} is in Python: only a law of expressions has a form in C")
    return law


# ── the law ──


def equations(law: ExpressionLaw[Any]) -> ca.Function:
    """Reference and law of a tick, from the levels of a measurement to the voltages before quantization.

    It is the controller's `tick_function` without codes. Inputs: those of `reference_function`; last, state, gains, eps
    and omega of `law_function`. Outputs: q, state_next, q_d, eps_e, omega_e, u.
    """
    laws, reference = law_function(law), reference_function()
    given = {name: ca.SX.sym(name, *reference.size_in(name)) for name in reference.name_in()}
    of_law = {name: ca.SX.sym(name, laws.size1_in(name)) for name in ("last", "state", "gains", "eps", "omega")}
    with as_written():
        desired = reference.call(given)
        found = laws.call(of_law | desired) | {"q_d": desired["q_d"]}
        names = ["q", "state_next", "q_d", "eps_e", "omega_e", "u"]
        inputs = given | of_law
        outputs = [found[name] for name in names]
        return ca.Function(_EQUATIONS, [*inputs.values()], outputs, [*inputs], names, {"cse": True})


def equations_files(settings: Settings) -> dict[str, str]:
    """`aero_names.h` and `aero_equations.c`, by name. Raises as `expression_law`."""
    law = expression_law(settings)
    function = equations(law)
    config = f"\n#include <stdint.h>\n\nconst uint64_t {_EQUATIONS}_config = {config_number(settings)};\n"
    source = c_source(function) + config
    return {"aero_names.h": _names_header(settings, law, function), f"{_EQUATIONS}.c": source}


def c_source(*functions: ca.Function) -> str:
    """Functions as C, which compiles where `aero_float.h` allows it."""
    generator = ca.CodeGenerator("functions.c", {"casadi_int": "long long int"})
    for function in functions:
        generator.add(function)
    with TemporaryDirectory(prefix="aeroloop-") as folder:
        generated = Path(generator.generate(f"{folder}/")).read_text(encoding="ascii")
    return f'#include "aero_float.h"\n{generated}'


def _names_header(settings: Settings, law: ExpressionLaw[Any], function: ca.Function) -> str:
    state, gains = initial_state(law), configured_gains(law)
    units = {name: law.units.get(name, "1") for name in state}
    described = {name: type(law.settings).model_fields[name].description or "" for name in gains}
    trajectory = Trajectory.of(settings.reference)
    pieces = ",".join(
        f" \\\n    {{{start.hex()}, {braced(quintic)}, {braced(amplitude)}, {braced(frequency)}}}"
        for start, quintic, amplitude, frequency in zip(
            trajectory.starts.tolist(), *(part.tolist() for part in trajectory[1:]), strict=True
        )
    )
    lines = [
        '#include "aero_config.h"',
        f"#if AERO_CONFIG != {config_number(settings)}",
        '#error "aero_config.h is of another export: copy all of its files"',
        "#endif",
        "",
        f"/* Names of the law {_ascii(settings.law.kind)}, its configured gains and the configured reference. */",
        *_struct("aero_state", state, {name: f"[{unit}]" for name, unit in units.items()}),
        f"#define AERO_STATE_BYTES {8 * sum(map(len, state.values()))}U",
        f"#define AERO_INITIAL_STATE {braced([*state.values()] or [[0.0]])}",
        "",
        *_struct("aero_gains", gains, described),
        f"#define AERO_GAINS_BYTES {8 * sum(map(len, gains.values()))}U",
        f"#define AERO_CONFIGURED_GAINS {braced([*gains.values()] or [[0.0]])}",
        "",
        f"#define AERO_PERIOD_S {settings.loop.period.hex()} /* {settings.loop.period:.9g} s */",
        f"#define AERO_REFERENCE {{{pieces}}}",
        "",
        "/* Reference and law: aero_equations.c, the AERO_CONFIG that it was generated for, lengths of its arrays. */",
        "extern const uint64_t aero_equations_config;",
        "int aero_equations(const double **arguments, double **results, long long int *indices, double *scratch, int);",
        f"#define AERO_SCRATCH_ARGUMENTS {function.sz_arg()}",
        f"#define AERO_SCRATCH_RESULTS {function.sz_res()}",
        f"#define AERO_SCRATCH_INDICES {max(1, function.sz_iw())}",
        f"#define AERO_SCRATCH {max(1, function.sz_w())}",
    ]
    return header("aero_names", lines)


def _struct(name: str, members: Mapping[str, Sequence[float]], comments: Mapping[str, str]) -> Iterator[str]:
    yield "typedef struct {"
    for member, values in members.items():
        yield f"    double {member}[{len(values)}]; /* {_ascii(comments[member])} */"
    if not members:
        yield "    double none[1]; /* it has none */"
    yield f"}} {name};"


def braced(values: Any) -> str:
    """Numbers, nested as they are, as an initializer that keeps every bit."""
    return exact(float(values)) if isinstance(values, int | float) else f"{{{', '.join(map(braced, values))}}}"


# ── golden commands and versions ──


def golden(settings: Settings) -> ScriptedController:
    """The controller after the loop's first ticks in lockstep with the emulated plant, or up to a trip."""
    controller = ScriptedController(settings.wire, settings.law, settings.reference, settings.loop.period)
    plant = settings.plant.model_copy(update={"via": "emulator", "faults": []})
    emulated = settings.model_copy(update={"plant": plant})
    with suppress(LoopEndedError):
        experiment(emulated, GOLDEN_TICKS * settings.loop.period, controller=controller)
    return controller


def _golden_header(controller: ScriptedController) -> str:
    lines = [
        "#include <stdint.h>",
        "",
        f"static const uint64_t golden_digest = 0x{controller.digest:x}U; /* of voltages and states: script.py */",
        *_bytes("golden_script", controller.script),
        *_bytes("golden_answers", controller.answers),
    ]
    return header("golden", lines)


def _version_header(settings: Settings) -> str:
    known = versions()
    wire = json.dumps(settings.wire.agreed(), sort_keys=True)
    texts = {
        "VERSION": known["aeroloop"],
        "REVISION": known.get("revision", ""),
        "CASADI": known["casadi"],
        "WIRE_SHA256": sha256(wire.encode()).hexdigest(),
        "CONFIGURATION_SHA256": settings_digest(settings),
        "CERTIFICATE": promise(settings).verdict,
    }
    lines = [f'#define AERO_{name} "{_ascii(text)}"' for name, text in texts.items()]
    return header("aero_version", [f"#define AERO_PROTOCOL {PROTOCOL_VERSION}", *lines])


def _bytes(name: str, data: bytes | bytearray) -> Iterator[str]:
    yield f"static const uint8_t {name}[] = {{"
    for i in range(0, len(data), 28):
        yield f"    {','.join(map(str, data[i : i + 28]))},"
    yield "};"


def _ascii(text: str) -> str:
    plain = {"·": "*", "²": "^2", "‖": "|", "≤": "<=", "°": " deg", "–": "-", "×": "x", "\\": "/", '"': "'"}
    return "".join(plain.get(letter, letter) for letter in text).encode("ascii", "replace").decode().replace("*/", "")
