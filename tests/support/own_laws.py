"""Laws as a user writes them, as expressions and in Python; tests name them `tests.support.own_laws:Class`.

All give one voltage for each of the last body axes, so they fit two motors and three: a PD law with a sum of errors,
one without gain and state, and one with a known optimum, for searches of gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import casadi as ca
import numpy as np
from pydantic import Field

from aeroloop import ExpressionLaw, LawSettings, Now, PythonLaw
from aeroloop.service.control.laws.interface import Floats, Gain, Gains3

HERE: Final = "tests.support.own_laws"
EXPRESSIONS, PYTHON = f"{HERE}:Expressions", f"{HERE}:Python"


class PDSettings(LawSettings):
    """Gains in volts, so that they fit any body."""

    kp: Gain = Field(default=15.0, description="gain of the attitude error [V]")
    kd: Gains3 = Field(default=(5.0, 6.0, 7.0), description="gain of the rate error [V·s/rad]")
    ki: Gain = Field(default=3.0, description="gain of its sum [V/s]")


class Expressions(ExpressionLaw[PDSettings]):
    """Chooses the nearer equilibrium at its first tick, as the paper's law does."""

    Settings = PDSettings
    gains = ("kp", "kd", "ki")

    def initial(self) -> Mapping[str, Sequence[float]]:
        return {"sum": (0.0,) * self.actuators, "sign": (0.0,)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        first, e = 3 - self.actuators, now.attitude_error
        sign = now.state["sign"] + (now.state["sign"] == 0) * (2 * (e[0] >= 0) - 1)
        error, rate = sign * e[first + 1 :], now.rate_error[first:]
        after = now.state["sum"] + self.period * error
        kp, kd, ki = (now.gains[name] for name in self.gains)
        return -(kp * error) - kd[first:] * rate - ki * after, {"sum": after, "sign": sign}


class Python(PythonLaw[PDSettings]):
    Settings = PDSettings
    gains = ("kp", "kd", "ki")

    def reset(self) -> None:
        self.state = {"sum": np.zeros(self.actuators), "sign": np.zeros(1)}

    def step(self, now: Now[Floats]) -> Floats:
        first, e = 3 - self.actuators, now.attitude_error
        if not self.state["sign"][0]:
            self.state["sign"][0] = 1.0 if e[0] >= 0 else -1.0
        error, rate = self.state["sign"] * e[first + 1 :], now.rate_error[first:]
        self.state["sum"] = self.state["sum"] + self.period * error
        kp, kd, ki = (now.gains[name] for name in self.gains)
        return np.asarray(-(kp * error) - kd[first:] * rate - ki * self.state["sum"])


class Bare(ExpressionLaw[LawSettings]):
    Settings = LawSettings

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        first = 3 - self.actuators
        return -15 * now.attitude_error[first + 1 :] - 6 * now.rate_error[first:], {}


class OffsetSettings(LawSettings):
    offset: Annotated[float, Field(gt=0, le=5)] = 0.5


class Offset(ExpressionLaw[OffsetSettings]):
    """Gives every motor the same voltage, 0 with a gain of 2: on a body at rest the one optimum."""

    Settings = OffsetSettings
    gains = ("offset",)

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return ca.repmat(now.gains["offset"] - 2, self.actuators, 1), {}
