"""Free rigid body with three motors and its own inertia, B and gains, through full turns and quantized feedback.

The plant's q turns on without a jump; the law receives only the quantized ε of the frames. For any number of bits it
must reconstruct the same q up to the quantizers, and neither lose the body nor shake it by more than their steps.

`_Slopes` derives how much the law's moment M = B u can change with its inputs; the largest step of a voltage between
two ticks and the largest attitude error follow from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import cos, radians, sin, sqrt

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.config import Settings, load, with_bits
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from tests.support import numpy_twin as twin
from tests.support.ideal import IDEAL
from tests.support.numpy_twin import Array
from tests.support.twin_body import body_of

BODY = (
    "inertia=[0.03, 0.02, 0.025]",
    "mass=0.8",
    "centre_of_mass=[0.001, -0.002, -0.003]",
    "allocation=[[0.03, 0.004, 0.0], [-0.003, 0.028, 0.005], [0.002, -0.004, 0.033]]",
)
"""What the plant is and the law believes. J, B and r_g are not the paper's, and B is full."""

OTHER = load(
    overrides=[
        "plant.kind=rigid_body",
        *IDEAL,
        "plant.voltage_limit=36",
        "plant.rigid_body.damping=[0.012, 0.008, 0.015]",
        "law.C1=[0.5, 0.6, 0.4]",
        "law.C2=[0.35, 0.3, 0.4]",
        "law.Gamma=[0.03, 0.01, 0.02]",
        "law.damping_estimate=[0.0, 0.0, 0.0]",
        "law.damping_bound=0.04",
        "wire.actuators=3",
        "wire.rate.limit=2.0",
        "wire.voltage.limit=36",
        "loop.rate_hz=250",
        "reference.amplitude=[400.0, 30.0, 400.0]",
        "reference.frequency=[0.1, 0.13, 0.08]",
        *(f"plant.rigid_body.{value}" for value in BODY),
        *(f"law.{value}" for value in BODY),
    ]
)
"""400° is more than a turn, to and fro; roll and yaw do it in turns of different length, with up to 0.9 rad/s."""

BITS = ("6", "10", "cont")
SECONDS = 60.0


@cache
def _desired(k: int) -> tuple[Array, Array, Array]:
    """q_d, ω_d and ω̇_d at tick k, by the twin; every run here follows the same reference."""
    assert isinstance(OTHER.reference, Sinusoid)
    reference = twin.Sinusoids(np.radians(OTHER.reference.amplitude), np.array(OTHER.reference.frequency))
    return reference.desired(k * OTHER.loop.period)


@dataclass(frozen=True)
class Run:
    """A run; rows are ticks. q and ω are true, q_seen and omega_seen as the controller reports them.

    θ is θ̂ as it was when the tick's voltages were computed.
    """

    settings: Settings
    frames: list[bytes]
    saturated: int
    q: Array
    omega: Array
    q_seen: Array
    omega_seen: Array
    q_d: Array
    omega_d: Array
    omega_d_dot: Array
    theta: Array
    voltages: Array
    sign: Array

    @property
    def e(self) -> Array:
        """q̄_d ⊗ q of the true attitude, which never jumps either. Shape (ticks, 4)."""
        eta_d, eps_d, eta, eps = self.q_d[:, :1], self.q_d[:, 1:], self.q[:, :1], self.q[:, 1:]
        scalar = eta_d * eta + np.sum(eps_d * eps, axis=1, keepdims=True)
        return np.hstack([scalar, eta_d * eps - eta * eps_d - np.cross(eps_d, eps)])


def _run(settings: Settings, first_tick: int, seconds: float) -> Run:
    """The closed loop in lockstep, through real frames."""
    loop, wire = settings.loop, settings.wire
    plant = settings.plant.build(loop.period)
    endpoint = Endpoint(plant, wire, loop.period_ns, lockstep=True)
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    claim = Claim(controller="test", session="loop", period_ns=loop.period_ns, lockstep=True, auto_arm=True, wire=wire)
    assert isinstance(endpoint.claim(claim), Grant)
    frames: list[bytes] = []
    rows: list[tuple[object, ...]] = []
    measurement = endpoint.tick(None, 0)
    for k in range(first_tick, first_tick + loop.ticks(seconds)):
        assert measurement is not None
        frames.append(measurement)
        state, theta = plant.truth(), controller.law_state["damping_estimate"]
        command = controller.tick(measurement, k)
        rows.append(
            (
                state.attitude,
                state.rate,
                controller.attitude,
                controller.rate,
                *_desired(k),
                theta,
                tuple(controller.voltages),
                controller.law_state["sign"],
            )
        )
        measurement = endpoint.tick(command, k + 1 - first_tick)
    assert endpoint.accepted == len(frames)
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    return Run(settings, frames, endpoint.saturated + controller.saturated, *columns)


