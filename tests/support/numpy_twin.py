"""NumPy twin: a second control law, reference and plant, with which tests compare the project.

Nothing here imports the project, so an error must be made twice, in two notations, to go unseen. The law is written
from the paper's (C.11) and (C.16)–(C.49). The reference is differentiated by hand. The plant does not project the rigid
body onto its free motions as bodies.py does: it keeps all three axes of (C.2) and solves for the torque with which the
mechanism holds the roll.

Vectors have shape (3,), quaternions (4,) with the scalar first.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]


def skew(a: Array) -> Array:
    """(C.7), element by element."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def rotation(q: Array) -> Array:
    """Body to inertial, the elements of (C.8) multiplied out for a unit quaternion."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def reconstructed(eps: Array, last: Array) -> Array:
    """(C.11) with Remarks 1 and 2: of the two unit quaternions of a received ε, the one nearer to `last`."""
    square = float(eps @ eps)
    q = np.append(0.0, eps / np.sqrt(square)) if square > 1 else np.append(np.sqrt(1 - square), eps)
    return -q if np.linalg.norm(q - last) > np.linalg.norm(q + last) else q


@dataclass(frozen=True)
class Body:
    """What (C.2) needs to know of a body, and the gains. Matrices have shape (3, 3)."""

    J: Array
    m: float
    g: float
    r_g: Array
    B: Array
    C1: Array
    C2: Array
    Gamma: Array
    bound: float
    centre: Array


def law(
    p: Body, q: Array, omega: Array, q_d: Array, omega_d: Array, omega_d_dot: Array, theta: Array, s: float
) -> SimpleNamespace:
    """(C.37), (C.38) and all on their way, by the paper's letters; s is the upper (+1) or lower (−1) sign of its ±."""
    eta, eps, eta_d, eps_d = q[0], q[1:], q_d[0], q_d[1:]
    e = np.empty(4)
    e[0] = eta_d * eta + eps_d @ eps  # (C.32)
    e[1:] = eta_d * eps - eta * eps_d - np.cross(eps_d, eps)  # (C.32)
    R_i_Q = rotation(q).T  # (C.48)
    omega_e = omega - R_i_Q @ omega_d  # (C.47)

    z1 = np.array([1 - s * e[0], e[1], e[2], e[3]])  # (C.39)
    lower = e[0] * np.identity(3) + skew(e[1:])
    G = np.vstack([s * e[1:], lower]).T  # (C.41)
    alpha = -s * p.C1 @ e[1:]  # (C.42), its right-hand side; the product G z1 is the project's way
    z2 = omega_e - alpha  # (C.40)
    alpha_bar = -s * 0.5 * p.C1 @ lower @ omega_e  # (C.46)

    gravity = -np.cross(p.r_g, R_i_Q @ np.array([0.0, 0.0, -p.m * p.g]))  # (C.45)
    Psi = -np.cross(omega, p.J @ omega) - gravity  # (C.43)
    Phi = np.diag(-omega)  # (C.44)
    feedforward = np.cross(omega, R_i_Q @ omega_d) - R_i_Q @ omega_d_dot - alpha_bar
    u = np.linalg.inv(p.B) @ (-G @ z1 - p.C2 @ z2 - Phi @ theta - Psi - p.J @ feedforward)  # (C.37)
    tau = p.Gamma @ Phi @ z2
    theta_dot = projected(p, theta, tau)
    return SimpleNamespace(
        e=e, omega_e=omega_e, z1=z1, z2=z2, alpha=alpha, alpha_bar=alpha_bar, u=u, tau=tau, theta_dot=theta_dot
    )


def projected(p: Body, theta: Array, tau: Array) -> Array:
    """Proj{τ} of (C.38): (I − c Γ ∇P ∇Pᵀ / ∇PᵀΓ∇P) τ where P > 0 and ∇Pᵀτ > 0, else τ.

    P = ‖θ̂‖² − k_θ², and c grows from 0 at P = 0 to 1 at ‖θ̂‖ = k_θ/0.95.
    """
    moved = theta - p.centre
    P, slope = moved @ moved - p.bound**2, 2 * moved
    if P <= 0 or slope @ tau <= 0:
        return tau
    c = min(1.0, float(P) / ((p.bound / 0.95) ** 2 - p.bound**2))
    removed: Array = c * (p.Gamma @ np.outer(slope, slope)) / (slope @ p.Gamma @ slope) @ tau
    return tau - removed


