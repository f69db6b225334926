"""Weighted norms from the safe side."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.errors import SolverError
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm, ball_root, largest_over_box


def metric(rng: np.random.Generator, n: int, spread: float = 3.0) -> np.ndarray:
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    matrix = (basis * 10 ** rng.uniform(-spread, spread, n)) @ basis.T
    return (matrix + matrix.T) / 2


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_the_ball_lies_in_the_image_of_the_root_and_fills_it(n):
    matrix = metric(np.random.default_rng(n), n)
    root = ball_root(matrix)
    above = root @ root.T
    exact = np.linalg.inv(matrix)
    eigenvalues = np.linalg.eigvalsh(above - exact)
    assert eigenvalues[0] > -1e-9 * np.linalg.norm(exact)
    assert np.linalg.norm(above - exact) < 1e-6 * np.linalg.norm(exact)


def test_the_root_of_a_metric_in_mixed_units_is_that_of_its_own_units():
    matrix, units = metric(np.random.default_rng(0), 3, spread=0.5), np.exp2([60.0, 0.0, -40.0])
    scaled = units[:, None] * ball_root(units[:, None] * matrix * units)
    np.testing.assert_allclose(scaled @ scaled.T, ball_root(matrix) @ ball_root(matrix).T, rtol=1e-9)


def test_a_metric_that_double_precision_cannot_invert_is_refused():
    with pytest.raises(SolverError, match="condition number"):
        ball_root(np.array([[1.0, 1.0], [1.0, 1.0 + 1e-15]]))


def test_lengths_and_dual_lengths_bound_the_exact_ones_tightly():
    rng = np.random.default_rng(3)
    matrix = metric(rng, 4)
    norm = Norm(4, matrix)
    vectors = rng.normal(size=(50, 4))
    exact = np.sqrt(np.einsum("bi,ij,bj->b", vectors, matrix, vectors))
    dual = np.sqrt(np.einsum("bi,ij,bj->b", vectors, np.linalg.inv(matrix), vectors))
    assert np.all(norm.length(Interval.point(vectors)) >= exact * (1 - 1e-13))
    assert np.all(norm.length(Interval.point(vectors)) <= exact * (1 + 1e-9))
    assert np.all(norm.dual(vectors) >= dual * (1 - 1e-10))
    assert np.all(norm.dual(vectors) <= dual * (1 + 1e-8))


def test_the_dual_norm_is_the_support_of_the_unit_ball():
    rng = np.random.default_rng(5)
    matrix = metric(rng, 3, 1.0)
    root = np.linalg.cholesky(np.linalg.inv(matrix))
    sphere = rng.normal(size=(20000, 3))
    ball = (sphere / np.linalg.norm(sphere, axis=1)[:, None]) @ root.T
    direction = rng.normal(size=3)
    largest = float(np.max(ball @ direction))
    bound = float(Norm(3, matrix).dual(direction))
    assert largest <= bound <= 1.02 * largest


def test_length_over_a_box_bounds_its_members_and_corners_sharpen_it():
    rng = np.random.default_rng(8)
    matrix = np.array([[2.0, -1.5], [-1.5, 2.0]])
    norm = Norm(2, matrix)
    box = Interval(np.array([[-1.0, -1.0]]), np.array([[1.0, 1.0]]))
    members = rng.uniform(-1, 1, size=(2000, 2))
    sampled = np.sqrt(np.einsum("bi,ij,bj->b", members, matrix, members)).max()
    assert sampled <= float(largest_over_box(norm, box)[0]) <= np.sqrt(7.0) * (1 + 1e-9)
    assert float(norm.length(box)[0]) >= float(largest_over_box(norm, box)[0])


def test_an_unbounded_box_has_infinite_length():
    box = Interval(np.array([[-np.inf, 0.0], [0.0, 0.0]]), np.array([[np.inf, 1.0], [0.0, 1.0]]))
    assert np.isinf(Norm(2, np.diag([1.0, 2.0])).length(box)[0])
    assert np.isfinite(Norm(2, np.diag([1.0, 2.0])).length(box)[1])


def test_section_is_the_largest_projection_of_the_ball():
    matrix = metric(np.random.default_rng(9), 4, 1.0)
    rows = np.eye(4)[[0, 2]]
    exact = np.sqrt(np.linalg.eigvalsh(rows @ np.linalg.inv(matrix) @ rows.T)[-1])
    assert exact * (1 - 1e-12) <= Norm(4, matrix).section(rows) <= exact * (1 + 1e-6)
    scaled = np.diag([0.5, 1.0]) @ rows
    exact = np.sqrt(np.linalg.eigvalsh(scaled @ np.linalg.inv(matrix) @ scaled.T)[-1])
    assert exact * (1 - 1e-12) <= Norm(4, matrix).section(scaled) <= exact * (1 + 1e-6)


def test_the_identity_is_the_euclidean_norm():
    assert 5.0 <= float(Norm(2).length(Interval.point(np.array([3.0, 4.0])))) < 5.0 + 1e-12
    assert 5.0 <= float(Norm(2).dual(np.array([3.0, 4.0]))) < 5.0 + 1e-12
