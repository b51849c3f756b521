"""3-D scene of the body: two rotors on a beam over a stand for the Aero, a box with a nose otherwise.

Entities are fixed to frames, so that transforms move them; a transparent copy is fixed to the frame of the desired
attitude. Lengths are in metres, about those of the bench; red points forward.
"""

from __future__ import annotations

from math import sqrt
from typing import Final

from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from aeroloop.protocol.wire.attitude import Vector

WORLD: Final = "world"

BEAM: Final = 0.35, 0.38, 0.42  # red, green and blue, 0…1
NOSE: Final = 0.85, 0.2, 0.15
TAIL: Final = 0.15, 0.4, 0.75

UPRIGHT: Final = Quaternion(w=1.0)
SIDEWAYS: Final = Quaternion(x=sqrt(0.5), w=sqrt(0.5))
"""Turns a cylinder's axis from z to y."""


def frame_of(vehicle: str) -> str:
    """Name of the frame that has the measured attitude."""
    return vehicle


def desired_frame_of(vehicle: str) -> str:
    """Name of the frame that has the desired attitude."""
    return f"{vehicle}_desired"


def timestamp(at_ns: int) -> Timestamp:
    """A time since 1970 [ns] in Foxglove's type, which has 32 bits of seconds."""
    seconds, rest = divmod(at_ns, 1_000_000_000)
    return Timestamp(min(max(seconds, 0), 0xFFFFFFFF), rest)


def scene(vehicle: str, kind: str, at_ns: int) -> SceneUpdate:
    """The body, its transparent copy and its stand.

    `kind` is `plant.kind`: `aero`, or anything else for a box. `at_ns` is since 1970 [ns].
    """
    at, body, desired = timestamp(at_ns), frame_of(vehicle), desired_frame_of(vehicle)
    parts = [(body, f"{body} body", *_body(kind, 1.0)), (desired, f"{desired} desired", *_body(kind, 0.25))]
    if kind == "aero":
        column = _cylinder((0.0, 0.0, -0.17), (0.04, 0.04, 0.3), UPRIGHT, _color(BEAM, 1.0))
        foot = _cylinder((0.0, 0.0, -0.33), (0.3, 0.3, 0.02), UPRIGHT, _color(BEAM, 1.0))
        parts.append((WORLD, f"{vehicle} stand", [], [column, foot]))
    return SceneUpdate(
        entities=[
            SceneEntity(timestamp=at, frame_id=frame, id=name, frame_locked=True, cubes=cubes, cylinders=cylinders)
            for frame, name, cubes, cylinders in parts
        ]
    )


def _body(kind: str, alpha: float) -> tuple[list[CubePrimitive], list[CylinderPrimitive]]:
    beam, nose, tail = (_color(rgb, alpha) for rgb in (BEAM, NOSE, TAIL))
    if kind != "aero":
        return [_box((0.0, 0.0, 0.0), (0.3, 0.2, 0.1), beam), _box((0.17, 0.0, 0.0), (0.04, 0.1, 0.05), nose)], []
    return [_box((0.0, 0.0, 0.0), (0.36, 0.03, 0.03), beam)], [
        _cylinder((0.18, 0.0, 0.0), (0.14, 0.14, 0.02), UPRIGHT, nose),
        _cylinder((-0.18, 0.0, 0.0), (0.14, 0.14, 0.02), SIDEWAYS, tail),
    ]


def _box(where: Vector, size: Vector, color: Color) -> CubePrimitive:
    return CubePrimitive(pose=_pose(where, UPRIGHT), size=_vector(size), color=color)


def _cylinder(where: Vector, size: Vector, turned: Quaternion, color: Color) -> CylinderPrimitive:
    return CylinderPrimitive(
        pose=_pose(where, turned), size=_vector(size), bottom_scale=1.0, top_scale=1.0, color=color
    )


def _pose(where: Vector, turned: Quaternion) -> Pose:
    return Pose(position=_vector(where), orientation=turned)


def _vector(v: Vector) -> Vector3:
    return Vector3(x=v[0], y=v[1], z=v[2])


def _color(rgb: Vector, alpha: float) -> Color:
    return Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)
