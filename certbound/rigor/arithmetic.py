"""Vectorised intervals with outward rounding: the type, its arithmetic, and matrix products.

An interval stands for a set of real numbers: an end of -inf or +inf says unbounded, and 0 times an unbounded
end is 0. Re-exported by ``certbound.rigor.intervals``, which is the module to import from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.rigor.rounding import LARGEST, TINY, lower, product_error, quiet, upper


class Interval:
    """A batch of closed real intervals [lo, hi], broadcasting like NumPy arrays. Treat it as immutable.

    Every operation encloses: the result contains the exact result for all reals in the operands. Division by
    an interval that contains 0 gives [-inf, inf]; NaN never arises.

    Parameters
    ----------
    lo, hi : array_like
        Ends, lo <= hi, broadcast against each other; -inf and +inf say unbounded.

    Raises
    ------
    ValueError
        NaN, lo > hi, lo = +inf or hi = -inf.

    Examples
    --------
    >>> x = Interval([0.0, -1.0], [1.0, 2.0])
    >>> (x * x).contains(np.array([0.0, -2.0])).tolist()
    [True, True]
    """

    __slots__ = ("hi", "lo")
    __array_ufunc__ = None  # lets ndarray + Interval reach Interval.__radd__
    __hash__ = None  # type: ignore[assignment]  # as Python marks it
    lo: Array
    hi: Array

    def __init__(self, lo: ArrayLike, hi: ArrayLike) -> None:
        lo_, hi_ = np.asarray(lo, dtype=np.float64), np.asarray(hi, dtype=np.float64)
        if lo_.shape != hi_.shape:
            lo_, hi_ = np.broadcast_arrays(lo_, hi_)
        if not ((lo_ <= hi_) & (lo_ < np.inf) & (hi_ > -np.inf)).all():
            raise ValueError("`lo` must be at most `hi`, without NaN, and not +inf (nor `hi` -inf).")
        self.lo, self.hi = lo_, hi_

    @classmethod
    def _raw(cls, lo: Array, hi: Array) -> Interval:
        """Unchecked constructor."""
        new = object.__new__(cls)
        new.lo, new.hi = lo, hi
        return new

    @classmethod
    def point(cls, value: ArrayLike) -> Interval:
        """Degenerate intervals [a, a] of finite numbers."""
        array = np.asarray(value, dtype=np.float64)
        if not np.isfinite(array).all():
            raise ValueError(f"`value` must be finite, got {value!r}.")
        return cls._raw(array, array)

    @classmethod
    def at_most(cls, value: ArrayLike) -> Interval:
        """Degenerate intervals of bounds from above; of one that overflowed, [largest float, +inf]."""
        array = np.asarray(value, dtype=np.float64)
        return cls(np.minimum(array, LARGEST), array)

    @classmethod
    @quiet
    def around(cls, mid: ArrayLike, rad: ArrayLike) -> Interval:
        """Intervals that contain mid - rad and mid + rad (rad >= 0, +inf allowed)."""
        mid_, rad_ = np.asarray(mid, dtype=np.float64), np.asarray(rad, dtype=np.float64)
        if not (np.all(np.isfinite(mid_)) and np.all(rad_ >= 0)):
            raise ValueError("`mid` must be finite and `rad` at least 0.")
        return cls._raw(lower(mid_ - rad_), upper(mid_ + rad_))

    def __repr__(self) -> str:
        return f"Interval(lo={self.lo!r}, hi={self.hi!r})"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the batch."""
        return self.lo.shape

    @property
    def ndim(self) -> int:
        """Number of axes of the batch."""
        return self.lo.ndim

    def __len__(self) -> int:
        return len(self.lo)

    @property
    @quiet
    def mid(self) -> Array:
        """A finite number in each interval, the midpoint up to rounding; see `rad`."""
        lo, hi = np.maximum(self.lo, -LARGEST), np.minimum(self.hi, LARGEST)
        result: Array = np.minimum(np.maximum(0.5 * lo + 0.5 * hi, lo), hi)
        infinite = ~(np.isfinite(self.lo) & np.isfinite(self.hi))
        if np.count_nonzero(infinite):
            result = np.where(infinite, np.clip(0.0, lo, hi), result)
        return result

    @property
    @quiet
    def rad(self) -> Array:
        """Radii with [mid - rad, mid + rad] containing the interval (+inf where unbounded)."""
        mid = self.mid
        return upper(np.maximum(self.hi - mid, mid - self.lo))

    @property
    def mag(self) -> Array:
        """Largest absolute value."""
        result: Array = np.maximum(-self.lo, self.hi)
        return result

    @property
    def mig(self) -> Array:
        """Smallest absolute value."""
        result: Array = np.maximum(np.maximum(self.lo, -self.hi), 0.0)
        return result

    @property
    @quiet
    def width(self) -> Array:
        """Upper bound of hi - lo."""
        return upper(self.hi - self.lo)

    @property
    def T(self) -> Interval:
        """Last two axes swapped (a batch of matrices transposed)."""
        return self.swapaxes(-1, -2) if self.ndim > 1 else self

    def swapaxes(self, first: int, second: int) -> Interval:
        """Two axes swapped."""
        return Interval._raw(self.lo.swapaxes(first, second), self.hi.swapaxes(first, second))

    def reshape(self, *shape: Any) -> Interval:
        """The same intervals in another shape."""
        return Interval._raw(self.lo.reshape(*shape), self.hi.reshape(*shape))

    def broadcast_to(self, shape: tuple[int, ...]) -> Interval:
        """A read-only view of the given shape."""
        return Interval._raw(np.broadcast_to(self.lo, shape), np.broadcast_to(self.hi, shape))

    def __getitem__(self, index: Any) -> Interval:
        return Interval._raw(self.lo[index], self.hi[index])

    @quiet
    def sum(self, axis: int | tuple[int, ...] | None = None) -> Interval:
        """Sums along axes, with the rounding error of any order of summation accounted for."""
        lo, hi = np.asarray(np.sum(self.lo, axis=axis)), np.asarray(np.sum(self.hi, axis=axis))
        terms = self.lo.size // max(lo.size, 1)
        gamma, _ = product_error(terms)
        lo = lo - np.sum(np.abs(self.lo), axis=axis) * (gamma * (1 + 1e-9)) if terms > 1 else lo
        hi = hi + np.sum(np.abs(self.hi), axis=axis) * (gamma * (1 + 1e-9)) if terms > 1 else hi
        return Interval._raw(np.where(np.isnan(lo), -np.inf, lo), np.where(np.isnan(hi), np.inf, hi))

    def contains(self, value: ArrayLike | Interval) -> Mask:
        """Elementwise: does the interval contain the number (or the other interval)?"""
        lo, hi = (value.lo, value.hi) if isinstance(value, Interval) else (np.asarray(value),) * 2
        return np.asarray((self.lo <= lo) & (hi <= self.hi))

    def hull(self, other: IntervalLike) -> Interval:
        """Smallest intervals that contain both."""
        other = _as_interval(other)
        return Interval._raw(np.minimum(self.lo, other.lo), np.maximum(self.hi, other.hi))

    def intersect(self, other: IntervalLike) -> Interval:
        """Common part; ValueError where it is empty."""
        other = _as_interval(other)
        lo, hi = np.maximum(self.lo, other.lo), np.minimum(self.hi, other.hi)
        if not np.all(lo <= hi):
            raise ValueError("`other` must overlap every interval; the intersection is empty somewhere.")
        return Interval._raw(lo, hi)

    def __neg__(self) -> Interval:
        return Interval._raw(-self.hi, -self.lo)

    def __add__(self, other: IntervalLike) -> Interval:
        return add(self, _as_interval(other))

    def __sub__(self, other: IntervalLike) -> Interval:
        return subtract(self, _as_interval(other))

    def __rsub__(self, other: IntervalLike) -> Interval:
        return subtract(_as_interval(other), self)

    def __mul__(self, other: IntervalLike) -> Interval:
        return multiply(self, _as_interval(other))

    def __truediv__(self, other: IntervalLike) -> Interval:
        return divide(self, _as_interval(other))

    def __rtruediv__(self, other: IntervalLike) -> Interval:
        return divide(_as_interval(other), self)

    def __matmul__(self, other: IntervalLike) -> Interval:
        return matmul(self, other)

    def __rmatmul__(self, other: IntervalLike) -> Interval:
        return matmul(other, self)

    def __pow__(self, exponent: int) -> Interval:
        return power(self, exponent)

    __radd__ = __add__
    __rmul__ = __mul__


