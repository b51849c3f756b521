"""Motion: the reference as the loop evaluates it tick by tick, and its changes.

However often the reference changes, its angle, rate and acceleration never jump.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from aeroloop.protocol.messages.operator import Change, Hold, Reference
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.symbolic import Buffer, Compiled
from aeroloop.service.control.approach import (
    Approach,
    approached,
    at_rest,
    braked,
    braking_times,
    shortest,
    to_set_point,
)
from aeroloop.service.control.reference import Angles, Limits, Plan, reference_function

JUMP: Final = Approach()


class Motion:
    """The reference as the loop evaluates it, tick by tick.

    Args:
        reference: What to follow from t = 0 on.
        shared: Memory to use instead of its own, by the name of an input or output of `reference_function`: that of a
            function with the same inputs, which then evaluates the reference at the time last set.

    Attributes:
        plan: The plan followed now.
    """

    def __init__(self, reference: Reference, shared: Mapping[str, Buffer] | None = None) -> None:
        self._function = Compiled(reference_function(), shared)
        self._time = self._function.inputs["t"]
        self.plan = Plan.of(reference)
        self._load(0)

    def set(self, t: float) -> None:
        """Write time t [s] and its piece to the inputs; t never decreases between calls."""
        if t >= self._until:
            self._load(self.plan.piece(t))
        self._time[0] = t

    def at(self, t: float) -> None:
        """Write the desired motion at time t [s] to the outputs."""
        self.set(t)
        self._function()

    def follow(self, target: Plan, t: float, approach: Approach = JUMP) -> None:
        """Follow another plan from time t [s] on, by an approach; its own time begins when it is reached."""
        self.plan = plan = approached(target, self.here(t), t, approach)
        self._load(plan.piece(t))

    def change(self, change: Change, period: float) -> None:
        """Follow the reference of a change, if it has one, from its tick on; period in s."""
        if change.reference is not None:
            approach = Approach(*(getattr(change, name) for name in Approach._fields))
            self.follow(Plan.of(change.reference), change.tick * period, approach)

    def attitude(self, t: float) -> Quaternion:
        """q_d at time t [s]."""
        self.at(t)
        w, x, y, z = self._function.outputs["q_d"]
        return w, x, y, z

    def rest(self, t: float, limits: Limits) -> Hold:
        """The attitude reached by braking from time t [s] on."""
        here = self.here(t)
        brake_s = braking_times(here, limits)
        roll, pitch, yaw = np.degrees(braked(here, brake_s, np.array([brake_s.max()])).angle[0]).tolist()
        return Hold(attitude=(roll, pitch, yaw))

    def shortest(self, target: Plan, t: float, limits: Limits, start: Vector | None = None) -> Approach:
        """The shortest approach from time t [s] on, from `start`, if given, at rest [deg]; as the function does."""
        if start is not None:
            return shortest(target, at_rest(np.radians(np.array([start]))), limits)._replace(start=start)
        here = self.here(t)
        return shortest(target, here, limits)._replace(here=here.row)

    def to_set_point(self, target: Plan, t: float, within_s: float, limits: Limits) -> Approach:
        """The approach to a set-point from time t [s] on; as the function does."""
        here = self.here(t)
        return to_set_point(target, here, within_s, limits)._replace(here=here.row)

    def here(self, t: float) -> Angles:
        """Roll, pitch, yaw, their rates and accelerations at time t [s]. Shapes (1, 3)."""
        i = self.plan.piece(t)
        tau = np.zeros((len(self.plan.starts), 1))
        tau[i] = t - self.plan.starts[i]
        return Angles(*(part[i] for part in self.plan.at(tau)))

    def _load(self, i: int) -> None:
        plan, inputs = self.plan, self._function.inputs
        self._until = float(plan.starts[i + 1]) if i + 1 < len(plan.starts) else float("inf")
        inputs["start"][0] = plan.starts[i]
        inputs["quintic"][:] = memoryview(plan.quintic[i].ravel())  # CasADi is column-major
        inputs["amplitude"][:] = memoryview(plan.amplitude[i].copy())
        inputs["frequency"][:] = memoryview(plan.frequency[i].copy())
