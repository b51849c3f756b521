"""Margins: how old a certificate lets commands become, and from what delay or loss a simulation diverges.

A command is as old as its measurement until the next command replaces it: hold + delay + lost frames · period. The
invariant set of the paper's body is proven up to a largest age, which a bisection finds; a set counts only if it lies
within the ranges that quantization presumes. Beside it, lockstep experiments with the paper's body, three torques and
nothing else, whose commands act some ticks later, or of which several in a row are lost, again and again. A run
diverges if the plant trips, or if ‖z‖ exceeds `DIVERGED` in its second half.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import floor, inf
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.plant_emulator.model.rigid_body import RigidBodySettings
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.lab.experiment import LoopEndedError, run_experiment
from aeroloop.service.lab.workers import Workers
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import beyond, premises
from aeroloop.service.theorem.extremes import extremes
from aeroloop.service.theorem.invariant import reach
from aeroloop.service.theorem.lemma import coordinates, rotation, times
from aeroloop.service.theorem.plant_bounds import paper_body

Bits = tuple[int | None, int | None]
"""Bits of ε and ω, and of u; None is float64."""

BITS: Final[tuple[Bits, ...]] = ((8, 6), (10, 8), (12, 12), (16, 16), (None, None))
RATES: Final = (100.0, 200.0, 500.0, 1000.0)
DURATION_S: Final = 20.0
DIVERGED: Final = 0.3
"""‖z‖ of a diverged run; an attitude error of 17° alone has as much [1, rad/s]."""
NO_SET: Final = "no set"
FLOAT64: Final = "float64"
OLDEST_S: Final = 1.0
"""Neither search goes beyond this age [s]."""
_RESOLUTION_S: Final = 1e-5


class Ages(NamedTuple):
    """Largest ages of a command [s], None where there is none at any age.

    Attributes:
        proven: With an invariant set.
        in_range: With one that lies within the ranges of the wire and of the voltages, which it presumes.
        limited_by: What fails beyond `in_range`.
    """

    proven: float | None
    in_range: float | None
    limited_by: str


class Margin(BaseModel):
    """Margins of one choice of bits and rate. Null where there is none; `limited_by` has the reason."""

    model_config = ConfigDict(frozen=True)

    bits_out: int | None = Field(description="bits of ε and ω; null is float64")
    bits_in: int | None = Field(description="bits of u; null is float64")
    rate_hz: float = Field(description="ticks a second [Hz]")
    set_age_ms: float | None = Field(description="largest age of a command with an invariant set, at any rate [ms]")
    age_ms: float | None = Field(description="the same, where the set lies within all ranges: what is proven [ms]")
    limited_by: str = Field(description="what fails at a larger age, or at any: `no set`, or a range that it exceeds")
    delay_ms: float | None = Field(description="largest proven delay, if no frame is lost: age less a period [ms]")
    lost_frames: int | None = Field(description="most frames lost in a row, if none is delayed")
    diverges_delay_ms: float | None = Field(
        description="least simulated delay that diverges [ms]; null: none up to 1 s"
    )
    diverges_lost_frames: int | None = Field(description="fewest frames lost in a row that diverge; null: none for 1 s")

    @property
    def bits(self) -> str:
        """Bits out and in, or float64."""
        if self.bits_out is self.bits_in is None:
            return FLOAT64
        return "/".join("cont" if bits is None else str(bits) for bits in (self.bits_out, self.bits_in))


class Margins(BaseModel):
    """The table."""

    model_config = ConfigDict(frozen=True)

    duration_s: float = Field(description="length of each simulated run [s]")
    diverged: float = Field(description="‖z‖ in the second half of a run that diverges [1, rad/s]")
    watchdog_ms: float = Field(description="plant.watchdog_s: longer delays and losses trip a real plant [ms]")
    damping_bound: float = Field(description="law.damping_bound [N·m·s/rad]")
    margins: list[Margin]


def measure_margins(
    settings: Settings,
    pairs: Sequence[Bits] = BITS,
    rates_hz: Sequence[float] = RATES,
    *,
    disturbance: float = 0.0,
    duration_s: float = DURATION_S,
    progress: Callable[[int, int], None] | None = None,
) -> Margins:
    """Margins of every choice of bits and rate, on every core.

    Args:
        settings: The configuration; each choice overrides bits and rate.
        pairs: Bits out and in.
        rates_hz: Ticks a second [Hz].
        disturbance: Further torque, for the certificate [N·m].
        duration_s: Length of each simulated run [s].
        progress: Called with searches done and searches in all.

    Raises:
        BoundlessError: A stream, as its set-points have no bounds.
        ValueError: The bits do not fit the kind of a quantizer, or the configuration a lockstep experiment.
    """
    chosen = [settings.model_copy(update={"wire": settings.wire.with_bits(*bits)}) for bits in pairs]
    at_rates = [_at_rate(each, rate) for each in chosen for rate in rates_hz]
    jobs = [(each.description(), lost, duration_s) for each in at_rates for lost in (False, True)]
    total = len(jobs) + len(chosen)
    report = progress or (lambda _done, _total: None)
    report(0, total)
    ages = list[Ages]()
    for i, each in enumerate(chosen, 1):
        ages.append(largest_ages(each, disturbance))
        report(i, total)
    with Workers() as workers:
        found = workers.each(diverges_at, jobs, lambda done: report(len(ages) + done, total))
    rows = [(bits, age, rate) for bits, age in zip(pairs, ages, strict=True) for rate in rates_hz]
    return Margins(
        duration_s=duration_s,
        diverged=DIVERGED,
        watchdog_ms=settings.plant.watchdog_s * 1e3,
        damping_bound=with_theorem(settings).law.damping_bound,
        margins=[_margin(*row, *found[2 * i : 2 * i + 2]) for i, row in enumerate(rows)],
    )


def _margin(bits: Bits, ages: Ages, rate_hz: float, delayed: int | None, lost: int | None) -> Margin:
    period = 1 / rate_hz
    delay = None if ages.in_range is None or ages.in_range < period else ages.in_range - period
    return Margin(
        bits_out=bits[0],
        bits_in=bits[1],
        rate_hz=rate_hz,
        set_age_ms=_ms(ages.proven),
        age_ms=_ms(ages.in_range),
        limited_by=ages.limited_by,
        delay_ms=_ms(delay),
        lost_frames=None if delay is None else floor(delay / period),
        diverges_delay_ms=None if delayed is None else _ms(delayed * period),
        diverges_lost_frames=lost,
    )


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1e3, 3)


def _at_rate(settings: Settings, rate_hz: float) -> Settings:
    return settings.model_copy(update={"loop": settings.loop.model_copy(update={"rate_hz": rate_hz})})


def largest_ages(settings: Settings, disturbance: float = 0.0) -> Ages:
    """The largest ages of a command with a proven set. Arguments as of `measure_margins`."""
    desired = extremes(settings.reference)
    p = premises(settings, desired, paper_body(settings), disturbance)

    def failing(age: float) -> str | None:
        now = replace(p, age=age)
        at = reach(now)
        return NO_SET if at is None else ", ".join(key for *_, key in beyond(settings, desired, now, at)) or None

    proven, _ = _last(lambda age: failing(age) != NO_SET)
    in_range, larger = _last(lambda age: failing(age) is None)
    return Ages(proven, in_range, failing(larger) or "")


def _last(holds: Callable[[float], bool]) -> tuple[float | None, float]:
    """The last age at which it holds, by bisection, and the first at which it does not [s]; None if at none."""
    low, high = 0.0, OLDEST_S
    if not holds(low):
        return None, low
    while high - low > _RESOLUTION_S:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low, high


def diverges_at(config: dict[str, Any], lost: bool, duration_s: float) -> int | None:
    """The least delay in ticks, or the fewest frames lost in a row, from which on runs diverge, by bisection.

    Args:
        config: Dump of a configuration.
        lost: Whether frames are lost, or else late.
        duration_s: Length of each run [s].

    Returns:
        0 if it diverges in any case; None if it does not within a second.
    """
    settings = Settings.model_validate(config)

    def diverges(ticks: int) -> bool:
        late = {"lost": ticks} if lost else {"delay": ticks}
        return largest_error(settings, duration_s, **late) > DIVERGED

    return least(diverges, settings.loop.ticks(0.1), settings.loop.ticks(OLDEST_S))


def least(fails: Callable[[int], bool], guess: int, most: int) -> int | None:
    """The least number that fails, if all larger ones do, by bisection from a guess; None if none up to `most` does."""
    low, high = 0, max(1, guess)
    while not fails(high):
        low, high = high, 2 * high
        if high > most:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fails(middle) else (middle, high)
    return 0 if high == 1 and fails(0) else high


def largest_error(settings: Settings, duration_s: float, *, delay: int = 0, lost: int = 0) -> float:
    """The largest ‖z‖ in the second half of a run of the paper's body [1, rad/s]; infinite if it trips.

    Args:
        settings: The configuration.
        duration_s: Length of the run [s].
        delay: How much later commands act [ticks].
        lost: Commands lost between two that act.
    """
    settings = three_torques(settings)
    loop, law = settings.loop, with_theorem(settings).law
    body = settings.plant.build(loop.period)
    controller = Controller(settings.wire, law, settings.reference, loop.period)
    rows = list[tuple[float, ...]]()

    def watch(k: int, _measurement: bytes, _command: bytes) -> None:
        if 2 * k >= loop.ticks(duration_s):
            true, c = body.truth(), controller
            rows.append(
                (*true.attitude, *true.rate, *c.attitude, *c.rate, *c.rate_error, *c.desired, *c.law_state["sign"])
            )

    try:
        run_experiment(settings, duration_s, watch=watch, plant=Late(body, delay, lost), controller=controller)
    except LoopEndedError:
        return inf
    q, omega, q_Q, omega_Q, omega_e_Q, q_d, sign = np.split(np.array(rows), [4, 7, 11, 14, 17, 21], axis=1)
    omega_d = times(rotation(q_Q), omega_Q - omega_e_Q)  # (C.47)
    return float(coordinates(q, omega, q_d, omega_d, sign[:, 0], np.array(law.C1)).norm.max())


def three_torques(settings: Settings) -> Settings:
    """The configuration with the paper's body for a plant: three torques, perfect sensors, no lag, no friction.

    An Aero becomes a body as the law assumes it, with θ = θ̂(0) and u₁ quantized as the others are.
    """
    plant, law, wire = settings.plant, with_theorem(settings).law, settings.wire
    if plant.kind == "aero":
        motors = np.array(law.allocation)[1:, 1:]
        allocation = np.diag([np.linalg.norm(motors, 2), 0.0, 0.0])
        allocation[1:, 1:] = motors
        law = law.model_copy(update={"allocation": tuple(map(tuple, allocation.tolist()))})
        wire = wire.model_copy(update={"actuators": 3})
        same = {name: getattr(law, name) for name in ("inertia", "mass", "gravity", "centre_of_mass", "allocation")}
        body = RigidBodySettings(**same, damping=law.damping_estimate)
        plant = plant.model_copy(update={"kind": "rigid_body", "rigid_body": body})
    plant = plant.model_copy(update={"ideal": True})
    return settings.model_copy(update={"plant": plant, "law": law, "wire": wire})


class Late(Plant):
    """A plant whose commands act `delay` ticks later, and of which `lost` in a row never do."""

    def __init__(self, plant: Plant, delay: int, lost: int) -> None:
        self.actuators = plant.actuators
        self._plant, self._every = plant, lost + 1
        self._due = deque([(0.0,) * plant.actuators] * delay)
        self._ticks = 0

    def actuate(self, voltages: Sequence[float]) -> None:
        """Take the command of a tick; the one that is due replaces the one in force."""
        self._due.append(tuple(voltages))
        due = self._due.popleft()
        if self._ticks % self._every == 0:
            self._plant.actuate(due)
        self._ticks += 1

    def advance(self) -> None:
        """Integrate one period."""
        self._plant.advance()

    def measure(self) -> Measurement:
        """Sensor values at the end of the last period."""
        return self._plant.measure()

    def close(self) -> None:
        """0 V."""
        self._plant.close()
