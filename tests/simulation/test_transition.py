"""The exact transition of a linear system: closed forms, and integrals computed another way."""

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from certbound.simulation.transition import exact_transition


def test_the_scalar_transition_is_the_ornstein_uhlenbeck_law():
    move, shift, factor = exact_transition(np.array([[-0.7, 2.0]]), np.array([0.3]), np.array([[0.5]]), 0.4)
    decay = np.exp(-0.28)
    np.testing.assert_allclose(move, [[decay, 2.0 * (1 - decay) / 0.7]], rtol=1e-13)
    np.testing.assert_allclose(shift, [0.3 * (1 - decay) / 0.7], rtol=1e-13)
    np.testing.assert_allclose(factor**2, [[0.25 * (1 - decay**2) / 1.4]], rtol=1e-13)


def test_a_double_integrator_gets_its_textbook_covariance():
    _, _, factor = exact_transition(np.array([[0.0, 1.0], [0.0, 0.0]]), np.zeros(2), np.array([[0.0], [1.0]]), 0.1)
    expected = np.array([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]])
    np.testing.assert_allclose(factor @ factor.T, expected, rtol=1e-10)


@pytest.mark.parametrize("step", [1e-3, 0.5, 20.0])
def test_the_covariance_is_the_integral_also_for_stiff_systems(step):
    rng = np.random.default_rng(1)
    matrix = rng.standard_normal((4, 4)) - 3 * np.eye(4)
    matrix[0] *= 10.0
    diffusion = rng.standard_normal((4, 2))
    move, _, factor = exact_transition(matrix, np.zeros(4), diffusion, step)
    np.testing.assert_allclose(move, expm(matrix * step), atol=1e-12)

    def integrand(s):
        image = expm(matrix * s) @ diffusion
        return image @ image.T

    expected, _ = quad_vec(integrand, 0.0, step, epsabs=1e-13, epsrel=1e-12, limit=2000)
    np.testing.assert_allclose(factor @ factor.T, expected, rtol=1e-8, atol=1e-12)


def test_states_that_get_no_noise_need_no_variates():
    move, _, factor = exact_transition(np.diag([-1.0, -2.0]), np.zeros(2), np.array([[1.0], [0.0]]), 0.1)
    assert factor.shape == (2, 1)
    assert factor[1, 0] == 0.0
    np.testing.assert_allclose(np.diag(move), np.exp([-0.1, -0.2]))


def test_a_system_at_rest_without_noise_has_an_empty_factor():
    _, _, factor = exact_transition(np.zeros((2, 2)), np.ones(2), np.zeros((2, 1)), 0.1)
    assert factor.shape == (2, 0)