def _started(settings: Settings, q: Array, omega: Array) -> Settings:
    """The same, with the body at another attitude and rate at the start."""
    body = settings.plant.rigid_body.model_validate(
        settings.plant.rigid_body.model_dump() | {"attitude": q.tolist(), "rate": omega.tolist()}
    )
    return settings.model_copy(update={"plant": settings.plant.model_copy(update={"rigid_body": body})})


@cache
def _through_full_turns(bits: str) -> Run:
    """From the reference's own attitude and rate at t = 0, so that there is nothing to settle."""
    settings = with_bits(OTHER, f"{bits}/{bits}")
    q_d, omega_d, _ = _desired(0)
    return _run(_started(settings, q_d, omega_d), 0, SECONDS)


# What quantizers may do


def _bound(signal: SignalSpec) -> float:
    """The largest error of three quantized components, as a vector's length."""
    return sqrt(3) * signal.quantizer().bound


def _steps(signal: SignalSpec) -> float:
    """One level of three components: twice their bound, as the levels are uniform."""
    return 2 * _bound(signal)


def _worst_attitude(signal: SignalSpec) -> float:
    """How far q^Q can be from q.

    ε is known to δ. η = √(1 − εᵀε), and |√a − √b| ≤ √|a − b|, where a − b is at most 2δ + δ²: the worst is near η = 0.
    Scaling ε to unit length (Remark 2) takes it nearer to every unit ε, so it makes nothing worse.
    """
    delta = _bound(signal)
    return sqrt(delta**2 + (2 * delta + delta**2))


def paper_s(settings: Settings) -> AdaptiveSettings:
    assert isinstance(settings.law, AdaptiveSettings)
    return settings.law


@dataclass(frozen=True)
class _Slopes:
    """How much the moment M = B u of (C.37) changes, at most, with a change of each thing in it [N·m per unit].

    By the triangle's inequality, term by term: R(q) changes by 2 per q, ω_e by ω's own and that of R ω_d; C₁, C₂ and J
    stand for their largest elements; W, Ω, E are the largest |ω_d|, |ω^Q|, |ω_e|.
    """

    q: float
    omega: float
    q_d: float
    omega_d: float
    omega_d_dot: float
    theta: float

    @classmethod
    def of(cls, run: Run) -> _Slopes:
        """For the rates that the run came to."""
        p = paper_s(run.settings)
        C1, C2, J = max(p.C1), max(p.C2), max(p.inertia)
        weight = p.mass * p.gravity * float(np.linalg.norm(p.centre_of_mass))
        W = _largest(run.omega_d)
        Omega = _largest(run.omega_seen)
        W_dot = _largest(run.omega_d_dot)
        E = Omega + W
        error = (1 + C1 * C2) + J * C1 / 2 * E  # ε̃ in −G z₁ − C₂ z₂; e in J ᾱ
        rate_error = C2 + J * C1 / 2  # ω_e in −C₂ z₂ and J ᾱ
        return cls(
            q=error + 2 * W * rate_error + 2 * weight + J * (2 * Omega * W + 2 * W_dot),
            omega=rate_error + p.damping_bound / 0.95 + 2 * J * Omega + J * W,  # …, Φ θ̂, ω × J ω, J S(ω) R ω_d
            q_d=error,
            omega_d=rate_error + J * Omega,
            omega_d_dot=J,
            theta=Omega,
        )


def _largest(rows: Array) -> float:
    return float(np.linalg.norm(rows, axis=1).max())


def _changes(rows: Array) -> Array:
    """How far each row is from the one before. Shape (ticks − 1,)."""
    lengths: Array = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    return lengths


def _crossings(eta: Array) -> int:
    """How often it changes its sign; to stay at 0 for a while, as a quantized η does, is not to change it."""
    return int(np.count_nonzero(np.diff(np.sign(eta[eta != 0]))))


