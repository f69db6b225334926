"""V o Phi on the grid, V multilinear and Phi the noise-free step: values at nodes, allowances on cells; compiled.

Along a side of a cell, with image c(tau), tau in [0, 1], and in the sense of distributions,
    -(V o c)'' <= -2 sum_{b<e} V_be c_b' c_e' + sum_b |V_b| |c_b''| + sum over planes of (-kink)^+ |c_b'| delta,
so that V o c exceeds its chord by at most 1/8 of the bounded part and tau (1 - tau) of each mass at tau. Where c_b' may
vanish, c_b is frozen instead: that costs |V_b| times the range of c_b. Interpolation axis by axis adds up over the
axes, since interpolation is positive; sides at all places across the cell count.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.lazy import compiled, within

PAIRS = ((0, 1), (0, 2), (1, 2))


def slopes_of(value: Array, axes: tuple[Array, ...]) -> Array:
    """Bounds of |V_b| on cells, shape (3, cells)."""
    found = []
    for b, axis in enumerate(axes):
        size = np.abs(np.diff(value, axis=b)) / _along(np.diff(axis), b)
        found.append(_over_others(size, b))
    return np.stack(found) * (1 + 1e-9)


def crosses_of(value: Array, axes: tuple[Array, ...]) -> Array:
    """Bounds of |V_be| on cells for b < e, shape (3, cells)."""
    found = []
    for b, e in PAIRS:
        size = np.diff(np.diff(value, axis=b), axis=e) / _along(np.diff(axes[b]), b) / _along(np.diff(axes[e]), e)
        rest = 3 - b - e
        found.append(_paired(np.abs(size), rest))
    loose = 1e-15 * float(np.abs(value).max()) / float(min(np.diff(axis).min() for axis in axes)) ** 2
    return np.stack(found) * (1 + 1e-9) + loose


def kinks_of(value: Array, axes: tuple[Array, ...]) -> tuple[Array, Array]:
    """Largest jumps of V_b upwards and downwards at the planes b = node: shape (3, nodes), cells along the others.

    Arrays are as long as nodes along every axis; what lies beyond the last cell across is not used.
    """
    up, down = np.zeros((3, *value.shape)), np.zeros((3, *value.shape))
    for b, axis in enumerate(axes):
        slope = np.diff(value, axis=b) / _along(np.diff(axis), b)
        jump = _padded(np.diff(slope, axis=b), b)
        cells = tuple(slice(None) if k == b else slice(None, -1) for k in range(3))
        up[b][cells] = _over_others(np.maximum(jump, 0.0), b)
        down[b][cells] = _over_others(np.maximum(-jump, 0.0), b)
    return up * (1 + 1e-9), down * (1 + 1e-9)


def beside(planes: Array) -> Array:
    """The larger of the kinks at a cell's two planes, shape (3, cells)."""
    cells = (slice(None, -1),) * 3
    found = []
    for b in range(3):
        upper = tuple(slice(1, None) if k == b else slice(None, -1) for k in range(3))
        found.append(np.maximum(planes[b][cells], planes[b][upper]))
    return np.stack(found)


def _along(widths: Array, axis: int) -> Array:
    return widths.reshape([-1 if k == axis else 1 for k in range(3)])


def _padded(part: Array, axis: int) -> Array:
    return np.pad(part, [(1, 1) if k == axis else (0, 0) for k in range(3)])


def _paired(part: Array, axis: int) -> Array:
    moved = np.moveaxis(part, axis, 0)
    return np.moveaxis(np.maximum(moved[:-1], moved[1:]), 0, axis)


def _over_others(part: Array, axis: int) -> Array:
    for other in range(3):
        if other != axis:
            part = _paired(part, other)
    return part


@within
def _cell_of(axis: Array, place: float) -> int:
    low, high = 0, len(axis) - 2
    while low < high:
        middle = (low + high + 1) // 2
        if axis[middle] <= place:
            low = middle
        else:
            high = middle - 1
    return low


