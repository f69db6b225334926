"""State equations of shaping filters, each driven by one white noise, whose first state is the output.

A filter is stated by H(s) = k N(s)/D(s) in units of its own time: N and D have the leading coefficient 1, N is one
degree lower, and its zeros -z_i are real, distinct and not positive. By partial fractions

    D(s)/N(s) = s + c + sum_i r_i / (s + z_i),

so that the output w of H(s) dW/dt obeys, with y_i = z_i w / (s + z_i), the output lagged by 1/z_i,

    dw = -(c w + sum_i (r_i/z_i) y_i) dt + k dW,    dy_i = z_i (w - y_i) dt,

where a zero z = 0 gives dy = q w dt, q = sqrt(r), and q y in place of (r/z) y. So w is a state, and noise enters no
other. The stationary covariance P is the solution of A P + P A' + B B' = 0; k is such that the variance of w is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen

_NOISE = 1e-13
"""Share of a variance of 1 below which a computed covariance is taken for 0."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape:
    """dy = A y dt + B dW with the stationary covariance P; the output is the first state."""

    rate: Array  # A, shape (k, k)
    intensity: float  # B_1^2: the noise enters the output alone
    covariance: Array  # P, shape (k, k)

    def scaled(self, std: float, time: float) -> Shape:
        """The same filter for a standard deviation of the output and a unit of time."""
        return Shape(
            rate=frozen(self.rate / time),
            intensity=self.intensity * std**2 / time,
            covariance=frozen(self.covariance * std**2),
        )

    @property
    def noise(self) -> Array:
        """B, shape (k,)."""
        return frozen(np.sqrt(self.intensity) * np.eye(len(self.rate))[0])

    def sampled(self) -> tuple[Array, Array]:
        """F and G, shapes (k, k), of the values at 0, 1, 2, ...: y+ = F y + G v with v standard normal.

        F = exp(A), and G G' = Q is the integral of exp(A s) B B' exp(A' s) over [0, 1]: by one exponential for a small
        part of the step (Van Loan 1978), then by doubling, Q <- Q + F Q F', F <- F F.
        """
        from scipy.linalg import expm

        k = len(self.rate)
        doublings = max(0, int(np.ceil(np.log2(np.abs(self.rate).sum(axis=1).max()))))
        block = np.block([[-self.rate, np.outer(self.noise, self.noise)], [np.zeros((k, k)), self.rate.T]])
        power = expm(block * 0.5**doublings)
        step = power[k:, k:].T
        spread = step @ power[:k, k:]
        for _ in range(doublings):
            step, spread = step @ step, spread + step @ spread @ step.T
        values, vectors = np.linalg.eigh((spread + spread.T) / 2)
        return frozen(step), frozen(vectors * np.sqrt(np.maximum(values, 0.0)))


def shaped(zeros: tuple[float, ...], den: tuple[float, ...]) -> Shape:
    """The filter of unit variance with D = ``den`` (highest power first, from 1) and N with the zeros -``zeros``."""
    num = np.poly([-zero for zero in zeros]) if zeros else np.ones(1)
    quotient, rest = np.polydiv(np.asarray(den), num)
    slope = np.polyder(num) if zeros else np.zeros(1)
    size = 1 + len(zeros)
    rate = np.zeros((size, size))
    rate[0, 0] = -quotient[1]
    for place, zero in enumerate(zeros, start=1):
        residue = np.polyval(rest, -zero) / np.polyval(slope, -zero)
        speed = zero if zero > 0 else np.sqrt(residue)
        rate[0, place], rate[place, 0], rate[place, place] = -residue / speed, speed, -zero
    covariance = _stationary(rate, np.eye(size)[0])
    scale = float(covariance[0, 0])
    covariance = covariance / scale
    covariance[np.abs(covariance) < _NOISE] = 0.0
    covariance[0, 0] = 1.0
    return Shape(rate=frozen(rate), intensity=1 / scale, covariance=frozen(covariance))


def _stationary(rate: Array, noise: Array) -> Array:
    """P with A P + P A' + B B' = 0."""
    eye, size = np.eye(len(rate)), len(rate)
    sums = np.kron(rate, eye) + np.kron(eye, rate)
    found = np.linalg.solve(sums, -np.outer(noise, noise).reshape(-1)).reshape(size, size)
    return np.asarray((found + found.T) / 2)
