"""How fast a scalar response w . Z_t forgets itself, proved between the nodes of a grid to second order.

D(s, t) = cov(xi_s, xi_t) = w Phi(t, s) V_s w for s <= t, psi = -log corr. On a cell [t_i, t_{i+1}] x [t_j, t_{j+1}] the
derivatives are bilinear forms of Phi(t_j, t_{i+1}): with rows q_m = (w, alpha, alpha_2)_t Phi(t, t_j), alpha = w A,
alpha_2 = alpha A + w A', and columns u_n = Phi(t_{i+1}, s) (c_0, c_1, c_2)_s, c_0 = V w, c_1 = V alpha + G w,
c_2 = -A c_1 + c_1', the derivative m times by t and n times by s is D_mn = q_m Phi(t_j, t_{i+1}) u_n. Rows and columns
of `certbound.gaussian.response.moments` are as wide as a part is long; what is made of them here enters `node_clock`
multiplied by the length of a part or its square.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.response.moments import UP, RowMoments, apply
from certbound.gaussian.scalar import EPS
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet
from certbound.watch import poll

BATCH = 1_000_000  # numbers of a batch of pairs
BESIDE = 100  # numbers that are made of a pair beside its matrix, for each state: rows, columns, and their products


@dataclass(frozen=True, eq=False, kw_only=True)
class Decorrelation:
    """What `node_clock` asks for: lengths, near rates (K,), needs (K + 1, K + 1); and the variance over each part."""

    durations: Array
    near: Array
    needs: Array
    variance: Interval


def _ratio(x: Interval, y: Interval, usable: Mask) -> Interval:
    """x / y where y > 0 (``usable``), anything elsewhere."""
    return x / Interval(np.where(usable, y.lo, 1.0), np.where(usable, y.hi, 1.0))


def _of(own: Interval, index: Integers) -> Interval:
    return Interval(own.lo[index], own.hi[index])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Pairs:
    """Phi(t_b, t_a) for pairs of nodes a < b in floats, with an entrywise error bound of each."""

    a: Integers
    b: Integers
    matrix: Array
    error: Array


def pairs_of(f: Array, phi: Array) -> Iterator[_Pairs]:
    """All pairs, in batches of a few million numbers with all that is made of them."""
    count, n = f.shape[:2]
    size = np.abs(f).sum(axis=2).max(axis=1) + n * phi
    matrix, error = np.zeros((0, n, n)), np.zeros(0)
    held: list[tuple[int, Array, Array]] = []
    waiting = 0
    for b in range(1, count + 1):
        poll()
        norm = np.abs(matrix).max(axis=(1, 2), initial=0.0)
        later = (size[b - 1] * error + (n * phi[b - 1] + 4 * (n + 2) * EPS * size[b - 1]) * (norm + error)) * UP
        matrix = np.concatenate([f[b - 1] @ matrix, f[b - 1][None]])
        error = np.append(later, phi[b - 1])
        held.append((b, matrix, error))
        waiting += len(error)
        if b == count or waiting * n * (n + BESIDE) > BATCH:
            yield _Pairs(
                a=np.concatenate([np.arange(len(e)) for _, _, e in held]),
                b=np.concatenate([np.full(len(e), k) for k, _, e in held]),
                matrix=np.concatenate([m for _, m, _ in held]), error=np.concatenate([e for _, _, e in held]),
            )
            held, waiting = [], 0


@quiet
def decorrelation(r: LinearResponse, w: Array, diffusion: Array, first: int) -> Decorrelation | None:
    """Near rates and needs of w . Z over the parts from number ``first`` on; None where none are proved.

    Proves: psi(s, t) <= near[k] (t - s) within a part, d psi/dt <= near[k] for s in part k - 1 and t in part k, and
    for cells two parts or more apart psi lies below the bilinear interpolation of needs at the cell's corners
    (a function exceeds its interpolation by at most h^2/8 of what its second derivatives are below 0, in s and in t).
    """
    row = RowMoments(r, w, diffusion, first)
    count = len(row.w)
    if not (np.all(row.variance.lo > 0) and all(np.all(end.lo > 0) for end in row.ends)):
        return None
    ratio = row.rate / row.variance
    own = (row.bend / row.variance - ratio**2) * 0.5
    psi, convex = np.full((count + 1, count + 1), np.inf), np.zeros((count + 2, count + 2))
    side = np.zeros(count)
    rows = np.stack([x.middle for x in row.rows], axis=1), np.stack([x.radius for x in row.rows], axis=1)
    for pairs in pairs_of(r.transition[0, first:], r.transition_error[0, first:]):
        psi[pairs.a, pairs.b] = _at_nodes(row, w, pairs)
        # the cell of parts a - 1 and b sees the pair of nodes a <= b; a = b is the neighbour
        inside = (pairs.a >= 1) & (pairs.b < count)
        a, b = pairs.a[inside], pairs.b[inside]
        d = _derivatives(row, rows, a - 1, b, pairs.matrix[inside], pairs.error[inside])
        usable = d["00"].lo > 0
        tt = _second(d, usable, _of(own, b), "20", "10")
        ss = _second(d, usable, _of(own, a - 1), "02", "01")
        bent = row.h**2 / 8 * (np.maximum(-tt.lo, 0.0) + np.maximum(-ss.lo, 0.0)) * UP
        convex[a, b + 1] = np.where(usable, bent, np.inf)
    neighbour = np.arange(1, count)
    unit = np.broadcast_to(np.eye(len(w)), (count - 1, len(w), len(w)))
    d = _derivatives(row, rows, neighbour - 1, neighbour, unit, np.zeros(count - 1))
    usable = d["00"].lo > 0
    tt, st = _second(d, usable, _of(own, neighbour), "20", "10"), _mixed(d, usable)
    corner = (_of(row.noise, neighbour) * 0.5 / _of(row.ends[0], neighbour)).hi + row.h * (
        np.maximum(-st.lo, 0.0) + np.maximum(tt.hi, 0.0)) * UP
    centre = _slope_at_middles(row, neighbour) + row.h / 2 * (np.asarray(st.mag) + np.asarray(tt.mag)) * UP
    side[1:] = np.where(usable, np.minimum(corner, centre), np.inf)
    # node (a, b) is a corner of the cells (a - 1 or a, b - 1 or b), found at convex[i + 1, j + 1]
    reach = np.maximum(np.maximum(convex[:-1, :-1], convex[1:, :-1]), np.maximum(convex[:-1, 1:], convex[1:, 1:]))
    needs, near = (psi + reach) * (1 + 4 * EPS), _near(row, own, side)
    if not (np.all(np.isfinite(near)) and np.all(np.isfinite(np.diagonal(needs, 1)))):
        return None
    return Decorrelation(durations=np.full(count, row.h), near=near, needs=needs, variance=row.variance)


def _at_nodes(row: RowMoments, w: Array, pairs: _Pairs) -> Array:
    """Upper bounds of psi(t_a, t_b); inf where the correlation may vanish."""
    n, a, b = len(w), pairs.a, pairs.b
    ends = np.concatenate([row.ends[0].hi, row.ends[1].hi[-1:]])
    log_sd = 0.5 * np.log(ends) * (1 + 4 * EPS) + 4 * EPS
    v_w = np.concatenate([apply(row.v[0], row.w), apply(row.v[1], row.w)[-1:]])[a]
    loose = np.append(row.loose_columns[0], row.loose_columns[0][-1])[a]
    seen, total, size = w @ pairs.matrix, float(np.abs(w).sum()), np.abs(v_w)
    lost = (np.abs(seen).sum(axis=1) + n * pairs.error * total) * loose + pairs.error * total * size.sum(axis=1)
    lost = lost + 8 * (n + 2) * EPS * ((np.abs(w) @ np.abs(pairs.matrix)) * size).sum(axis=1)
    value = np.einsum("ai,ai->a", seen, v_w) - lost * UP
    log = np.log(np.where(value > 0, value, 1.0))
    found = log_sd[a] + log_sd[b] - log + 8 * EPS * (1 + np.abs(log) + np.abs(log_sd[a]) + np.abs(log_sd[b]))
    return np.asarray(np.where(value > 0, found, np.inf))


def _derivatives(
    row: RowMoments, rows: tuple[Array, Array], i: Integers, j: Integers, matrix: Array, error: Array
) -> dict[str, Interval]:
    """D differentiated by t and s over the cells of parts i < j; ``matrix`` = Phi(t_j, t_{i+1})."""
    n, (middles, radii) = matrix.shape[-1], rows
    total = np.abs(middles).sum(axis=2)
    middle = middles[j] @ matrix
    off = error[:, None] * total[j] + 8 * (n + 2) * EPS * (np.abs(middles[j]) @ np.abs(matrix)).max(axis=2)
    radius = radii[j] @ (np.abs(matrix) + error[:, None, None]) * UP + off[..., None]
    d = {}
    for name in ("00", "10", "20", "01", "02", "11"):
        x, y = int(name[0]), row.columns[int(name[1])]
        d[name] = _product(middle[:, x], radius[:, x], y.middle[i], y.radius[i])
    return d


def _product(middle: Array, radius: Array, other: Array, width: Array) -> Interval:
    """Row times column, both within a radius of their middles; the whole line where floats overflowed."""
    size = np.abs(other)
    centre = np.einsum("ai,ai->a", middle, other)
    spread = np.einsum("ai,ai->a", np.abs(middle) + radius, width) + np.einsum("ai,ai->a", radius, size)
    spread = spread * UP + 1e-14 * np.einsum("ai,ai->a", np.abs(middle), size)
    known = np.isfinite(centre - spread) & np.isfinite(centre + spread)
    return Interval(np.where(known, centre - spread, -np.inf), np.where(known, centre + spread, np.inf))


def _second(d: dict[str, Interval], usable: Mask, own: Interval, second: str, first: str) -> Interval:
    """psi differentiated twice by t or by s: -D''/D + (D'/D)^2 + ``own``."""
    return _ratio(d[first], d["00"], usable) ** 2 - _ratio(d[second], d["00"], usable) + own


def _mixed(d: dict[str, Interval], usable: Mask) -> Interval:
    """psi differentiated by s and t."""
    product = _ratio(d["10"], d["00"], usable) * _ratio(d["01"], d["00"], usable)
    return product - _ratio(d["11"], d["00"], usable)


def _slope_at_middles(row: RowMoments, part: Integers) -> Array:
    """Upper bounds of d psi/dt with s at the middle of the part before and t at that of ``part``."""
    column = row.at_middle[2]
    over, under = (
        _product(x.middle[part], x.radius[part], column.middle[part - 1], column.radius[part - 1])
        for x in (row.at_middle[1], row.at_middle[0])
    )
    usable = (under.lo > 0) & (row.own_middle[0].lo[part] > 0)
    own = _ratio(_of(row.own_middle[1], part), _of(row.own_middle[0], part), usable)
    return np.asarray(np.where(usable, (own * 0.5 - _ratio(over, under, usable)).hi, np.inf))


def _near(row: RowMoments, own: Interval, side: Array) -> Array:
    """Bounds of d psi/dt within each part, by the mean value from s = t at its ends or its middle, and ``side``."""
    dev = row.m.grow - np.eye(row.w.shape[1])
    d = {}
    for name in ("00", "10", "20", "01", "11"):
        x, y = row.inner_rows[int(name[0])], row.inner_columns[int(name[1])]
        found = _product(x.middle, x.radius, y.middle, y.radius)
        turned = np.einsum("ki,kij,kj->k", np.abs(x.middle) + x.radius, dev, np.abs(y.middle) + y.radius) * UP
        d[name] = Interval(found.lo - turned, found.hi + turned)
    usable = d["00"].lo > 0
    tt, st = _second(d, usable, own, "20", "10"), _mixed(d, usable)
    start, end = (row.noise * 0.5 / end for end in row.ends)
    inner = np.minimum(
        start.hi + row.h * (np.maximum(st.hi, 0.0) + np.maximum(tt.hi, 0.0)) * UP,
        end.hi + row.h * (np.maximum(-st.lo, 0.0) + np.maximum(-tt.lo, 0.0)) * UP,
    )
    variance = row.own_middle[0]
    clear = variance.lo > 0
    middle = _ratio(row.noise * 0.5, variance, clear).hi + row.h / 2 * (np.asarray(st.mag) + np.asarray(tt.mag)) * UP
    inner = np.where(clear, np.minimum(inner, middle), inner)
    return np.asarray(np.where(usable, np.maximum(inner, side), np.inf))
