"""Laws with a known optimum, and laws that fail, for searches of gains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import casadi as ca
from pydantic import Field

from aeroloop import ExpressionLaw, LawSettings, Now, PythonLaw
from tests.support.failing_laws import Raising as Raising
from tests.support.failing_laws import Runaway as Runaway


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
