"""Wind: a steady torque about each axis and gusts around it.

The gust is an Ornstein–Uhlenbeck process (the same filter as Dryden's longitudinal gust) with time constant
`gust_time_s` and a standard deviation of `gust` times the steady torque. It is seeded, so that a run repeats, and
stepped exactly, so that its statistics do not depend on the period.
"""

from __future__ import annotations

from itertools import accumulate
from math import exp, hypot, sqrt

import numpy as np
from pydantic import BaseModel, Field

_BLOCK = 4096  # random numbers are drawn this many periods at a time: one draw costs more than a plant's step


class WindSettings(BaseModel, extra="forbid"):
    """Wind on the plant. The default is calm; the default torques are the fitted ones of the paper's fan."""

    blowing: bool = Field(default=False, description="whether the fan is on")
    torque: tuple[float, ...] = Field(
        default=(-0.000220, 0.009858),
        max_length=3,
        description="steady torque about the axes [N·m], missing ones 0; fitted by `lab calibrate`",
    )
    gust: float = Field(
        default=0.2,
        ge=0,
        le=10,
        description="standard deviation of gusts, all axes together, as a part of the steady torque [1]; assumed",
    )
    gust_time_s: float = Field(default=1.0, gt=0, le=1000, description="time constant of a gust [s]")
    seed: int = Field(default=0, ge=0, description="of the gusts' random numbers")


class Wind:
    """Torque about each axis, `period` by `period` [s].

    Attributes:
        calm: Whether the torque is always 0.
    """

    def __init__(self, settings: WindSettings, axes: int, period: float) -> None:
        self._steady = np.array((*settings.torque, 0.0, 0.0, 0.0)[:axes]) * settings.blowing
        self.calm = not self._steady.any()
        deviation = settings.gust * hypot(*self._steady) / sqrt(axes)
        self._keep = exp(-period / settings.gust_time_s)
        self._kick = deviation * sqrt(1 - self._keep**2)
        self._random = np.random.default_rng(settings.seed)
        self._gust: list[float] = (deviation * self._random.standard_normal(axes)).tolist()
        self._block: list[list[float]] = []

    def sample(self) -> list[float]:
        """Torque about each axis for the next period [N·m]. Shape (axes,)."""
        if not self._block:
            self._block = self._draw()[::-1]
        return self._block.pop()

    def _draw(self) -> list[list[float]]:
        torques = np.tile(self._steady, (_BLOCK, 1))
        if self._kick:
            kicks = (self._random.standard_normal(torques.shape) * self._kick).T.tolist()
            gusts = [
                list(accumulate(each, self._next, initial=gust)) for each, gust in zip(kicks, self._gust, strict=True)
            ]
            self._gust = [each[-1] for each in gusts]
            torques += np.array(gusts).T[1:]
        block: list[list[float]] = torques.tolist()
        return block

    def _next(self, gust: float, kick: float) -> float:
        return self._keep * gust + kick
