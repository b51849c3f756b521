"""Laws as a user writes them: the same PD law with a sum of errors as expressions and in Python, and laws that fail.

All give one voltage for each of the last body axes, so they fit two motors and three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

import casadi as ca
import numpy as np
from pydantic import Field

from aeroloop.service.control.laws.interface import (
    ExpressionLaw,
    Floats,
    Gain,
    Gains3,
    LawSettings,
    Now,
    PythonLaw,
)

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
    """The same, operation by operation."""

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
        u: Floats = -(kp * error) - kd[first:] * rate - ki * self.state["sum"]
        return u


class BareSettings(LawSettings):
    """Nothing of its own."""


class Bare(ExpressionLaw[BareSettings]):
    """No gain that may change, and no state."""

    Settings = BareSettings

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        first = 3 - self.actuators
        return -15 * now.attitude_error[first + 1 :] - 6 * now.rate_error[first:], {}


class BarePython(PythonLaw[BareSettings]):
    """Likewise."""

    Settings = BareSettings

    def reset(self) -> None:
        pass

    def step(self, now: Now[Floats]) -> Floats:
        first = 3 - self.actuators
        u: Floats = -15 * now.attitude_error[first + 1 :] - 6 * now.rate_error[first:]
        return u


Failure = Literal["raises", "gives NaN", "gives one voltage", "another shape", "another name", "gives no number"]


class FailingSettings(LawSettings):
    """What shall go wrong."""

    failure: Failure = Field(default="raises", description="what goes wrong")
    at: int = Field(default=3, description="at which tick")


class Failing(PythonLaw[FailingSettings]):
    """Counts its ticks, and fails at one of them."""

    Settings = FailingSettings

    def reset(self) -> None:
        self.state = {"ticks": np.zeros(1)}

    def step(self, now: Now[Floats]) -> Any:
        del now
        k = int(self.state["ticks"][0])
        self.state["ticks"] += 1
        if k != self.settings.at:
            return [1.0] * self.actuators
        match self.settings.failure:
            case "raises":
                raise RuntimeError("the estimator\ndiverged")
            case "gives NaN":
                return [1.0] + [np.nan] * (self.actuators - 1)
            case "gives one voltage":
                return [1.0]
            case "another shape":
                self.state["ticks"] = np.zeros(2)
            case "another name":
                self.state = {"tocks": np.zeros(1)}
            case "gives no number":
                return ["much"] * self.actuators
        return [1.0] * self.actuators


class WrongWidth(ExpressionLaw[BareSettings]):
    """One voltage, whatever the number of motors."""

    Settings = BareSettings

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return now.rate_error[0], {}


class WrongState(ExpressionLaw[BareSettings]):
    """A state that is not as long as its first one."""

    Settings = BareSettings

    def initial(self) -> Mapping[str, Sequence[float]]:
        return {"sum": (0.0, 0.0)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return now.rate_error[3 - self.actuators :], {"sum": now.rate_error}


class Picky(PythonLaw[BareSettings]):
    """Cannot be made."""

    Settings = BareSettings

    def __init__(self, settings: BareSettings, period: float, actuators: int) -> None:
        super().__init__(settings, period, actuators)
        raise ValueError("flies with eight motors only")

    def reset(self) -> None:
        pass

    def step(self, now: Now[Floats]) -> Floats:
        return now.rate


class NoSettings(PythonLaw[LawSettings]):
    """Has no model of its settings."""

    def reset(self) -> None:
        pass

    def step(self, now: Now[Floats]) -> Floats:
        return now.rate


class NoLaw:
    """Derives from no law."""


not_even_a_class = 3
