"""Laws of a user's own that go wrong, named by tests as `tests.support.failing_laws:Class`."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import casadi as ca

from aeroloop import ExpressionLaw, LawSettings, Now, PythonLaw


class Runaway(ExpressionLaw[LawSettings]):
    """Pushes where it should pull."""

    Settings = LawSettings

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return 200 * now.attitude_error[-self.actuators :] + 0.3, {}


class FourthTick(PythonLaw[LawSettings]):
    """Gives 1 V, and calls `fail` at its fourth tick and every later one."""

    Settings = LawSettings

    def reset(self) -> None:
        self.state = {"ticks": 0.0}  # type: ignore[dict-item]  # a number, as a user may write it

    def step(self, now: Now[Any]) -> Any:
        self.state["ticks"] = now.state["ticks"] + 1
        if now.state["ticks"] > 2:
            self.fail()
        return [1.0] * self.actuators

    @abstractmethod
    def fail(self) -> None: ...


class Raising(FourthTick):
    """Fails."""

    def fail(self) -> None:
        raise ZeroDivisionError("by nothing")


class Hanging(FourthTick):
    """Never ends."""

    def fail(self) -> None:
        while True:
            pass


class Slow(FourthTick):
    """Takes 0.3 s."""

    def fail(self) -> None:
        time.sleep(0.3)