@compiled
def at_images(
    value: Array, x: Array, y: Array, q: Array, shift: Array, radius: Array, known: Mask, steep: Array, top: float
) -> Array:
    """V at the images of all nodes, from above; ``top`` where they are unknown or beyond the grid.

    ``steep``, shape (3,): bounds of |V_b| everywhere.
    """
    found = np.full(value.shape, top)
    f0, f1, f2 = shift.shape[1] > 1, shift.shape[2] > 1, shift.shape[3] > 1
    for i in range(len(x)):
        for j in range(len(y)):
            for k in range(len(q)):
                a, b, c = i * f0, j * f1, k * f2
                if not known[a, b, c]:
                    continue
                u, v, w = x[i] + shift[0, a, b, c], y[j] + shift[1, a, b, c], q[k] + shift[2, a, b, c]
                r0 = radius[0, a, b, c] + 4e-16 * (abs(u) + abs(x[i]))
                r1 = radius[1, a, b, c] + 4e-16 * (abs(v) + abs(y[j]))
                r2 = radius[2, a, b, c] + 4e-16 * (abs(w) + abs(q[k]))
                if u - r0 < x[0] or u + r0 > x[-1] or v - r1 < y[0] or v + r1 > y[-1]:
                    continue
                if w - r2 < q[0] or w + r2 > q[-1]:
                    continue
                m, n, o = _cell_of(x, u), _cell_of(y, v), _cell_of(q, w)
                s = min(max((u - x[m]) / (x[m + 1] - x[m]), 0.0), 1.0)
                t = min(max((v - y[n]) / (y[n + 1] - y[n]), 0.0), 1.0)
                p = min(max((w - q[o]) / (q[o + 1] - q[o]), 0.0), 1.0)
                total = 0.0
                for d in range(2):
                    e = s if d else 1 - s
                    for g in range(2):
                        z = t if g else 1 - t
                        total += e * z * ((1 - p) * value[m + d, n + g, o] + p * value[m + d, n + g, o + 1])
                r0 += 4e-16 * (x[m + 1] - x[m])
                r1 += 4e-16 * (y[n + 1] - y[n])
                r2 += 4e-16 * (q[o + 1] - q[o])
                more = steep[0] * r0 + steep[1] * r1 + steep[2] * r2
                found[i, j, k] = min(total * (1 + 1e-14) + more, top)
    return found


def near(field: Array, axes: tuple[Array, ...], reach: Array) -> Array:
    """Largest value of a field over the cells within ``reach`` of a cell, axis by axis."""
    for b, axis in enumerate(axes):
        first = np.searchsorted(axis, axis[:-1] - reach[b], side="right") - 1
        last = np.searchsorted(axis, axis[1:] + reach[b])
        ends = np.maximum(first, 0), np.minimum(last, len(axis) - 1)
        moved = np.moveaxis(field, b, 0)
        field = np.moveaxis(_running(np.ascontiguousarray(moved), ends[0], ends[1]), 0, b)
    return field


@compiled
def _running(field: Array, first: Index, last: Index) -> Array:
    """Largest along the first axis of members first[i] : last[i]."""
    found = np.empty_like(field)
    for i in range(len(field)):
        for m in range(first[i], max(last[i], first[i] + 1)):
            for j in range(field.shape[1]):
                for k in range(field.shape[2]):
                    found[i, j, k] = field[m, j, k] if m == first[i] else max(found[i, j, k], field[m, j, k])
    return found


@within
def _largest(field: Array, window: Index) -> float:
    best = 0.0
    for m in range(window[0], window[1] + 1):
        for n in range(window[2], window[3] + 1):
            for o in range(window[4], window[5] + 1):
                best = max(best, field[m, n, o])
    return best


@within
def _at_plane(field: Array, window: Index, axis: int, plane: int) -> float:
    """Largest kink at a plane across a window."""
    part = np.empty(6, dtype=np.intp)
    for k in range(6):
        part[k] = plane if k // 2 == axis else window[k]
    return _largest(field, part)


