"""v_t + L v on the lattice of one cell after another, and the most of its interpolants there: compiled loops.

What `most_of_interpolants` says of arrays over all lattice points, for coefficients that do not change, without these
arrays: a plane of points along the first axis is made at a time, and cells are bounded once the planes about them are
there. Loops over points run innermost along the last axis, cell by cell for points with the same share of their cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index
from certbound.lazy import compiled
from certbound.values.kolmogorov.splines import DEGREE, Axis

_WINDOW = DEGREE + 1
_NOTHING = np.zeros((0, 1))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Images:
    """The generator as the loops read it, of two axes or three; a first axis of one point stands before two.

    Attributes
    ----------
    starts : tuple of ndarray
        First coefficient of each lattice point along the first two axes.
    along : tuple of ndarray, shapes (3, L_i, W_i)
        Weights of derivatives of orders 0 to 2 along these.
    last : ndarray, shape (3, m + 1, 6, N_n)
        The same along the last axis, by shares of cells.
    pairs : ndarray, shape (C, 2)
        Orders along the first two axes.
    plain : ndarray, shape (3, C)
        Constant coefficients, by the order along the last axis and the pair.
    terms : ndarray, shape (T, 2)
        Pairs and orders along the last axis, of the terms with other coefficients.
    fields : ndarray, shape (T, L_1, L_2, m + 1, N_n)
        These coefficients.
    bends : tuple of ndarray
        From values on a cell to the coefficients of minus the interpolant's second derivative, along each axis.
    chords : ndarray, shape (3,)
    order : tuple of int
        The grid's axes as the loops take them: the one with most cells last.
    """

    starts: tuple[Index, Index]
    along: tuple[Array, Array]
    last: Array
    pairs: Index
    plain: Array
    terms: Index
    fields: Array
    bends: tuple[Array, Array, Array]
    chords: Array
    order: tuple[int, ...]

    @classmethod
    def of(cls, axes: Sequence[Axis], terms: Sequence[tuple[tuple[int, ...], Array]]) -> Images:
        """From the terms: orders of a derivative along the axes, and its coefficient at the lattice points."""
        turn = tuple(sorted(range(len(axes)), key=lambda k: axes[k].cells))
        shape = tuple(len(axis.lattice) for axis in axes)
        terms = [
            (tuple(orders[k] for k in turn), np.broadcast_to(given, shape).transpose(turn)) for orders, given in terms
        ]
        axes = [axes[k] for k in turn]
        ahead = 3 - len(axes)
        known: dict[tuple[int, int], int] = {(0, 0): 0}
        places: list[tuple[int, int]] = []
        for given, _ in terms:
            first, second, third = (0,) * ahead + given
            places.append((known.setdefault((first, second), len(known)), third))
        plain, others, fields = np.zeros((3, len(known))), list[tuple[int, int]](), list[Array]()
        for (pair, order), (_, coefficient) in zip(places, terms):
            if np.all(coefficient == coefficient.flat[0]):
                plain[order, pair] += float(coefficient.flat[0])
            else:
                others.append((pair, order))
                fields.append(_by_cells(coefficient.reshape((1,) * ahead + coefficient.shape), axes[-1]))
        both = [(np.zeros(1, dtype=np.intp), np.array([[[1.0]], [[0.0]], [[0.0]]]))] * ahead
        both += [(axis.on_lattice[0].start, np.array([one.weights for one in axis.on_lattice])) for axis in axes]
        bends = [_NOTHING] * ahead + [np.ascontiguousarray(-axis.sampling.derivative(2)) for axis in axes]
        chords = [0.0] * ahead + [axis.sampling.chord for axis in axes]
        parts, cells = axes[-1].sampling.parts, axes[-1].cells
        points = _points(axes[-1])
        last = np.zeros((3, parts + 1, _WINDOW, cells))
        for derivative, banded in enumerate(axes[-1].on_lattice):
            shift = banded.start[points] - np.arange(cells)  # a cell's last point is the next one's first
            for k in range(_WINDOW):
                place = k + shift
                for p in range(parts + 1):
                    fits = place[p] < _WINDOW  # of what does not, a spline that begins at a node, the weight is 0
                    last[derivative, p, place[p][fits], np.flatnonzero(fits)] = banded.weights[points[p], k][fits]
        return cls(
            starts=(both[0][0], both[1][0]), along=(both[0][1], both[1][1]), last=last,
            pairs=np.array(list(known), dtype=np.intp), plain=plain,
            terms=np.array(others, dtype=np.intp).reshape(-1, 2),
            fields=np.array(fields).reshape(len(fields), len(both[0][0]), len(both[1][0]), parts + 1, cells),
            bends=(bends[0], bends[1], bends[2]), chords=np.array(chords), order=turn,
        )  # fmt: skip

    def most(self, values: Array, rates: Array, *, proved: bool) -> Array:
        """The most of the interpolants of rates + L values on every cell; or of the values at the lattice points.

        Parameters
        ----------
        values, rates : ndarray, shape (K, N_1 + 5, ...)

        Returns
        -------
        ndarray, shape (K, N_1, ...)
        """
        ahead = 3 - len(self.order)
        turn = (0, *(k + 1 for k in self.order))
        given, pace = (np.ascontiguousarray(one.transpose(turn)) for one in (values, rates))
        for _ in range(ahead):
            given, pace = given[:, None], pace[:, None]
        parts = [len(one) + 1 if len(one) else 0 for one in self.bends]
        counts = [max(len(start) - 1, 1) // max(m, 1) for start, m in zip(self.starts, parts)]
        out = np.empty((len(given), *counts, self.last.shape[3]))
        _most(
            out, given, pace, *self.starts, *self.along, self.last, self.pairs, self.plain, self.terms, self.fields,
            *self.bends, self.chords, proved,
        )  # fmt: skip
        return np.ascontiguousarray((out[:, 0] if ahead else out).transpose(np.argsort(turn)))


def _points(axis: Axis) -> Index:
    """Lattice points by shares of cells, shape (m + 1, N)."""
    parts = axis.sampling.parts
    return np.asarray(np.arange(axis.cells) * parts + np.arange(parts + 1)[:, None], dtype=np.intp)


def _by_cells(coefficient: Array, axis: Axis) -> Array:
    """Lattice values by shares of cells along the last axis."""
    return np.asarray(coefficient[..., _points(axis)])


@compiled
def _most(  # type: ignore[no-untyped-def]
    out, values, rates, start1, start2, along1, along2, last, pairs, plain, terms, fields, bend1, bend2, bend3,
    chords, proved,
):  # fmt: skip
    """A plane of lattice points along the first axis after the other, and the cells between two nodes."""
    parts1, parts2 = bend1.shape[0] + 1, bend2.shape[0] + 1
    if bend1.shape[0] == 0:
        parts1 = 0
    points1, points2 = start1.size, start2.size
    shares, cells = last.shape[1], last.shape[3]
    shape = values.shape
    first = np.empty((4, shape[2], shape[3]))
    second = np.empty((pairs.shape[0] + 1, points2, shape[3]))
    mixed = np.empty((3, points2, shape[3]))
    used = np.zeros(3, np.bool_)
    for o in range(3):
        used[o] = np.any(plain[o] != 0.0)
    used[0] = True
    planes = np.empty((parts1 + 1, points2, shares, cells))
    held = np.empty((parts1 + 1, points2, shares, cells))
    rows, sums = np.empty((parts2 + 1, shares, cells)), np.empty((shares, cells))
    over = np.empty(cells)
    for k in range(shape[0]):
        for p1 in range(points1):
            _along_first(first, values[k], rates[k], start1[p1], along1[:, p1])
            here = planes[p1 % (parts1 + 1)]
            _along_second(second, first, pairs, start2, along2)
            here[:] = 0.0
            for o in range(3):
                if used[o]:
                    _mixed(mixed[o], second, plain[o], o == 0)
                    _add_dots(here, last[o], mixed[o])
            for t in range(terms.shape[0]):
                _add_products(here, fields[t, p1], last[terms[t, 1]], second[terms[t, 0]])
            if parts1 > 0 and (p1 == 0 or p1 % parts1 > 0):
                continue
            begin = p1 - parts1
            for a in range(parts1 + 1):
                held[a] = planes[(begin + a) % (parts1 + 1)]
            cell1 = begin // max(parts1, 1)
            for cell2 in range(out.shape[2]):
                own = held[:, cell2 * parts2 : (cell2 + 1) * parts2 + 1]
                best = out[k, cell1, cell2]
                best[:] = -np.inf
                for a in range(parts1 + 1):
                    _most_of_plane(best, own[a], bend2, bend3, chords, proved, sums)
                if proved and bend1.shape[0] > 0:
                    over[:] = 0.0
                    for b in range(bend1.shape[0]):
                        for q in range(parts2 + 1):
                            _sum_of(rows[q], own[:, q], bend1[b])
                        _most_of_plane(over, rows, bend2, bend3, chords, proved, sums)
                    for c in range(cells):
                        best[c] += chords[0] * over[c]


@compiled
def _along_first(out, values, rates, start, weights):  # type: ignore[no-untyped-def]
    """Derivatives of orders 0 to 2 along the first axis at one of its points, and the rates there."""
    out[:] = 0.0
    for k in range(weights.shape[1]):
        for o in range(4):
            w = weights[o, k] if o < 3 else weights[0, k]
            if w == 0.0:
                continue
            given = values[start + k] if o < 3 else rates[start + k]
            for j in range(given.shape[0]):
                for m in range(given.shape[1]):
                    out[o, j, m] += w * given[j, m]


@compiled
def _along_second(out, first, pairs, starts, weights):  # type: ignore[no-untyped-def]
    """The pairs of derivatives at the points of the second axis; last, the rates there."""
    for i in range(out.shape[0]):
        rates = i == pairs.shape[0]
        given = first[3] if rates else first[pairs[i, 0]]
        order = 0 if rates else pairs[i, 1]
        for p in range(out.shape[1]):
            start = starts[p]
            for m in range(out.shape[2]):
                out[i, p, m] = 0.0
            for k in range(weights.shape[2]):
                w = weights[order, p, k]
                if w != 0.0:
                    for m in range(out.shape[2]):
                        out[i, p, m] += w * given[start + k, m]


@compiled
def _mixed(out, second, plain, with_rates):  # type: ignore[no-untyped-def]
    """The sum of the pairs with constant coefficients, and of the rates."""
    out[:] = 0.0
    for i in range(plain.size + 1):
        w = plain[i] if i < plain.size else 1.0
        if w == 0.0 or (i == plain.size and not with_rates):
            continue
        for p in range(out.shape[0]):
            for m in range(out.shape[1]):
                out[p, m] += w * second[i, p, m]


@compiled
def _add_dots(out, w, v):  # type: ignore[no-untyped-def]
    """out[p, s, c] += sum_m w[s, m, c] v[p, c + m], of six."""
    for p in range(out.shape[0]):
        for s in range(out.shape[1]):
            for c in range(out.shape[2]):
                out[p, s, c] += (
                    w[s, 0, c] * v[p, c] + w[s, 1, c] * v[p, c + 1] + w[s, 2, c] * v[p, c + 2]
                    + w[s, 3, c] * v[p, c + 3] + w[s, 4, c] * v[p, c + 4] + w[s, 5, c] * v[p, c + 5]
                )  # fmt: skip


@compiled
def _add_products(out, field, w, v):  # type: ignore[no-untyped-def]
    """The same times coefficients."""
    for p in range(out.shape[0]):
        for s in range(out.shape[1]):
            for c in range(out.shape[2]):
                out[p, s, c] += field[p, s, c] * (
                    w[s, 0, c] * v[p, c] + w[s, 1, c] * v[p, c + 1] + w[s, 2, c] * v[p, c + 2]
                    + w[s, 3, c] * v[p, c + 3] + w[s, 4, c] * v[p, c + 4] + w[s, 5, c] * v[p, c + 5]
                )  # fmt: skip


@compiled
def _most_of_plane(out, plane, bend2, bend3, chords, proved, sums):  # type: ignore[no-untyped-def]
    """Raise ``out`` to bounds of the interpolants over the last two axes, of cells in a row."""
    best, extra = np.full(out.size, -np.inf), np.zeros(out.size)
    for q in range(plane.shape[0]):
        _most_of_line(best, plane[q], bend3, chords[2], proved)
    if proved:
        for b in range(bend2.shape[0]):
            _sum_of(sums, plane, bend2[b])
            _most_of_line(extra, sums, bend3, chords[2], proved)
    for c in range(out.size):
        out[c] = max(out[c], best[c] + chords[1] * extra[c])


@compiled
def _sum_of(out, rows, w):  # type: ignore[no-untyped-def]
    """out = sum_q w[q] rows[q], of shares and cells."""
    if w.size == 6:
        for s in range(out.shape[0]):
            for c in range(out.shape[1]):
                out[s, c] = (
                    w[0] * rows[0, s, c] + w[1] * rows[1, s, c] + w[2] * rows[2, s, c]
                    + w[3] * rows[3, s, c] + w[4] * rows[4, s, c] + w[5] * rows[5, s, c]
                )  # fmt: skip
        return
    out[:] = 0.0
    for q in range(w.size):
        for s in range(out.shape[0]):
            for c in range(out.shape[1]):
                out[s, c] += w[q] * rows[q, s, c]


@compiled
def _most_of_line(out, points, bend, chord, proved):  # type: ignore[no-untyped-def]
    """Raise ``out`` to bounds of the interpolants along the last axis, of cells in a row."""
    count = points.shape[0]
    if proved and count == 6:
        _most_of_six(out, points, bend, chord)
    elif proved and count == 5:
        _most_of_five(out, points, bend, chord)
    elif proved and count == 4:
        _most_of_four(out, points, bend, chord)
    else:
        for c in range(out.size):
            high, more = points[0, c], 0.0
            for s in range(1, count):
                high = max(high, points[s, c])
            if proved:
                for b in range(bend.shape[0]):
                    total = 0.0
                    for s in range(count):
                        total += bend[b, s] * points[s, c]
                    more = max(more, total)
            out[c] = max(out[c], high + chord * more)


@compiled
def _most_of_six(out, p, bend, chord):  # type: ignore[no-untyped-def]
    """`_most_of_line` of six points a cell, whose interpolants bend by four coefficients."""
    a0, a1, a2, a3, a4, a5 = bend[0, 0], bend[0, 1], bend[0, 2], bend[0, 3], bend[0, 4], bend[0, 5]
    b0, b1, b2, b3, b4, b5 = bend[1, 0], bend[1, 1], bend[1, 2], bend[1, 3], bend[1, 4], bend[1, 5]
    c0, c1, c2, c3, c4, c5 = bend[2, 0], bend[2, 1], bend[2, 2], bend[2, 3], bend[2, 4], bend[2, 5]
    d0, d1, d2, d3, d4, d5 = bend[3, 0], bend[3, 1], bend[3, 2], bend[3, 3], bend[3, 4], bend[3, 5]
    for k in range(out.size):
        u, v, w, x, y, z = p[0, k], p[1, k], p[2, k], p[3, k], p[4, k], p[5, k]
        high = max(max(max(u, v), max(w, x)), max(y, z))
        first = max(
            a0 * u + a1 * v + a2 * w + a3 * x + a4 * y + a5 * z, b0 * u + b1 * v + b2 * w + b3 * x + b4 * y + b5 * z
        )
        second = max(
            c0 * u + c1 * v + c2 * w + c3 * x + c4 * y + c5 * z, d0 * u + d1 * v + d2 * w + d3 * x + d4 * y + d5 * z
        )
        out[k] = max(out[k], high + chord * max(max(first, second), 0.0))


@compiled
def _most_of_five(out, p, bend, chord):  # type: ignore[no-untyped-def]
    """The same of five points, and three coefficients."""
    a0, a1, a2, a3, a4 = bend[0, 0], bend[0, 1], bend[0, 2], bend[0, 3], bend[0, 4]
    b0, b1, b2, b3, b4 = bend[1, 0], bend[1, 1], bend[1, 2], bend[1, 3], bend[1, 4]
    c0, c1, c2, c3, c4 = bend[2, 0], bend[2, 1], bend[2, 2], bend[2, 3], bend[2, 4]
    for k in range(out.size):
        u, v, w, x, y = p[0, k], p[1, k], p[2, k], p[3, k], p[4, k]
        high = max(max(max(u, v), max(w, x)), y)
        first = max(a0 * u + a1 * v + a2 * w + a3 * x + a4 * y, b0 * u + b1 * v + b2 * w + b3 * x + b4 * y)
        more = max(first, c0 * u + c1 * v + c2 * w + c3 * x + c4 * y)
        out[k] = max(out[k], high + chord * max(more, 0.0))


@compiled
def _most_of_four(out, p, bend, chord):  # type: ignore[no-untyped-def]
    """The same of four points, and two coefficients."""
    a0, a1, a2, a3 = bend[0, 0], bend[0, 1], bend[0, 2], bend[0, 3]
    b0, b1, b2, b3 = bend[1, 0], bend[1, 1], bend[1, 2], bend[1, 3]
    for k in range(out.size):
        u, v, w, x = p[0, k], p[1, k], p[2, k], p[3, k]
        more = max(a0 * u + a1 * v + a2 * w + a3 * x, b0 * u + b1 * v + b2 * w + b3 * x)
        out[k] = max(out[k], max(max(u, v), max(w, x)) + chord * max(more, 0.0))
