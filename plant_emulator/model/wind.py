"""Wind: a steady torque about each axis and gusts around it.

The gust is an Ornstein–Uhlenbeck process (the same filter as Dryden's longitudinal gust) with time constant
`gust_time_s` and a standard deviation of `gust` times the steady torque. It is seeded, so that a run repeats, and
stepped exactly, so that its statistics do not depend on the period.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import exp, hypot, sqrt

import numpy as np
from pydantic import BaseModel, Field

_BLOCK = 4096  # periods whose random numbers are drawn at once: one draw costs more than a plant's step


class WindSettings(BaseModel, extra="forbid"):
    """Wind on the plant. The default is calm; the default torques are the fitted ones of the paper's fan."""

    blowing: bool = Field(default=False, description="whether the fan is on")
    torque: tuple[float, ...] = Field(
        default=(-0.000220, 0.009858),
        max_length=3,
        description="steady torque about the axes [N·m], missing ones 0; fitted to the paper",
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
    """Torque about each axis, `period` by `period` [s]; `calm` if it is always 0."""

    def __init__(self, settings: WindSettings, axes: int, period: float) -> None:
        self._steady = [torque * settings.blowing for torque in (*settings.torque, 0.0, 0.0, 0.0)[:axes]]
        self.calm = not any(self._steady)
        self._deviation = settings.gust * hypot(*self._steady) / sqrt(axes)
        self._keep = exp(-period / settings.gust_time_s)
        self._random = np.random.default_rng(settings.seed)
        self._torques = self._blow()

    def sample(self) -> list[float]:
        """Torque about each axis for the next period [N·m]. Shape (axes,)."""
        return next(self._torques)

    def _blow(self) -> Iterator[list[float]]:
        axes, keep = len(self._steady), self._keep
        gust = (self._deviation * self._random.standard_normal(axes)).tolist()
        kick = self._deviation * sqrt(1 - keep**2)
        while True:
            for kicks in (self._random.standard_normal((_BLOCK, axes)) * kick).tolist():
                gust = [keep * old + new for old, new in zip(gust, kicks, strict=True)]
                yield [steady + part for steady, part in zip(self._steady, gust, strict=True)]
