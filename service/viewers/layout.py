"""Layout for Foxglove and Lichtblick that fits the topics of channels.py, from layout.json.

Both import the same JSON: `configById` with a panel's settings under `Type!name`, and `layout`, a tree of splits. The
keys of the settings are those of Lichtblick's sources (suite-base/src/panels: 3D, Plot, StateTransitions, and Log,
whose type is still RosOut); both ignore unknown keys. Plots show 20 s of a live loop, and all of a log.
"""

from __future__ import annotations

import json
import re
from importlib.resources import files


def layout(vehicle: str, motors: range) -> str:
    """The layout as JSON, to be imported as a file; `motors` are the numbers of those there are."""
    text = files(__package__).joinpath("layout.json").read_text(encoding="utf-8")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", vehicle):  # in a message path, such a topic is quoted
        text = re.sub(r'"value": "(/VEHICLE/[^.]+)\.', r'"value": "\\"\1\\".', text)
    tree = json.loads(text.replace("VEHICLE", vehicle))
    voltages = tree["configById"]["Plot!voltages"]
    first = json.dumps(voltages["paths"][0])
    voltages["paths"] = [json.loads(first.replace("_1_", f"_{i}_").replace('"u1"', f'"u{i}"')) for i in motors]
    return json.dumps(tree, indent=2, ensure_ascii=False)
