"""Laws of a user's own that go wrong, named by tests as `tests.support.tuned_laws:Class`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import casadi as ca
from pydantic import Field

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
        return [0.0] * self.actuators


class OffsetSettings(LawSettings):
    """One gain."""

    offset: Annotated[float, Field(gt=0, le=5)] = 0.5


class Offset(ExpressionLaw[OffsetSettings]):
    """Gives every motor the same voltage, 0 with a gain of 2: on a body at rest the one optimum."""

    Settings = OffsetSettings
    gains = ("offset",)

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        return ca.repmat(now.gains["offset"] - 2, self.actuators, 1), {}


class OffsetInPython(PythonLaw[OffsetSettings]):
    """The same, tick by tick."""

    Settings = OffsetSettings
    gains = ("offset",)

    def reset(self) -> None:
        self.state = {}

    def step(self, now: Now[Any]) -> Any:
        return [now.gains["offset"][0] - 2] * self.actuators


class Stubborn(Offset):
    """Takes its gain from its settings, where no change of gains reaches it."""

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:  # noqa: ARG002  # it ignores it
        return ca.SX([self.settings.offset - 2] * self.actuators), {}
