"""Layout for Foxglove and Lichtblick that fits the topics of channels.py.

Both import the same JSON: `configById` with a panel's settings under `Type!name`, and `layout`, a tree of splits. The
keys of the settings are those of Lichtblick's sources (suite-base/src/panels: 3D, Plot, StateTransitions, and Log,
whose type is still RosOut); both ignore unknown keys.
"""

from __future__ import annotations

import json
import re
from typing import Any, Final

from aeroloop.service.viewers.body import frame_of
from aeroloop.service.viewers.channels import topic_of

Tree = dict[str, Any]

FOLLOWING_S: Final = 20
"""Time span of plots of a live loop [s]; plots of a log show all of it."""

COLOURS: Final = {"roll": ("#2ca02c", "#98df8a"), "pitch": ("#1f77b4", "#aec7e8"), "yaw": ("#d62728", "#ff9896")}
"""Colours of measured and of desired values."""


def layout(vehicle: str, actuators: int) -> str:
    """The layout as JSON, to be imported as a file; `actuators` is 2 for u₂ and u₃, 3 for all."""
    motors = range(4 - actuators, 4)
    panels = {
        "3D!body": _body(vehicle),
        "StateTransitions!states": {
            **_titled("States"),
            "isSynced": True,
            "paths": [
                {"value": _path(vehicle, f"status/{role}", "state"), "label": role, "timestampMethod": "receiveTime"}
                for role in ("plant", "controller")
            ],
        },
        "RosOut!log": {
            **_titled("Log"),
            "searchTerms": [],
            "minLogLevel": 2,  # Info
            "topicToRender": topic_of(vehicle, "log"),
        },
        "Plot!attitude": _plot(
            "Attitude",
            "deg",
            [
                line
                for angle, (measured, desired) in COLOURS.items()
                for line in (
                    _line(vehicle, "tracking", f"desired_{angle}_deg", f"{angle}, desired", desired),
                    _line(vehicle, "tracking", f"{angle}_deg", angle, measured),
                )
            ],
        ),
        "Plot!error": _plot("Tracking error", "deg", [_line(vehicle, "tracking", "error_deg", "error", "#9467bd")]),
        "Plot!voltages": _plot(
            "Voltages", "V", [_line(vehicle, "command", f"voltage_{motor}_v", f"u{motor}") for motor in motors]
        ),
        "Plot!timing": _plot(
            "Latency, lateness of measurements",
            "µs",
            [
                _line(vehicle, "status/plant", "latency_p50_us", "latency, median"),
                _line(vehicle, "status/plant", "latency_p99_us", "latency, 99 %"),
                _line(vehicle, "status/controller", "age_p50_us", "lateness, median"),
                _line(vehicle, "status/controller", "age_p99_us", "lateness, 99 %"),
            ],
        ),
    }
    tree = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split(
            "row",
            45,
            _split("column", 55, "3D!body", _split("column", 40, "StateTransitions!states", "RosOut!log")),
            _split(
                "column",
                50,
                _split("column", 60, "Plot!attitude", "Plot!error"),
                _split("column", 50, "Plot!voltages", "Plot!timing"),
            ),
        ),
    }
    return json.dumps(tree, indent=2, ensure_ascii=False)


def _body(vehicle: str) -> Tree:
    """The 3-D panel: the camera follows the body and does not turn with it."""
    return {
        **_titled("Body"),
        "followTf": frame_of(vehicle),
        "followMode": "follow-position",
        "cameraState": {"distance": 1.6, "phi": 65, "thetaOffset": 40, "near": 0.01},
        "scene": {"transforms": {"axisScale": 0.25, "showLabel": False}},
        "topics": {
            topic_of(vehicle, "scene"): {"visible": True},
            topic_of(vehicle, "pose"): {"visible": False},
            topic_of(vehicle, "desired_pose"): {"visible": False},
        },
        "transforms": {},
        "layers": {
            "grid": {
                "instanceId": "grid",
                "layerId": "foxglove.Grid",
                "label": "Grid",
                "visible": True,
                "frameLocked": True,
                "size": 2,
                "divisions": 10,
                "lineWidth": 1,
                "color": "#7f7f7f80",
                "position": [0, 0, -0.34],
                "rotation": [0, 0, 0],
            }
        },
    }


def _titled(title: str) -> Tree:
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title}


def _plot(title: str, unit: str, lines: list[Tree]) -> Tree:
    return {
        **_titled(title),
        "paths": lines,
        "yAxisLabel": unit,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "followingViewWidth": FOLLOWING_S,
        "sidebarDimension": 240,
    }


def _line(vehicle: str, name: str, field: str, label: str, colour: str | None = None) -> Tree:
    line = {"value": _path(vehicle, name, field), "label": label, "enabled": True, "timestampMethod": "receiveTime"}
    return line if colour is None else {**line, "color": colour}


def _path(vehicle: str, name: str, field: str) -> str:
    """A message path; a topic with a special character, such as a dot, is quoted."""
    topic = topic_of(vehicle, name)
    return f"{topic}.{field}" if re.fullmatch(r"[A-Za-z0-9_/-]+", topic) else f'"{topic}".{field}'


def _split(direction: str, percentage: int, first: Tree | str, second: Tree | str) -> Tree:
    return {"direction": direction, "splitPercentage": percentage, "first": first, "second": second}
