"""The constants by which wider normal densities dominate derivatives of narrower ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.hermite_e import HermiteE
from scipy.integrate import quad

from certbound.values.discrete.dominance import KAPPA, density_tail, dominance, quadrature_error, tail


def hermite(order: int, z: np.ndarray) -> np.ndarray:
    return np.asarray(HermiteE.basis(order)(z))


def density(z: np.ndarray) -> np.ndarray:
    return np.asarray(np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi))


@pytest.mark.parametrize("order", range(9))
@pytest.mark.parametrize("rho", [0.0, 0.3, 1.0])
def test_the_constant_dominates_every_shifted_derivative_and_is_nearly_attained(order: int, rho: float) -> None:
    y, shift = np.linspace(-12, 12, 4801)[:, None], np.linspace(-rho, rho, 21)
    derivative = np.abs(hermite(order, y - shift)) * density(y - shift)
    ratio = derivative / (density(y / KAPPA) / KAPPA)
    assert ratio.max() <= dominance(order, rho)
    assert ratio.max() >= 0.9 * dominance(order, rho)


def test_an_extra_factor_is_dominated_too() -> None:
    z = np.linspace(0, 12, 2401)
    ratio = (1 + z) ** 4 * density(z) / (density((z + 0.5) / KAPPA) / KAPPA)
    assert ratio.max() <= dominance(0, 0.5, 4) <= 1.1 * ratio.max()


def test_arguments_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 12"):
        dominance(13)
    with pytest.raises(ValueError, match="at least 7"):
        density_tail(2, 3.0)


@pytest.mark.parametrize("order", range(7))
def test_tails_of_derivatives_are_bounded(order: int) -> None:
    exact = 2 * quad(lambda z: float(np.abs(hermite(order, np.array(z))) * density(np.array(z))), 8, 40)[0]
    assert exact * (1 - 1e-4) <= density_tail(order, 8.0) <= 2 * exact
    assert tail(8.0) >= density_tail(0, 8.0) * (1 - 1e-12)


@pytest.mark.parametrize(("points", "half"), [(5, 0.1), (6, 0.25), (8, 0.5)])
@pytest.mark.parametrize("order", range(3))
def test_the_rule_is_as_exact_as_stated(points: int, half: float, order: int) -> None:
    bound = quadrature_error(points, half, order, 11.0)
    root, weight = np.polynomial.legendre.leggauss(points)
    fine, heavy = np.polynomial.legendre.leggauss(40)
    for centre in np.linspace(0, 8, 33):
        for shape in (lambda t: np.ones_like(t), lambda t: (1 + t) / 2, lambda t: 1 - t**2):

            def rule(t: np.ndarray, w: np.ndarray, shape=shape, centre=centre) -> float:  # type: ignore[no-untyped-def]
                z = centre + half * t
                return float(np.sum(w * shape(t) * hermite(order, z) * density(z)))

            mass = float(np.sum(heavy * density((centre + half * fine) / KAPPA) / KAPPA))
            assert abs(rule(root, weight) - rule(fine, heavy)) <= bound * mass + 1e-15
