"""The noise of one step, G w, as independent coordinates and one common factor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.noise import Law
from certbound.problem.table_laws import Histogram, Laplace
from certbound.rigor.intervals import Interval, sq, sqrt

_SIZES = (1e-60, 1e60)
"""Sizes of noise between which tables of second derivatives neither vanish nor overflow: rounding is paid for in units
of the numbers themselves, which says nothing of what has fallen below the smallest float."""


class Inapplicable(InfeasibleError):
    """Value functions do not fit the problem; the message says why, and what would make them fit."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Shocks:
    """w = diag(sigma) xi + factor zeta, with xi and zeta independent standard normal.

    Parameters
    ----------
    sigma : Interval, shape (n,)
        Standard deviations of the independent parts, positive, known up to rounding.
    factor : Interval, shape (n,)
        Loads of the common factor; all 0 where the entries are independent.
    uniform : bool
        True: w has another law, without a common factor: uniform on the box [-sigma, sigma] if nothing else is said.
    laplace : bool
        One state: the density exp(-|w|/sigma)/(2 sigma).
    steps : (Array, Array, Array), optional
        One state: lower ends, upper ends and probabilities of intervals on each of which w is uniform; all of them are
        known up to 1e-11 of the largest end.
    sizes : callable, optional
        Where the noise depends on the state: standard deviations at points, (P, n) to (P, n), in plain floats;
        ``sigma`` holds typical ones. Only grids take these.
    """

    sigma: Interval
    factor: Interval
    uniform: bool = False
    laplace: bool = False
    steps: tuple[Array, Array, Array] | None = None
    sizes: Callable[[Array], Array] | None = None

    @property
    def reach(self) -> float:
        """How far one step of such a law leads, in units of ``sigma``, but for 1e-20."""
        if self.steps is None:
            return 47.0 if self.laplace else 1.0
        return float(np.abs(self.steps[:2]).max()) / float(self.sigma.lo[0]) * (1 + 1e-9)

    @property
    def dimension(self) -> int:
        """Number of states."""
        return len(self.sigma)

    @property
    def common(self) -> bool:
        """Whether there is a common factor."""
        return bool(np.any(self.factor.mag > 0))


def shocks_of(law: Law, gain: Array) -> Shocks:
    """The law of G w, for Gaussian w and for uniform w that moves every state on its own; in one state also others.

    Raises
    ------
    Inapplicable
        For other laws, and where G w leaves a state without noise of its own.
    """
    if law.uniform:
        return _uniform_shocks(np.asarray(law.bound), gain)
    if gain.shape == (1, 1) and type(law) in (Laplace, Histogram) and gain.item():
        return _line_shocks(law, float(gain.item()))
    if not law.gaussian:
        raise Inapplicable(
            "value functions take noise that is exactly Gaussian or uniform so far, no other law and no class of "
            f"laws; got {type(law).__name__} (give cb.Gaussian if that is what it is)."
        )
    left = Interval.point(gain)
    half = (left[:, :, None] * law.enclosed_covariance()[None, :, :]).sum(axis=1)
    return gaussian_shocks((half[:, None, :] * left[None, :, :]).sum(axis=-1))


def _uniform_shocks(halfwidth: Array, gain: Array) -> Shocks:
    n = len(gain)
    alone = gain.shape == (n, n) and np.all((gain != 0).sum(axis=1) == 1) and np.all((gain != 0).sum(axis=0) == 1)
    if not alone or not np.all(halfwidth > 0):
        raise Inapplicable("value functions need uniform noise that moves every state by an entry of its own.")
    place = np.argmax(gain != 0, axis=1)
    sides = Interval.point(np.abs(gain[np.arange(n), place])) * Interval.point(halfwidth[place])
    _check_sizes(sides)
    return Shocks(sigma=sides, factor=Interval.point(np.zeros(n)), uniform=True)


