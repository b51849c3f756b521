"""Identification: how well the paper's figures determine the fitted parameters, and the dead zone beside them.

The dead zone is not fitted, but acts on the same figures. J is the Jacobian of the eight figures of Table C.4 by these
parameters. A figure counts as a part of its published value, in units of the published cells' scatter about their
column means; a parameter in units of its published value. A singular value is the number of scatters by which a step
of one unit along its direction moves the figures. Uncertainties are those of a least-squares fit to such figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field


class Named(NamedTuple):
    """A parameter: its name, unit, value, and the published value or size that it is measured in."""

    name: str
    unit: str
    value: float
    scale: float


class Parameter(BaseModel):
    """A parameter, and one standard deviation of it."""

    model_config = ConfigDict(frozen=True)

    name: str
    unit: str
    value: float
    alone: float = Field(description="uncertainty if all other parameters were known")
    jointly: float = Field(description="uncertainty with all of them open")
    identified: bool = Field(description="whether twice the latter is less than its published value")


class Identification(BaseModel):
    """Singular values of the scaled Jacobian, the weakest direction, and each parameter's uncertainty."""

    model_config = ConfigDict(frozen=True)

    parameters: list[Parameter]
    singular_values: list[float] = Field(description="largest first [1]")
    weakest: str = Field(description="the direction of the least, in the parameters' units")


def identify(parameters: Sequence[Named], jacobian: np.ndarray) -> Identification:
    """Identification from the scaled Jacobian J, shape (figures, parameters), with at least as many figures."""
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    floor = np.maximum(singular, np.finfo(float).tiny ** 0.25)  # no direction at all: a huge number, no division by 0
    jointly = np.sqrt(((directions / floor[:, None]) ** 2).sum(axis=0))  # √ of the diagonal of (JᵀJ)⁻¹
    alone = 1 / np.maximum(np.linalg.norm(jacobian, axis=0), floor[-1])
    weakest = directions[-1] / directions[-1][np.abs(directions[-1]).argmax()]
    return Identification(
        parameters=[
            Parameter(
                name=p.name,
                unit=p.unit,
                value=p.value,
                alone=alone[i] * p.scale,
                jointly=jointly[i] * p.scale,
                identified=bool(jointly[i] < 0.5),
            )
            for i, p in enumerate(parameters)
        ],
        singular_values=singular.tolist(),
        weakest=", ".join(
            f"{p.name} {part * p.scale:+.2g} {p.unit}"
            for p, part in zip(parameters, weakest, strict=True)
            if abs(part) >= 0.1
        ),
    )