IntervalLike: TypeAlias = Interval | Array | float


def _as_interval(value: ArrayLike | Interval) -> Interval:
    return value if isinstance(value, Interval) else Interval.point(value)


def _constant(x: Interval) -> float | None:
    """The number that a zero-dimensional point interval holds."""
    return float(x.lo) if x.lo.ndim == 0 and x.lo == x.hi else None


@quiet
def add(a: Interval, b: Interval) -> Interval:
    """Interval sum."""
    return Interval._raw(lower(a.lo + b.lo), upper(a.hi + b.hi))


@quiet
def subtract(a: Interval, b: Interval) -> Interval:
    """Interval difference (of independent quantities)."""
    return Interval._raw(lower(a.lo - b.hi), upper(a.hi - b.lo))


def _outward(lo: Array, hi: Array, a: Interval, b: Interval) -> Interval:
    """Widen products or quotients; where one underflows to 0, keep the sign that the factors give."""
    if _without_zero(lo, hi):
        return Interval._raw(lower(lo, tiny=TINY), upper(hi, tiny=TINY))
    a_above, a_below, b_above, b_below = a.lo >= 0, a.hi <= 0, b.lo >= 0, b.hi <= 0
    zero = (a_above & a_below) | (b_above & b_below)
    same = (a_above & b_above) | (a_below & b_below) | zero
    opposite = (a_above & b_below) | (a_below & b_above) | zero
    return _signed(lo, hi, same, opposite)


