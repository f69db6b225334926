"""Lower bounds of overlaps against trivariate normal probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from certbound.gaussian.scalar.normal import log_tail, log_tail_below
from certbound.gaussian.scalar.triples import triple_below


def exact(matrix: np.ndarray, below: float, above: float, third: float) -> float:
    sign = np.diag([1.0, -1.0, -1.0])
    return float(multivariate_normal(np.zeros(3), sign @ matrix @ sign, allow_singular=True).cdf(
        [below, -above, -third]))


def test_the_lower_tail_is_below_and_near() -> None:
    x = np.concatenate([np.linspace(-8, 37, 400), [0.0, 1e-300, -1e-300, 100.0]])
    assert np.all(log_tail_below(x) <= norm.logsf(x) + 1e-15 * np.abs(norm.logsf(x)))
    assert np.all(log_tail(x) - log_tail_below(x) <= 1e-13 * (1 + x * x))
    assert log_tail_below(np.inf) == -np.inf


@pytest.mark.parametrize("seed", range(4))
def test_overlaps_are_bounded_from_below(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shares = []
    for _ in range(25):
        root = rng.standard_normal((3, 3))
        matrix = root @ root.T
        sd = np.sqrt(np.diag(matrix))
        x, y, w = rng.uniform(-1, 2.5) * sd[0], rng.uniform(-1, 2.5) * sd[1], rng.uniform(0, 2.5) * sd[2]
        slack = 1e-9 * np.abs(matrix)
        lo, hi = matrix - slack, matrix + slack
        found = float(triple_below(
            x, y, w, tuple((lo[i, i], hi[i, i]) for i in range(3)),
            tuple((lo[i, j], hi[i, j]) for i, j in ((0, 1), (0, 2), (1, 2))),
        )[0])
        truth = exact(matrix, x, y, w)
        assert found <= truth + 2e-5
        if truth > 1e-2:
            shares.append(found / truth)
    assert np.median(shares) > 0.85


def test_consecutive_steps_of_a_slow_process_keep_most_of_the_overlap() -> None:
    # X, Y one step apart (correlation .97), W a little earlier
    matrix = np.array([[1, 0.97, 0.8], [0.97, 1, 0.75], [0.8, 0.75, 1]])
    found = float(triple_below(2.0, 2.0, 2.0, (1.0, 1.0, 1.0), (0.97, 0.8, 0.75))[0])
    truth = exact(matrix, 2.0, 2.0, 2.0)
    assert 0.75 * truth < found < truth


def test_what_cannot_be_bounded_is_zero() -> None:
    assert float(triple_below(1.0, 1.0, 1.0, (1.0, 1.0, 0.0), (0.5, 0.0, 0.0))[0]) == 0.0
    assert float(triple_below(np.inf, 1.0, 1.0, (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))[0]) == 0.0
    assert float(triple_below(1.0, 1.0, -1.0, (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))[0]) == 0.0
    with pytest.raises(ValueError, match="must not contain NaN"):
        triple_below(np.nan, 1.0, 1.0, (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))
