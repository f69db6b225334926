"""Tabulated means, against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.rigor.intervals import Interval
from certbound.values.discrete.fields import Tables
from certbound.values.discrete.shocks import gaussian_shocks
from certbound.values.grids import Grid
from tests.values.discrete.helpers import mean_after_noise, random_function

COVARIANCES = [
    np.array([[0.04]]),
    np.array([[0.04, 0.0], [0.0, 0.09]]),
    np.array([[0.04, 0.03], [0.03, 0.09]]),
    np.array([[0.04, -0.02], [-0.02, 0.09]]),
    np.diag([0.04, 0.09, 0.05]),
]


def tables_of(covariance: np.ndarray) -> Tables:
    n = len(covariance)
    axes = (np.array([-1.0, -0.4, -0.3, 0.5]), np.array([-0.8, 0.0, 0.9]), np.array([-0.5, 0.6]))
    grid = Grid(axes=axes[:n])
    return Tables(grid, gaussian_shocks(Interval.point(covariance)), np.full(n, -0.7), np.full(n, 0.8))


@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("fixed", [0.0, 0.4])
def test_the_table_is_the_mean_within_its_error(covariance: np.ndarray, fixed: float) -> None:
    rng = np.random.default_rng(3)
    tables = tables_of(covariance)
    value = random_function(rng, tables.grid, fixed=fixed)
    field = tables.field(value)
    n = len(covariance)
    index = [tuple(int(rng.integers(4, count - 4)) for count in tables.mesh.count) for _ in range(5)]
    points = np.array([[tables.mesh.points(i)[k] for i, k in enumerate(place)] for place in index])
    exact = mean_after_noise(value, points, covariance)
    zero = (0,) * n
    for place, mean in zip(index, exact):
        bound = field.error[zero] * field.dominant[place] + field.floor[zero]
        assert abs(field.tables[zero][place] - mean) <= bound + 1e-9
        assert bound < 1e-6
        assert field.dominant[place] >= mean / 1.3**n


@pytest.mark.parametrize("covariance", COVARIANCES)
def test_derivatives_are_those_of_the_mean(covariance: np.ndarray) -> None:
    tables = tables_of(covariance)
    field = tables.field(random_function(np.random.default_rng(5), tables.grid, fixed=0.3))
    n = len(covariance)
    for i in range(n):
        step = tables.mesh.step[i]
        first = tuple(int(k == i) for k in range(n))
        second = tuple(2 * int(k == i) for k in range(n))
        table = np.moveaxis(field.tables[(0,) * n], i, 0)
        slope = (8 * (table[3:-1] - table[1:-3]) - (table[4:] - table[:-4])) / (12 * step)
        bend = (16 * (table[3:-1] + table[1:-3]) - (table[4:] + table[:-4]) - 30 * table[2:-2]) / (12 * step**2)
        scale = 1 / float(tables.sigma[i])
        assert np.abs(np.moveaxis(field.tables[first], i, 0)[2:-2] - slope).max() <= 2e-3 * scale
        assert np.abs(np.moveaxis(field.tables[second], i, 0)[2:-2] - bend).max() <= 1e-2 * scale**2


def test_far_outside_the_mean_is_one() -> None:
    covariance = np.array([[0.04]])
    grid = Grid(axes=(np.array([-1.0, 1.0]),))
    tables = Tables(grid, gaussian_shocks(Interval.point(covariance)), np.array([5.0]), np.array([9.0]))
    field = tables.field(random_function(np.random.default_rng(0), grid))
    assert field.tables[(0,)] == pytest.approx(1.0, abs=1e-12)
