"""Laws of a user's own that go wrong, named by tests as `tests.support.failing_laws:Class`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import casadi as ca

from aeroloop import ExpressionLaw, LawSettings, Now, PythonLaw


class Runaway(ExpressionLaw[LawSettings]):
    """Pushes where it should pull."""

    Settings = LawSettings

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return 200 * now.attitude_error[-self.actuators :] + 0.3, {}


class Raising(PythonLaw[LawSettings]):
    """Fails at its fourth tick."""

    Settings = LawSettings

    def reset(self) -> None:
        self.state = {"ticks": 0.0}  # type: ignore[dict-item]  # a number, as a user may write it

    def step(self, now: Now[Any]) -> Any:
        self.state["ticks"] = now.state["ticks"] + 1
        if now.state["ticks"] > 2:
            raise ZeroDivisionError("by nothing")
        return [1.0] * self.actuators


class Hanging(PythonLaw[LawSettings]):
    """Never ends its fourth tick."""

    Settings = LawSettings

    def reset(self) -> None:
        self.state = {"ticks": 0.0}  # type: ignore[dict-item]  # a number, as a user may write it

    def step(self, now: Now[Any]) -> Any:
        self.state["ticks"] = now.state["ticks"] + 1
        while now.state["ticks"] > 2:
            pass
        return [1.0] * self.actuators


class Slow(PythonLaw[LawSettings]):
    """Takes 0.3 s for its fourth tick."""

    Settings = LawSettings

    def reset(self) -> None:
        self.state = {"ticks": 0.0}  # type: ignore[dict-item]  # a number, as a user may write it

    def step(self, now: Now[Any]) -> Any:
        self.state["ticks"] = now.state["ticks"] + 1
        if now.state["ticks"] == 3:
            time.sleep(0.3)
        return [1.0] * self.actuators
