"""Calibrated plant, the tables predicted with it, and the baselines beside them."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from aeroloop.service.config import Settings, load
from aeroloop.service.lab import tables as paper
from aeroloop.service.lab.sweep import open_workers, run_of
from aeroloop.service.lab.tables import TOLERANCE, Cell, Tables, baselines, predict, run_cells, sheets
from tests.support.in_this_process import workers_here

pytestmark = pytest.mark.processes

BENCH = load()
README = Path(__file__).parents[3] / "service" / "lab" / "README.md"


def run_cell(cell: Cell, settings: Settings = BENCH) -> tuple[float, float]:
    [result] = run_cells(workers_here(), [run_of(settings, cell.overrides)])
    return result


@pytest.fixture(scope="module")
def tables() -> Tables:
    """All cells, once: some 30 s on two cores."""
    return predict(BENCH)


@pytest.mark.parametrize("windy", [False, True], ids=["calm", "wind"])
def test_the_default_bench_is_the_one_that_calibration_finds(windy: bool) -> None:
    published = paper.WIND["continuous"]["wind" if windy else "calm"]
    z_track, u_total = run_cell(Cell(None, None, windy))
    # Newton stops within TOLERANCE of the paper's figures; the committed values are rounded to four digits, and wind
    # and friction answer about in proportion, so as much again.
    assert z_track == pytest.approx(published["z_track_1e-4"], rel=2 * TOLERANCE)
    assert u_total == pytest.approx(published["u_total"], rel=2 * TOLERANCE)


def test_what_is_predicted_lies_as_near_the_paper_as_the_readme_says(tables: Tables) -> None:
    # The bars the project set itself: published cells scatter by 5.8 % and 0.7 % about their own column means.
    assert tables.C2.mare <= 0.09
    assert tables.C3.mare <= 0.015
    ours, published = tables.C4.ours["quantized_8_6"]["wind"], paper.WIND["quantized_8_6"]["wind"]
    assert ours["z_track_1e-4"] == pytest.approx(published["z_track_1e-4"], rel=0.12)
    assert ours["u_total"] == pytest.approx(published["u_total"], rel=0.03)


def test_a_table_is_made_of_its_cells_in_rows_of_input_bits_and_columns_of_output_bits(tables: Tables) -> None:
    z_track, u_total = run_cell(Cell(bits_out=10, bits_in=7))
    assert tables.C2.ours[paper.INPUT_BITS.index(7)][paper.OUTPUT_BITS.index(10)] == round(z_track, 2)
    assert tables.C3.ours[paper.INPUT_BITS.index(7)][paper.OUTPUT_BITS.index(10)] == round(u_total, 2)
    assert tables.C2.ours[-1][-1] == tables.C4.ours["continuous"]["calm"]["z_track_1e-4"]
    assert tables.C3.ours[0][0] == tables.C4.ours["quantized_8_6"]["calm"]["u_total"]


def test_the_fitted_cells_do_not_count_in_the_error(tables: Tables) -> None:
    errors = [
        abs(mine - theirs) / theirs for mine, theirs in zip(chain(*tables.C2.ours), chain(*paper.Z_TRACK), strict=True)
    ]
    assert tables.C2.mare == pytest.approx(sum(errors[:23]) / 23)


def test_seeds_make_a_spread_and_the_same_seed_the_same_figures() -> None:
    runs = [run_of(BENCH, Cell(8, 6, windy=True).overrides, seed) for seed in (0, 1, 0)]
    with open_workers() as workers:
        first, other, again = run_cells(workers, runs)
    assert first == again != other


def test_the_papers_numbers_are_those_of_its_tables() -> None:
    """A few, by their place in the paper: enough to distinguish rows from columns."""
    assert paper.Z_TRACK[0][1] == 51  # 6 bits in, 9 out
    assert paper.Z_TRACK[-1][0] == 43  # input unquantized, 8 bits out
    assert paper.U_TOTAL[2][3] == 8017  # 8 bits in, output unquantized
    assert len(paper.Z_TRACK) == len(paper.U_TOTAL) == len(paper.INPUT_BITS)


# ── baselines ──


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


def test_every_row_of_the_readme_is_printed_by_the_command(tables: Tables) -> None:
    printed = [f"| {' | '.join(row.values())} |" for _, rows in sheets(tables) for row in rows]
    shown = re.findall(r"^\| (?:\d+|cont) \|.*$", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(shown) == 4
    assert set(shown) <= set(printed)
