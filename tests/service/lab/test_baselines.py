"""Baselines beside the predicted tables: fits without physics, in and out of sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aeroloop.service.lab import paper
from aeroloop.service.lab.baselines import baselines
from aeroloop.service.lab.tables import Table, Tables, comparison

FIGURES = ("z_track_1e-4", "u_total")
README = Path(__file__).parents[3] / "service" / "README.md"


def _design(name: str, rows: int, columns: int) -> np.ndarray:
    """Regressors of a form, a row for each cell."""
    row, column = (index.ravel() for index in np.indices((rows, columns)))
    of_row, of_column = np.eye(rows)[row], np.eye(columns)[column]
    one = np.ones((rows * columns, 1))
    return {"constant": one, "column mean": of_column, "row + column": np.hstack([of_row, of_column])}[name]


@pytest.mark.parametrize("shape", [(6, 4), (2, 2), (3, 7)])
def test_an_error_left_out_is_that_of_a_fit_made_again_without_each_cell(shape: tuple[int, int]) -> None:
    table = np.random.default_rng(1).uniform(20, 60, shape)
    fitted = (0, shape[1] - 1)
    skipped = np.ravel_multi_index(fitted, shape)
    y = table.ravel()
    alone, *found = baselines([table.tolist()], fitted)
    others = np.delete(y, skipped)
    assert alone.mare is None
    assert alone.mare_left_out == pytest.approx(np.mean(np.abs(y[skipped] / others - 1)))
    assert [baseline.name for baseline in found] == ["constant", "column mean", "row + column"]
    for baseline in found:
        X = _design(baseline.name, *shape)
        assert baseline.parameters == np.linalg.matrix_rank(X)
        whole = X @ np.linalg.lstsq(X, y)[0]
        again = [X[i] @ np.linalg.lstsq(np.delete(X, i, 0), np.delete(y, i))[0] for i in range(y.size)]
        for mare, values in ((baseline.mare, whole), (baseline.mare_left_out, np.array(again))):
            assert mare == pytest.approx(np.mean(np.delete(np.abs(values / y - 1), skipped)))


def test_only_the_scored_cell_counts_and_figures_are_averaged() -> None:
    z, u = [[35, 97], [49, 119]], [[7980, 9241], [8042, 9699]]
    alone, *_, additive = baselines([z, u], fitted=(0, 1), scored=(1, 1))
    assert alone.mare_left_out == pytest.approx(((119 - 97) / 119 + (9699 - 9241) / 9699) / 2)
    sums = 49 + 97 - 35, 8042 + 9241 - 7980
    assert additive.mare_left_out == pytest.approx(((119 - sums[0]) / 119 + (9699 - sums[1]) / 9699) / 2)


def test_the_readme_shows_the_baselines_of_the_published_tables() -> None:
    z, u = ([*map(list, table)] for table in (paper.Z_TRACK, paper.U_TOTAL))
    windy = [[[air[name] for air in case.values()] for case in paper.WIND.values()] for name in FIGURES]
    found = baselines([z], (-1, -1)), baselines([u], (-1, -1)), baselines(windy, (0, 1), (1, 1))
    C2, C3, C4 = (Table(ours=None, paper=None, mare=0.0, baselines=each) for each in found)
    text = README.read_text(encoding="utf-8")
    header, _, *rows = comparison(Tables(C2=C2, C3=C3, C4=C4))
    for row in (header, *rows):
        assert f"| {' | '.join(row)} |" in text
