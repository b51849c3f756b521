"""The paper's law without adaptation: (C.37) with θ̂ as first estimated, so Γ = 0 in (C.38).

What it does worse than the adaptive law is what adaptation is for. Its equations are those of `adaptive`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot
from typing import Literal

import casadi as ca
from pydantic import Field

from aeroloop.service.control.laws.adaptive import Adaptive, AdaptiveSettings, MatrixGain
from aeroloop.service.control.laws.interface import ExpressionLaw, LawSettings, Now, Vector


class NonadaptiveSettings(LawSettings):
    """Model of the plant, known damping included, and gains of the law. The default is Table C.1."""

    kind: Literal["nonadaptive"] = Field(default="nonadaptive", description="which law")
    C1: MatrixGain = Field(default=(0.3, 0.3, 0.3), description="gain of the attitude error [1/s]")
    C2: MatrixGain = Field(default=(0.15, 0.15, 0.15), description="gain of the rate error [N·m·s/rad]")
    damping_estimate: Vector = Field(
        default=(0.0, 0.0070, 0.0095), description="θ̂(t0), first estimate of the damping [N·m·s/rad]"
    )


class Nonadaptive(ExpressionLaw[NonadaptiveSettings]):
    """The law with a constant θ̂. State: sign, 0 before the first tick, which chooses that of η̃ (Assumption 3)."""

    Settings = NonadaptiveSettings
    gains = ("C1", "C2")

    def __init__(self, settings: NonadaptiveSettings, period: float, actuators: int) -> None:
        super().__init__(settings, period, actuators)
        same = settings.model_dump(exclude={"kind"})
        bound = 2 * hypot(*settings.damping_estimate) or 1.0  # anything above: nothing is projected
        self._adaptive = Adaptive(AdaptiveSettings(**same, damping_bound=bound), period, actuators)

    def initial(self) -> Mapping[str, Sequence[float]]:
        """No sign yet."""
        return {"sign": (0.0,)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """(C.37)."""
        theta = ca.SX(self.settings.damping_estimate)
        gains = {**now.gains, "Gamma": ca.SX.zeros(3)}
        u, state = self._adaptive.expressions(now._replace(gains=gains, state={**now.state, "damping_estimate": theta}))
        return u, {"sign": state["sign"]}
