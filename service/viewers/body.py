"""3-D scene of the body: two rotors on a beam over a stand for the Aero, a box with a nose otherwise.

Entities are fixed to frames, so that transforms move them; a transparent copy is fixed to the frame of the desired
attitude. Lengths are in metres, about those of the bench; red points forward.
"""

from __future__ import annotations

from math import sqrt
from typing import Final, NamedTuple

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

WORLD: Final = "world"
_NS: Final = 1_000_000_000


class Rgb(NamedTuple):
    """A colour; 0…1 each."""

    r: float
    g: float
    b: float

    def at(self, alpha: float) -> Color:
        """The colour with an opacity, 0…1."""
        return Color(r=self.r, g=self.g, b=self.b, a=alpha)


BEAM: Final = Rgb(0.35, 0.38, 0.42)
NOSE: Final = Rgb(0.85, 0.2, 0.15)
TAIL: Final = Rgb(0.15, 0.4, 0.75)

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
    seconds, rest = divmod(at_ns, _NS)
    return Timestamp(min(max(seconds, 0), 0xFFFFFFFF), rest)


def scene(vehicle: str, kind: str, at_ns: int) -> bytes:
    """An encoded SceneUpdate with the body, its transparent copy and its stand.

    Args:
        vehicle: Names the frames.
        kind: `plant.kind`: `aero`, or anything else for a box.
        at_ns: Time since 1970 [ns].
    """
    at = timestamp(at_ns)
    entities = [
        _body(kind, at, frame_of(vehicle), "body", 1.0),
        _body(kind, at, desired_frame_of(vehicle), "desired", 0.25),
    ]
    if kind == "aero":
        column = _cylinder((0.0, 0.0, -0.17), (0.04, 0.04, 0.3), UPRIGHT, BEAM.at(1.0))
        foot = _cylinder((0.0, 0.0, -0.33), (0.3, 0.3, 0.02), UPRIGHT, BEAM.at(1.0))
        entities.append(
            SceneEntity(
                timestamp=at, frame_id=WORLD, id=f"{vehicle} stand", frame_locked=True, cylinders=[column, foot]
            )
        )
    return SceneUpdate(entities=entities).encode()


def _body(kind: str, at: Timestamp, frame: str, name: str, alpha: float) -> SceneEntity:
    if kind == "aero":
        cubes = [_box((0.0, 0.0, 0.0), (0.36, 0.03, 0.03), BEAM.at(alpha))]
        cylinders = [
            _cylinder((0.18, 0.0, 0.0), (0.14, 0.14, 0.02), UPRIGHT, NOSE.at(alpha)),
            _cylinder((-0.18, 0.0, 0.0), (0.14, 0.14, 0.02), SIDEWAYS, TAIL.at(alpha)),
        ]
    else:
        cubes = [
            _box((0.0, 0.0, 0.0), (0.3, 0.2, 0.1), BEAM.at(alpha)),
            _box((0.17, 0.0, 0.0), (0.04, 0.1, 0.05), NOSE.at(alpha)),
        ]
        cylinders = []
    return SceneEntity(
        timestamp=at, frame_id=frame, id=f"{frame} {name}", frame_locked=True, cubes=cubes, cylinders=cylinders
    )


def _box(where: tuple[float, float, float], size: tuple[float, float, float], color: Color) -> CubePrimitive:
    return CubePrimitive(pose=_pose(where, UPRIGHT), size=_vector(size), color=color)


def _cylinder(
    where: tuple[float, float, float], size: tuple[float, float, float], turned: Quaternion, color: Color
) -> CylinderPrimitive:
    return CylinderPrimitive(
        pose=_pose(where, turned), size=_vector(size), bottom_scale=1.0, top_scale=1.0, color=color
    )


def _pose(where: tuple[float, float, float], turned: Quaternion) -> Pose:
    return Pose(position=_vector(where), orientation=turned)


def _vector(v: tuple[float, float, float]) -> Vector3:
    return Vector3(x=v[0], y=v[1], z=v[2])