def _explained_error(run: Run) -> Array:
    """The largest |ε̃| that the quantizers, and what the law does not know of θ, explain. Shape (ticks,).

    Near ε̃ = 0 the closed loop is 2J ë + (J C₁ + 2C₂) ė + (1 + C₁C₂) e = d for each axis, more than critically damped,
    so that its impulse response h does not change its sign and |e| ≤ h ∗ |d|; where axes differ, the largest h counts.
    The moment d is what the law would have commanded otherwise, had it known q, ω and θ, with what the quantizer of u
    takes away and what changes while u is held.
    """
    p, wire = paper_s(run.settings), run.settings.wire
    slopes, period = _Slopes.of(run), run.settings.loop.period
    d = (
        slopes.q * np.linalg.norm(run.q_seen - run.q, axis=1)
        + slopes.omega * _bound(wire.rate)
        + slopes.theta * np.linalg.norm(run.theta - np.array(run.settings.plant.rigid_body.damping), axis=1)
        + float(np.linalg.norm(p.allocation, ord=2)) * _bound(wire.voltage)
        + slopes.q * _changes(run.q).max()
        + slopes.omega * _changes(run.omega).max()
    )
    t = np.arange(period, 10.0, period)
    responses = []
    for J, C1, C2 in zip(p.inertia, p.C1, p.C2, strict=True):
        fast, slow = np.roots([2 * J, J * C1 + 2 * C2, 1 + C1 * C2])
        assert np.isreal(fast)
        assert np.isreal(slow)
        responses.append((np.exp(slow * t) - np.exp(fast * t)) / (2 * J * (slow - fast)))
    bound: Array = np.convolve(d, np.max(responses, axis=0) * period)[: len(d)]
    return bound


# Through full turns


@pytest.mark.parametrize("bits", BITS)
def test_eta_passes_zero_again_and_again_and_nothing_saturates(bits: str) -> None:
    """Else the tests below would promise less than they say."""
    run = _through_full_turns(bits)
    true, seen = run.q[:, 0], run.q_seen[:, 0]
    assert _crossings(true) >= 4
    assert true.min() < -0.8  # far enough to mean it
    assert true.max() > 0.8
    assert _crossings(seen) == _crossings(true)
    assert run.saturated == 0


@pytest.mark.parametrize("bits", BITS)
def test_the_sign_of_q_goes_on_while_that_of_what_is_sent_turns_over(bits: str) -> None:
    run = _through_full_turns(bits)
    attitude = run.settings.wire.attitude
    # εᵀε rounds by 2e-16, and near η = 0 η by its root
    assert np.linalg.norm(run.q_seen - run.q, axis=1).max() <= _worst_attitude(attitude) + 3e-8
    level = attitude.quantizer().level
    sent = []
    for frame in run.frames:
        read = run.settings.wire.measurement.unpack(frame)
        assert read is not None
        sent.append([level(code) for code in read[1][:3]])
    jumps = _changes(np.array(sent)) > 1  # where η = 0, ‖ε‖ = 1 and so it jumps by 2
    assert np.count_nonzero(jumps) == _crossings(run.q[:, 0])


@pytest.mark.parametrize("bits", BITS)
def test_the_attitude_error_stays_within_what_the_quantizers_explain(bits: str) -> None:
    """And it is the error of the true attitude that does, from the first tick on: the body never starts to unwind."""
    run = _through_full_turns(bits)
    explained = _explained_error(run)
    assert explained.max() < 0.5  # a body that lets go passes |ε̃| = 1
    assert (np.linalg.norm(run.e[:, 1:], axis=1) <= explained).all()
    assert run.e[:, 0].min() > 0
    assert (run.sign == 1).all()


@pytest.mark.parametrize("bits", BITS)
def test_no_voltage_jumps_by_more_than_a_level_of_each_input_and_smooth_motion_explain(bits: str) -> None:
    run = _through_full_turns(bits)
    wire, slopes = run.settings.wire, _Slopes.of(run)
    # Neighbouring values fall into the same interval or neighbouring ones: |Q(a) − Q(b)| ≤ |a − b| + l.
    eps = _changes(run.q[:, 1:]) + _steps(wire.attitude)
    omega = _changes(run.omega) + _steps(wire.rate)
    # η² = 1 − εᵀε changes by 2 ‖Δε‖ at most, so η by that over |η| + |η'|, or by its root. Where η passes zero and is
    # seen as −η, both are at most what (C.11) can make of η = 0.
    eta = np.abs(run.q_seen[:, 0])
    change = np.minimum(np.sqrt(2 * eps), 2 * eps / np.maximum(eta[1:] + eta[:-1], 1e-12))
    crossing = run.q_seen[1:, 0] * run.q_seen[:-1, 0] < 0
    change[crossing] = 2 * (_worst_attitude(wire.attitude) + _changes(run.q)[crossing])
    moment = (
        slopes.q * np.hypot(eps, change)
        + slopes.omega * omega
        + slopes.q_d * _changes(run.q_d)
        + slopes.omega_d * _changes(run.omega_d)
        + slopes.omega_d_dot * _changes(run.omega_d_dot)
        + slopes.theta * _changes(run.theta)
    )
    explained = moment * float(np.linalg.norm(np.linalg.inv(run.settings.law.allocation), ord=2))
    assert (_changes(run.voltages) <= explained).all()


