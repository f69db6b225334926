"""Noise is given by name; proxies bound the moment generating function; samples follow the law."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.noise import Bounded, Gaussian, Rademacher, SubGaussian, Uniform

LAWS = [
    Gaussian(std=[0.5, 2.0]),
    Gaussian(covariance=[[2.0, 0.7], [0.7, 1.0]]),
    Uniform(halfwidth=[1.5, 0.3]),
    Rademacher(scale=[1.0, 0.2]),
    Bounded(halfwidth=[1.0, 0.5]),
    Bounded(halfwidth=[1.0, 0.5], independent=False),
]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Gaussian(0.1), "takes no bare value, got 0.1; say std= or variance= or covariance="),
        (lambda: Uniform(0.1), "say halfwidth="),
        (lambda: Rademacher(0.1), "say scale="),
        (lambda: SubGaussian(0.1), "say proxy_std= or proxy_variance= or proxy_covariance="),
    ],
)
def test_a_bare_number_is_refused_with_the_names(build, message):
    with pytest.raises(TypeError, match=message):
        build()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Gaussian(), "needs exactly one of std=, variance=, covariance=; got none"),
        (lambda: Gaussian(std=1, variance=1), r"got \['std', 'variance'\]"),
        (lambda: Gaussian(std=-1), "`std` must not be negative"),
        (lambda: Gaussian(variance=np.nan), "must not contain nan"),
        (lambda: Gaussian(std=np.inf), "must be finite"),
        (lambda: Gaussian(std=np.eye(2)), "a matrix is a covariance="),
        (lambda: SubGaussian(proxy_std=np.eye(2)), "a matrix is a proxy_covariance="),
        (lambda: Gaussian(covariance=[[1, 2], [2, 1]]), "positive semidefinite, its smallest eigenvalue is -1"),
        (lambda: Gaussian(covariance=[[1e12, 0], [0, -0.5]]), "its diagonal has -0.5"),
        (lambda: Gaussian(covariance=[[1e12, 2], [2, 1e-12]]), "must be positive semidefinite, its smallest"),
        (lambda: SubGaussian(proxy_covariance=[[1e12, 1], [1, 0]]), "a row whose diagonal entry is 0 must be 0"),
        (lambda: Gaussian(covariance=[[1, 2], [0, 1]]), "must be symmetric"),
        (lambda: Gaussian(covariance=[[1, 2, 3], [0, 1, 2]]), "must be square"),
        (lambda: Uniform(halfwidth=-1), "`halfwidth` must not be negative"),
        (lambda: Gaussian(std=[1, 2]).resolve(3), "must be a number or 3 numbers, got 2"),
        (lambda: Gaussian(covariance=np.eye(2)).resolve(3), "must be 3 x 3, got 2 x 2"),
    ],
)
def test_levels_are_checked(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_what_rounding_has_taken_from_a_covariance_is_added_in_proportion_to_its_variances():
    short = np.array([[1e12, 1 + 1e-13], [1 + 1e-13, 1e-12]])
    found = Gaussian(covariance=short).covariance
    np.testing.assert_allclose(np.diag(found), np.diag(short) * (1 + 1e-12), rtol=1e-15)
    np.testing.assert_array_equal(Gaussian(covariance=np.ones((3, 3))).covariance, np.ones((3, 3)))


@settings(derandomize=True, deadline=None)
@given(std=st.floats(1e-100, 1e100))
def test_the_proxy_of_a_standard_deviation_is_never_rounded_down(std):
    proxy = Gaussian(std=std).resolve(1).proxy[0, 0]
    assert Fraction(float(proxy)) >= Fraction(std) ** 2
    assert proxy <= np.nextafter(std * std, np.inf)
    bounded = Bounded(halfwidth=[std, std, std], independent=False).proxy[0, 0]
    assert Fraction(float(bounded)) >= 3 * Fraction(std) ** 2
    uniform = Uniform(halfwidth=std).resolve(1).proxy[0, 0]
    assert Fraction(float(uniform)) >= Fraction(std) ** 2 / 3


def test_a_variance_is_its_own_proxy():
    np.testing.assert_array_equal(Gaussian(variance=0.1).resolve(2).proxy, 0.1 * np.eye(2))
    np.testing.assert_array_equal(SubGaussian(proxy_variance=0.1).resolve(2).proxy, 0.1 * np.eye(2))


def test_proxies_and_bounds_in_closed_form():
    np.testing.assert_allclose(Uniform(halfwidth=3.0).resolve(2).proxy, 3 * np.eye(2), rtol=1e-15)
    np.testing.assert_array_equal(Rademacher(scale=[1.0, 2.0]).proxy, np.diag([1.0, 4.0]))
    np.testing.assert_array_equal(Bounded(halfwidth=[3.0, 4.0]).proxy, np.diag([9.0, 16.0]))
    np.testing.assert_array_equal(Bounded(halfwidth=[3.0, 4.0], independent=False).proxy, 25 * np.eye(2))
    np.testing.assert_array_equal(Bounded(halfwidth=[3.0, 4.0]).bound, [3.0, 4.0])
    assert Gaussian(std=1).bound is None
    assert SubGaussian(proxy_std=1).bound is None
    np.testing.assert_array_equal(Uniform(halfwidth=[1.0, 0.0]).proxy[1], [0.0, 0.0])


def test_only_the_gaussian_law_says_that_it_is_one():
    assert [law.gaussian for law in LAWS] == [True, True, False, False, False, False]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_samples_are_centred_bounded_and_below_the_proxy(law):
    samples = law.sample(np.random.default_rng(0), (100, 1000))
    assert samples.shape == (100, 1000, 2)
    flat = samples.reshape(-1, 2)
    covariance = flat.T @ flat / len(flat)
    np.testing.assert_allclose(flat.mean(axis=0), 0.0, atol=0.03)
    assert np.linalg.eigvalsh(law.proxy - covariance).min() > -0.05
    if law.bound is not None:
        assert np.all(np.abs(flat) <= law.bound)
        assert np.all(np.abs(flat).max(axis=0) > 0.99 * law.bound)


def test_a_gaussian_sample_has_the_covariance():
    law = Gaussian(covariance=[[2.0, 0.7], [0.7, 1.0]])
    np.testing.assert_allclose(law.factor @ law.factor.T, law.covariance, atol=1e-12)
    samples = law.sample(np.random.default_rng(1), 200_000)
    np.testing.assert_allclose(np.cov(samples.T), law.covariance, atol=0.02)


def test_a_singular_covariance_is_allowed():
    law = Gaussian(covariance=np.ones((2, 2)))
    samples = law.sample(np.random.default_rng(2), 100)
    np.testing.assert_allclose(samples[:, 0], samples[:, 1], atol=1e-7)


def test_noise_without_a_law_cannot_be_simulated():
    with pytest.raises(ValueError, match="cannot be simulated; give a law"):
        SubGaussian(proxy_std=1).resolve(1).sample(np.random.default_rng(0), 3)


def test_moment_generating_functions_stay_below_the_proxy():
    lam = np.linspace(-20, 20, 401)
    proxy = Uniform(halfwidth=1.0).resolve(1).proxy[0, 0]
    x = np.where(lam == 0, 1.0, lam)
    assert np.all(np.where(lam == 0, 1.0, np.sinh(x) / x) <= np.exp(lam**2 * proxy / 2))
    proxy = Rademacher(scale=1.0).resolve(1).proxy[0, 0]
    assert np.all(np.cosh(lam) <= np.exp(lam**2 * proxy / 2))


def test_twelve_entries_and_read_only_arrays():
    law = Gaussian(std=0.1).resolve(12)
    assert law.dimension == 12
    assert law.sample(np.random.default_rng(0), 5).shape == (5, 12)
    with pytest.raises(ValueError, match="read-only"):
        law.std[0] = 1.0
