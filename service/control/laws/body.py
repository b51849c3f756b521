"""Body of a law's settings: the torque of its weight, and the voltages that give a torque."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from aeroloop.protocol.wire.attitude import R, S
from aeroloop.service.control.laws.interface import LawSettings


def gravity_torque(p: LawSettings, q: ca.SX) -> ca.SX:
    """Torque of the weight about the origin at attitude q, body frame: −g of (C.45) [N·m]. Shape (3,)."""
    weight = ca.vertcat(0, 0, -p.mass * p.gravity)
    return S(ca.SX(p.centre_of_mass)) @ R(q).T @ weight


def voltages_for(p: LawSettings, torque: Any, actuators: int) -> Any:
    """The voltages whose torque B u is this, the least ones if there are several [V]. Shape (actuators,).

    A B of three columns serves two motors, too: they are its last two, and the first row is fictitious.

    Args:
        p: Has B.
        torque: Body frame, an expression or an array [N·m]. Shape (3,).
        actuators: Number of motors.

    Raises:
        ValueError: B has no inverse, or another number of columns.
    """
    B: np.ndarray[Any, Any] = check_allocation(p, actuators)
    if isinstance(torque, np.ndarray):
        return (np.linalg.pinv(B) @ torque)[-actuators:]
    if B.shape == (3, 3):
        return ca.solve(ca.SX(B), torque)[3 - actuators :]
    return ca.mtimes(ca.SX(np.linalg.pinv(B)), torque)


def check_allocation(p: LawSettings, actuators: int) -> np.ndarray[Any, Any]:
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
