"""Reference: Euler angles over time, and the q_d, ω_d, ω̇_d that the law uses.

Every reference is a sequence of pieces, and every piece a quintic plus a sinusoid, of which either may be zero. One
CasADi function evaluates any piece: the desired quaternion, the angular velocity of (C.12) in the inertial frame and
its derivative follow by CasADi's own derivatives, so they are exact and consistent.

The extremes of a quintic are those of 65 samples, those of a sinusoid suprema over its phases: `Trajectory.largest`.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import cache
from itertools import product as combinations
from math import acos, asin, cos, degrees, lcm, pi, radians
from typing import Final, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Hold, Points, Reference, Sinusoid
from aeroloop.protocol.wire.attitude import Vector, conjugate, from_half_angles, product
from aeroloop.protocol.wire.elementary import sine_cosine
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.settings import ControllerSettings

Floats = NDArray[np.float64]

POWERS: Final = 6
SAMPLES: Final = 65
"""Samples of a quintic. Its rate is a polynomial of degree 4: the largest of so many is within 0.4 % of the maximum."""
_BASIS: Final = np.linspace(0.0, 1.0, SAMPLES) ** np.arange(POWERS)[:, None]
"""Powers, a row each, of the samples' times as shares of a piece."""
_CHUNK: Final = 200
"""Pieces that are sampled at once to check a reference: they fit a CPU's cache, and BLAS starts no thread for so few,
nor is Python's lock held for longer than a loop in the same process can wait."""
_CELLS: Final = {1: 512, 2: 96, 3: 36}  # of each free phase to begin with, by the number of free phases
_MOST_CELLS: Final = 100_000
_TOLERANCE: Final = 1e-7  # share by which a supremum may exceed the largest value found, unless that takes more cells
_ROUNDED: Final = 1e-12  # share by which a value may be rounded
_LIMIT_SLACK: Final = 1 + 1e-6  # a reference that just reaches a limit is within it
_COMMON: Final = 16  # axes are locked to each other if the ratio of their frequencies has integers up to this


class FollowError(AeroloopError):
    """A reference that the vehicle must not follow; one line with the limit and a remedy."""


class Limits(NamedTuple):
    """Limits of a reference."""

    rate: float  # largest angular velocity [rad/s]
    tilt: float  # largest angle between the body's z axis and the vertical [rad]
    rolls: bool  # whether the vehicle can roll; a 2-DOF bench cannot

    @classmethod
    def of(cls, own: ControllerSettings, actuators: int) -> Limits:
        """The limits of a controller, for a vehicle with so many actuators."""
        return cls(own.max_reference_rate, radians(own.max_reference_tilt_deg), rolls=actuators > 2)


class Angles(NamedTuple):
    """Roll, pitch, yaw [rad], their rates [rad/s] and accelerations [rad/s²]; each of shape (…, 3)."""

    angle: Floats
    rate: Floats
    acceleration: Floats

    @property
    def row(self) -> tuple[Vector, Vector, Vector]:
        """The first row, as numbers."""
        angle, rate, acceleration = (tuple(part[0].tolist()) for part in self)
        return angle, rate, acceleration

    def speeds(self) -> Floats:
        """Angular velocities [rad/s]: ‖ω‖² = φ̇² + θ̇² + ψ̇² − 2 φ̇ ψ̇ sin θ, for roll φ, pitch θ, yaw ψ. Shape (n,)."""
        square = (self.rate**2).sum(axis=1)
        square -= 2 * self.rate[:, 0] * self.rate[:, 2] * np.sin(self.angle[:, 1])
        return np.asarray(np.sqrt(np.maximum(0.0, square)))  # NaN stays NaN

    def tilts(self) -> Floats:
        """Angles between the body's z axis and the vertical [rad]. Shape (n,)."""
        return np.asarray(np.arccos(np.cos(self.angle[:, 0]) * np.cos(self.angle[:, 1])))

    def speed_bounds(self) -> Floats:
        """Bounds of `speeds` that need no sine [rad/s]: √(θ̇² + (|φ̇| + |ψ̇|)²). Shape (n,)."""
        roll, pitch, yaw = self.rate.T
        return np.asarray(np.sqrt(pitch**2 + (np.abs(roll) + np.abs(yaw)) ** 2))

    def tilt_bounds(self) -> Floats:
        """Bounds of `tilts` that need no cosine [rad]: |φ| + |θ|, one turn after the other. Shape (n,)."""
        return np.asarray(np.abs(self.angle[:, 0]) + np.abs(self.angle[:, 1]))

    def rows(self, selected: NDArray[np.bool_]) -> Angles:
        """The selected rows."""
        return Angles(*(part[selected] for part in self))


