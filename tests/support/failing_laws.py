"""Laws of a user's own that go wrong, named by tests as `tests.support.failing_laws:Class`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

import casadi as ca
import numpy as np
from pydantic import Field

from aeroloop import ExpressionLaw, LawSettings, Now, PythonLaw
from aeroloop.service.control.laws.interface import Floats

FAILING: Final = "tests.support.failing_laws"

Failure = Literal["raises", "gives NaN", "gives one voltage", "another shape"]


class FailingSettings(LawSettings):
    failure: Failure | Literal["hangs"] = Field(default="raises", description="what goes wrong")
    at: int = Field(default=3, description="at which tick")


class Failing(PythonLaw[FailingSettings]):
    Settings = FailingSettings

    def reset(self) -> None:
        self.state = {"ticks": 0.0}  # type: ignore[dict-item]  # a number, as a user may write it

    def step(self, now: Now[Floats]) -> Any:
        k = int(now.state["ticks"][0])
        self.state["ticks"] = now.state["ticks"] + 1
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
            case "hangs":
                while True:
                    pass
        return [1.0] * self.actuators


class MistakenSettings(LawSettings):
    mistake: Literal["width", "state", "no such vector"] = Field(description="what is wrong with it")


class Mistaken(ExpressionLaw[MistakenSettings]):
    Settings = MistakenSettings

    def initial(self) -> Mapping[str, Sequence[float]]:
        return {"sum": (0.0, 0.0)}

    def expressions(self, now: Now[ca.SX]) -> Any:
        zero = ca.SX.zeros(self.actuators)
        match self.settings.mistake:
            case "width":
                return now.rate_error[0], now.state
            case "state":
                return zero, {"sum": now.rate_error}
            case "no such vector":
                return now.speed, now.state  # type: ignore[attr-defined]  # no such vector
        return zero, now.state


class Picky(PythonLaw[LawSettings]):
    Settings = LawSettings

    def __init__(self, settings: LawSettings, period: float, actuators: int) -> None:
        super().__init__(settings, period, actuators)
        raise ValueError("flies with eight motors only")

    def reset(self) -> None:
        pass

    def step(self, now: Now[Floats]) -> Floats:
        return now.rate


class Runaway(ExpressionLaw[LawSettings]):
    Settings = LawSettings

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return 200 * now.attitude_error[-self.actuators :] + 0.3, {}


class NoLaw:
    """Derives from no law."""
