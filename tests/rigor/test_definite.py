"""Eigenvalue bounds hold for every member, are tight, and refuse what they must."""

from __future__ import annotations

import flint
import numpy as np
import pytest

from certbound.rigor.definite import eigenvalue_lower, eigenvalue_upper, is_positive_definite
from certbound.rigor.intervals import Interval


def symmetric(rng: np.random.Generator, *shape: int) -> np.ndarray:
    a = rng.normal(size=shape)
    return (a + np.swapaxes(a, -1, -2)) / 2


@flint.ctx.workprec(200)
def exceeds(matrix: np.ndarray, bound: float) -> bool:
    """Whether lambda_max(matrix) > bound for certain: bound I - matrix is indefinite in ball arithmetic."""
    n = len(matrix)
    shifted = flint.arb_mat((-matrix).tolist()) + flint.arb_mat(np.eye(n).tolist()) * flint.arb(float(bound))
    for k in range(1, n + 1):
        leading = flint.arb_mat([[shifted[i, j] for j in range(k)] for i in range(k)])
        if leading.det() < 0:
            return True
    return False


@pytest.mark.parametrize("n", [1, 2, 3, 5, 12])
def test_eigenvalue_bounds_of_point_matrices_are_rigorous_and_tight(n):
    rng = np.random.default_rng(n)
    a = symmetric(rng, 40, n, n) * 10.0 ** rng.uniform(-6, 6, (40, 1, 1))
    a[:3] = np.eye(n) * 0.1
    up, low = eigenvalue_upper(a), eigenvalue_lower(a)
    size = np.abs(np.linalg.eigvalsh(a)).max(axis=-1)
    assert np.all(up - np.linalg.eigvalsh(a)[:, -1] <= 1e-13 * n * size)
    assert np.all(np.linalg.eigvalsh(a)[:, 0] - low <= 1e-13 * n * size)
    for k in range(40):
        assert not exceeds(a[k], up[k])
        assert not exceeds(-a[k], -low[k])
        assert exceeds(a[k], up[k] - 1e-12 * n * size[k])


@pytest.mark.parametrize("n", [2, 3, 4, 8])
def test_eigenvalue_bounds_hold_for_members_and_are_tight_to_first_order(n):
    rng = np.random.default_rng(10 + n)
    middle, radius = symmetric(rng, n, n), np.abs(symmetric(rng, n, n)) * 1e-6
    bound = eigenvalue_upper(Interval.around(middle, radius))
    signs = np.sign(np.outer(v := np.linalg.eigh(middle)[1][:, -1], v))
    worst = np.linalg.eigvalsh(middle + radius * signs)[-1]
    assert worst <= bound <= worst + 1e-4 * radius.max() * n
    noise = rng.uniform(-1, 1, (2000, n, n))
    noise = np.triu(noise) + np.swapaxes(np.triu(noise, 1), -1, -2)
    for size in (1.0, 1e6):
        values = np.linalg.eigvalsh(middle + size * radius * noise)
        wide = Interval.around(middle, size * radius)
        assert values.max() <= eigenvalue_upper(wide)
        assert values.min() >= eigenvalue_lower(wide)


def test_wide_interval_matrices_of_order_two_get_the_exact_largest_eigenvalue():
    a = Interval([[-5.0, -2.0], [-1.0, -np.inf]], [[1.0, 1.0], [1.0, 3.0]])
    exact = np.linalg.eigvalsh(np.array([[1.0, 1.0], [1.0, 3.0]]))[-1]
    assert exact <= eigenvalue_upper(a) <= exact + 1e-14


def test_unbounded_entries_give_infinite_bounds_only_where_they_matter():
    lo, hi = -np.ones((4, 3, 3)), np.ones((4, 3, 3))
    lo[0, 1, 1] = -np.inf
    hi[1, 1, 1] = np.inf
    lo[2, 0, 1] = lo[2, 1, 0] = -np.inf
    bound = eigenvalue_upper(Interval(lo, hi))
    assert np.isfinite(bound).tolist() == [True, False, False, True]
    assert np.isinf(eigenvalue_upper(Interval(lo[2, :2, :2], hi[2, :2, :2])))


def test_tiny_and_huge_matrices_are_bounded_soundly():
    for scale in (1e-170, 1e-300, 1e150):
        a = np.array([[1.0, 2.0], [2.0, -1.0]]) * scale
        assert eigenvalue_upper(a) >= np.sqrt(5.0) * scale * (1 - 1e-15)


def test_positive_definiteness_is_decided_on_both_sides_of_the_edge():
    hilbert = 1.0 / (np.arange(6)[:, None] + np.arange(6) + 1.0)
    assert is_positive_definite(hilbert)
    assert not is_positive_definite(-hilbert)
    edge = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert not is_positive_definite(edge)
    assert is_positive_definite(edge + 1e-13 * np.eye(3))
    assert not is_positive_definite(Interval.around(edge + 1e-3 * np.eye(3), 1.1e-3))
    badly_scaled = np.diag([1e-200, 1.0, 1e200]) + 0.0
    badly_scaled[0, 1] = badly_scaled[1, 0] = 5e-101
    assert is_positive_definite(np.stack([badly_scaled, edge])).tolist() == [True, False]
    assert not is_positive_definite(np.diag([0.0, 1.0]))


def test_malformed_matrices_are_refused():
    with pytest.raises(ValueError, match="`A` must be a batch of square matrices"):
        eigenvalue_upper(np.ones((2, 3)))
    with pytest.raises(ValueError, match="symmetric"):
        eigenvalue_upper(np.array([[1.0, 2.0], [0.0, 1.0]]))


@pytest.mark.parametrize("n", [40, 400])
def test_a_large_matrix_is_proved_definite_by_its_factor(n):
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    values = np.geomspace(1e-5, 1.0, n)
    matrix = (basis * values) @ basis.T
    matrix = (matrix + matrix.T) / 2
    assert is_positive_definite(matrix)
    shifted = matrix - 1.0001e-5 * np.eye(n)
    assert not is_positive_definite(shifted)
    assert not is_positive_definite(Interval.around(matrix, np.full((n, n), 1e-5)))


def test_a_large_matrix_in_very_different_units_is_proved_definite():
    n = 50
    rng = np.random.default_rng(1)
    units = 10.0 ** rng.uniform(-20, 20, n)
    root = np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n)
    matrix = root @ root.T
    scaled = units[:, None] * ((matrix + matrix.T) / 2) * units
    assert is_positive_definite(np.minimum(scaled, scaled.T))


def test_a_factor_proves_nothing_of_an_unbounded_matrix():
    n = 40
    entries = np.eye(n)
    high = entries.copy()
    high[0, 1] = high[1, 0] = np.inf
    assert not is_positive_definite(Interval(entries, high))
