"""Adversary of the certificate: the worst loops that `adversary_loop` can build stay within what is proven."""

from __future__ import annotations

from functools import lru_cache
from math import radians, sin
from typing import Any, Final, NamedTuple

import numpy as np
import pytest

from aeroloop.service.config import Settings, load_over
from aeroloop.service.theorem.certificate import certify, evaluate, largest_voltage
from aeroloop.service.theorem.invariant import reach
from tests.support import adversary_loop as loop
from tests.support import certified
from tests.support.adversary_loop import Array
from tests.support.ideal import IDEAL

pytestmark = pytest.mark.realtime  # no clock decides, but its loops take 20 s
LEAST: Final = 0.1
"""What the adversary reaches of every bound of ‖z‖; of most it reaches 0.2 to 0.9."""


class Case(NamedTuple):
    """A configuration's overrides, and what the adversary may do.

    Commands may be `late` by these ticks, by frames lost in a row if `loss`, else by a delay that changes; τ_d may be
    `disturbance` [N·m], and ‖x(t₀)‖ this share of the radius.
    """

    changes: tuple[str, ...]
    late: int = 0
    loss: bool = False
    disturbance: float = 0.0
    start: float = 0.0


def bits(attitude: int | str, rate: int | str, voltage: int | str) -> tuple[str, ...]:
    return f"wire.attitude.bits={attitude}", f"wire.rate.bits={rate}", f"wire.voltage.bits={voltage}"


def swing(amplitude: str, frequency: str) -> tuple[str, ...]:
    return f"reference.amplitude=[{amplitude}]", f"reference.frequency=[{frequency}]"


def law(kind: str, *changes: str, hz: float = 250) -> tuple[str, ...]:
    return f"law.kind={kind}", f"loop.rate_hz={hz}", *(f"law.{change}" for change in changes)


def rotors(up: float, down: float) -> tuple[str, ...]:
    return f"plant.rotor.lag_up_s={up}", f"plant.rotor.lag_down_s={down}"


PERFECT: Final = (
    "loop.lockstep=true", "plant.friction.viscous=[]", "plant.friction.coulomb=[]", *rotors(0, 0),
    "plant.sensors.attitude=perfect", "plant.sensors.rate=perfect",
)  # fmt: skip
FREE: Final = ("loop.lockstep=true", *certified.FREE)
AERO: Final = (
    *PERFECT, *swing("0, 10, 40", "0, 0.1, 0.07"), "plant.aero.centre_of_mass=[0, 0, -0.0038]", "wire.voltage.limit=60",
    "plant.friction.viscous=[0.0071, 0.022]", "law.damping_estimate=[0.022, 0.0071, 0.022]", "law.damping_bound=0.003",
    "plant.voltage_limit=60",
)  # fmt: skip
HELD_ROLL: Final = (
    "loop.lockstep=true", *IDEAL, "law.damping_bound=0.0135", *swing("0, 10, 60", "0, 0.1, 0.07"),
)  # fmt: skip
BODY: Final = (
    "law.inertia=[0.02, 0.03, 0.01]", "plant.rigid_body.inertia=[0.02, 0.03, 0.01]",
    "law.centre_of_mass=[0.002, 0.001, -0.0038]", "plant.rigid_body.centre_of_mass=[0.002, 0.001, -0.0038]",
)  # fmt: skip
SWUNG: Final = (
    *FREE, *bits("cont", "cont", "cont"), *swing("60, 50, 80", "0.04, 0.04006, 0.04002"),
    "controller.max_reference_tilt_deg=90", "plant.limits.max_tilt_deg=90",
)  # fmt: skip
PATIENT: Final = (
    *FREE, *bits(16, 16, 16), *swing("0, 5, 10", "0, 0.1, 0.07"), "law.damping_estimate=[0, 0.006, 0.006]",
    "law.damping_bound=0.001", *law("pd", "kp=[0.02, 0.02, 0.02]", "kd=[0.05, 0.05, 0.05]"),
)  # fmt: skip
CASES: Final = {
    "8/8/6 bits": Case((*FREE, *bits(8, 8, 6), *law("adaptive"))),
    "10/6/6 bits, from afar": Case((*FREE, *bits(10, 6, 6), *law("adaptive")), start=0.3),
    "16 bits, 500 Hz": Case((*FREE, *bits(16, 16, 16), *law("adaptive", hz=500))),
    "three moments and a weight": Case((*FREE, *bits(12, 12, 12), *BODY, *law("adaptive"))),
    "unequal C₁, C₂": Case((*FREE, *bits(10, 10, 10), *law("adaptive", "C1=[0.3, 1.0, 0.5]", "C2=[0.3, 0.15, 0.25]"))),
    "unequal Γ": Case((*FREE, *bits(12, 12, 12), *law("adaptive", "Gamma=[0.2, 0.02, 0.05]"))),
    "three axes, no bits": Case((*SWUNG, *law("adaptive", "C1=[1, 1, 1]", "C2=[0.3, 0.3, 0.3]", hz=500))),
    "10 ms late": Case((*FREE, *bits(12, 12, 12), *law("adaptive", hz=500)), late=5),
    "12 frames lost": Case((*FREE, *bits(10, 10, 10), *law("adaptive", hz=500)), late=12, loss=True),
    "real time, pushed": Case((*FREE, *bits(12, 12, 12), "loop.lockstep=false", *law("adaptive")), 1, disturbance=1e-3),
    "Coulomb friction": Case((*FREE, *bits(12, 12, 12), "plant.friction.coulomb=[0.0005, 0.0003]", *law("adaptive"))),
    "nonadaptive, late, from afar": Case((*FREE, *bits(10, 10, 10), *law("nonadaptive")), late=3, start=0.5),
    "at the limits of tilt and rate": Case(
        (*FREE, *bits(12, 12, 12), *law("adaptive"), "plant.limits.max_tilt_deg=41.2", "plant.limits.max_rate=0.375")
    ),
    "PD, as late as its watchdog allows": Case(PATIENT, late=24),
    "PD, as many frames lost as its watchdog allows": Case(PATIENT, late=24, loss=True),
    "PD, pushed hard": Case((*FREE, *bits(12, 12, 12), *law("pd")), disturbance=2e-2),
    "PID, late, pushed": Case((*FREE, *bits(10, 10, 10), *law("pid", hz=100)), late=1, disturbance=2e-3),
    "PID, rotors": Case((*FREE, *bits(10, 10, 10), *rotors(0.02, 0.02), *law("pid", hz=100))),
    "rotors, up and down": Case((*FREE, *bits(12, 12, 12), *rotors(0.02, 0.03), *law("adaptive"))),
    "held roll": Case((*HELD_ROLL, *bits(12, 12, 12), *law("adaptive"))),
    "held roll, PD, rotors": Case((*AERO, *bits(12, 12, 12), *rotors(0.03, 0.032), *law("pd", hz=500))),
}  # fmt: skip


