"""How far derivatives of a normal density are dominated by a wider normal density; and tails of such derivatives.

With phi_s the density of N(0, s^2), He_k the Hermite polynomials, kappa > 1 and |mu| <= rho s,
    s^k |d^k/dm^k phi_s(y - m - mu)| <= A_k(kappa, rho) phi_{kappa s}(y - m)   for all real y,
    A_k = kappa sup_{z >= 0} |He_k(z)| exp(-z^2/2 + (z + rho)^2/(2 kappa^2)),
because the k-th derivative is He_k(z) phi_s(s z) with z = (y - m - mu)/s, and |y - m| <= s (|z| + rho). Products over
the axes give the same for densities in the plane and in space. Source: K8 of docs/theory.md.

With s' instead of s on the left, s/tau <= s' <= tau s, |y - m| <= s (tau |z| + rho), and for tau < kappa
    s^k |d^k/dm^k phi_s'(y - m - mu)| <= tau^(k + 1) kappa sup |He_k(z)| exp(-z^2/2 + (tau z + rho)^2/(2 kappa^2))
times phi_{kappa s}(y - m).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval, abs_, exp, sq

KAPPA = 1.4
"""Ratio of the standard deviations of the dominating density and of the noise."""
_STEPS = 128
_REACH = 30  # where the supremum is surely past its peak


@lru_cache(maxsize=1024)
def dominance(order: int, rho: float = 0.0, power: int = 0, stretch: float = 1.0) -> float:
    """A_k of the module for kappa = `KAPPA`, rounded up; with ``power`` p, of (1 + z)^p times the density.

    Parameters
    ----------
    order : int
        k, at most 12.
    rho : float
        Between 0 and 3.
    power : int
        Exponent p of the extra factor (1 + z)^p.
    stretch : float
        tau of the module, between 1 and 1.1.
    """
    if not 1 <= stretch <= 1.1:
        raise ValueError(f"`stretch` must lie in [1, 1.1], got {stretch}.")
    if not (0 <= rho <= 3 and 0 <= order + power <= 12):
        raise ValueError(f"`rho` must lie in [0, 3] and the order be at most 12, got {rho} and {order + power}.")
    ends = np.arange(_REACH * _STEPS + 1) / _STEPS
    z = Interval(ends[:-1], ends[1:])
    weight = abs_(_hermite(z, order))
    for _ in range(power):
        weight = weight * (z + 1.0)
    exponent = sq(z * stretch + rho) / Interval.point(2 * KAPPA**2) - sq(z) * 0.5
    value = weight * exp(exponent) * KAPPA
    # beyond the reach: (1 + z)^(k + p) exp(...) bounds it, whose logarithm falls there (k + p <= 12, kappa = 1.4)
    last = Interval.point(float(_REACH))
    beyond = exp(sq(last * stretch + rho) / Interval.point(2 * KAPPA**2) - sq(last) * 0.5) * KAPPA
    for _ in range(order + power):
        beyond = beyond * (last + 4.0)
    return float(max(value.hi.max(), float(beyond.hi))) * stretch ** (order + 1) * (1 + 1e-12)


def _hermite(z: Interval, order: int) -> Interval:
    """He_k over intervals."""
    before, now = Interval.point(np.ones(z.shape)), z
    if order == 0:
        return before
    for k in range(1, order):
        before, now = now, z * now - before * float(k)
    return now


def tail(z: float) -> float:
    """Upper bound of P(|N(0, 1)| > z) for z >= 1: 2 phi(z)/z."""
    return 2 * math.exp(-z * z / 2) / (math.sqrt(2 * math.pi) * z) * (1 + 1e-9) + 1e-300


def density_tail(order: int, z: float) -> float:
    """Upper bound of the integral of |He_k| phi over |x| > z, for z >= 7 and k <= 8.

    Beyond the zeros of He_k (all below 2 sqrt(k) < 6) its absolute value is He_k <= x^k, and integration by parts
    gives int_z^inf x^k phi <= z^(k - 1) phi(z) / (1 - (k - 1)/z^2).
    """
    if not (z >= 7 and order <= 8):
        raise ValueError(f"`z` must be at least 7 and `order` at most 8, got {z} and {order}.")
    if order == 0:
        return tail(z)
    density = math.exp(-z * z / 2) / math.sqrt(2 * math.pi)
    return 2 * z ** (order - 1) * density / (1 - (order - 1) / (z * z)) * (1 + 1e-9) + 1e-300


@lru_cache(maxsize=8)  # one rule after the other is tried
def _ellipses(
    half: float, order: int, reach: float, ratio: float, degree: int
) -> list[tuple[float, Array, Array]]:
    """rho, and for each piece of z0 the exponents of the densities, and log (1 + |z|)^order |b|."""
    left = np.arange(0.0, reach, 1 / 16)
    right, found = left + 1 / 16, []
    for rho in (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0, 128.0, 192.0, 256.0):
        a, b = (rho + 1 / rho) / 2, (rho - 1 / rho) / 2
        widest = math.log(2 * a * a + 2 * b * b + 1) if degree == 2 else 3 * math.log(rho)
        nearest = np.maximum(left - half * a, 0.0)
        size = right + half * (a + b)
        first = -(nearest**2) / 2 + (half * b) ** 2 / 2 + (right + half) ** 2 / (2 * ratio**2)
        found.append((rho, first, np.log(1 + size) * order + widest))
    return found


@lru_cache(maxsize=256)
def quadrature_error(
    points: int, half: float, order: int, reach: float, ratio: float = KAPPA, degree: int = 2
) -> float:
    """Error of Gauss's rule for He_k(z) phi(z) times a basis function, in units of the mass of phi_{ratio s}.

    Proves: on an interval of half-width ``half`` (in units of s), centred at |z0| <= ``reach``, the rule with
    ``points`` points is off by at most the returned number times that mass of the interval, for a basis
    function that is a polynomial of degree at most ``degree``, 2 or 3, with |b| <= 1 on the interval.

    The rule is exact for degree N = 2 points - 1 and its weights are positive, so the error is at most 4 ||g - p||
    (interval of length 2), and ||g - p|| <= 2 M rho^-N/(rho - 1), M = sup |g| on the Bernstein ellipse of rho: there
    |phi(z)| <= exp(-(|z0| - half A)_+^2/2 + half^2 B^2/2)/sqrt(2 pi) with the half-axes A, B, |b| <= 2 A^2 + 2 B^2 + 1
    (a polynomial of degree 2 bounded by 1 on [-1, 1] is at most |T_2| there; one of degree 3 at most rho^3) and
    |He_k(z)| <= (1 + |z|)^k for k <= 3, three times that for k = 4. The mass is at least the width times the least
    density. The supremum over z0 is taken in pieces.
    """
    best, more = np.array(np.inf), math.log(3) if order == 4 else 0.0
    for rho, first, grown in _ellipses(half, order, reach, ratio, degree):
        exponent = first + (grown - (2 * points - 1) * math.log(rho))
        best = np.minimum(best, exponent + math.log(4 / (rho - 1) * ratio) + more)
    return float(np.exp(best.max())) * (1 + 1e-9)