def _line_shocks(law: Law, gain: float) -> Shocks:
    """One entry of a law in one state."""
    scale = Interval.point(gain) * Interval.point(float(getattr(law, law.level)[0]))
    size = Interval.point(np.array([1.0])) * Interval(float(scale.mig), float(scale.mag))
    _check_sizes(size)
    nothing = Interval.point(np.zeros(1))
    if isinstance(law, Laplace):
        return Shocks(sigma=size, factor=nothing, uniform=True, laplace=True)
    assert isinstance(law, Histogram)
    ends: Array = np.asarray(law.edges, dtype=float) * float(scale.mid)
    low, high = np.minimum(ends[:-1], ends[1:]), np.maximum(ends[:-1], ends[1:])
    share: Array = np.asarray(law.probabilities, dtype=float)
    width = float((share * np.hypot(high + low, (high - low) / math.sqrt(3))).sum()) / 2
    return Shocks(sigma=Interval.point(np.array([width])), factor=nothing, uniform=True, steps=(low, high, share))


def gaussian_shocks(covariance: Interval) -> Shocks:
    """A normal law of that covariance as independent parts and one common factor.

    With C = diag(s^2) + e e' the normal law N(0, C) is that of s xi + e zeta. One pair of correlated states needs
    e_i e_j = C_ij, balanced so that both keep the same share of their variance; three need e_i^2 = C_ij C_ik / C_jk.

    Raises
    ------
    Inapplicable
        If no such factor leaves every state noise of its own.
    """
    n = len(covariance)
    factor = _factor(covariance)
    rest = [covariance[i, i] - sq(factor[i]) for i in range(n)]
    floor = [1e-4 * float(covariance.hi[i, i]) for i in range(n)]
    for i, value in enumerate(rest):
        if not float(value.lo) > floor[i] or not float(value.lo) > 0:
            raise Inapplicable(
                f"value functions need noise of its own on every state; that of state {i + 1} is zero or a combination "
                "of the others'. Add a little noise there, or use another engine."
            )
    sigma = sqrt(Interval(np.array([float(v.lo) for v in rest]), np.array([float(v.hi) for v in rest])))
    _check_sizes(sigma)
    return Shocks(sigma=sigma, factor=factor)


def shocks_of_start(covariance: Array) -> Shocks | None:
    """A normal start about its mean; None where it is certain.

    Raises
    ------
    Inapplicable
        If its covariance is neither diagonal nor that plus one common factor, or a state is certain.
    """
    if not np.any(covariance):
        return None
    try:
        return gaussian_shocks(Interval.point(covariance))
    except Inapplicable as error:
        raise Inapplicable(
            "value functions need a random start with a covariance that is diagonal, or diagonal plus one common "
            "factor, and positive in every state."
        ) from error


def _check_sizes(sigma: Interval) -> None:
    """Refuse units in which the noise is so small or so large that floats end."""
    for i, (low, high) in enumerate(zip(sigma.lo, sigma.hi)):
        if not (_SIZES[0] <= low and high <= _SIZES[1]):
            raise Inapplicable(
                f"value functions need noise between {_SIZES[0]:g} and {_SIZES[1]:g} on every state, that of state "
                f"{i + 1} is {float(high):g}: write the state in another unit."
            )


def _factor(covariance: Interval) -> Interval:
    n = len(covariance)
    pairs = [(i, j) for i in range(n) for j in range(i) if covariance.mag[i, j] > 0]
    lo, hi = np.zeros(n), np.zeros(n)

    def load(i: int, value: Interval) -> None:
        lo[i], hi[i] = float(value.lo), float(value.hi)

    if len(pairs) == 1:
        i, j = pairs[0]
        if not (covariance.lo[i, i] > 0 and covariance.lo[j, j] > 0):
            return Interval(lo, hi)
        c = covariance[i, j]
        first = Interval.point(math.sqrt(float(c.mag) * math.sqrt(float(covariance.hi[i, i] / covariance.hi[j, j]))))
        load(i, first)
        load(j, c / first)
    elif len(pairs) == 3:
        c21, c31, c32 = covariance[1, 0], covariance[2, 0], covariance[2, 1]
        square = c21 * c31 / c32
        if not float(square.lo) > 0:
            raise Inapplicable(_NO_FACTOR)
        first = sqrt(square)
        load(0, first)
        load(1, c21 / first)
        load(2, c31 / first)
    elif len(pairs) == 2:
        raise Inapplicable(_NO_FACTOR)
    return Interval(lo, hi)


_NO_FACTOR = (
    "value functions treat correlated noise of three states only where it is independent noise plus one common factor; "
    "this covariance is not."
)
