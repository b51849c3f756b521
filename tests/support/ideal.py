"""An ideal plant: the paper's equations and nothing else, as overrides of the configuration."""

from __future__ import annotations

from typing import Final

from aeroloop.plant_emulator.model.bodies import AeroSettings
from aeroloop.plant_emulator.model.emulated import FrictionSettings, RotorSettings, SensorSettings
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.service.config import as_overrides

AERO: Final = AeroSettings(centre_of_mass=(0.0, 0.0, -0.0038), damping=(0.0, 0.0071, 0.0220))
"""The Aero of Table C.1, with its damping about the body's axes."""
ROTOR: Final = RotorSettings(lag_up_s=0.0, lag_down_s=0.0)
FRICTION: Final = FrictionSettings(viscous=(), coulomb=())
SENSORS: Final = SensorSettings(attitude="perfect", rate="perfect")
PLANT: Final = PlantSettings(aero=AERO, rotor=ROTOR, friction=FRICTION, sensors=SENSORS)

PARTS: Final = {
    "aero": {"centre_of_mass": [0.0, 0.0, -0.0038], "damping": [0.0, 0.0071, 0.0220]},
    "rotor": {"lag_up_s": 0.0, "lag_down_s": 0.0},
    "friction": {"viscous": [], "coulomb": []},
    "sensors": {"attitude": "perfect", "rate": "perfect"},
}
IDEAL: Final = tuple(as_overrides({"plant": PARTS}))