@lru_cache
def shares(rows: int = 24, generations: int = 3, ticks: int = 600) -> dict[str, Array]:
    """The largest of each of QUANTITIES that was found, as shares of the bounds."""
    known, limits = list[dict[str, Any]](), list[list[float]]()
    for i, (name, case) in enumerate(CASES.items()):
        settings = load_over(Settings(), case.changes)
        late_s = case.late * settings.loop.period * settings.loop.lockstep  # in real time the first tick is none
        options = {"disturbance": case.disturbance, "late_s": late_s}
        e = evaluate(settings, **options)
        assert certify(settings, **options, margins=False).holds, name
        assert e.plant_reach is not None
        at = reach(e.plant, start := case.start * e.plant_reach.radius)
        assert at is not None, name
        volts = largest_voltage(settings, e.plant.desired, at)
        trips = settings.plant.limits
        most_silent = round(settings.plant.watchdog_s / settings.loop.period) - 1
        proven = [at.radius, at.eps_e, at.omega_e, at.axis_rate, sin(at.half_angle), volts]
        limits.append([*proven, radians(trips.max_tilt_deg), trips.max_rate, most_silent])
        numbers = loop.constants(settings, case.late, loss=case.loss, disturbance=case.disturbance)
        known.append(numbers | {"start": [start], "case": [i]})
    return dict(zip(CASES, loop.worst(known, rows, generations, ticks) / np.array(limits), strict=True))


@pytest.mark.parametrize("name", CASES)
def test_no_loop_of_an_adversary_exceeds_what_is_proven(name: str) -> None:
    found = shares()[name]
    assert found.max() <= 1
    assert found[0] > LEAST


BEYOND: Final = {
    "the watchdog": (PATIENT, 25),
    "the largest tilt": ((*PATIENT, "plant.limits.max_tilt_deg=4"), 0),
    "the largest rate": ((*PATIENT, "plant.limits.max_rate=0.01"), 0),
}


@pytest.mark.parametrize("name", BEYOND)
def test_a_loop_beyond_what_its_plant_lets_pass_trips_and_is_not_certified(name: str) -> None:
    changes, late = BEYOND[name]
    settings = load_over(Settings(), changes)
    late_s = late * settings.loop.period
    numbers = loop.constants(settings, late) | {"start": [0.0], "case": [0]}
    reached = loop.worst([numbers], 8, 2, 1200)[0]
    allowed = reach(evaluate(load_over(Settings(), PATIENT), late_s=late_s).plant)
    assert allowed is not None
    assert reached[1] > allowed.eps_e
    assert not certify(settings, late_s=late_s, margins=False).holds


def test_the_adversary_comes_near_to_what_is_proven() -> None:
    reached = [found[0] for found in shares().values()]
    assert max(reached) > 0.8
    assert np.median(reached) > 0.3
