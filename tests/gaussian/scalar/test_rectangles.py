"""Gaussian probabilities of boxes against SciPy's integrals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from certbound.gaussian.scalar.rectangles import log_rectangle
from certbound.rigor.intervals import Interval


@pytest.mark.parametrize("sides", [1, 2, 3, 4])
def test_boxes_are_bounded_from_above(sides: int) -> None:
    rng = np.random.default_rng(sides)
    ratios = []
    for _ in range(25 if sides < 4 else 6):
        root = rng.standard_normal((sides, sides)) + 1.5 * np.eye(sides)
        matrix = root @ root.T
        sd = np.sqrt(np.diag(matrix))
        low = rng.uniform(-1.5, 2, sides) * sd
        high = low + rng.uniform(0.1, 1.5, sides) * sd
        if rng.random() < 0.3:
            high[int(rng.integers(sides))] = np.inf
        if rng.random() < 0.3:
            low[int(rng.integers(sides))] = -np.inf
        slack = 1e-9 * np.abs(matrix)
        found = float(np.exp(log_rectangle(low[None], high[None], Interval(matrix - slack, matrix + slack)[None])[0]))
        truth = float(multivariate_normal(np.zeros(sides), matrix, allow_singular=True).cdf(high, lower_limit=low))
        assert found >= truth - 2e-5
        if truth > 2e-4:
            ratios.append(found / truth)
    assert np.median(ratios) < {1: 1.0 + 1e-6, 2: 1.1, 3: 1.25, 4: 1.6}[sides]


def test_independent_sides_multiply_and_more_sides_never_add() -> None:
    low, high = np.array([[0.5, -1.0, 1.0]]), np.array([[1.5, 0.3, 1.7]])
    product = np.prod(norm.cdf(high) - norm.cdf(low))
    found = [float(log_rectangle(low[:, :k], high[:, :k], Interval.point(np.eye(k)[None]))[0]) for k in (1, 2, 3)]
    assert found[0] > found[1] > found[2] >= np.log(product) - 1e-12
    assert np.exp(found[2]) <= 1.001 * product


def test_coordinates_without_noise() -> None:
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    still = Interval.point(np.zeros((1, 1, 1)))
    assert float(log_rectangle(-one, one, still)[0]) == 0.0
    assert float(log_rectangle(one, 2 * one, still)[0]) == -np.inf
    assert float(log_rectangle(zero, one, still)[0]) == 0.0
    # the first side is certain, the other one random
    matrix = np.diag([0.0, 1.0])[None]
    found = float(log_rectangle(np.array([[-1.0, 1.0]]), np.array([[1.0, 2.0]]), Interval.point(matrix))[0])
    assert norm.cdf(2) - norm.cdf(1) <= np.exp(found) <= 1.0


def test_too_many_sides_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 4 sides"):
        log_rectangle(np.zeros((1, 5)), np.ones((1, 5)), Interval.point(np.eye(5)[None]))
