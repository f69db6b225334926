"""Noise as independent parts and one common factor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import certbound as cb
from certbound.rigor.intervals import Interval
from certbound.values.discrete.failures import bound_failure
from certbound.values.discrete.shocks import Inapplicable, gaussian_shocks, shocks_of


def rebuilt(covariance: np.ndarray) -> np.ndarray:
    found = gaussian_shocks(Interval.point(covariance))
    factor = found.factor.mid
    return np.asarray(np.diag(found.sigma.mid**2) + np.outer(factor, factor))


@pytest.mark.parametrize(
    "covariance",
    [
        [[0.04]],
        [[0.04, 0.01], [0.01, 0.09]],
        [[0.04, -0.02], [-0.02, 0.09]],
        [[1, 0, 0.5], [0, 2, 0], [0.5, 0, 1]],
        [[1, 0.3, 0.4], [0.3, 2, 0.5], [0.4, 0.5, 1]],
        [[1, -0.3, -0.4], [-0.3, 2, 0.5], [-0.4, 0.5, 1]],
    ],
)
def test_the_parts_add_up_to_the_covariance(covariance: list[list[float]]) -> None:
    assert rebuilt(np.array(covariance)) == pytest.approx(np.array(covariance), rel=1e-12, abs=1e-15)


def test_independent_noise_has_no_common_factor() -> None:
    found = shocks_of(cb.Gaussian(std=[0.1, 0.2]).resolve(2), np.array([[1.0, 0.0], [0.0, -2.0]]))
    assert not found.common
    assert found.sigma.contains(np.array([0.1, 0.4])).all()


@pytest.mark.parametrize(
    "covariance",
    [
        [[1, 0.3, 0], [0.3, 1, 0.3], [0, 0.3, 1]],
        [[1, -0.3, 0.3], [-0.3, 1, 0.3], [0.3, 0.3, 1]],
        [[0.0]],
        [[1, 1], [1, 1]],
    ],
)
def test_what_is_no_such_sum_is_refused(covariance: list[list[float]]) -> None:
    with pytest.raises(Inapplicable, match="value functions"):
        gaussian_shocks(Interval.point(np.array(covariance, dtype=float)))


@pytest.mark.parametrize("law", [cb.Bounded(halfwidth=0.1), cb.SubGaussian(proxy_std=0.1)])
def test_a_class_of_laws_is_refused(law: object) -> None:
    with pytest.raises(Inapplicable, match="class of laws"):
        shocks_of(law.resolve(1), np.eye(1))  # type: ignore[attr-defined]


@pytest.mark.parametrize("unit", [1e-150, 1e150])
@pytest.mark.parametrize("law", [lambda c: cb.Gaussian(std=0.2 * c), lambda c: cb.Uniform(halfwidth=0.2 * c)])
def test_units_in_which_floats_end_are_refused(law: Callable[[float], object], unit: float) -> None:
    """Second derivatives of 1e-300 vanished from the tables: the lower bound was .0491 where .0489 is an upper one."""
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=1, noise=law(unit))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-unit], [unit]))], horizon=10)
    with pytest.raises(Inapplicable, match="another unit"):
        bound_failure(problem, seconds=1.0)
