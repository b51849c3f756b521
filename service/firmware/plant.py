"""Plant: the emulated plant as C, from the functions that the emulator evaluates, for the node's program and FMUs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from aeroloop.plant_emulator.model.emulated import Sensors, initially, sensor_function, step_function
from aeroloop.service.config import Settings
from aeroloop.service.firmware.configuration import header
from aeroloop.service.firmware.export import SOURCES, ExportError, braced, c_source


def write_plant(settings: Settings, folder: Path) -> list[Path]:
    """Write `aero_plant.[ch]` and what is generated for them into a folder. Returns the C files to compile.

    Raises PlantError if the plant is none of the emulated bodies, ExportError if it has faults, wind or noise.
    """
    plant, period = settings.plant, settings.loop.period
    lacking = {"plant.faults": plant.faults, "plant.wind": plant.wind.blowing, "noise": plant.sensors.gyro_noise}
    if found := [name for name, wanted in lacking.items() if wanted]:
        raise ExportError(f"the plant in C has no {found[0]}: leave it out")
    mechanism, sensors = plant.mechanism(), Sensors(plant.sensors, period)
    functions = step_function(mechanism, plant.rotor, plant.friction, period), sensor_function(plant.sensors, period)
    attitude, rate, angles = initially(mechanism)
    states = functions[0].numel_in("x")
    rows: dict[str, Sequence[float]] = {
        "X": [*mechanism.initial, *[0.0] * (states - len(mechanism.initial))],
        "ATTITUDE": attitude,
        "RATE": rate,
        "ANGLES": [*angles, 0.0, 0.0][:2],  # a free body has none
        "ZEROS": sensors.zeros,
        "ERROR": plant.sensors.gyro_bias,
    }
    scratch = max(16, *(f.sz_w() for f in functions), *(f.sz_arg() + f.sz_res() for f in functions))
    numbers = {"ACTUATORS": mechanism.actuators, "AXES": mechanism.axes, "STATES": states, "SCRATCH": scratch}
    lines = [
        *(f"#define AERO_PLANT_{name} {number}" for name, number in numbers.items()),
        *(f"#define AERO_PLANT_{name} {braced(row)}" for name, row in rows.items()),
        f"#define AERO_PLANT_VOLTAGE_LIMIT {plant.voltage_limit.hex()} /* {plant.voltage_limit:g} V */",
        *(f"int {f.name()}(const double **, double **, long long int *, double *, int);" for f in functions),
    ]
    (folder / "aero_plant_config.h").write_text(header("aero_plant_config", lines), encoding="ascii")
    (folder / "aero_plant_equations.c").write_text(c_source(*functions), encoding="ascii")
    for source in SOURCES.glob("plant/*"):
        shutil.copy(source, folder)
    return [folder / "aero_plant.c", folder / "aero_plant_equations.c"]
