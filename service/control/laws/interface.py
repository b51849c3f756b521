"""Law interface: settings, with the body that a law knows, and one tick, as CasADi expressions or as Python.

Each tick the controller gives a law the attitude and rate as received, the desired motion and the errors between them,
and takes voltages. What a law carries from tick to tick is its named state, which telemetry and logs have, so that a
replay can begin anywhere. Gains are those of its settings that an operator may change while it runs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Final, Generic, NamedTuple, TypeVar, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat

from aeroloop.protocol.wire.attitude import R, S

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
X = TypeVar("X")
T = TypeVar("T", bound="LawSettings")

MAX_GAIN: Final = 20.0  # no typing error makes one a hundred times too large
Gain = Annotated[float, Field(ge=0, le=MAX_GAIN)]
Gains3 = tuple[Gain, Gain, Gain]  # one for each body axis: x, y, z
PositiveGain = Annotated[float, Field(gt=0, le=MAX_GAIN)]
MatrixGain = tuple[PositiveGain, PositiveGain, PositiveGain]
"""The same of a gain that must act: the diagonal of a positive definite matrix."""
Diagonal = tuple[PositiveFloat, PositiveFloat, PositiveFloat]  # the diagonal of a positive definite matrix
_Row = Annotated[tuple[float, ...], Field(min_length=1, max_length=8)]


class LawSettings(BaseModel):
    """Settings of a law: `[law]` of the configuration. A law's own model derives from it and adds fields with units.

    All have a model of the plant, which stays where only the kind is changed. The default is Table C.1.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="strings")

    kind: str = Field(description="which law: one of ours, or package.module:Class")
    inertia: Diagonal = Field(default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]")
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: Vector = Field(
        default=(0.0, 0.0, -0.0038), description="r_g, origin to centre of mass, body frame [m]"
    )
    allocation: tuple[_Row, _Row, _Row] = Field(
        default=((1.0, 0.0, 0.0), (0.0, 0.0011, 0.0011), (0.0, -0.0014, 0.00176)),
        description="B, control allocation of rank 3, a column for each motor: voltages u turn the body with "
        "the torque +B u, body frame [N·m/V]; the Aero's first row and column are fictitious",
    )


class EstimateSettings(LawSettings):
    """Model of the plant, and what is known of its damping: its first estimate, and a ball around that."""

    damping_estimate: Vector = Field(
        default=(0.0, 0.0070, 0.0095), description="θ̂(t0), first estimate of the damping [N·m·s/rad]"
    )
    damping_bound: float = Field(
        default=0.03,
        gt=0,
        le=100,
        description="k_θ: ‖θ − θ̂(t0)‖ is assumed to be below this, and a law that adapts keeps ‖θ̂ − θ̂(t0)‖ below "
        "k_θ/0.95 [N·m·s/rad]",
    )


class Now(NamedTuple, Generic[X]):
    """What a law computes a tick from, as CasADi columns or as arrays.

    The error e = q_d⁻¹ ∘ q, (C.16), is the body relative to the desired frame: [1, 0, 0, 0] without error. A torque
    along −e[1:4] turns back the shorter way if e[0] ≥ 0; −e is the same attitude.
    """

    attitude: X  # q, body relative to inertial, as received; scalar part first [1]. Shape (4,)
    rate: X  # ω as received, body frame [rad/s]. Shape (3,)
    desired_attitude: X  # q_d, relative to inertial [1]. Shape (4,)
    desired_rate: X  # ω_d, *inertial* frame: R(q)ᵀω_d is in the body frame [rad/s]. Shape (3,)
    desired_acceleration: X  # its derivative, inertial frame [rad/s²]. Shape (3,)
    attitude_error: X  # e [1]. Shape (4,)
    rate_error: X  # ω − R(q)ᵀω_d, (C.18), *body* frame [rad/s]. Shape (3,)
    gains: Mapping[str, X]  # the present value of each of `Law.gains`. Shape (1,) for a number, else its length
    state: Mapping[str, X]  # after the last tick


