"""Gains of the linear error equations (T.2) of README.md, from a start and from bounded disturbances.

The states of an axis are ε̃ and ω_e, the integral where the law has one, filtered rate and its slope where encoders give
it, and the torque of the feedback where rotors lag behind it. For each output h, over all axes, with the worst axis at
every s and with ‖x(t₀)‖ the norm of (ε̃, z₂) there,

    ‖h x(t)‖ ≤ ‖x(t₀)‖ sup ‖h e^{As} M‖ + Σ D_j ∫ ‖h e^{As} E_j‖ ds                                         (T.3)
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeroloop.service.control.reference import Floats

Complexes = NDArray[np.complex128]

_STEP: Final = 0.1  # first step of e^{As}, in time constants of the fastest mode; and of an oscillation [rad]
_BLOCK: Final = 256  # steps until the step may double, so that a mode that decays is sampled finely while it lasts
_SLACK: Final = 1.002  # by which trapezoids, and what lies between two steps, are rounded up
_END: Final = 20.0  # time constants of the slowest mode after which e^{As} counts as 0
_MOST_BLOCKS: Final = 512

OUTPUTS: Final = {
    "eps": "", "omega": "", "integral": "", "z": "", "feedback": "", "applied": "", "gap": "",
    "eps_dot": "eps", "omega_dot": "omega", "feedback_dot": "feedback",
}  # fmt: skip
"""Outputs, and those that are the derivative of one."""


class Axis(NamedTuple):
    """One axis, by the letters of (T.2); `lag` is T, 0 without rotors."""

    kp: float
    kd: float
    alpha: float
    ki: float
    share: float
    damping: float
    J: float
    phi: float
    lag: float
    bandwidth: float
    ratio: float


class System(NamedTuple):
    """An axis in state space: x' = A x + E d; outputs by name, each a matrix; K of w_s; M of a start."""

    A: Floats
    E: Floats
    outputs: dict[str, Floats]
    K: Floats
    M: Floats


class Responses(NamedTuple):
    """Gain of every output, from ‖x(t₀)‖ and D₁ to D₇, (8,); ‖·‖ of w_s for ε̃ and (ε̃, z₂) at which it is balanced."""

    gains: dict[str, Floats]
    eps: float
    z: float


def system(axis: Axis) -> System:
    """The state space of an axis. Raises LinAlgError if a constant torque is not balanced."""
    names = ["eps", "omega", *["integral"] * bool(axis.ki), *["rate", "slope"] * bool(axis.bandwidth)]
    names += ["torque"] * bool(axis.lag)
    unit = dict(zip(names, np.identity(len(names)), strict=True))
    at, none = {name: i for i, name in enumerate(names)}, np.zeros(len(names))
    rate = unit.get("rate", unit["omega"])  # as received
    integral = unit.get("integral", none)
    damping = axis.damping if len(names) > 2 + bool(axis.ki) else 0.0  # else the law cancels it
    f = -axis.kp * unit["eps"] - (axis.kd + axis.alpha - damping) * rate - axis.ki * integral
    applied = unit.get("torque", f)
    A, E = np.zeros((len(names), len(names))), np.zeros((len(names), 5))
    A[0] = unit["omega"] / 2
    A[1] = axis.phi * (applied - damping * unit["omega"]) / axis.J
    E[0, 0], E[1, 0], E[1, 1] = 1.0, -2 * axis.alpha / axis.J, 1 / axis.J
    M = np.zeros((len(names), 2))
    M[:2] = [[1.0, 0.0], [-axis.share, 1.0]]
    if axis.ki:
        A[at["integral"]], E[at["integral"], 3] = rate + axis.share * unit["eps"], 1.0
    if axis.bandwidth:
        A[at["rate"]], M[at["rate"]] = unit["slope"], M[1]  # at the start filter and rotors are in balance
        A[at["slope"]] = axis.bandwidth**2 * (unit["omega"] - rate) - 2 * axis.ratio * axis.bandwidth * unit["slope"]
    if axis.lag:
        A[at["torque"]], E[at["torque"], 4], M[at["torque"]] = (f - applied) / axis.lag, 1 / axis.lag, f.dot(M)
    else:
        E[1, 4] = 1 / axis.J
    K: Floats = np.asarray(-np.linalg.solve(A, E[:, 1]) * axis.phi, np.float64)
    E[:, 2] = -K
    z = np.stack([unit["eps"], unit["omega"] + axis.share * unit["eps"]])
    rows = {"eps": unit["eps"], "omega": unit["omega"], "integral": integral, "feedback": f, "applied": applied}
    return System(A, E, {"z": z, **{name: row[None] for name, row in rows.items()}, "gap": (f - applied)[None]}, K, M)