@pytest.mark.parametrize("bits", BITS)
def test_every_voltage_is_the_laws_for_the_attitude_that_never_jumped(bits: str) -> None:
    """The twin decodes the frame, and takes the sign of q from the truth."""
    run = _through_full_turns(bits)
    wire, body = run.settings.wire, body_of(paper_s(run.settings))
    attitude, rate = wire.attitude.quantizer().level, wire.rate.quantizer().level
    crossed = np.flatnonzero(np.diff(np.sign(run.q[:, 0])))
    near = {int(k) for at in crossed for k in range(at - 20, at + 20)}
    for k in sorted(near | set(range(0, len(run.frames) - 1, 25))):
        read = wire.measurement.unpack(run.frames[k])
        assert read is not None
        codes = read[1]
        q = twin.reconstructed(np.array([attitude(code) for code in codes[:3]]), run.q[k])
        omega = np.array([rate(code) for code in codes[3:]])
        state = twin.law(body, q, omega, run.q_d[k], run.omega_d[k], run.omega_d_dot[k], run.theta[k], 1.0)
        # Some hundred operations of 2e-16, but η = √(1 − εᵀε) rounds by 1e-16/η; the nearest of these ticks has 1e-4.
        assert run.voltages[k] == pytest.approx(state.u, abs=1e-9)
        theta_next = run.theta[k] + run.settings.loop.period * state.theta_dot
        assert run.theta[k + 1] == pytest.approx(theta_next, abs=1e-14)  # rounding, of 0.01 at most
    assert len(near) >= 4 * 40
    assert _largest(run.theta[-1:] - run.theta[:1]) > 1e-4  # it does adapt


# Towards the other equilibrium


def _product(p: Array, q: Array) -> Array:
    """p ⊗ q."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.append(p[0] * q[0] - p[1:] @ q[1:], vector)


AWAY = radians(60)
"""How far the body is from the desired attitude at the start."""


def _from_behind(bits: str, seconds: float, sign: float = 1.0) -> Run:
    """From where q_d has its smallest η, with q of η ≥ 0 as received: η̃ < 0. `sign` is that of the plant's own q."""
    settings = with_bits(OTHER, f"{bits}/{bits}")
    first = min(range(settings.loop.ticks(SECONDS)), key=lambda k: float(_desired(k)[0][0]))
    q_d, omega_d, _ = _desired(first)
    away = np.append(cos(AWAY / 2), sin(AWAY / 2) * np.array([1, 2, -2]) / 3)
    q = _product(q_d, away)
    q *= sign if q[0] >= 0 else -sign
    return _run(_started(settings, q, twin.rotation(q).T @ omega_d), first, seconds)


@pytest.mark.parametrize("bits", BITS)
def test_a_start_with_negative_eta_of_the_error_goes_the_short_way_and_stays_there(bits: str) -> None:
    run = _from_behind(bits, SECONDS)
    assert run.q_d[0, 0] < -0.8
    assert run.q[0, 0] > 0
    assert run.e[0, 0] < -0.8  # cos 30°
    assert (run.sign == -1).all()
    assert _crossings(run.q[:, 0]) >= 4
    assert run.saturated == 0
    error, explained = np.linalg.norm(run.e[:, 1:], axis=1), _explained_error(run)
    assert run.e[:, 0].max() < 0  # the long way would pass η̃ = 0
    assert error.max() <= sin(AWAY / 2) + explained.max()
    # The slowest pole, near −2.4 1/s, has made less than 1e-5 of the start after 5 s.
    settled = run.settings.loop.ticks(5.0)
    assert (error[settled:] <= explained[settled:]).all()


@pytest.mark.parametrize("bits", BITS)
def test_the_loop_cannot_distinguish_q_from_minus_q_in_the_plant(bits: str) -> None:
    one, other = _from_behind(bits, 10.0), _from_behind(bits, 10.0, -1.0)
    assert (one.q == -other.q).all()
    assert one.frames == other.frames
    assert (one.voltages == other.voltages).all()