class Law(ABC, Generic[T]):
    """A control law, for ticks of a period [s] and a number of voltages. Derive from `ExpressionLaw` or `PythonLaw`.

    Its settings are an instance of the class's `Settings`, as configured; a gain's present value is in `Now.gains`. A
    constructor raises ValueError if it is no law for so many actuators.
    """

    Settings: ClassVar[type[LawSettings]]  # the model of its settings
    gains: ClassVar[tuple[str, ...]] = ()
    """Names of those settings that may change while it runs: numbers, or tuples of them."""
    units: ClassVar[Mapping[str, str]] = {}
    """Unit of each part of its named state, for tables and pages; 1 where none is given."""

    def __init__(self, settings: T, period: float, actuators: int) -> None:
        self.settings, self.period, self.actuators = settings, period, actuators


class ExpressionLaw(Law[T]):
    """A law of CasADi expressions."""

    def initial(self) -> Mapping[str, Sequence[float]]:
        """The named state before the first tick; its names and sizes are those of every tick."""
        return {}

    @abstractmethod
    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """The voltages before quantization [V], shape (actuators,), and the named state after this tick."""


class PythonLaw(Law[T]):
    """A law in plain Python. `step` runs once a tick, between a received frame and the sent one: it must not block."""

    state: dict[str, Floats]
    """All that it carries from tick to tick, by name. What is kept elsewhere is not in logs, and does not replay."""

    @abstractmethod
    def reset(self) -> None:
        """Set `state` to what it is before the first tick."""

    @abstractmethod
    def step(self, now: Now[Floats]) -> Sequence[float] | Floats:
        """The voltages before quantization [V], shape (actuators,). Sets `state` to what it is after this tick."""


def gravity_torque(p: LawSettings, q: X) -> X:
    """Torque of the weight about the origin at attitude q, body frame: −g of (C.45) [N·m]. Shape (3,).

    It acts on the body, so a law that cancels it subtracts it. Of a CasADi expression it is one, of numbers an array.
    """
    weight = ca.vertcat(0, 0, -p.mass * p.gravity)
    torque = S(ca.SX(p.centre_of_mass)) @ R(ca.SX(cast(Any, q))).T @ weight
    return cast(X, torque if isinstance(q, ca.SX) else np.asarray(ca.evalf(torque)).ravel())


def voltages_for(p: LawSettings, torque: Any, actuators: int) -> Any:
    """The voltages whose torque B u is this, the least ones if there are several [V]. Shape (actuators,).

    A B of three columns serves two motors, too: they are its last two, and the first row is fictitious. Of an
    expression it is one, of numbers an array. Raises ValueError if B has no inverse, or another number of columns.
    """
    B = check_allocation(p, actuators)
    if not isinstance(torque, ca.SX):
        return (np.linalg.pinv(B) @ np.asarray(torque, dtype=np.float64))[-actuators:]
    if B.shape == (3, 3):
        return ca.solve(ca.SX(B), torque)[3 - actuators :]
    return ca.mtimes(ca.SX(np.linalg.pinv(B)), torque)


def check_allocation(p: LawSettings, actuators: int) -> Floats:
    """B, if it fits so many motors and has an inverse; else ValueError with the key. Shape (3, columns)."""
    columns = {len(row) for row in p.allocation}
    fits = actuators in columns or (columns == {3} and actuators == 2)
    if len(columns) > 1 or not fits:
        found = "/".join(map(str, sorted(columns)))
        raise ValueError(f"law.allocation (B) has {found} columns for {actuators} actuators: one for each motor")
    B: Floats = np.array(p.allocation)
    check_invertible(B)
    return B


def check_invertible(B: Floats) -> None:
    """Raise ValueError, with the key, if B or a part of it has no inverse. Shape (n, m), n ≤ m."""
    if B.shape[0] > B.shape[1] or np.linalg.cond(B) > 1e12:
        raise ValueError("law.allocation (B) has no inverse: every axis needs a motor that acts on it")