@lru_cache(maxsize=256)
def responses(axes: tuple[Axis, ...]) -> Responses | None:
    """Gains over all axes; None if one does not decay."""
    try:
        systems = [system(axis) for axis in axes]
    except np.linalg.LinAlgError:
        return None
    steps = _steps(np.concatenate([np.linalg.eigvals(one.A) for one in systems]))
    if steps is None:
        return None
    s = np.append(0.0, np.cumsum(np.repeat(steps, _BLOCK)))
    flows = [_flow(one.A, steps) for one in systems]
    gains = dict[str, Floats]()
    for name, of in OUTPUTS.items():
        rows = [one.outputs[of or name] for one in systems]
        rates = _gain([row @ one.A @ flow for row, one, flow in zip(rows, systems, flows, strict=True)], systems, s)
        rates[1:] += np.max([np.linalg.norm(h @ one.E, axis=0) for h, one in zip(rows, systems, strict=True)], axis=0)
        if of:
            gains[name] = np.array([*rates, 0.0, rates[5]])
        else:
            plain = _gain([row @ flow for row, flow in zip(rows, flows, strict=True)], systems, s)
            gains[name] = np.array([*plain, rates[5], 0.0])
    eps, z = (max(float(np.linalg.norm(one.outputs[name] @ one.K)) for one in systems) for name in ("eps", "z"))
    return Responses(gains, eps, z)


def _gain(rows: list[Floats], systems: list[System], s: Floats) -> Floats:
    """The gain of outputs h e^{As} at times s, of each axis, from a start and D₁ to D₅. Shape (6,)."""
    start = max(_norms(row @ one.M).max() for row, one in zip(rows, systems, strict=True))
    forced = [np.linalg.norm(row @ one.E, axis=1) for row, one in zip(rows, systems, strict=True)]
    return np.append(start, np.trapezoid(np.max(forced, axis=0), s, axis=0)) * _SLACK


def _norms(matrices: Floats) -> Floats:
    """The induced norm of each matrix: of a single row its length, which takes no SVD. Shape (n,)."""
    order = None if matrices.shape[1] == 1 else 2
    return np.asarray(np.linalg.norm(matrices, order, axis=(1, 2)))


def _steps(poles: Complexes) -> Floats | None:
    """The step of each block of times at which e^{As} is sampled [s]: as the one before, or twice that.

    A step is `_STEP` of an oscillation at the most, as long as that lasts. None if a mode does not decay, or oscillates
    for too long.
    """
    if poles.real.max() >= 0:
        return None
    lasts_s = _END / -poles.real
    step = _STEP / float(np.abs(poles).max())
    reached_s = 0.0
    steps: list[float] = []
    while reached_s < lasts_s.max():
        if len(steps) == _MOST_BLOCKS:
            return None
        steps.append(step)
        reached_s += _BLOCK * step
        fastest_oscillation = float(np.abs(poles.imag[lasts_s > reached_s]).max(initial=0.0))
        if 2 * step * fastest_oscillation <= _STEP:
            step *= 2
    return np.array(steps)


def _flow(A: Floats, steps: Floats) -> Floats:
    """e^{As} at 0 and at the times of blocks of `steps`. Shape (1 + _BLOCK len(steps), n, n)."""
    h = float(steps[0])
    step = np.identity(len(A))
    for k in range(16, 0, -1):  # Taylor: ‖A h‖ is of the size of `_STEP`
        step = np.identity(len(A)) + A * h / k @ step
    flow = [np.identity(len(A))]
    for block_h in steps.tolist():
        if block_h > h:
            step = step @ step
            h = block_h
        for _ in range(_BLOCK):
            flow.append(step @ flow[-1])
    return np.array(flow)