class Trajectory(NamedTuple):
    """Consecutive pieces, each Σ cₙ τⁿ + amplitude · sin(frequency · τ) with τ = t − start; the last never ends."""

    starts: Floats  # of each [s], increasing. Shape (n,)
    quintic: Floats  # c₀…c₅ of roll, pitch, yaw [rad/sᵖ]. Shape (n, 6, 3)
    amplitude: Floats  # of roll, pitch, yaw [rad]. Shape (n, 3)
    frequency: Floats  # of roll, pitch, yaw [rad/s]. Shape (n, 3)

    @classmethod
    def of(cls, reference: Reference) -> Trajectory:
        """The trajectory of a reference that begins at t = 0. A stream holds 0 until its first set-point."""
        if isinstance(reference, Points):
            return cls._through(reference)
        still = cls._polynomial(np.zeros(1), np.zeros((1, POWERS, 3)))
        if isinstance(reference, Sinusoid):
            amplitude = np.array([[a * (pi / 180) for a in reference.amplitude]])
            return still._replace(amplitude=amplitude, frequency=np.array([reference.frequency]))
        if isinstance(reference, Hold) and reference.attitude is not None:
            still.quintic[0, 0] = np.radians(reference.attitude)
        return still

    @classmethod
    def _polynomial(cls, starts: Floats, quintic: Floats) -> Trajectory:
        return cls(starts, quintic, np.zeros((len(starts), 3)), np.zeros((len(starts), 3)))

    @classmethod
    def _through(cls, points: Points) -> Trajectory:
        """A trajectory through points, at rest at both ends."""
        times, angles = np.array(points.times), np.radians(np.array(points.attitudes))
        monotone = points.interpolation == "monotone"
        rates = np.gradient(angles, times, axis=0)
        if monotone:
            rates[1:-1] = _monotone_rates(times, angles, rates[1:-1])
        rates[0] = rates[-1] = 0.0
        accelerations = np.gradient(rates, times, axis=0)
        if monotone:
            accelerations[1:-1] = _monotone_accelerations(times, angles, rates, accelerations[1:-1])
        accelerations[0] = accelerations[-1] = 0.0
        here = Angles(angles[:-1], rates[:-1], accelerations[:-1])
        there = Angles(angles[1:], rates[1:], accelerations[1:])
        last = np.zeros((1, POWERS, 3))
        last[0, 0] = angles[-1]
        return cls._polynomial(times, np.concatenate([join(here, there, np.diff(times)), last]))

    @property
    def first(self) -> Angles:
        """The state at its start. Shapes (1, 3)."""
        angle, rate, twice = self.quintic[:1, 0], self.quintic[:1, 1], self.quintic[:1, 2]
        return Angles(angle, rate + self.amplitude[:1] * self.frequency[:1], 2 * twice)

    def after(self, starts: Floats, lengths: Floats, knots: Angles) -> Trajectory:
        """This trajectory from the last of these times on, preceded by quintics through the states `knots` at them.

        `lengths` are the differences of the times before they were rounded by an addition [s]. Shapes (n,), (n − 1,)
        and (n, 3); the last of the states is this trajectory's first.
        """
        here, there = Angles(*(part[:-1] for part in knots)), Angles(*(part[1:] for part in knots))
        way = self._polynomial(starts[:-1], join(here, there, lengths))
        later = self._replace(starts=self.starts + starts[-1])
        return Trajectory(*map(np.concatenate, zip(way, later, strict=True)))

    def piece(self, t: float) -> int:
        """Index of the piece that contains time t [s]."""
        return max(0, int(np.searchsorted(self.starts, t, side="right")) - 1)

    def pieces(self, begin: int, end: int) -> Trajectory:
        """The pieces from index `begin` until before `end`, the last of which is taken never to end."""
        return Trajectory(*(part[begin:end] for part in self))

    def state(self, i: int, tau: float) -> Angles:
        """The state in piece i at time τ since its start [s]. Shapes (1, 3)."""
        return Angles(*(part[0] for part in self.pieces(i, i + 1).at(np.array([[tau]]))))

    def at(self, tau: Floats) -> Angles:
        """Angles of every piece at times τ since its start [s]. Shape of τ: (n, m), of the angles (n, m, 3)."""
        tau = tau[:, :, None]
        angle, rate, acceleration = np.zeros((3, *tau.shape[:2], 3))
        for power in reversed(range(POWERS)):  # Horner's rule, for the polynomial and its derivatives at once
            acceleration = acceleration * tau + 2 * rate
            rate = rate * tau + angle
            angle = angle * tau + self.quintic[:, None, power]
        amplitude, f = self.amplitude[:, None], self.frequency[:, None]
        return Angles(
            angle + amplitude * np.sin(f * tau),
            rate + amplitude * f * np.cos(f * tau),
            acceleration - amplitude * f * f * np.sin(f * tau),
        )

    def samples(self) -> Angles:
        """Samples of the quintics, dense enough for their extremes, piece after piece. Shapes (n, 3)."""
        return Angles(*self._sampled(3))

    def _sampled(self, count: int) -> list[Floats]:
        """The first `count` of the quintics' angle, rate, acceleration and jerk at the samples [rad/sᵖ], (n, 3) each.

        The columns are contiguous. The last piece, which does not move, has its samples, too.
        """
        lengths = np.append(np.diff(self.starts), 0.0)[:, None]
        coefficients = self.quintic
        sampled = []
        for _ in range(count):
            powers = np.arange(coefficients.shape[1])
            of_shares = coefficients * (lengths**powers)[:, :, None]
            by_axis = of_shares.transpose(2, 0, 1).reshape(-1, len(powers))
            sampled.append((by_axis @ _BASIS[: len(powers)]).reshape(3, -1).T)
            coefficients = coefficients[:, 1:] * powers[1:, None]
        return sampled

    @property
    def swings(self) -> bool:
        """Whether the last piece is a sinusoid."""
        return bool((self.amplitude[-1] * self.frequency[-1]).any())

    def peaks(self) -> Floats:
        """The largest |angle|, |rate|, |acceleration| and |jerk| of roll, pitch, yaw [rad/sᵖ]. Shape (4, 3)."""
        swing, f = np.abs(self.amplitude[-1]) * (self.frequency[-1] > 0), self.frequency[-1]
        largest = [np.abs(part).max(axis=0) for part in self._sampled(4)]
        return np.asarray(np.maximum(largest, [swing, swing * f, swing * f**2, swing * f**3]))

    def largest(self, value: Callable[[Angles], Floats], terms: Floats) -> float:
        """The largest of a value of the angles: of the quintics' samples, and over all phases of the sinusoid.

        Axes whose frequencies have a ratio of small integers are locked to each other; all others come as near as one
        likes to every combination of phases. A grid covers these, and each cell that may hold the maximum is halved
        until the allowance for what lies between is small: the value is ‖v‖, v a sum of products of factors φ of one
        axis' phase each, with |φ| ≤ K, |φ'| ≤ nK, |φ''| ≤ n²K. From the maximum to the centre of its cell, up to d away
        in each phase, a product's second derivative is at most (d Σn)² ΠK, and ‖v‖' = 0 at the maximum. `terms` has a
        row a product: its size ΠK, and Σn for the phases of roll, pitch and yaw.
        """
        most = float(value(self.samples()).max())
        sizes, degrees = terms[:, 0], terms[:, 1:]
        locked = _locked(self.amplitude[-1] * degrees.max(axis=0), self.frequency[-1])
        axes = len(locked)
        if not axes:
            return most
        bend = sizes @ (np.abs(locked) @ degrees.T).sum(axis=0) ** 2 / 2
        d = pi / _CELLS[axes]
        phases = np.stack(np.meshgrid(*[np.arange(d, 2 * pi, 2 * d)] * axes), axis=-1).reshape(-1, axes)
        halves = np.array(list(combinations((-0.5, 0.5), repeat=axes)))
        while True:
            found = value(self.swing(phases @ locked))
            most = max(most, float(found.max()))
            allowance = float(d**2 * bend) + _ROUNDED * most
            phases = phases[found >= most - allowance]
            if not allowance > _TOLERANCE * most or len(phases) * len(halves) > _MOST_CELLS:
                return most + allowance
            phases = (phases[:, None] + d * halves).reshape(-1, axes)
            d /= 2

    def swing(self, phase: Floats) -> Angles:
        """Angles of the last piece's sinusoid at phases of roll, pitch, yaw [rad]. Shapes (n, 3)."""
        a, f = self.amplitude[-1], self.frequency[-1]
        return Angles(a * np.sin(phase), a * f * np.cos(phase), -a * f * f * np.sin(phase))

    def fastest(self) -> float:
        """The largest angular velocity [rad/s]."""
        angle, (roll, pitch, yaw), *_ = self.peaks()
        terms = np.array([[roll, 1, 0, 0], [pitch, 0, 1, 0], [yaw, 0, turning(angle)[1], 1]])
        return self.largest(Angles.speeds, terms)

    def steepest(self) -> float:
        """The largest angle between the body's z axis and the vertical [rad]."""
        terms = np.array([[0.5, *turning(self.peaks()[0])[:2], 0]])
        return 2 * asin(min(1.0, self.largest(lambda at: np.sin(at.tilts() / 2), terms)))

    def check(self, limits: Limits) -> None:
        """Raise FollowError if the reference itself, however it is reached, goes beyond the limits."""
        with np.errstate(over="ignore", invalid="ignore"):  # a rate that is not finite counts as too fast
            if self.swings:
                fastest, tilt = self.fastest(), self.steepest()
            else:
                fastest, tilt = self._beyond(limits)
        if not fastest <= limits.rate * _LIMIT_SLACK:
            raise FollowError(
                f"the reference itself turns at {fastest:.2f} rad/s, more than controller.max_reference_rate = "
                f"{limits.rate:g} rad/s, however it is approached: make it slower or smaller"
            )
        if tilt > limits.tilt * _LIMIT_SLACK:
            raise FollowError(
                f"the reference itself tilts by {degrees(tilt):.1f}°, more than controller.max_reference_tilt_deg = "
                f"{degrees(limits.tilt):g}°, however it is approached"
            )
        if not limits.rolls and self.peaks()[0, 0] > 0:
            raise FollowError("this vehicle has no motor that rolls it: set its roll to 0")

    def _beyond(self, limits: Limits) -> tuple[float, float]:
        """The largest angular velocity [rad/s] and tilt [rad] of a trajectory that comes to rest, where beyond limits.

        Sines and cosines are computed only of the samples of which a quicker bound is not within the limit. What is
        within it counts as 0, but for the attitude that is held at last.
        """
        speeds = [0.0]
        roll, pitch, _ = self.quintic[-1, 0].tolist()
        tilts = [acos(cos(roll) * cos(pitch))]
        for begin in range(0, len(self.starts) - 1, _CHUNK):
            samples = self.pieces(begin, begin + _CHUNK + 1).samples()
            fast = samples.rows(~(samples.speed_bounds() <= limits.rate))
            tilted = samples.rows(~(samples.tilt_bounds() <= limits.tilt))
            speeds.append(float(fast.speeds().max(initial=0.0)))
            tilts.append(float(tilted.tilts().max(initial=0.0)))
        return float(np.max(speeds)), float(np.max(tilts))


