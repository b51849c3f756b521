"""Many closed loops at once: the paper's body under the law, a row an experiment, as an adversary would have them.

The body is that of the certificate: (C.1), (C.78) with the law's own model, three torques, perfect sensors, commands
held for a period. One CasADi function is a tick of the whole loop; `in_columns` runs each of its instructions over all
rows. Largest values are those at ticks, up to the first at which a value is beyond the wire's range, as nothing is
claimed of what follows.

An error y^Q − y is either that of the wire's quantizers, whose grids may be shifted, or any within their bounds, as
(C.13) allows: the wave of an adversary, without limit of range.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Final, NamedTuple

import casadi as ca
import numpy as np

from aeroloop.plant_emulator.model.emulated import rk4
from aeroloop.plant_emulator.model.rigid_body import RigidBody, RigidBodySettings
from aeroloop.protocol.messages.operator import Points, Reference, Sinusoid
from aeroloop.protocol.wire.quantizer import TIE, Quantizer, UniformQuantizer
from aeroloop.protocol.wire.symbolic import Buffer, Compiled, in_columns
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import Adaptive, equations
from aeroloop.service.control.laws.evaluation import law_function
from aeroloop.service.control.reference import Floats, desired
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.lemma import coordinates, lyapunov, rotation, times

WAVES: Final = ("square", "sinusoid", "constant", "bang-bang")
_TURNS: Final = 4
_LONGEST_S: Final = 300.0
_SIZES: Final = {"q": 4, "omega": 3, "last": 4, "theta_hat": 3, "within": 1, "largest": 4, "square": 1, "lasted": 1}
"""State of an experiment, and what it has reached: ‖z‖², |ω_k|, |ε_k|, |u_k|; ∫‖z‖² dt; the time while `within`."""


@dataclass(frozen=True)
class Wave:
    """Something that acts along a vector, with a course in time within ±1.

    Attributes:
        along: Shape (n, 3).
        kind: Index into WAVES; bang-bang has the sign of z₂, of each axis or along the vector. Shape (n,).
        frequency: [rad/s]. Shape (n,).
        angle: [rad]. Shape (n,).
    """

    along: Floats
    kind: Floats
    frequency: Floats
    angle: Floats

    @property
    def columns(self) -> Floats:
        """As an input of the tick: vector, weight of each kind, frequency, angle. Shape (n, 9)."""
        weights = np.identity(len(WAVES))[self.kind.astype(int)]
        return np.column_stack([self.along, weights, self.frequency, self.angle])


@dataclass(frozen=True)
class Experiments:
    """What an adversary chooses, a row an experiment.

    Attributes:
        start: x(t₀) = (ε̄, z̄) as in `theorem.invariant` [1, rad/s]. Shape (n, 6).
        theta: θ [N·m·s/rad]. Shape (n, 3).
        theta_hat: θ̂(t₀) [N·m·s/rad]. Shape (n, 3).
        phase: Time of the reference at t₀, as a share of its length, 0…1. Shape (n,).
        torque: τ_d [N·m].
        error: (y − y^Q)/δ_y of each axis, in place of the quantizers; 0 with them [1].
        offset: Shift of the quantizers' grids for ε, ω and u, in steps. Shape (n, 9).
        quantized: 1 where the wire's quantizers act, else 0. Shape (n,).
    """

    start: Floats
    theta: Floats
    theta_hat: Floats
    phase: Floats
    torque: Wave
    error: Wave
    offset: Floats
    quantized: Floats


class Outcome(NamedTuple):
    """What each experiment reached until it left the wire's ranges. Shapes (n,).

    Attributes:
        z: Largest ‖z‖ [1, rad/s].
        omega: Largest |ω_k| [rad/s].
        eps: Largest |ε_k| [1].
        u: Largest |u_k| of the motors present, as the law commands [V].
        square: ∫‖z‖² dt [s].
        lasted: Time until it left [s].
        V: V at the start [N·m].
    """

    z: Floats
    omega: Floats
    eps: Floats
    u: Floats
    square: Floats
    lasted: Floats
    V: Floats


class Loops:
    """A number of loops that run at once.

    Args:
        settings: The configuration.
        rows: How many.
        ticks: How long they run at most.
    """

    def __init__(self, settings: Settings, rows: int, ticks: int) -> None:
        self.settings = settings
        self._starts = round(span(settings.reference) / settings.loop.period)
        self._desired = desired(settings.reference, settings.loop.period, self._starts + ticks)
        self._tick = Compiled(in_columns(tick_function(settings), rows))
        self._inputs = {name: _columns(memory, rows) for name, memory in self._tick.inputs.items()}
        self._after = _columns(self._tick.outputs["after"], rows)
        ends = np.cumsum(list(_SIZES.values()))
        self._state = {
            name: self._inputs["state"][:, end - size : end]
            for (name, size), end in zip(_SIZES.items(), ends, strict=True)
        }
        self._first, self._V, self._k = np.zeros(rows, int), np.zeros(rows), 0

    def begin(self, chosen: Experiments) -> None:
        """Set every loop to its start. As many experiments as rows."""
        law = with_theorem(self.settings).law
        self._first, self._k = np.round(self._starts * chosen.phase).astype(int), 0
        q_d, omega_d = self._desired[self._first, :4], self._desired[self._first, 4:7]
        C1, theta_error = np.array(law.C1), chosen.theta - chosen.theta_hat
        eps_e, z2 = np.hsplit(chosen.start + balance(self.settings, q_d, omega_d, theta_error), 2)
        q = turned(q_d, eps_e)
        omega = z2 - C1 * eps_e + times(np.swapaxes(rotation(q), 1, 2), omega_d)
        self._V = lyapunov(coordinates(q, omega, q_d, omega_d, np.ones(len(q)), C1), theta_error, law)
        for name, value in {"q": q, "last": q, "omega": omega, "theta_hat": chosen.theta_hat}.items():
            self._state[name][:] = value
        self._state["within"][:] = 1.0
        self.forget()
        inputs = self._inputs
        inputs["theta"][:], inputs["offset"][:] = chosen.theta, chosen.offset
        inputs["quantized"][:] = chosen.quantized[:, None]
        inputs["torque"][:], inputs["error"][:] = chosen.torque.columns, chosen.error.columns

    def forget(self) -> None:
        """Begin anew with largest values and integrals."""
        for name in ("largest", "square", "lasted"):
            self._state[name][:] = 0.0

    def advance(self, ticks: int) -> Outcome:
        """Run some ticks; largest values since `begin` or `forget`."""
        state, period = self._inputs["state"], self.settings.loop.period
        for k in range(self._k, self._k + ticks):
            self._inputs["desired"][:] = self._desired[self._first + k]
            self._inputs["time"][:] = k * period
            self._tick()
            state[:] = self._after
        self._k += ticks
        z_square, omega, eps, u = self._state["largest"].T.copy()
        square, lasted = (self._state[name][:, 0].copy() for name in ("square", "lasted"))
        return Outcome(np.sqrt(z_square), omega, eps, u, square, lasted, self._V)


def balance(settings: Settings, q_d: Floats, omega_d: Floats, theta_error: Floats) -> Floats:
    """K w_s: ε̃ and z₂ at which the law balances the slow disturbance. Shape (n, 6)."""
    law = with_theorem(settings).law
    C1, C2 = np.array(law.C1), np.array(law.C2)
    slow = -times(np.swapaxes(rotation(q_d), 1, 2), omega_d) * theta_error
    eps = slow / (1 + C1 * C2)
    return np.hstack([eps, C1 * eps])


def turned(q_d: Floats, eps_e: Floats) -> Floats:
    """q_d ⊗ e, the attitude whose error has the vector part ε̃ and η̃ ≥ 0. Shape (n, 4)."""
    eta_e, eta_d, eps_d = np.sqrt(1 - (eps_e**2).sum(axis=1, keepdims=True)), q_d[:, :1], q_d[:, 1:]
    eta = eta_d * eta_e - (eps_d * eps_e).sum(axis=1, keepdims=True)
    return np.hstack([eta, eta_d * eps_e + eta_e * eps_d + np.cross(eps_d, eps_e)])


def quantized(y: ca.SX, quantizer: Quantizer) -> ca.SX:
    """`UniformQuantizer.quantize` as an expression, (C.14); of another kind, y itself. Shape as given."""
    if not isinstance(quantizer, UniformQuantizer):
        return y
    half = quantizer.step / 2
    index = ca.fmin(ca.ceil((ca.fabs(y) - quantizer.deadzone) / quantizer.step * TIE), quantizer.top)
    return ca.sign(y) * (index > 0) * (quantizer.deadzone - half + index * quantizer.step)


def tick_function(settings: Settings) -> ca.Function:
    """A tick of the loop: measurement, law and a period of the body.

    Inputs: state, desired (q_d, ω_d, ω̇_d), time [s], theta, torque and error as `Wave.columns`, offset [steps],
    quantized. Output: after.
    """
    law, wire, period = with_theorem(settings).law, settings.wire, settings.loop.period
    given = {
        "state": ca.SX.sym("state", sum(_SIZES.values())),
        "desired": ca.SX.sym("desired", 10),
        "time": ca.SX.sym("time"),
        "theta": ca.SX.sym("theta", 3),
        "torque": ca.SX.sym("torque", 9),
        "error": ca.SX.sym("error", 9),
        "offset": ca.SX.sym("offset", 9),
        "quantized": ca.SX.sym("quantized"),
    }
    state, desired, time, theta, torque, error, offset, with_quantizers = given.values()
    q, omega, last, theta_hat, within, largest, square, lasted = ca.vertsplit(
        state, [0, *np.cumsum(list(_SIZES.values())).tolist()]
    )
    q_d, omega_d, omega_d_dot = ca.vertsplit(desired, [0, 4, 7, 10])

    def received(y: ca.SX, quantizer: Quantizer, shift: ca.SX, wave: ca.SX) -> tuple[ca.SX, ca.SX]:
        """y^Q, and how far beyond the range y is."""
        o = shift * getattr(quantizer, "step", 0.0)
        on_grid = quantized(y + o, quantizer) - o
        beyond = with_quantizers * (_largest(y + o) - quantizer.limit)
        return ca.if_else(with_quantizers > 0, on_grid, y - quantizer.bound * wave), beyond

    p = equations(law)
    errors = ca.Function("errors", [p.q, p.omega, p.q_d, p.omega_d, p.s, p.C1], [ca.vertcat(p.z1, p.z2), p.z2])
    z, z2 = errors(q, omega, q_d, omega_d, 1, ca.SX(law.C1))

    sent = ca.if_else(q[0] < 0, -1, 1) * q[1:4]
    wave = error[:3] * _course(error, time, ca.sign(z2))
    eps, eps_beyond = received(sent, wire.attitude.quantizer(), offset[:3], wave)
    rate, rate_beyond = received(omega, wire.rate.quantizer(), offset[3:6], wave)
    gains = ca.SX([*law.C1, *law.C2, *law.Gamma])
    last, u, state, *_ = law_function(Adaptive(law, period, 3))(
        last, ca.vertcat(theta_hat, 1), gains, eps, rate, q_d, omega_d, omega_d_dot
    )
    theta_hat = state[:3]
    first = 3 - wire.actuators  # with two motors the first torque is fictitious: neither quantized nor limited
    pushed = -ca.sign(ca.SX(np.array(law.allocation)).T @ wave)  # as the wave's other errors push
    motors, u_beyond = received(u[first:], wire.voltage.quantizer(), offset[6 + first :], pushed[first:])
    limit = ca.if_else(with_quantizers > 0, settings.plant.voltage_limit, ca.inf)
    applied = ca.vertcat(u[:first], ca.fmax(-limit, ca.fmin(limit, motors)))

    body = RigidBody(
        RigidBodySettings(
            inertia=law.inertia,
            mass=law.mass,
            gravity=law.gravity,
            centre_of_mass=law.centre_of_mass,
            allocation=np.array(law.allocation).tolist(),
            damping=(0.0, 0.0, 0.0),  # θ differs from row to row: it is part of the load
        )
    )
    disturbance = torque[:3] * _course(torque, time, ca.sign(ca.dot(torque[:3], z2)))
    moved = rk4(
        lambda x: body.derivative(x, applied, disturbance - theta * x[4:7]), ca.vertcat(q, omega), period, substeps=1
    )
    now = ca.vertcat(ca.sumsqr(z), _largest(omega), _largest(sent), _largest(u[first:]))
    saturated = with_quantizers * (_largest(u[first:]) > settings.plant.voltage_limit)
    beyond = ca.fmax(saturated, ca.mmax(ca.vertcat(eps_beyond, rate_beyond, u_beyond)))
    after = ca.vertcat(
        body.settle(moved),
        last,
        theta_hat,
        within * (beyond <= 0),
        ca.fmax(largest, within * now),
        square + within * period * now[0],
        lasted + within * period,
    )
    return ca.Function("tick", list(given.values()), [after], list(given), ["after"], {"cse": True})


def _course(wave: ca.SX, time: ca.SX, bang: ca.SX) -> ca.SX:
    """The course of a wave, within ±1: one of WAVES. Shape of `bang`."""
    swing = ca.sin(wave[7] * time + wave[8])
    return wave[3] * ca.sign(swing) + wave[4] * swing + wave[5] + wave[6] * bang


def _largest(vector: ca.SX) -> ca.SX:
    return ca.mmax(ca.fabs(vector))


def _columns(memory: Buffer, rows: int) -> Floats:
    """A view of what CasADi holds column by column. Shape (rows, m)."""
    view: Floats = np.asarray(memory).reshape(-1, rows).T
    return view


def span(reference: Reference) -> float:
    """A time within which the reference shows what it does, or most of it [s]."""
    if isinstance(reference, Sinusoid):
        return min(_LONGEST_S, _TURNS * 2 * pi / min([f for f in reference.frequency if f > 0], default=2 * pi))
    return min(_LONGEST_S, reference.times[-1]) if isinstance(reference, Points) else 0.0
