"""Layered networks over boxes: values, derivatives, and linear functions around them, with outward rounding.

A layer is phi(W x + b). Everything that is carried through it (the value at the centre, the range over the box, first
and second derivatives) stands side by side as the columns of one matrix, in midpoint-radius form, and passes W in two
floating-point matrix products: W times the midpoints, |W| times the radii. What the products round off is covered by a
bound that holds in any order of summation, so that BLAS and its threads are free to choose theirs.

The lines around a network are those of linear relaxation, put together backwards (`certbound.rigor.planes`). Source:
Rump, Fast and parallel interval arithmetic, BIT 39 (1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor.arithmetic import Interval
from certbound.rigor.planes import Relaxed, Weights, bound_arguments, parallel_planes, relax
from certbound.rigor.rounding import STEP, TINY, product_error, quiet, upper
from certbound.rigor.series import ZERO, Series

_CHUNK, _NUMBERS = 512, 4_000_000  # boxes carried through a network at a time, and numbers of its planes
_FAR = 1e100  # boxes that reach beyond are taken for unbounded


@dataclass(frozen=True, eq=False, slots=True)
class Enclosure:
    """A network of n inputs and p outputs over M boxes.

    ``value`` (p, M); ``slopes`` (p, n, M) and ``bends`` (p, n, n, M) are its generalised derivatives, where they were
    asked for; ``kinked`` (M,) says where a kink lies in the box. Where the box is unbounded, so is everything.
    """

    value: Interval
    slopes: Interval | None
    bends: Interval | None
    kinked: Mask


@quiet
def _product(weights: Array, size: Array, mid: Array, rad: Array) -> tuple[Array, Array]:
    """W times what lies within ``rad`` of ``mid``, (k, C) each: midpoints and radii.

    |fl(W m) - W m| <= gamma |W| |m| + eta, whatever the order of summation (`product_error`).
    """
    gamma, eta = product_error(weights.shape[1])
    spread = upper(rad + gamma * np.abs(mid), step=4 * STEP, tiny=TINY)
    return weights @ mid, upper((1 + 2 * gamma) * (size @ spread), step=4 * STEP, tiny=4 * eta)


def _columns(count: int) -> list[tuple[int, int]]:
    """The pairs i <= j of second derivatives."""
    return [(i, j) for i in range(count) for j in range(i, count)]


def bound_network(layers: Sequence[Weights], box: Interval, order: int) -> Enclosure:
    """Enclose a network over boxes (n, M), with its derivatives up to ``order`` (0, 1 or 2).

    The range over the box is the best of what the layers' ranges, planes to the inputs (`certbound.rigor.planes`) and,
    where they are asked for, the first derivatives (mean value form) say, layer by layer.

    Examples
    --------
    >>> layer = Weights(np.array([[1.0, -1.0]]), np.zeros(1), "tanh")
    >>> found = bound_network([layer], Interval(np.full((2, 1), 1.0), np.full((2, 1), 1.5)), 1)
    >>> bool(found.value.contains([[0.0]]).all() and found.slopes.contains(np.array([[[1.0], [-1.0]]])).all())
    True
    """
    parts = [_bound(layers, part, order)[0] for part in _portions(layers, box)]
    return parts[0] if len(parts) == 1 else Enclosure(
        _joined([part.value for part in parts]), _joined([part.slopes for part in parts if part.slopes is not None]),
        _joined([part.bends for part in parts if part.bends is not None]),
        np.concatenate([part.kinked for part in parts]),
    )  # fmt: skip


def _portions(layers: Sequence[Weights], box: Interval) -> list[Interval]:
    """Boxes to be carried through a network at a time: so many that the planes of no layer need more memory."""
    widths = [len(layer.bias) for layer in layers]
    most = max((a * b for a, b in zip(widths, widths[2:])), default=1)
    chunk = max(min(_CHUNK, _NUMBERS // (2 * most)), 1)
    return [box[:, start : start + chunk] for start in range(0, max(box.shape[1], 1), chunk)]


def _joined(parts: Sequence[Interval]) -> Interval:
    if not parts:
        return ZERO
    return Interval(np.concatenate([part.lo for part in parts], -1), np.concatenate([part.hi for part in parts], -1))


@quiet
def _bound(
    layers: Sequence[Weights], box: Interval, order: int, *, parallel: bool = False
) -> tuple[Enclosure, list[Relaxed], Interval]:
    """The enclosure, lines around the activations, and what the first layer's take at the centres, (width, M).

    ``parallel`` lines are those of all layers; others of hidden ones.
    """
    n, count = box.shape
    lost: Mask = np.asarray(~((box.lo > -_FAR) & (box.hi < _FAR)).all(axis=0))
    box = Interval(np.where(lost, 0.0, box.lo), np.where(lost, 0.0, box.hi))
    radius, pairs = box.rad, _columns(n) if order > 1 else []
    width = 2 + (n if order else 0) + len(pairs)
    mid, rad = np.zeros((n, width, count)), np.zeros((n, width, count))
    mid[:, 0] = mid[:, 1] = box.mid
    rad[:, 1] = radius
    mid[:, 2 : 2 + n] = np.eye(n)[:, : width - 2, None]
    kinked, first_centre = lost.copy(), Interval.point(0.0)
    passed: list[Relaxed] = []
    size = radius
    for number, layer in enumerate(layers):
        mid, rad = _affine(layer, mid, rad)
        bad = np.asarray(~(np.isfinite(mid) & np.isfinite(rad)).all(axis=(0, 1)))
        if bad.any():
            lost = np.asarray(lost | bad)
            mid, rad = np.where(bad, 0.0, mid), np.where(bad, 0.0, rad)
        centre, over = _ranges(mid, rad, radius)
        planar, first_centre = over, first_centre if number else centre
        if passed:
            found = bound_arguments(layer, passed, first_centre, radius)
            unknown = lost | ~(np.isfinite(found.lo) & np.isfinite(found.hi))
            planar = Interval(np.where(unknown, over.lo, found.lo), np.where(unknown, over.hi, found.hi))
        over = _meet(over, planar)
        if parallel or number < len(layers) - 1:
            # where lines differ, those of planes alone: nearer ranges may have lines that are worse further on
            where = over if parallel else planar
            passed.append(relax(layer, where, size, None if number else centre, parallel=parallel))
            size = layer.row.value(where, *layer.constants).mag
        kinked = kinked | layer.row.kinked(over, layer.constants).any(axis=0)
        mid, rad = _activated(layer, mid, rad, (centre, over), pairs)
    value, bends = _ranges(mid, rad, radius)[1], None
    if order > 1:
        place = np.zeros((n, n), dtype=int)
        for number, (i, j) in enumerate(pairs):
            place[i, j] = place[j, i] = 2 + n + number
        bends = _without(Interval.around(mid[:, place], rad[:, place]), lost)
    first = _without(Interval.around(mid[:, 2 : 2 + n], rad[:, 2 : 2 + n]), lost) if order else None
    return Enclosure(_without(value, lost), first, bends, np.asarray(kinked | lost)), passed, first_centre


def _affine(layer: Weights, mid: Array, rad: Array) -> tuple[Array, Array]:
    """The columns (k, c, M) behind W, with the bias added to the first two."""
    k, c, count = mid.shape
    flat_mid, flat_rad = _product(layer.weights, layer.size, mid.reshape(k, c * count), rad.reshape(k, c * count))
    mid, rad = flat_mid.reshape(-1, c, count), flat_rad.reshape(-1, c, count)
    mid[:, :2] += layer.bias[:, None, None]
    rad[:, :2] = upper(rad[:, :2] + STEP * np.abs(mid[:, :2]), step=4 * STEP)
    return mid, rad


def _ranges(mid: Array, rad: Array, radius: Array) -> tuple[Interval, Interval]:
    """What the first column says of the centres, and the second and the mean value form (if any) of the boxes."""
    n = len(radius)
    if mid.shape[1] == 2:
        return Interval.around(mid[:, 0], rad[:, 0]), Interval.around(mid[:, 1], rad[:, 1])
    reach = ((np.abs(mid[:, 2 : 2 + n]) + rad[:, 2 : 2 + n]) * radius).sum(axis=1)
    reach = upper(reach, step=(n + 8) * STEP, tiny=TINY)
    centre = Interval.around(mid[:, 0], rad[:, 0])
    return centre, _meet(Interval.around(mid[:, 1], rad[:, 1]), centre + Interval(-reach, reach))


_Pair = tuple[Array, Array]


def _times(first: _Pair, second: _Pair) -> _Pair:
    """The product of two midpoint-radius arrays."""
    (a, r), (b, q) = first, second
    mid = a * b
    return mid, upper(np.abs(a) * q + r * (np.abs(b) + q) + STEP * np.abs(mid), step=8 * STEP, tiny=4 * TINY)


def _plus(first: _Pair, second: _Pair) -> _Pair:
    mid = first[0] + second[0]
    return mid, upper(first[1] + second[1] + STEP * np.abs(mid), step=4 * STEP)


def _activated(
    layer: Weights, mid: Array, rad: Array, arguments: tuple[Interval, Interval], pairs: Sequence[tuple[int, int]]
) -> _Pair:
    """The columns behind the activation: phi' J, and phi' H + phi'' J_i J_j."""
    row, constants, over = layer.row, layer.constants, arguments[1]
    slope = row.slope(over, *constants)
    own = slope.mid[:, None], slope.rad[:, None]
    new_mid, new_rad = np.empty(mid.shape), np.empty(rad.shape)
    for column, argument in enumerate(arguments):
        value = row.value(argument, *constants)
        new_mid[:, column], new_rad[:, column] = value.mid, value.rad
    new_mid[:, 2:], new_rad[:, 2:] = _times((mid[:, 2:], rad[:, 2:]), own)
    if pairs:
        bend = row.bend(over, *constants)
        first, second = ([2 + pair[side] for pair in pairs] for side in (0, 1))
        squares = _times((mid[:, first], rad[:, first]), (mid[:, second], rad[:, second]))
        bent = _times(squares, (bend.mid[:, None], bend.rad[:, None]))
        last = slice(mid.shape[1] - len(pairs), None)
        new_mid[:, last], new_rad[:, last] = _plus((new_mid[:, last], new_rad[:, last]), bent)
    return new_mid, new_rad


def _meet(first: Interval, second: Interval) -> Interval:
    """The common part of two enclosures of one thing."""
    return Interval(np.maximum(first.lo, second.lo), np.minimum(first.hi, second.hi))


def _without(value: Interval, lost: Mask) -> Interval:
    if not lost.any():
        return value
    return Interval(np.where(lost, -np.inf, value.lo), np.where(lost, np.inf, value.hi))


def relax_network(layers: Sequence[Weights], box: Interval) -> tuple[Array, Interval]:
    """Lines around a network over bounded boxes (n, M): slopes (p, n, M), and what is left (p, M).

    Proves: the network lies in slopes . (x - c) + rest for every x of the box, c its middle (``box.mid``). Slopes are
    the floats that are returned. Where a box is unbounded the rest is.

    Examples
    --------
    >>> layer = Weights(np.eye(1), np.zeros(1), "relu")
    >>> slopes, rest = relax_network([layer], Interval([[-1.0]], [[1.0]]))
    >>> bool(slopes[0, 0, 0] == 0.5 and abs(rest.width[0, 0] - 0.5) < 1e-12)
    True
    """
    parts = [_relax(layers, part) for part in _portions(layers, box)]
    return np.concatenate([part[0] for part in parts], -1), _joined([part[1] for part in parts])


@quiet
def _relax(layers: Sequence[Weights], box: Interval) -> tuple[Array, Interval]:
    found, passed, centre = _bound(layers, box, 0, parallel=True)
    lost = np.asarray(~np.isfinite(found.value.lo).all(axis=0))
    slopes, rest = parallel_planes(passed, centre, np.where(np.isfinite(box.rad), box.rad, 0.0))
    return np.where(lost, 0.0, slopes), _without(rest, lost)


def expand_network(layers: Sequence[Weights], inputs: Sequence[Series], order: int) -> list[Series]:
    """Taylor coefficients 0 .. ``order`` of every output, from those of the inputs (of any shapes that broadcast)."""
    order = 0 if all(len(series) == 1 for series in inputs) else order
    shape = np.broadcast_shapes(*(coefficient.shape for series in inputs for coefficient in series))
    size = int(np.prod(shape))
    columns: Series = []
    for k in range(min(order + 1, max(map(len, inputs)))):
        own = [(series[k] if k < len(series) else ZERO).broadcast_to(shape).reshape(size) for series in inputs]
        columns.append(Interval(np.stack([x.lo for x in own]), np.stack([x.hi for x in own])))
    lost = ~np.all([np.isfinite(x.lo) & np.isfinite(x.hi) for x in columns], axis=(0, 1))
    columns = [Interval(np.where(lost, 0.0, x.lo), np.where(lost, 0.0, x.hi)) for x in columns]
    for layer in layers:
        passed: Series = []
        for k, coefficient in enumerate(columns):
            mid, rad = _product(layer.weights, layer.size, coefficient.mid, coefficient.rad)
            bad = ~(np.isfinite(mid) & np.isfinite(rad)).all(axis=0)
            lost = lost | bad
            moved = Interval.around(np.where(bad, 0.0, mid), np.where(bad, 0.0, rad))
            passed.append(moved + layer.bias[:, None] if k == 0 else moved)
        columns = layer.row.series(passed, order, *layer.constants)
        for number, coefficient in enumerate(columns):
            unbounded = ~(np.isfinite(coefficient.lo) & np.isfinite(coefficient.hi))
            if unbounded.any():
                lost = lost | np.broadcast_to(unbounded, (len(layer.bias), size)).any(axis=0)
                lo, hi = (np.where(unbounded, 0.0, end) for end in (coefficient.lo, coefficient.hi))
                columns[number] = Interval(lo, hi)
    whole = [_without(x.broadcast_to((len(layers[-1].bias), size)), lost) for x in columns]
    return [[x[output].reshape(shape) for x in whole] for output in range(len(layers[-1].bias))]
