"""Outward rounding of NumPy results, and a-priori error bounds of floating-point products.

The processor rounds + - * / and the square root to nearest, so that each result is off by at most half a unit
in the last place. ``lower`` and ``upper`` step over that error by a relative 2^-52, three times as fast as a
call of ``nextafter`` and at most two units wide; results that may underflow are widened by the smallest
normal number. NumPy's transcendental functions are accurate to four units (the vector kernels' documented
bound); certbound grants them ``LIBRARY_ULPS`` = 8, and the tests measure that this holds against ball
arithmetic.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array

UNIT = 2.0**-53
"""Unit roundoff u of float64: |fl(a op b) - (a op b)| <= u |a op b| barring underflow."""
TINY = 2.0**-1022
"""Smallest normal number, an upper bound of any underflow error."""
LIBRARY_ULPS = 8
"""Units in the last place granted to exp, log, sin, ... of NumPy."""
STEP = 2.0**-52
LARGEST = float(np.finfo(np.float64).max)
_STEP, _MOST, _LEAST = np.array(STEP), np.array(LARGEST), np.array(-LARGEST)  # NumPy takes these faster than floats

quiet = np.errstate(all="ignore")
"""Decorator and context: infinite ends overflow, and 0 * inf is dealt with by hand."""


def down(x: ArrayLike) -> Array:
    """The next float64 below each entry."""
    return np.nextafter(np.asarray(x, dtype=np.float64), -np.inf)


def up(x: ArrayLike) -> Array:
    """The next float64 above each entry."""
    return np.nextafter(np.asarray(x, dtype=np.float64), np.inf)


def lower(value: Array, *, step: float | Array = _STEP, tiny: float = 0.0) -> Array:
    """A lower bound of every number that rounds to ``value``.

    Proves: lower(fl(a op b)) <= a op b for + - * / sqrt. With the default ``step`` = 2u the subtrahend
    exceeds half a unit in the last place also where it is subnormal; sums underflow exactly, so that 0 stays
    0 unless ``tiny`` asks for more. A result of +inf is an overflow and gives the largest float.
    """
    value = np.minimum(value, _MOST)  # an array of its own from here on
    slack = np.abs(value)
    slack *= step
    if tiny:
        slack += tiny
    value -= slack
    return value


def upper(value: Array, *, step: float | Array = _STEP, tiny: float = 0.0) -> Array:
    """An upper bound of every number that rounds to ``value``; see `lower`."""
    value = np.maximum(value, _LEAST)
    slack = np.abs(value)
    slack *= step
    if tiny:
        slack += tiny
    value += slack
    return value


def product_error(terms: int) -> tuple[float, float]:
    """Relative and absolute error of a sum of ``terms`` products, evaluated in any order.

    Proves: |fl(x.y) - x.y| <= gamma * fl(|x|.|y|) + eta, and x.y <= (1 + gamma) fl(x.y) + eta for x, y >= 0.
    gamma = 2 k u / (1 - 2 k u) with k = terms + 2 is at least gamma_k / (1 - gamma_k) of Higham, Accuracy and
    Stability of Numerical Algorithms, Sec. 3.1; it holds with fused operations too.
    """
    k = terms + 2
    return 2 * k * UNIT / (1 - 2 * k * UNIT) * (1 + 8 * UNIT), k * TINY


@quiet
def matmul_error(a: Array, b: Array) -> tuple[Array, Array]:
    """A floating-point matrix product and a bound of its rounding error.

    Proves: |a @ b - product| <= bound, entry by entry, for finite float64 inputs.

    Parameters
    ----------
    a, b : ndarray, shapes (..., p, k) and (..., k, q)

    Returns
    -------
    product, bound : ndarray, shape (..., p, q)

    Examples
    --------
    >>> product, bound = matmul_error(np.full((1, 3), 0.1), np.full((3, 1), 0.1))
    >>> bool(abs(float(product[0, 0]) - 0.03) <= float(bound[0, 0]) < 1e-16)
    True
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    gamma, eta = product_error(a.shape[-1])
    product: Array = a @ b
    magnitude: Array = np.abs(a) @ np.abs(b)
    return product, upper(gamma * magnitude, step=4 * STEP, tiny=2 * eta)