def turning(amplitude: Floats) -> Floats:
    """The degree n of cos and sin of A sin x as factors of x, in `Trajectory.largest`. Shape as given."""
    return np.asarray(np.sqrt(np.where(amplitude < 0.5, amplitude, amplitude**2 + 0.25)))


def _locked(amplitude: Floats, frequency: Floats) -> Floats:
    """The phases of roll, pitch, yaw as multiples of phases that are free of each other. Shape (m, 3)."""
    rows, left = list[Floats](), [i for i in range(3) if amplitude[i] and frequency[i]]
    while left:
        row, first = np.zeros(3), frequency[left[0]]
        ratios = {i: (Fraction(frequency[i]) / Fraction(first)).limit_denominator(_COMMON) for i in left}
        near = {i: r for i, r in ratios.items() if 0 < r.numerator <= _COMMON}
        near = {i: r for i, r in near.items() if abs(float(r) * first / frequency[i] - 1) < 1e-12}
        common = lcm(*(r.denominator for r in near.values()))
        for i, r in near.items():
            row[i] = r * common
        rows.append(row)
        left = [i for i in left if i not in near]
    return np.array(rows).reshape(-1, 3)


# ── points without overshoot ──
#
# The rate of a quintic that goes on by D in T seconds, from rate v to w and acceleration a to b, is a quartic. Its
# coefficients in Bernstein's polynomials are v, v + aT/4, 5D/T − 2(v + w) − (a − b)T/4, w − bT/4 and w. Where none of
# them has another sign than D, the angle never turns back, so it stays between the two points. As Fritsch and Carlson
# do it for cubics ("Monotone piecewise cubic interpolation", SIAM J. Numer. Anal. 17, 1980), rates and accelerations
# are differences that are reduced until that holds.