@within
def _hump(low: float, high: float) -> float:
    """max of tau (1 - tau) over [low, high] and [0, 1]."""
    if low <= 0.5 <= high:
        return 0.25
    end = high if high < 0.5 else low
    return max(end * (1 - end), 0.0)


@within
def _excess(
    axis: int, start: Array, end: Array, rate: Array, bow: Array, window: Index, x: Array, y: Array, q: Array,
    slopes: Array, crosses: Array, down: Array,
) -> float:  # fmt: skip
    """What V o Phi may exceed its chord by along a side; ranges (3, 2) of its ends and of c', and ``bow`` >= |c''|."""
    total = 0.0
    moving = np.zeros(3)
    for b in range(3):
        size = max(abs(rate[b, 0]), abs(rate[b, 1]))
        if size == 0.0:
            continue
        if rate[b, 0] <= 0.0 <= rate[b, 1]:
            total += slopes[b] * (size + bow[b])
            continue
        moving[b] = size
        mesh = x if b == 0 else (y if b == 1 else q)
        least = min(abs(rate[b, 0]), abs(rate[b, 1]))
        forth = rate[b, 0] > 0
        for plane in range(window[2 * b] + 1, window[2 * b + 1] + 1):
            kink = _at_plane(down[b], window, b, plane)
            if kink == 0.0:
                continue
            # from the start's side: the plane is reached once |c_b - start| has grown to its distance
            near = mesh[plane] - start[b, 1] if forth else start[b, 0] - mesh[plane]
            far = mesh[plane] - start[b, 0] if forth else start[b, 1] - mesh[plane]
            first, last = near / (size if near > 0 else least), far / (least if far > 0 else size)
            if last < 0 or first > 1:
                continue
            back_near = end[b, 0] - mesh[plane] if forth else mesh[plane] - end[b, 1]
            back_far = end[b, 1] - mesh[plane] if forth else mesh[plane] - end[b, 0]
            first = max(first, 1 - back_far / (least if back_far > 0 else size))
            last = min(last, 1 - back_near / (size if back_near > 0 else least))
            total += kink * size * _hump(max(first, 0.0), min(max(last, 0.0), 1.0))
        total += slopes[b] * bow[b] / 8
    total += (crosses[0] * moving[0] * moving[1] + crosses[1] * moving[0] * moving[2]) / 4
    return float(total + crosses[2] * moving[1] * moving[2] / 4)


@within
def _ends(values: Array, found: Array) -> None:
    """Write the least and the largest of ``values`` to the first two of ``found``; what is no number stays so."""
    least, most = values[0], values[0]
    for value in values:
        if value < least or value != value:
            least = value
        if value > most or value != value:
            most = value
    found[0], found[1] = least, most


@within
def _sides(part: Array, axis: int, low: Array, high: Array) -> None:
    """Fill ``low`` and ``high`` with the corners at the two ends of an axis."""
    for one in range(2):
        for two in range(2):
            place = 2 * one + two
            if axis == 0:
                low[place], high[place] = part[0, one, two], part[1, one, two]
            elif axis == 1:
                low[place], high[place] = part[one, 0, two], part[one, 1, two]
            else:
                low[place], high[place] = part[one, two, 0], part[one, two, 1]


