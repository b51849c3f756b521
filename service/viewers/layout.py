"""Layout for Foxglove and Lichtblick that fits the topics of channels.py, from layout.json.

Both import the same JSON: `configById` with a panel's settings under `Type!name`, and `layout`, a tree of splits. The
keys of the settings are those of Lichtblick's sources (suite-base/src/panels: 3D, Plot, StateTransitions, and Log,
whose type is still RosOut); both ignore unknown keys. Plots show 20 s of a live loop, and all of a log.
"""

from __future__ import annotations

import json
import re
from importlib.resources import files


def layout(vehicle: str, actuators: int) -> str:
    """The layout as JSON, to be imported as a file; `actuators` is 2 for u₂ and u₃, 3 for all."""
    text = files(__package__).joinpath("layout.json").read_text(encoding="utf-8")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", vehicle):  # in a message path, such a topic is quoted
        text = re.sub(r'"value": "(/VEHICLE/[^.]+)\.', r'"value": "\\"\1\\".', text)
    tree = json.loads(text.replace("VEHICLE", vehicle))
    voltages = tree["configById"]["Plot!voltages"]
    voltages["paths"] = voltages["paths"][3 - actuators :]
    return json.dumps(tree, indent=2, ensure_ascii=False)
