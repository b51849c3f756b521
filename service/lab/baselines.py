"""Baselines: predictions of the paper's tables without any physics, to compare ours with.

They are fitted to the published table itself, so each has seen the cells that it is scored on, as our prediction has
not. What compares is their error with each cell left out of its own fit. Even then all but the first use every other
published cell, where our prediction uses the fitted one alone; the first uses just that one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field


class Baseline(BaseModel):
    """A form fitted to a published table by least squares, and its error over the cells that we predict."""

    model_config = ConfigDict(frozen=True)

    name: str
    parameters: int = Field(description="numbers fitted, for each figure")
    cells: int = Field(description="published cells that they are fitted to")
    mare: float | None = Field(description="mean absolute relative error [1]; null if fitted to none of these cells")
    mare_left_out: float = Field(description="the same, each cell predicted by a fit to all others [1]")


def baselines(
    published: Sequence[Sequence[Sequence[float]]], fitted: tuple[int, int], scored: tuple[int, int] | None = None
) -> list[Baseline]:
    """The fitted cell for all others, a constant, column means, and a sum of rows and columns.

    Args:
        published: A table for each figure, all of one shape.
        fitted: The cell that the plant is calibrated on: row and column, from 0.
        scored: The only cell that counts; all but `fitted` if None.
    """
    tables = [np.array(table, dtype=float) for table in published]
    (rows, columns), n = tables[0].shape, tables[0].size
    counts = np.full((rows, columns), scored is None)
    counts[scored or fitted] = scored is not None

    def error(forms: Sequence[np.ndarray]) -> float:
        misses = [np.abs(form / y - 1)[counts] for form, y in zip(forms, tables, strict=True)]
        return float(np.mean(misses))

    forms = (
        ("constant", 1, [np.full(y.shape, y.mean()) for y in tables]),
        ("column mean", columns, [np.tile(y.mean(axis=0), (rows, 1)) for y in tables]),
        ("row + column", rows + columns - 1, [np.add.outer(y.mean(axis=1), y.mean(axis=0)) - y.mean() for y in tables]),
    )
    alone = error([np.full(y.shape, y[fitted]) for y in tables])
    return [
        Baseline(name="fitted cell", parameters=1, cells=1, mare=None, mare_left_out=alone),
        # Every cell has the leverage p/n in these fits: left out, it is missed by 1/(1 − p/n) times as much.
        *(
            Baseline(name=name, parameters=p, cells=n, mare=error(form), mare_left_out=error(form) * n / (n - p))
            for name, p, form in forms
        ),
    ]
