"""Integrals of the basis functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from certbound.values.discrete.dominance import KAPPA
from certbound.values.discrete.kernels import AxisKernel, axis_kernel

NODES = np.array([-1.0, -0.7, -0.65, -0.2, 0.4, 0.5, 1.1])
POINTS = np.linspace(-2.0, 2.0, 41)
SIGMA = 0.15


@pytest.fixture(scope="module")
def kernel() -> AxisKernel:
    return axis_kernel(POINTS, NODES, SIGMA, 1e-15)


def reference(name: str, k: int, order: int) -> np.ndarray:
    """The integral over interval k, by a fine rule."""
    root, weight = np.polynomial.legendre.leggauss(200)
    tau = (root + 1) / 2
    width = NODES[k + 1] - NODES[k]
    z = (NODES[k] + width * tau - POINTS[:, None]) / SIGMA
    shape = {"left": 1 - tau, "right": tau, "bubble": width**2 * tau * (1 - tau) / 2, "whole": 1 + 0 * tau}[name]
    factor = [1 + 0 * z, z / SIGMA, (z**2 - 1) / SIGMA**2][order]
    return np.asarray((norm.pdf(z) / SIGMA * factor * shape) @ weight * width / 2)


@pytest.mark.parametrize("name", ["left", "right", "bubble", "whole"])
@pytest.mark.parametrize("order", range(3))
def test_every_entry_is_the_integral(kernel: AxisKernel, name: str, order: int) -> None:
    for k in range(len(NODES) - 1):
        unit = np.zeros(len(NODES) - 1)
        unit[k] = 1.0
        found = kernel.apply(name, unit, 0)[order]
        mass = norm.cdf((NODES[k + 1] - POINTS) / SIGMA / KAPPA) - norm.cdf((NODES[k] - POINTS) / SIGMA / KAPPA)
        bound = kernel.error * SIGMA**-order * mass + 1e-20 * SIGMA**-order
        assert np.all(np.abs(found - reference(name, k, order)) <= bound + 1e-13 * np.abs(reference(name, k, order)))
        assert kernel.apply_mass(unit) == pytest.approx(mass, rel=1e-4, abs=1e-12)


def test_hats_and_the_outside_make_up_everything(kernel: AxisKernel) -> None:
    ones = kernel.apply("hat", np.ones(len(NODES)), 0)
    for order, total in enumerate((1.0, 0.0, 0.0)):
        assert ones[order] + kernel.outside[order] == pytest.approx(total, abs=1e-11)
    inside = norm.cdf((NODES[-1] - POINTS) / SIGMA) - norm.cdf((NODES[0] - POINTS) / SIGMA)
    assert kernel.outside[0] == pytest.approx(1 - inside, abs=1e-14)


def test_far_tails_keep_their_digits() -> None:
    kernel = axis_kernel(np.array([0.0]), np.array([-0.9, 0.9]), 0.1, 0.0)
    assert kernel.outside[0, 0] == pytest.approx(2 * norm.sf(9), rel=1e-12)
