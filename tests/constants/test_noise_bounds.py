"""sigma and nu bound the noise in the metric; isotropy is found by exact arithmetic, never assumed."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.bounds import bound_constants
from certbound.constants.enclosures.coordinates import Metric
from certbound.constants.model_data import model_of
from certbound.constants.noise_bounds import bound_noise
from certbound.errors import EnclosureError, InfeasibleError

WEIGHT = np.array([[2.0, 0.5], [0.5, 1.0]])


def truth(covariance, metric):
    """sigma and tr/sigma^2 in floating point."""
    root = np.linalg.cholesky(metric).T
    inside = root @ covariance @ root.T
    top = np.linalg.eigvalsh(inside)[-1]
    return np.sqrt(top), np.trace(inside) / top


@pytest.mark.parametrize("metric", [None, WEIGHT])
def test_constant_diffusion_and_proxies_are_bounded_tightly(metric):
    rng = np.random.default_rng(0)
    gain = rng.normal(size=(2, 3))
    p = np.eye(2) if metric is None else metric
    ct = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=gain)
    for system, covariance in (
        (ct, gain @ gain.T),
        (
            cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Gaussian(covariance=WEIGHT)),
            WEIGHT,
        ),
        (
            cb.DiscreteSystem(
                lambda x: 0.5 * x, states=2, noise=cb.Uniform(halfwidth=[0.1, 0.2, 0.3]), noise_matrix=gain
            ),
            None,
        ),
    ):
        if covariance is None:
            covariance = gain @ system.noise.proxy @ gain.T
        found = bound_noise(model_of(system, None, None), Metric(metric, 2))
        sigma, nu = truth(covariance, p)
        assert sigma * (1 - 1e-15) <= found.sigma <= sigma * (1 + 1e-12)
        assert abs(found.effective_dimension - nu) < 1e-11
        assert found.effective_dimension * found.sigma**2 >= nu * sigma**2 * (1 - 1e-14)
        assert not found.isotropic


def test_isotropy_is_found_exactly():
    def isotropic(diffusion, metric=None):
        system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=diffusion)
        return bound_noise(model_of(system, None, None), Metric(metric, 2))

    assert isotropic(0.1 * np.eye(2)).isotropic
    assert isotropic(0.1 * np.eye(2)).sigma == 0.1
    assert isotropic([[0.0, 0.3], [-0.3, 0.0]]).isotropic
    assert not isotropic([[0.1, 0.0], [0.0, np.nextafter(0.1, 1)]]).isotropic
    assert not isotropic([[0.1, 0.0], [0.0, 0.0]]).isotropic
    assert isotropic([[0.5, 0.0], [0.0, 1.0]], [[4.0, 0.0], [0.0, 1.0]]).isotropic
    assert not isotropic(0.1 * np.eye(2), WEIGHT).isotropic
    c, s = np.cos(0.3), np.sin(0.3)
    assert isotropic([[c, -s], [s, c]]).isotropic
    assert not isotropic([[c, -s], [s, np.nextafter(c, 0)]]).isotropic


@pytest.mark.parametrize(
    ("law", "isotropic", "gaussian"),
    [
        (cb.Gaussian(std=0.1), True, True),
        (cb.Gaussian(variance=0.01), True, True),
        (cb.Gaussian(covariance=[[0.01, 0.0], [0.0, 0.01]]), True, True),
        (cb.Gaussian(std=[0.1, 0.2]), False, True),
        (cb.Uniform(halfwidth=0.1), False, False),
        (cb.Rademacher(scale=0.1), False, False),
        (cb.SubGaussian(proxy_std=0.1), False, False),
    ],
)
def test_only_gaussian_noise_is_gaussian(law, isotropic, gaussian):
    k = bound_constants(cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=law), metric="euclidean")
    assert (k.isotropic, k.gaussian) == (isotropic, gaussian)


def test_nu_never_exceeds_the_rank_of_the_noise():
    column = cb.ContinuousSystem(lambda x: -x, states=3, diffusion=[[0.3], [0.1], [0.7]])
    assert bound_constants(column, metric="euclidean").nu <= 1.0
    assert bound_constants(cb.linear_system(-np.eye(3)), metric="euclidean").sigma == 0.0


def test_state_dependent_diffusion_is_bounded_over_the_domain():
    def g(x):
        return [[0.2 + 0.1 * np.sin(x[0]), 0.05 * x[1]], [0.0, 0.1]]

    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=g)
    domain = cb.Box([-2.0, -1.0], [2.0, 1.0])
    rng = np.random.default_rng(1)
    for metric in (None, WEIGHT):
        k = bound_constants(system, domain, metric="euclidean" if metric is None else metric)
        p = np.eye(2) if metric is None else metric
        x = rng.uniform([-2, -1], [2, 1], (4000, 2))
        diffusion = np.zeros((len(x), 2, 2))
        diffusion[:, 0, 0], diffusion[:, 0, 1] = 0.2 + 0.1 * np.sin(x[:, 0]), 0.05 * x[:, 1]
        diffusion[:, 1, 1] = 0.1
        level = np.swapaxes(diffusion, 1, 2) @ p @ diffusion
        top, trace = np.linalg.eigvalsh(level)[:, -1], np.trace(level, axis1=1, axis2=2)
        assert np.sqrt(top.max()) <= k.sigma <= np.sqrt(top.max()) * 1.02
        assert trace.max() <= k.nu * k.sigma**2 <= trace.max() * 1.02
        assert not k.isotropic


def test_unbounded_or_undefined_diffusion_is_refused():
    growing = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda x: [[0.1 * x[0]]])
    with pytest.raises(InfeasibleError, match=r"diffusion is unbounded on all of R\^n"):
        bound_constants(growing, metric="euclidean")
    assert bound_constants(growing, cb.Box([-2], [2]), metric="euclidean").sigma < 0.2 + 1e-4
    with pytest.raises(EnclosureError, match="keep the diffusion bounded"):
        bound_constants(growing, cb.Box([0], [np.inf]), metric="euclidean")
    root = cb.ContinuousSystem(lambda x: -x, states=["q"], diffusion=lambda x: [[np.sqrt(x[0])]])
    with pytest.raises(EnclosureError, match=r"sqrt\(q\)"):
        bound_constants(root, cb.Box([-1], [1]), metric="euclidean")