def motion_of(angle: Array, rate: Array, acceleration: Array) -> tuple[Array, Array, Array]:
    """q_d of roll, pitch and yaw, of which yaw turns first, and ω_d and ω̇_d in the desired body frame. (…, 3)."""
    (r, p, _), (dr, dp, dy), (ddr, ddp, ddy) = (np.moveaxis(each, -1, 0) for each in (angle, rate, acceleration))
    sr, cr, sp, cp = np.sin(r), np.cos(r), np.sin(p), np.cos(p)
    across, across_dot = dy * cp, ddy * cp - dy * dp * sp
    omega = np.stack([dr - dy * sp, dp * cr + across * sr, across * cr - dp * sr], axis=-1)
    of_y, of_z = ddp * cr + across_dot * sr + dr * omega[..., 2], across_dot * cr - ddp * sr - dr * omega[..., 1]
    return attitude_of(angle), omega, np.stack([ddr - ddy * sp - dy * dp * cp, of_y, of_z], axis=-1)


def attitude_of(angle: Array) -> Array:
    """q of roll, pitch and yaw. Shapes (…, 3), (…, 4)."""
    (a, b, c), (r, p, y) = (np.moveaxis(each(angle / 2), -1, 0) for each in (np.cos, np.sin))
    return np.stack([a * b * c + r * p * y, r * b * c - a * p * y, a * p * c + r * b * y, a * b * y - r * p * c], -1)


@dataclass(frozen=True)
class Sinusoids:
    """amplitude · sin(frequency · t) on roll, pitch and yaw. [rad], [rad/s]."""

    amplitude: Array
    frequency: Array

    def angles(self, t: float) -> tuple[Array, Array, Array]:
        a, w = self.amplitude, self.frequency
        return a * np.sin(w * t), a * w * np.cos(w * t), -a * w * w * np.sin(w * t)

    def desired(self, t: float) -> tuple[Array, Array, Array]:
        """q_d, ω_d and ω̇_d, the last two in the inertial frame."""
        q_d, omega, omega_dot = motion_of(*self.angles(t))
        return q_d, rotation(q_d) @ omega, rotation(q_d) @ omega_dot


@dataclass
class LockedBody:
    """A rigid body on the Aero's mechanism, by (C.2) plus the torque that holds its roll."""

    body: Body
    thrust: Array  # torque of two motors about three axes [N·m/V]. Shape (3, 2)
    damping: Array  # θ [N·m·s/rad]
    x: Array  # pitch, yaw [rad], their rates [rad/s]

    @property
    def q(self) -> Array:
        """R_z(yaw) R_y(pitch) as a quaternion; its sign is unwrapped, so it turns over after a full turn."""
        b, c = self.x[0] / 2, self.x[1] / 2
        return np.array([np.cos(b) * np.cos(c), -np.sin(b) * np.sin(c), np.sin(b) * np.cos(c), np.cos(b) * np.sin(c)])

    @property
    def omega(self) -> Array:
        p, _, dp, dy = self.x
        return np.array([-np.sin(p) * dy, dp, np.cos(p) * dy])

    def derivative(self, x: Array, u: Array) -> Array:
        """ẋ. Four unknowns: ω̇ and the torque λ n about the locked axis n; four equations: (C.2) and d/dt nᵀω = 0."""
        p, y, dp, dy = x
        at = LockedBody(self.body, self.thrust, self.damping, np.array([p, y, dp, dy]))
        omega, J = at.omega, self.body.J
        n = np.array([np.cos(p), 0.0, np.sin(p)])
        n_dot = np.array([-np.sin(p), 0.0, np.cos(p)]) * dp
        weight = rotation(at.q).T @ np.array([0.0, 0.0, -self.body.m * self.body.g])
        torque = np.cross(self.body.r_g, weight) - np.cross(omega, J @ omega) - self.damping * omega + self.thrust @ u
        left = np.block([[J, -n[:, None]], [n[None, :], np.zeros((1, 1))]])
        omega_dot = np.linalg.solve(left, np.append(torque, -n_dot @ omega))[:3]
        return np.array([dp, dy, omega_dot[1], np.cos(p) * omega_dot[2] - np.sin(p) * omega_dot[0]])

    def advance(self, u: Array, period: float, substeps: int) -> None:
        """Hold u for a period, in equal Runge–Kutta steps of fourth order."""
        h = period / substeps
        for _ in range(substeps):
            a = self.derivative(self.x, u)
            b = self.derivative(self.x + h / 2 * a, u)
            c = self.derivative(self.x + h / 2 * b, u)
            d = self.derivative(self.x + h * c, u)
            self.x = self.x + h * (a + 2 * b + 2 * c + d) / 6