_STEEPEST: Final = 1.25
"""Largest rate at a point, as a multiple of D/T on either side: then 5D/T − 2(v + w) has the sign of D."""


def _monotone_rates(times: Floats, angles: Floats, differences: Floats) -> Floats:
    """Rates at all points but the first and the last: 0 where the angle turns back. Shape (n − 2, 3)."""
    slopes = np.diff(angles, axis=0) / np.diff(times)[:, None]
    before = slopes[:-1]
    after = slopes[1:]
    goes_on = np.sign(before) == np.sign(after)
    most = np.where(goes_on, _STEEPEST * np.minimum(np.abs(before), np.abs(after)), 0.0)
    return np.clip(differences, -most, most)


def _monotone_accelerations(times: Floats, angles: Floats, rates: Floats, differences: Floats) -> Floats:
    """Accelerations at all points but the first and the last, by `rates` at all of them. Shape (n − 2, 3)."""
    lengths = np.diff(times)[:, None]
    ways = np.diff(angles, axis=0)
    begin = np.abs(rates[:-1])
    end = np.abs(rates[1:])
    # Of the third coefficient each end may take half; of the second and the fourth, what its own rate leaves.
    middle = np.maximum(0.0, 2 * (5 * np.abs(ways) / lengths - 2 * (begin + end)) / lengths)
    rises = ways > 0
    least_begin = np.where(rises, -4 * begin / lengths, -middle)
    most_begin = np.where(rises, middle, 4 * begin / lengths)
    least_end = np.where(rises, -middle, -4 * end / lengths)
    most_end = np.where(rises, 4 * end / lengths, middle)
    least = np.maximum(least_end[:-1], least_begin[1:])
    most = np.minimum(most_end[:-1], most_begin[1:])
    return np.clip(differences, least, most)