def _without_zero(lo: Array, hi: Array) -> bool:
    return bool(np.count_nonzero(lo) == lo.size and np.count_nonzero(hi) == hi.size)


def _signed(lo: Array, hi: Array, positive: Mask, negative: Mask) -> Interval:
    """Widened, but for ends at which the sign of the exact result is known (neither below nor above 0)."""
    lo, hi = lower(lo, tiny=TINY), upper(hi, tiny=TINY)
    return Interval._raw(np.where(positive, np.maximum(lo, 0.0), lo), np.where(negative, np.minimum(hi, 0.0), hi))


def _times(factor: float, x: Interval) -> Interval:
    """A number other than 0 times an interval."""
    first, second = (x.lo, x.hi) if factor > 0 else (x.hi, x.lo)
    lo, hi = factor * first, factor * second
    if _without_zero(lo, hi):
        return Interval._raw(lower(lo, tiny=TINY), upper(hi, tiny=TINY))
    return _signed(lo, hi, *((first >= 0, second <= 0) if factor > 0 else (first <= 0, second >= 0)))


@quiet
def multiply(a: Interval, b: Interval) -> Interval:
    """Interval product (of independent quantities); 0 times an unbounded interval is 0."""
    if _constant(b) is not None:
        a, b = b, a
    factor = _constant(a)
    if factor is not None:
        if factor == 1.0:
            return b
        if factor == 0.0:
            return Interval._raw(zero := np.zeros(b.shape), zero)
        return _times(factor, b)
    ll, lh, hl, hh = a.lo * b.lo, a.lo * b.hi, a.hi * b.lo, a.hi * b.hi
    lo = np.minimum(np.minimum(ll, lh), np.minimum(hl, hh))
    hi = np.maximum(np.maximum(ll, lh), np.maximum(hl, hh))
    if np.count_nonzero(np.isnan(lo)):
        four = [np.where(np.isnan(p), 0.0, p) for p in (ll, lh, hl, hh)]
        lo, hi = np.minimum.reduce(four), np.maximum.reduce(four)
    return _outward(lo, hi, a, b)


@quiet
def divide(a: Interval, b: Interval) -> Interval:
    """Interval quotient; [-inf, inf] where the divisor contains 0."""
    ll, lh, hl, hh = a.lo / b.lo, a.lo / b.hi, a.hi / b.lo, a.hi / b.hi
    lo = np.minimum(np.minimum(ll, lh), np.minimum(hl, hh))
    hi = np.maximum(np.maximum(ll, lh), np.maximum(hl, hh))
    undefined = (b.lo <= 0) & (b.hi >= 0)
    bad = np.isnan(lo)
    if np.count_nonzero(bad):  # inf / inf: through the reciprocal, whose unbounded end gives 0
        one = np.ones(b.shape)
        inverse = _outward(one / b.hi, one / b.lo, Interval._raw(one, one), b)
        safe = Interval._raw(np.where(undefined, 0.0, inverse.lo), np.where(undefined, 0.0, inverse.hi))
        other = multiply(a, safe)
        lo, hi = np.where(bad, other.lo, lo), np.where(bad, other.hi, hi)
    result = _outward(lo, hi, a, b)
    if np.count_nonzero(undefined):
        lo, hi = np.where(undefined, -np.inf, result.lo), np.where(undefined, np.inf, result.hi)
        return Interval._raw(lo, hi)
    return result


