"""Body model of a law: the rigid body that it is designed for, and the voltages that give a torque."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from aeroloop.protocol.lazy import casadi as ca
from aeroloop.protocol.lazy import numpy as np
from aeroloop.protocol.wire.attitude import R, S
from aeroloop.service.control.laws.interface import LawSettings

Vector = tuple[float, float, float]


def _positive(values: Vector) -> Vector:
    if min(values) <= 0:
        raise ValueError("every element must be positive")
    return values


Diagonal = Annotated[Vector, AfterValidator(_positive)]
"""The diagonal of a positive definite matrix."""

Row = Annotated[tuple[float, ...], Field(min_length=1, max_length=8)]


class BodySettings(LawSettings):
    """Model of the plant. The default is the paper's experiment, Table C.1."""

    inertia: Diagonal = Field(default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]")
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: Vector = Field(
        default=(0.0, 0.0, -0.0038), description="r_g, origin to centre of mass, body frame [m]"
    )
    allocation: tuple[Row, Row, Row] = Field(
        default=((1.0, 0.0, 0.0), (0.0, 0.0011, 0.0011), (0.0, -0.0014, 0.00176)),
        description="B, control allocation of rank 3, a column for each motor [N·m/V]; the Aero's first row and column "
        "are fictitious",
    )


def gravity_torque(p: BodySettings, q: ca.SX) -> ca.SX:
    """g of (C.45): torque of the weight about the origin at attitude q, body frame [N·m]. Shape (3,)."""
    weight = ca.vertcat(0, 0, -p.mass * p.gravity)
    return -S(ca.SX(p.centre_of_mass)) @ R(q).T @ weight


def voltages_for(p: BodySettings, torque: ca.SX, actuators: int) -> ca.SX:
    """The voltages whose torque B u is this, the least ones if there are several [V]. Shape (actuators,).

    A B of three columns serves two motors, too: they are its last two, and the first row is fictitious.

    Args:
        p: Has B.
        torque: Body frame [N·m]. Shape (3,).
        actuators: Number of motors.

    Raises:
        ValueError: B has no inverse, or another number of columns.
    """
    B: np.ndarray[Any, Any] = check_allocation(p, actuators)
    if B.shape == (3, 3):
        return ca.solve(ca.SX(B), torque)[3 - actuators :]
    return ca.mtimes(ca.SX(np.linalg.pinv(B)), torque)


def check_allocation(p: BodySettings, actuators: int) -> np.ndarray[Any, Any]:
    """B, if it fits so many motors and has an inverse; else ValueError with the key. Shape (3, columns)."""
    columns = {len(row) for row in p.allocation}
    fits = actuators in columns or (columns == {3} and actuators == 2)
    if len(columns) > 1 or not fits:
        found = "/".join(map(str, sorted(columns)))
        raise ValueError(f"law.allocation (B) has {found} columns for {actuators} actuators: one for each motor")
    B: np.ndarray[Any, Any] = np.array(p.allocation)
    check_invertible(B)
    return B


def check_invertible(B: np.ndarray[Any, Any]) -> None:
    """Raise ValueError, with the key, if B or a part of it has no inverse. Shape (n, m), n ≤ m."""
    if B.shape[0] > B.shape[1] or np.linalg.cond(B) > 1e12:
        raise ValueError("law.allocation (B) has no inverse: every axis needs a motor that acts on it")
