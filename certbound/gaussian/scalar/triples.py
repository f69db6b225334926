"""Lower bounds of trivariate normal probabilities, to be subtracted where events overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.gaussian.scalar.normal import log_tail, log_tail_below
from certbound.gaussian.scalar.pairs import Bounds, ends, levels_of, log_pair, standard_levels
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

_KNOTS = np.array([0.0, 0.1, 0.2, 0.3, 0.42, 0.56, 0.72, 0.9, 1.1, 1.35, 1.65, 2.05, 2.6, 3.4, 4.8])
_CUTS = np.interp(np.arange(29) / 2, np.arange(15), _KNOTS)  # edges of the cells of W, in units of its mean excess
_ROUND = 1e-12


@quiet
def triple_below(
    below: ArrayLike, above: ArrayLike, third: ArrayLike, variances: tuple[Bounds, Bounds, Bounds],
    covariances: tuple[Bounds, Bounds, Bounds],
) -> Array:
    """Lower bound of P(X <= below, Y > above, W > third), (X, Y, W) centred Gaussian, third >= 0.

    Proves: X = a W + X', Y = b W + Y' with (X', Y') independent of W. For W in a cell [w, w'] the event follows from
    X' <= below - max a W and Y' > above - min b W; the probabilities of these, P(Y' > .) - P(X' > ., Y' > .), are added
    over a few cells with their weights. Everything holds for all second moments within the enclosures.

    Parameters
    ----------
    below, above, third : array_like, shape (M,)
        Levels, finite; ``third`` not negative.
    variances : three Bounds, shape (M,)
        Enclosures of Var X, Var Y, Var W.
    covariances : three Bounds, shape (M,)
        Enclosures of cov(X, Y), cov(X, W), cov(Y, W).

    Returns
    -------
    ndarray, shape (M,)
        0 where nothing is proved.

    Examples
    --------
    >>> value = triple_below([1.0], [1.0], [1.0], (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))  # the truth is .0287
    >>> bool(0.025 < value[0] < 0.0287)
    True
    """
    x, y, w = (np.atleast_1d(levels_of(v)) for v in (below, above, third))
    v_x, v_y, v_w = (_interval(v, x.shape, name, 0.0) for v, name in zip(variances, "XYW", strict=True))
    c_xy, c_xw, c_yw = (_interval(c, x.shape, "covariances", -np.inf) for c in covariances)
    usable = (v_w.lo > 0) & (w >= 0) & np.isfinite(x) & np.isfinite(y) & np.isfinite(w)
    v_w = Interval(np.where(usable, v_w.lo, 1.0), np.where(usable, v_w.hi, 1.0))
    x, y, w = (np.where(usable, v, 0.0) for v in (x, y, w))
    slope_x, slope_y = c_xw / v_w, c_yw / v_w
    own_x, own_y, own_xy = v_x - c_xw * slope_x, v_y - c_yw * slope_y, c_xy - c_xw * slope_y
    sd = np.sqrt(v_w.hi)
    cuts = w + _CUTS[:, None] * sd / np.maximum(w / sd, 0.7)
    near, far = cuts[:-1], cuts[1:]
    largest = np.maximum(slope_x.hi * near, slope_x.hi * far)
    least = np.minimum(slope_y.lo * near, slope_y.lo * far)
    rest_x = x - largest - _ROUND * (np.abs(x) + np.abs(largest))
    rest_y = y - least + _ROUND * (np.abs(y) + np.abs(least))
    shape = near.shape
    low_y, high_y = (np.broadcast_to(np.maximum(v, 0.0), shape) for v in (own_y.lo, own_y.hi))
    low_x, high_x = (np.broadcast_to(np.maximum(v, 0.0), shape) for v in (own_x.lo, own_x.hi))
    over_y = np.exp(log_tail_below(standard_levels(rest_y, low_y, high_y)[1])) * (1 - _ROUND)
    both = log_pair(-rest_x, (low_x, high_x), rest_y, (low_y, high_y), (
        np.broadcast_to(-own_xy.hi, shape), np.broadcast_to(-own_xy.lo, shape)))
    inside = np.maximum(over_y - np.exp(both) * (1 + _ROUND), 0.0)
    weight = np.exp(log_tail_below(near / np.sqrt(v_w.lo) * (1 + _ROUND)))
    weight = weight - np.exp(log_tail(far / sd * (1 - _ROUND))) * (1 + _ROUND)
    total = np.sum(np.maximum(weight * (1 - _ROUND), 0.0) * inside, axis=0) * (1 - _ROUND)
    return np.asarray(np.where(usable & np.isfinite(total), total, 0.0))


def _interval(value: Bounds, shape: tuple[int, ...], name: str, least: float) -> Interval:
    lo, hi = ends(value, name, least=least)
    return Interval(np.array(np.broadcast_to(lo, shape)), np.array(np.broadcast_to(hi, shape)))
