"""Exit probability of S+ = L S + w, w ~ N(0, sigma^2 I), bounded rigorously (DT; Secs. 4 and 5 of docs/theory.md).

v_{k+1}(s) = P(||L s e_1 + w|| > R) + int_0^R q(L s -> y) v_k(y) dy, v_0 = 0, and v_T(0) is the probability. The
integral is a Gauss-Legendre sum on panels of one or two sigma: on a Bernstein ellipse of height h the density obeys
|q| <= C e^{h^2/(2 sigma^2)} and, as an expectation over a shifted Gaussian, |v_k| <= e^{L^2 h^2/(2 sigma^2)}, which
bounds the error of the sum (Trefethen, Approximation Theory and Approximation Practice, Thm 19.3). All terms are
positive: rounding of sums and of kernel entries is paid for by the factor :attr:`Recursion.inflation`. v_k rises in s:
taken a little above a node, it exceeds its value there. The Bessel factor E(x) = e^{-x} 0F1(; n/2; x^2/4) of q is
log-convex: chords of its logarithm between points where ball arithmetic gave an upper bound lie above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from flint import arb

from certbound.arrays import Array, Index
from certbound.rigor.balls import bessel_excess, precision, upper
from certbound.rigor.rounding import LIBRARY_ULPS, UNIT

_POINTS = 14
_TINY = 1e-290  # more than what entries below the smallest float add up to
_TABLE_RATIO = 2e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Recursion:
    """Exit from the ball of radius R at one of the steps 1, ..., T."""

    # (K,): L and sigma per group of steps, in the order of time
    gains: Array
    sigmas: Array
    counts: Index  # (K,): steps per group
    dimension: int  # n
    radius: float  # R, in the unit of sigma

    @cached_property
    def size(self) -> int:
        """Number of nodes."""
        return _POINTS * self._panels

    @property
    def entries(self) -> float:
        """Number of entries of one kernel: from the nodes of the ball to all nodes."""
        return float(self.size) * _POINTS * (self._panels + self._beyond / self.radius * self._panels + 1)

    @cached_property
    def _panels(self) -> int:
        wide = 2.0 if self.dimension <= 3 else (1.5 if self.dimension <= 20 else 1.0)
        return max(1, math.ceil(self.radius / (wide * float(np.min(self.sigmas)))))

    @cached_property
    def _grid(self) -> tuple[Array, Array]:
        """Nodes and weights on [0, R] and on as many panels beyond as carry probability."""
        points, weights = legendre_rule()
        width = self.radius / self._panels
        panels = np.arange(self._panels + math.ceil(self._beyond / width))
        nodes = ((points[None, :] + 1) / 2 + panels[:, None]).ravel() * width
        return nodes, np.tile(weights / 2 * width, len(panels))

    @cached_property
    def inflation(self) -> float:
        """1 + twice a bound of the relative rounding of a kernel entry and of a sum of such entries.

        With u = 2^-53: y and x are off by at most 6u of their size, so that (y - x)^2/2 is off by 12u times the
        size times |y - x|, at most 39 where the entry does not underflow, and 4u of itself; log and exp are off by
        ``LIBRARY_ULPS`` units of 2u each, the summands of the exponent and their sum by 8u of their sizes; x E'/E lies
        between -n and 0.
        """
        far = (self.radius + self._beyond) * max(1.0, float(np.max(self.gains))) / float(np.min(self.sigmas))
        n, nodes = self.dimension, len(self._grid[0])
        summands = 760.0
        if n > 1:
            widest = math.log(far / float(self._grid[0][0]) * self.radius) + abs(math.log(far)) + 800
            summands += (n - 1) * widest * (2 * LIBRARY_ULPS) / 8 + n * math.log(4 * n)
            summands += float(np.max(np.abs(self._table[1])))
        units = 12 * 39 * far + 8 * summands + 8 * n + 4 * LIBRARY_ULPS + 2 * nodes + 64
        return 1 + 2 * UNIT * units

    @cached_property
    def _beyond(self) -> float:
        """Distance past R after which the mass is counted as lost."""
        sigma = float(np.max(self.sigmas))
        return max(0.0, float(np.max(self.gains)) - 1) * self.radius + sigma * (math.sqrt(self.dimension) + 16)

    @cached_property
    def _lost(self) -> float:
        """P(||w|| > _beyond - (L - 1)^+ R), an upper bound of the mass past the last panel."""
        reach = math.sqrt(self.dimension) + 16
        with precision():
            half = arb(self.dimension) / 2
            return upper((arb(reach) ** 2 / 2).gamma_upper(half, regularized=1)) * 1.01

    def quadrature_error(self, gain: float, sigma: float) -> float:
        """Bound of the error of one sum, over all panels, for |v| <= 1 on the real line.

        Lengths in sigma. At z with real part x > 0 and imaginary part h the density is at most (|z|/x)^{n-1} e^{h^2/2}
        times its value at x (a Poisson mixture of chi densities, none of which exceeds 0.8), and in any case
        |z|^{n-1} e^{h^2/2}/(2^{n/2-1} Gamma(n/2)), twice that for n = 1.
        """
        width = self.radius / self._panels / sigma
        centre = (np.arange(len(self._grid[0]) // _POINTS)[:, None] + 0.5) * width
        n = self.dimension
        steepest = max(float(np.max(self.gains / self.sigmas)) * sigma, gain)
        rho = np.linspace(2.0, 40.0, 96)[None, :]
        height, reach = width / 4 * (rho - 1 / rho), width / 4 * (rho + 1 / rho)
        near = np.where(centre > reach, centre - reach, 1.0)
        log_near = (n - 1) / 2 * np.log1p((height / near) ** 2) + math.log(0.8)
        constant = (n / 2 - 1) * math.log(2) + math.lgamma(n / 2) - (math.log(2) if n == 1 else 0.0)
        log_far = (n - 1) * np.log(centre + 2 * reach) - constant
        log_m = np.where(centre > reach, np.minimum(log_near, log_far), log_far) + height**2 / 2 * (1 + steepest**2)
        each = np.min(log_m - 2 * (_POINTS - 1) * np.log(rho) - np.log1p(-(rho**-2.0)), axis=1)
        return float(np.sum(np.exp(np.minimum(each, 700.0))) * width / 2 * (64 / 15) * 1.01)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """(x, upper bound of log E(x)) at points dense enough for chords."""
        top = 1.01 * float(np.max(self.gains / self.sigmas**2)) * self.radius * (self.radius + self._beyond) + 1.0
        dense = np.geomspace(0.05, top, math.ceil(math.log(top / 0.05) / _TABLE_RATIO))
        x = np.concatenate([np.linspace(0.0, 0.05, 6)[:-1], dense])
        with precision():
            half = arb(self.dimension) / 2
            logs = [upper(bessel_excess(half, arb(v) ** 2 / 4).log1p() - arb(v)) for v in x.tolist()]
        return x, np.array(logs)

    def _kernel(self, starts: Array, gain: float, sigma: float) -> Array:
        """Upper bounds of weight times density from ``gain`` times each start to each node."""
        nodes, weights = self._grid
        x, y = (gain / sigma) * starts[:, None], nodes[None, :] / sigma
        n = self.dimension
        if n == 1:
            density = (np.exp(-((y - x) ** 2) / 2) + np.exp(-((y + x) ** 2) / 2)) / math.sqrt(2 * math.pi)
        else:
            points, logs = self._table
            log_e = np.interp(x * y, points, logs)
            constant = (n / 2 - 1) * math.log(2) + math.lgamma(n / 2)
            density = np.exp((n - 1) * np.log(y) - (y - x) ** 2 / 2 + log_e - constant)
        return np.asarray(density * (weights / sigma * self.inflation))

    def bound(self) -> float:
        """Upper bound of the probability of leaving the ball."""
        nodes, inside = self._grid[0], self.size
        width = self.radius / self._panels
        starts = nodes[:inside] + 8 * UNIT * (nodes[:inside] + width)  # not below the exact nodes
        v = np.zeros(inside)
        kernels: dict[tuple[float, float], tuple[Array, Array]] = {}
        first = (float(self.gains[0]), float(self.sigmas[0]))
        for k in range(len(self.counts) - 1, -1, -1):
            key = (float(self.gains[k]), float(self.sigmas[k]))
            if key not in kernels:
                kernel = self._kernel(starts, *key)
                error = self.quadrature_error(*key)
                leave = kernel[:, inside:].sum(axis=1) * self.inflation + (2 * error + self._lost + _TINY)
                kernels[key] = np.ascontiguousarray(kernel[:, :inside]), leave
            kernel, leave = kernels[key]
            for _ in range(int(self.counts[k]) - (k == 0)):
                v = np.minimum((kernel @ v) * self.inflation + leave, 1.0)
        last = self._kernel(np.zeros(1), *first)[0]
        error = 2 * self.quadrature_error(*first) + self._lost + _TINY
        return min(1.0, float((last[:inside] @ v + last[inside:].sum()) * self.inflation + error) * self.inflation)


@cache
def legendre_rule() -> tuple[Array, Array]:
    """Gauss-Legendre nodes on [-1, 1] to the last place, and their weights rounded up."""
    with precision():
        roots = [arb.legendre_p_root(_POINTS, k, weight=True) for k in range(_POINTS)]
    pairs = sorted((float(root.mid()), upper(weight)) for root, weight in roots)
    return np.array([root for root, _ in pairs]), np.array([weight for _, weight in pairs])
