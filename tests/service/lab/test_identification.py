"""Identification of parameters from a scaled Jacobian."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from aeroloop.service.config import Settings, load
from aeroloop.service.lab import paper
from aeroloop.service.lab.calibrate import identification_at
from aeroloop.service.lab.cells import Cell
from aeroloop.service.lab.identification import Named, identify
from aeroloop.service.lab.tables import CASES

THREE = [Named("friction", "N·m", 0.003, 0.004), Named("height", "m", 0.0, 0.01), Named("zone", "V", 1.0, 2.5)]


def test_uncertainties_are_those_of_a_least_squares_fit_to_figures_that_scatter() -> None:
    rng = np.random.default_rng(1)
    J = rng.normal(size=(8, 3))
    found = identify(THREE, J)
    fits = np.array([np.linalg.lstsq(J, noise)[0] for noise in rng.normal(size=(20_000, 8))])
    scales = [p.scale for p in THREE]
    # a standard deviation of 20 000 draws is exact to 0.5 %
    assert [p.jointly for p in found.parameters] == pytest.approx(fits.std(axis=0) * scales, rel=0.03)
    for p, scale, column in zip(found.parameters, scales, J.T, strict=True):
        assert p.alone == pytest.approx(scale * np.sqrt(1 / (column @ column)))
        assert p.alone <= p.jointly
    assert found.singular_values == sorted(found.singular_values, reverse=True)


def test_parameters_that_act_alike_are_not_identified_and_named_as_the_weakest_direction() -> None:
    a, b = np.random.default_rng(2).normal(size=(2, 8)) * 10
    found = identify(THREE, np.column_stack([a, b, 2 * a]))
    assert [p.identified for p in found.parameters] == [False, True, False]
    # half a scale of the third is undone by a whole one of the first
    assert found.weakest in {"friction +0.004 N·m, zone -1.2 V", "friction +0.004 N·m, zone -1.3 V"}
    assert found.singular_values[-1] < 1e-12


def test_a_parameter_without_any_effect_is_not_identified() -> None:
    found = identify(THREE, np.column_stack([np.eye(8)[0] * 5, np.zeros(8), np.eye(8)[1] * 5]))
    assert [p.identified for p in found.parameters] == [True, False, True]
    assert found.weakest == "height +0.01 m"
    assert found.parameters[0].jointly == pytest.approx(0.004 / 5)


def test_the_scatter_is_that_of_the_published_cells_about_their_column_means() -> None:
    for table, scatter in zip((paper.Z_TRACK, paper.U_TOTAL), paper.SCATTER, strict=True):
        cells = np.array(table)
        off = cells / cells.mean(axis=0) - 1
        assert scatter == pytest.approx(np.sqrt((off**2).sum() / (cells.size - cells.shape[1])), rel=0.03)


def test_calibration_asks_for_the_figures_of_table_c4_around_what_it_fitted() -> None:
    """With figures that are linear in the parameters, the Jacobian found is the one that they were made with."""
    values = [0.003, -0.004, -0.0003, 0.0004, 0.5]  # the wind's torque is 0.5 mN·m
    scales = np.array([0.0037, 0.0038, 0.0005, 0.0005, 2.5])
    J = np.random.default_rng(3).normal(size=(2, 2, 2, 5))  # case, air, figure

    def evaluate(jobs: Sequence[tuple[Settings, Cell]]) -> np.ndarray:
        figures = []
        for settings, cell in jobs:
            plant, case = settings.plant, list(CASES.values()).index((cell.bits_out, cell.bits_in))
            x = [plant.friction.coulomb[1], plant.aero.centre_of_mass[2], *plant.wind.torque, plant.rotor.dead_zone_v]
            published = list(paper.WIND[list(CASES)[case]]["wind" if cell.windy else "calm"].values())
            figures.append(published * (1 + paper.SCATTER * (J[case, int(cell.windy)] @ (x / scales))))
        return np.array(figures)

    found = identification_at(load(), values, evaluate)
    assert [p.value for p in found.parameters] == values
    assert found.singular_values == pytest.approx(np.linalg.svd(J.reshape(8, 5))[1])
    assert [p.alone for p in found.parameters] == pytest.approx(scales / np.linalg.norm(J.reshape(8, 5), axis=0))
