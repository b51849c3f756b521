"""An ideal plant: the paper's equations and nothing else, as overrides of the configuration."""

from __future__ import annotations

from typing import Final

from aeroloop.service.config import as_overrides, load

PARTS: Final = {
    "aero": {"centre_of_mass": [0.0, 0.0, -0.0038], "damping": [0.0, 0.0071, 0.0220]},  # Table C.1, about body axes
    "rotor": {"lag_up_s": 0.0, "lag_down_s": 0.0},
    "friction": {"viscous": [], "coulomb": []},
    "sensors": {"attitude": "perfect", "rate": "perfect"},
}
IDEAL: Final = tuple(as_overrides({"plant": PARTS}))
PLANT: Final = load(overrides=IDEAL).plant
