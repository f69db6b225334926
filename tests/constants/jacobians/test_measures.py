"""Matrix measures and induced norms agree with their definitions; diagonal weights reach the Perron value."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from certbound.constants.jacobians.measures import diagonal_weights, induced_norm, matrix_measure

ORDERS = [1, 2, np.inf]


def example_weights(rng: np.random.Generator, n: int, order: float) -> np.ndarray:
    if order == 2:
        factor = rng.normal(size=(n, n))
        return factor @ factor.T + np.eye(n)
    return rng.uniform(0.2, 5.0, n)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 5), order=st.sampled_from(ORDERS), weighted=st.booleans())
def test_the_measure_is_the_one_sided_derivative_of_the_norm_and_bounds_growth(seed, n, order, weighted):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    weights = example_weights(rng, n, order) if weighted else None
    measure = matrix_measure(A, order, weights=weights)
    h = 1e-7
    slope = (induced_norm(np.eye(n) + h * A, order, weights=weights) - 1) / h
    assert measure == pytest.approx(slope, abs=1e-4)
    assert np.linalg.eigvals(A).real.max() <= measure + 1e-9
    assert measure <= induced_norm(A, order, weights=weights) + 1e-12
    assert induced_norm(expm(A), order, weights=weights) <= np.exp(measure) * (1 + 1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_batches_are_taken_matrix_by_matrix(order):
    batch = np.random.default_rng(0).normal(size=(2, 3, 4, 4))
    assert matrix_measure(batch, order).shape == (2, 3)
    assert matrix_measure(batch, order)[1, 2] == pytest.approx(matrix_measure(batch[1, 2], order))
    assert induced_norm(batch, order)[0, 1] == pytest.approx(np.linalg.norm(batch[0, 1], ord=order))


@pytest.mark.parametrize("order", [1, np.inf])
def test_weights_of_a_metzler_matrix_reach_its_perron_value(order):
    A = np.array([[-3.0, 10.0, 0.0], [0.1, -2.0, 0.5], [0.0, 1.0, -4.0]])
    perron = np.linalg.eigvals(A).real.max()
    weights, value = diagonal_weights(A, order, continuous=True)
    assert perron <= value <= perron + 1e-6
    assert matrix_measure(A, order, weights=weights) == pytest.approx(value)
    assert weights.min() == pytest.approx(1.0)


def test_weights_serve_all_vertices_in_discrete_time_and_beat_the_plain_norm():
    vertices = np.array([[[0.5, 2.0], [0.0, 0.4]], [[-0.5, 2.0], [0.01, 0.4]]])
    weights, value = diagonal_weights(vertices, continuous=False)
    assert value < 0.7 < induced_norm(vertices, np.inf).max()
    assert induced_norm(vertices, np.inf, weights=weights).max() == pytest.approx(value)


def test_the_ratio_of_the_weights_is_bounded():
    weights, value = diagonal_weights([[-1.0, 4.0], [0.0, -1.0]], continuous=True, max_ratio=10.0)
    assert weights.max() <= 10.0 * (1 + 1e-9)
    assert value == pytest.approx(-0.6, abs=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: matrix_measure(np.eye(2), 3), "1, 2 or inf"),
        (lambda: matrix_measure(np.zeros((2, 3))), "square"),
        (lambda: induced_norm(np.eye(2), 1, weights=[1.0, -1.0]), "positive numbers"),
        (lambda: induced_norm(np.eye(2), 2, weights=[1.0, 1.0]), "2 x 2 matrix"),
        (lambda: induced_norm([[np.nan]], 2), "finite"),
        (lambda: diagonal_weights(np.eye(2), 2, continuous=True), "1 or inf"),
        (lambda: diagonal_weights(np.eye(2), 1, continuous=True, max_ratio=0.5), "at least 1"),
    ],
)
def test_malformed_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