@compiled
def over_images(
    x: Array, y: Array, q: Array, shift: Array, radius: Array, known: Mask, blocks: tuple[Index, Index, Index],
    growth: Array, bends: Array, usable: Mask, reach: Array, slopes: Array, crosses: Array, down: Array, around: Array,
    steep: Array,
) -> tuple[Array, Array, Mask]:  # fmt: skip
    """Per cell: what V o Phi may exceed its interpolation by, ``around`` (m, cells) over its image, what is unknown.

    Returns
    -------
    excess : ndarray, shape (cells)
    nearby : ndarray, shape (m, cells)
        Largest of ``around``.
    lost : ndarray of bool, shape (cells)
    """
    shape = (len(x) - 1, len(y) - 1, len(q) - 1)
    excess, nearby = np.zeros(shape), np.zeros((len(around), *shape))
    lost = np.zeros(shape, dtype=np.bool_)
    step = (shift.shape[1] > 1, shift.shape[2] > 1, shift.shape[3] > 1)
    corner = np.empty((3, 2, 2, 2))
    close = np.empty(6, dtype=np.intp)
    first, last, rate, bow, local = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 2)), np.empty(3), np.empty(6)
    width, low, high, move, ends = np.empty(3), np.empty(4), np.empty(4), np.empty(4), np.empty(2)
    corners = corner.reshape(3, 8)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                bi, bj, bk = blocks[0][i], blocks[1][j], blocks[2][k]
                fine = usable[bi, bj, bk]
                width[0], width[1], width[2] = x[i + 1] - x[i], y[j + 1] - y[j], q[k + 1] - q[k]
                loose = 0.0
                for d in range(2):
                    for g in range(2):
                        for h in range(2):
                            a, b, c = (i + d) * step[0], (j + g) * step[1], (k + h) * step[2]
                            fine = fine and known[a, b, c]
                            corner[0, d, g, h] = x[i + d] + shift[0, a, b, c]
                            corner[1, d, g, h] = y[j + g] + shift[1, a, b, c]
                            corner[2, d, g, h] = q[k + h] + shift[2, a, b, c]
                            for e in range(3):
                                loose = max(loose, radius[e, a, b, c] + 1e-15 * abs(corner[e, d, g, h]))
                if not fine:
                    lost[i, j, k] = True
                    continue
                for b in range(3):
                    sag = loose
                    for a in range(3):
                        sag += bends[b, a, a, bi, bj, bk] * width[a] ** 2 / 8
                    mesh = x if b == 0 else (y if b == 1 else q)
                    _ends(corners[b], ends)
                    least, most = ends[0] - sag, ends[1] + sag
                    if least - reach[b] < mesh[0] or most + reach[b] > mesh[-1]:
                        fine = False
                        break
                    spare = min(loose, (most - least) / 4)  # V is followed that far beyond a window by its slopes
                    close[2 * b], close[2 * b + 1] = _cell_of(mesh, least + 2 * spare), _cell_of(mesh, most - 2 * spare)
                if not fine:
                    lost[i, j, k] = True
                    continue
                for b in range(len(around)):
                    nearby[b, i, j, k] = _largest(around[b], close)
                if nearby[0, i, j, k] + nearby[1, i, j, k] + nearby[2, i, j, k] == 0.0:
                    continue
                excess[i, j, k] = 8 * loose * (steep[0] + steep[1] + steep[2])
                for b in range(3):
                    local[b], local[3 + b] = _largest(slopes[b], close), _largest(crosses[b], close)
                for a in range(3):
                    for b in range(3):
                        bow[b] = bends[b, a, a, bi, bj, bk] * width[a] ** 2
                        vary, sag = 2 * loose, loose
                        for e in range(3):
                            vary += bends[b, a, e, bi, bj, bk] * width[a] * width[e]
                            if e != a:
                                sag += bends[b, e, e, bi, bj, bk] * width[e] ** 2 / 8
                        _sides(corner[b], a, low, high)
                        for c in range(4):
                            move[c] = high[c] - low[c]
                        _ends(low, ends)
                        first[b, 0], first[b, 1] = ends[0] - sag, ends[1] + sag
                        _ends(high, ends)
                        last[b, 0], last[b, 1] = ends[0] - sag, ends[1] + sag
                        _ends(move, ends)
                        most = growth[b, a, bi, bj, bk] * width[a]
                        own = width[a] if a == b else 0.0
                        rate[b, 0] = max(ends[0] - vary, own - most)
                        rate[b, 1] = min(ends[1] + vary, own + most)
                        if a != b and most == 0.0:
                            rate[b, 0], rate[b, 1] = 0.0, 0.0
                    excess[i, j, k] += _excess(
                        a, first, last, rate, bow, close, x, y, q, local[:3], local[3:], down
                    )
    return excess, nearby, lost
