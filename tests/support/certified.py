"""A configuration of which everything is proven: a free body with three motors, perfect sensors and small damping."""

from __future__ import annotations

from typing import Final

from aeroloop.service.config import Settings, load_over
from tests.support.ideal import IDEAL

SIGNALS: Final = ("attitude", "rate", "voltage")
FREE: Final = (
    "plant.kind=rigid_body",
    *IDEAL,
    "plant.rigid_body.damping=[0, 0.006, 0.006]",
    "wire.actuators=3",
    "law.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]",
    "law.centre_of_mass=[0, 0, 0]",
    "law.damping_bound=0.0119",
)  # the paper's inertia, gains and reference; nothing beyond (C.1) and (C.2); θ within the first estimate's norm


def bits(out: int | None, inp: int | None) -> list[str]:
    """Overrides for these bits of ε and ω, and of u; None is cont."""
    return [f"wire.{name}.bits={n or 'cont'}" for name, n in zip(SIGNALS, (out, out, inp), strict=True)]


def certified_settings(out: int | None = 12, inp: int | None = 12, *changes: str) -> Settings:
    """The configuration with these bits and changes; with 12 bits its certificate holds."""
    return load_over(Settings(), [*FREE, *bits(out, inp), *changes])
