"""Measures and norms in a metric hold in ball arithmetic, are tight, and keep shared parameters correlated."""

from __future__ import annotations

import flint
import numpy as np
import pytest

from certbound.constants.enclosures.coordinates import Metric, Spread
from certbound.rigor.intervals import Interval


def metrics(rng: np.random.Generator, n: int) -> list[np.ndarray | None]:
    a = rng.normal(size=(n, n))
    stretch = np.diag(10.0 ** np.linspace(-3, 3, n))
    well = a @ a.T + np.eye(n)
    badly = stretch @ well @ stretch
    return [None, well, (badly + badly.T) / 2]


def is_indefinite(matrix: flint.arb_mat) -> bool:
    """Whether the matrix is certainly not positive semidefinite (a leading minor is negative)."""
    n = matrix.nrows()
    for k in range(1, n + 1):
        leading = flint.arb_mat([[matrix[i, j] for j in range(k)] for i in range(k)])
        if leading.det() < 0:
            return True
    return False


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@flint.ctx.workprec(300)
def test_the_inequalities_hold_in_ball_arithmetic_and_fail_just_below(n):
    rng = np.random.default_rng(n)
    jacobians = rng.normal(size=(6, n, n)) * 10.0 ** rng.uniform(-3, 3, (6, 1, 1))
    for matrix in metrics(rng, n):
        norm = Metric(matrix, n)
        p = flint.arb_mat((np.eye(n) if matrix is None else matrix).tolist())
        measures, norms = norm.measure(Interval.point(jacobians)), norm.norm(Interval.point(jacobians))
        for j, c, gain in zip(jacobians, measures.tolist(), norms.tolist(), strict=True):
            ball = flint.arb_mat(j.tolist())
            form = ball.transpose() * p + p * ball
            square = ball.transpose() * p * ball
            slack = 1e-9 * gain
            assert not is_indefinite(p * flint.arb(2 * c) - form)
            assert is_indefinite(p * flint.arb(2 * (c - slack)) - form)
            assert not is_indefinite(p * (flint.arb(gain) ** 2) - square)
            assert is_indefinite(p * (flint.arb(gain * (1 - 1e-9)) ** 2) - square)


@pytest.mark.parametrize("n", [2, 4])
def test_bounds_cover_members_of_intervals_and_of_linear_terms(n):
    rng = np.random.default_rng(20 + n)
    centre = rng.normal(size=(5, n, n))
    slopes, reach = rng.normal(size=(5, 3, n, n)), rng.uniform(0, 0.1, (5, 3))
    spread = Spread(Interval.around(slopes, 1e-3), reach)
    for matrix in metrics(rng, n)[:2]:
        norm = Metric(matrix, n)
        box = Interval.around(centre, 0.01)
        upper, gains = norm.measure(box), norm.norm(box)
        upper_terms, gains_terms = norm.measure(box, spread), norm.norm(box, spread)
        for _ in range(300):
            member = centre + rng.uniform(-0.01, 0.01, centre.shape)
            assert np.all(norm.sample_measure(member) <= upper)
            assert np.all(norm.sample_norm(member) <= gains)
            share = reach * np.sign(rng.uniform(-1, 1, reach.shape))
            member = member + np.einsum("nk,nkij->nij", share, slopes + rng.uniform(-1e-3, 1e-3, slopes.shape))
            assert np.all(norm.sample_measure(member) <= upper_terms)
            assert np.all(norm.sample_norm(member) <= gains_terms)


def test_shared_parameters_stay_correlated():
    norm = Metric(None, 2)
    centre = Interval.point(np.array([[[0.0, 0.0], [0.0, -5.0]]]))
    skew = Interval.point(np.array([[[[0.0, 1.0], [-1.0, 0.0]]]]))
    assert norm.measure(centre, Spread(skew, np.array([[3.0]])))[0] < 1e-12
    entries = Interval.around(np.array([[[0.0, 0.0], [0.0, -5.0]]]), np.array([[[0.0, 3.0], [3.0, 0.0]]]))
    assert norm.measure(entries)[0] > 1.0


def test_unbounded_jacobians_give_infinity_except_far_down_the_diagonal():
    low, high = -np.ones((3, 2, 2)), np.ones((3, 2, 2))
    low[1, 0, 0] = -np.inf
    high[2, 0, 1] = np.inf
    assert np.isfinite(Metric(None, 2).measure(Interval(low, high))).tolist() == [True, True, False]
    assert np.isfinite(Metric(None, 2).norm(Interval(low, high))).tolist() == [True, False, False]
    weighted = Metric([[2.0, 0.5], [0.5, 1.0]], 2)
    assert np.isfinite(weighted.measure(Interval(low, high))).tolist() == [True, False, False]
    terms = Spread(Interval.point(np.ones((3, 1, 2, 2))), np.array([[1.0], [np.inf], [1.0]]))
    assert np.isfinite(weighted.measure(Interval.point(np.ones((3, 2, 2))), terms)).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1.0]], "2 x 2 matrix, got shape"),
        ([[1.0, np.nan], [np.nan, 1.0]], "must be a finite"),
        ([[1.0, 0.5], [0.0, 1.0]], "must be symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "must be positive definite"),
    ],
)
def test_malformed_metrics_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        Metric(matrix, 2)


@pytest.mark.parametrize("size", [1e-320, 1e-300, 1e200, 1.7e308])
@pytest.mark.parametrize("shape", [[1.0, 1.0, 1.0], [1e-8, 1e-8, 1e-8], [1e-8, 1.0, 1e8]])
@pytest.mark.parametrize("linear", [False, True])
def test_entries_at_the_ends_of_the_floats_end_in_a_bound(size: float, shape: list[float], linear: bool) -> None:
    rng = np.random.default_rng(0)
    metric = Metric(np.diag(shape), 3)
    jacobians = rng.uniform(-1, 1, (4, 3, 3)) * size
    slopes = rng.uniform(-1, 1, (4, 2, 3, 3)) * size
    spread = Spread(slopes=Interval.point(slopes), reach=np.ones((4, 2))) if linear else None
    for bounds in (metric.measure(Interval.point(jacobians), spread), metric.norm(Interval.point(jacobians), spread)):
        assert not np.isnan(bounds).any()
    root = np.sqrt(np.array(shape))
    with np.errstate(over="ignore"):
        inner = jacobians * (root[:, None] / root)
        least = np.abs(inner).max(axis=(1, 2))
    assert np.all(metric.norm(Interval.point(jacobians)) >= least * (1 - 1e-12))