@quiet
def power(x: Interval, exponent: int) -> Interval:
    """x ** n for an integer n by repeated squaring; [-inf, inf] where n < 0 and x contains 0."""
    if int(exponent) != exponent:
        raise TypeError(f"`exponent` must be an integer, got {exponent}; use pow_ for other exponents.")
    n = int(exponent)
    if n < 0:
        return divide(Interval.point(1.0), power(x, -n))
    if n == 0:
        return Interval.point(np.ones(x.shape))
    if n == 1:
        return x
    if n % 2 == 0:
        return Interval._raw(_power_end(x.mig, n, down=True), _power_end(x.mag, n, down=False))

    def odd(end: Array, low: bool) -> Array:
        above, below = np.maximum(end, 0.0), np.maximum(-end, 0.0)
        return np.where(end >= 0, _power_end(above, n, down=low), -_power_end(below, n, down=not low))

    return Interval._raw(odd(x.lo, True), odd(x.hi, False))


def _power_end(base: Array, n: int, *, down: bool) -> Array:
    """A bound from one side of base ** n for base >= 0, n >= 1."""
    zero = base == 0
    result: Array | None = None
    square = base
    while n:
        if n & 1:
            result = square if result is None else _nonnegative(result * square, down)
        n >>= 1
        if n:
            square = _nonnegative(square * square, down)
    assert result is not None
    return np.where(zero, 0.0, result)


def _nonnegative(value: Array, is_lower: bool) -> Array:
    if is_lower:
        return np.maximum(lower(value, tiny=TINY), 0.0)
    return upper(value, tiny=TINY)


@quiet
def matmul(a: IntervalLike, b: IntervalLike) -> Interval:
    """Product of matrices of intervals, shapes (..., p, k) and (..., k, q); vectors as for ``numpy.matmul``.

    Proves: the result contains A @ B for all matrices A in a and B in b. Midpoint-radius form: with
    A = Ma +- Ra, B = Mb +- Rb the product lies within |Ma| Rb + Ra (|Mb| + Rb) of Ma Mb, plus rounding errors
    (`product_error`). Source: Rump, Fast and parallel interval arithmetic, BIT 39 (1999).
    """
    x, y = _as_interval(a), _as_interval(b)
    if x.ndim == 1 or y.ndim == 1:
        left = x.reshape(1, -1) if x.ndim == 1 else x
        right = y.reshape(-1, 1) if y.ndim == 1 else y
        product = matmul(left, right)
        shape = product.shape[: product.ndim - (y.ndim == 1)]
        product = product.reshape(shape)
        if x.ndim == 1:
            product = product.reshape(shape[:-1] if y.ndim == 1 else (*shape[:-2], shape[-1]))
        return product
    if not all(np.isfinite(end).all() for end in (x.lo, x.hi, y.lo, y.hi)):
        wide = multiply(
            Interval._raw(x.lo[..., :, :, None], x.hi[..., :, :, None]),
            Interval._raw(y.lo[..., None, :, :], y.hi[..., None, :, :]),
        )
        return wide.sum(axis=-2)
    gamma, eta = product_error(x.shape[-1])
    mx, my = x.mid, y.mid
    rx, ry = (upper(np.maximum(z.hi - mid, mid - z.lo)) for z, mid in ((x, mx), (y, my)))  # `rad`
    absolute_y: Array = np.abs(my)
    spread = upper(absolute_y + ry)
    product_mid: Array = mx @ my
    radius = upper(gamma * (np.abs(mx) @ absolute_y)) + (1 + 2 * gamma) * (np.abs(mx) @ ry + rx @ spread)
    radius = upper(radius, step=1e-15, tiny=4 * eta)
    if not np.isfinite(radius).all():  # overflow
        radius = np.where(np.isfinite(radius), radius, np.inf)
        product_mid = np.where(np.isfinite(radius), product_mid, 0.0)
    return Interval._raw(lower(product_mid - radius), upper(product_mid + radius))


def stack(items: Sequence[Interval], axis: int = 0) -> Interval:
    """Intervals of equal shapes joined along a new axis."""
    return Interval._raw(np.stack([x.lo for x in items], axis), np.stack([x.hi for x in items], axis))


def concatenate(items: Sequence[Interval], axis: int = 0) -> Interval:
    """Intervals joined along an existing axis."""
    lo, hi = [x.lo for x in items], [x.hi for x in items]
    return Interval._raw(np.concatenate(lo, axis), np.concatenate(hi, axis))