def join(here: Angles, there: Angles, length: Floats) -> Floats:
    """The quintics from states `here` to states `there` in `length` seconds. Shapes (n, 3), (n,), (n, 6, 3)."""
    (p, v, a), T = here, length[:, None]
    angle = there.angle - (p + v * T + a * T * T / 2)
    rate = (there.rate - (v + a * T)) * T
    acceleration = (there.acceleration - a) * T * T
    third = (10 * angle - 4 * rate + acceleration / 2) / T**3
    fourth = (-15 * angle + 7 * rate - acceleration) / T**4
    fifth = (6 * angle - 3 * rate + acceleration / 2) / T**5
    return np.stack([p, v, a / 2, third, fourth, fifth], axis=1)


@cache
def reference_function() -> ca.Function:
    """A piece at time t ↦ q_d, ω_d, ω̇_d: desired attitude [1], angular velocity [rad/s], acceleration [rad/s²].

    The latter two are inertial. Inputs: t, start, quintic (3 × 6, a column a power), amplitude, frequency.
    """
    t, start, quintic = ca.SX.sym("t"), ca.SX.sym("start"), ca.SX.sym("quintic", 3, POWERS)
    amplitude, frequency = ca.SX.sym("amplitude", 3), ca.SX.sym("frequency", 3)
    tau, *circular = ca.SX.sym("tau"), *(ca.SX.sym(name, 3) for name in ("s_wave", "c_wave", "s_half", "c_half"))
    s_wave, c_wave, s_half, c_half = circular  # sines and cosines of the sinusoid's angles and of half the attitude's
    angles = ca.SX.zeros(3)
    for n in reversed(range(POWERS)):
        angles = angles * tau + quintic[:, n]
    angles += amplitude * s_wave
    waves, wave_rates = ca.vertcat(tau, s_wave, c_wave), ca.vertcat(1, frequency * c_wave, -frequency * s_wave)
    half_rates = ca.jtimes(angles, waves, wave_rates) / 2
    moving = ca.vertcat(waves, s_half, c_half)
    rates = ca.vertcat(wave_rates, c_half * half_rates, -s_half * half_rates)
    q_d = from_half_angles(s_half, c_half)
    omega_d = 2 * product(ca.jtimes(q_d, moving, rates), conjugate(q_d))[1:4]  # (C.12), solved for ω_d
    moved = [q_d, omega_d, ca.jtimes(omega_d, moving, rates)]

    piece = [quintic, amplitude, frequency]
    attitude = ca.Function("attitude", [tau, *piece, s_wave], [angles])
    motion = ca.Function("motion", [tau, *piece, *circular], moved, {"cse": True})
    inputs = {"t": t, "start": start, "quintic": quintic, "amplitude": amplitude, "frequency": frequency}
    with as_written():
        since = t - start
        wave = sine_cosine(frequency * since)
        half = sine_cosine(attitude(since, *piece, wave[0]) / 2)
        found = motion(since, *piece, *wave, *half)
        names = ["q_d", "omega_d", "omega_d_dot"]
        return ca.Function("reference", [*inputs.values()], [*found], [*inputs], names, {"cse": True})


def desired(reference: Reference, period: float, ticks: int) -> Floats:
    """q_d, ω_d, ω̇_d of a reference at each tick of a `period` [s], as `Motion` has them. Shape (ticks, 10)."""
    trajectory = Trajectory.of(reference)
    t = np.arange(ticks) * period
    piece = np.maximum(0, np.searchsorted(trajectory.starts, t, side="right") - 1)
    rows = t, *(part[piece] for part in trajectory)
    function = Compiled(reference_function().map(ticks))
    for memory, row in zip(function.inputs.values(), rows, strict=True):
        np.asarray(memory)[:] = row.ravel()
    function()
    return np.concatenate([np.asarray(memory).reshape(ticks, -1) for memory in function.outputs.values()], axis=1)
