"""The smoothed function at the images of nodes and over the images of cells, compiled.

With phi0 = (linear interpolation between rows) o m, m the flow, a path x(tau), tau in [0, 1], along a side of a cell
has the image (y(tau), w(tau)) and, in the sense of distributions,
    -phi0'' <= (-W'') w_t^2 - 2 X y_t w_t + |W_y| |y_tt| + |W_w| |w_tt| + sum_k (-KW_k)^+ |y_t| delta(tau - tau_k),
tau_k where the path crosses the row Y_k. phi0 exceeds its chord by int G(tau, .) of that: at most tau (1 - tau)/2 times
a bound of the density, and tau_k (1 - tau_k) a unit of mass; where y_t may vanish a kink exceeds the chord by at most
its slope times the range of y. Of a bound that is linear in tau the mean and a sixth of the change are enough, as the
integral of G(tau, s) (s - 1/2) is tau (1 - tau)/2 times (2 tau - 1)/6.
Along q the density goes into the parabola, along y it is paid as a constant.

A step smooths with one or two laws of q (`bands`); their tables are stacked along a first axis, as where nodes and
cells land is the same for all. Neighbours land beside each other, so that the cell of one is looked for from there.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.lazy import compiled, within


@within
def _cell_near(axis: Array, place: float, guess: int) -> int:
    """The cell of an axis in which a place is (the first or last for places beyond), looked for from a guess."""
    last = len(axis) - 2
    k = min(max(guess, 0), last)
    while k > 0 and axis[k] > place:
        k -= 1
    while k < last and axis[k + 1] <= place:
        k += 1
    return k


@within
def _density(window: Index, tables: Array, rates: Array, bend: Array, found: Array) -> None:
    """sup of the density over a window, without -W'' w_t^2 and with it: ``found`` (laws, 2).

    ``tables`` cross_low, cross_high, steep_y, steep_w; ``rates`` ranges of y_t and w_t, bounds of |y_tt| and |w_tt|.
    """
    y0, y1, w0, w1 = rates[0], rates[1], rates[2], rates[3]
    largest = max(abs(w0), abs(w1)) ** 2
    smallest = 0.0 if w0 <= 0.0 <= w1 else min(abs(w0), abs(w1)) ** 2
    p = min(min(y0 * w0, y0 * w1), min(y1 * w0, y1 * w1))
    r = max(max(y0 * w0, y0 * w1), max(y1 * w0, y1 * w1))
    for n in range(len(found)):
        found[n, 0], found[n, 1] = -np.inf, -np.inf
    for k in range(window[0], window[1] + 1):
        for c in range(window[2], window[3] + 1):
            for n in range(len(found)):
                b = max(bend[n, k, c], bend[n, k + 1, c])
                a, d = tables[n, 0, k, c], tables[n, 1, k, c]
                mixed = min(min(a * p, a * r), min(d * p, d * r))
                total = tables[n, 2, k, c] * rates[4] + tables[n, 3, k, c] * rates[5] - 2 * mixed
                found[n, 0] = max(found[n, 0], total)
                found[n, 1] = max(found[n, 1], total + (b * largest if b > 0 else b * smallest))


@within
def _mean_bent(
    n: int, window: Index, q: Array, ends: tuple[float, float], loose: float, rates: Array, sagging: Array, sway: Array
) -> float:
    """Mean and a sixth of the change of a linear bound of -W'' w_t^2 along a side whose image has these ends in w."""
    c, d = _cell_near(q, ends[0], window[2]), _cell_near(q, ends[1], window[3])
    s = min(max((ends[0] - q[c]) / (q[c + 1] - q[c]), 0.0), 1.0)
    t = min(max((ends[1] - q[d]) / (q[d + 1] - q[d]), 0.0), 1.0)
    one, two, steep, above, span = -np.inf, -np.inf, 0.0, 0.0, ends[1] - ends[0]
    for k in range(window[0], window[1] + 2):
        one = max(one, (1 - s) * sagging[n, k, c] + s * sagging[n, k, c + 1])
        two = max(two, (1 - t) * sagging[n, k, d] + t * sagging[n, k, d + 1])
    more = 0.0
    for e in range(window[2], window[3] + 1):
        level, lean = -np.inf, 0.0
        for k in range(window[0], window[1] + 2):
            more = max(more, sway[n, k, e])
            lean = max(lean, abs(sagging[n, k, e + 1] - sagging[n, k, e]))
            level = max(level, sagging[n, k, e + 1])
        steep = max(steep, lean / (q[e + 1] - q[e]))
        share = (q[e + 1] - ends[0]) / span if span != 0.0 else 0.0
        if 0.0 < share < 1.0:
            above = max(above, level - (1 - share) * one - share * two)
    above += more + steep * loose
    largest = max(abs(rates[2]), abs(rates[3])) ** 2
    smallest = 0.0 if rates[2] <= 0.0 <= rates[3] else min(abs(rates[2]), abs(rates[3])) ** 2
    one, two = one + above, two + above
    first, last = max(one * largest, one * smallest), max(two * largest, two * smallest)
    return float((first + last) / 2 + abs(last - first) / 6)


@compiled
def _crossed(window: Index, kinks: Array, mesh: Array, ends: Array, rates: Array, found: Array) -> None:
    """What kinks that a path crosses lift it above its chord: |y_t| tau (1 - tau) times each, tau where it does.

    ``ends`` holds the ranges of y at both ends. Where y_t may vanish a kink costs its slope times the range of y, and
    no path of a length crosses more of them than fit into it. ``found`` (laws, 4): that, and room for sums.
    """
    for n in range(len(found)):
        found[n, 0], found[n, 1], found[n, 2], found[n, 3] = 0.0, 0.0, 0.0, 0.0
    if window[0] == window[1]:
        return
    turns, sign = rates[0] <= 0.0 <= rates[1], 1.0 if rates[0] > 0.0 else -1.0
    slow, fast = min(abs(rates[0]), abs(rates[1])), max(abs(rates[0]), abs(rates[1]))
    start, stop = (ends[0], ends[1]), (ends[2], ends[3])
    if sign < 0.0:
        start, stop = (-ends[1], -ends[0]), (-ends[3], -ends[2])
    least = np.inf
    for k in range(window[0] + 1, window[1] + 1):
        least = min(least, mesh[k + 1] - mesh[k])
        share, place = 0.0, sign * mesh[k]
        if not turns:
            early = max((place - start[1]) / fast, 1 - (stop[1] - place) / slow) - 1e-6
            late = min((place - start[0]) / slow, 1 - (stop[0] - place) / fast) + 1e-6
            early, late = max(early, 0.0), min(late, 1.0)
            if early <= late:
                nearest = min(max(0.5, early), late)
                share = nearest * (1 - nearest)
        for n in range(len(found)):
            most = 0.0
            for c in range(window[2], window[3] + 1):
                most = max(most, kinks[n, k, c])
            found[n, 1] += most
            found[n, 2] = max(found[n, 2], most)
            found[n, 3] += most * share
    fit = 1 + np.floor(fast / least * 1.000001)
    for n in range(len(found)):
        whole = fast * min(found[n, 1], found[n, 2] * fit)
        found[n, 0] = whole if turns else min(0.25 * whole, fast * found[n, 3])


@within
def _look(window: Index, mesh: Array, q: Array, ends: Array) -> None:
    """Set a window to the cells of these ranges of y and w, looked for from where it was."""
    window[0] = _cell_near(mesh, ends[0], window[0])
    window[1] = _cell_near(mesh, ends[1], window[0])
    window[2] = _cell_near(q, ends[2], window[2])
    window[3] = _cell_near(q, ends[3], window[2])


@compiled
def at_nodes(
    image: Array, radius: Array, wanted: Mask, mesh: Array, q: Array, values: Array, bend: Array, tables: Array
) -> Array:
    """phi0 at the images, from above, shape (laws, nx, nq).

    ``image`` and ``radius`` (2, nx, nq), the tables of `Rows` stacked law by law; ``tables`` as in `_density`.
    """
    found = np.zeros((len(values), *wanted.shape))
    k, c = 0, 0
    for i in range(wanted.shape[0]):
        for j in range(wanted.shape[1]):
            if not wanted[i, j]:
                continue
            y, w = image[0, i, j], image[1, i, j]
            k, c = _cell_near(mesh, y, k), _cell_near(q, w, c)
            d = q[c + 1] - q[c]
            t = min(max((y - mesh[k]) / (mesh[k + 1] - mesh[k]), 0.0), 1.0)
            s = min(max((w - q[c]) / d, 0.0), 1.0)
            arch = s * (1 - s) * d * d / 2
            for n in range(len(values)):
                low = (1 - s) * values[n, k, c] + s * values[n, k, c + 1] + arch * bend[n, k, c]
                high = (1 - s) * values[n, k + 1, c] + s * values[n, k + 1, c + 1] + arch * bend[n, k + 1, c]
                near_y, near_w = 0.0, 0.0
                for a in range(max(k - 1, 0), min(k + 2, tables.shape[2])):
                    for e in range(max(c - 1, 0), min(c + 2, tables.shape[3])):
                        near_y, near_w = max(near_y, tables[n, 2, a, e]), max(near_w, tables[n, 3, a, e])
                found[n, i, j] = (1 - t) * low + t * high + radius[0, i, j] * near_y + radius[1, i, j] * near_w
    return found


@compiled
def along_q(
    image: Array, radius: Array, live: Mask, bends: Array, dq: Array, mesh: Array, q: Array, tables: Array,
    bend: Array, kinks: Array, sagging: Array, sway: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Per law, line and cell of the q-axis: the parabola's coefficient and the constant for kinks.

    ``live`` (cells, nq - 1); ``bends`` (2, cells, nq - 1): |d_qq m|; lines are the cells' ends; the rest as `Rows` has
    it, stacked law by law.
    """
    lines, columns = image.shape[1], image.shape[2] - 1
    curve, extra = np.zeros((len(bend), lines, columns)), np.zeros((len(bend), lines, columns))
    rates, places, box, window = np.empty(6), np.empty(4), np.empty(4), np.zeros(4, dtype=np.intp)
    dense, lifted = np.empty((len(bend), 2)), np.empty((len(bend), 4))
    for i in range(lines):
        for j in range(columns):
            below, above = i > 0 and live[i - 1, j], i < lines - 1 and live[i, j]
            if not below and not above:
                continue
            square = dq[j] ** 2
            for axis in range(2):
                size = 0.0
                if below:
                    size = bends[axis, i - 1, j]
                if above:
                    size = max(size, bends[axis, i, j])
                one, two = image[axis, i, j], image[axis, i, j + 1]
                spare = size * square / 2 + radius[axis, i, j] + radius[axis, i, j + 1]
                step = two - one
                rates[2 * axis], rates[2 * axis + 1], rates[4 + axis] = step - spare, step + spare, size * square
                sag = rates[4 + axis] / 8 + max(radius[axis, i, j], radius[axis, i, j + 1])
                box[2 * axis], box[2 * axis + 1] = min(one, two) - sag, max(one, two) + sag
            _look(window, mesh, q, box)
            for side in range(2):
                slack = radius[0, i, j + side]
                places[2 * side], places[2 * side + 1] = image[0, i, j + side] - slack, image[0, i, j + side] + slack
            ends = (image[1, i, j], image[1, i, j + 1])
            _density(window, tables, rates, bend, dense)
            _crossed(window, kinks, mesh, places, rates, lifted)
            for n in range(len(bend)):
                mean = _mean_bent(n, window, q, ends, sag, rates, sagging, sway)
                curve[n, i, j] = min(mean + dense[n, 0], dense[n, 1]) / square
                extra[n, i, j] = lifted[n, 0]
    return curve, extra


@compiled
def over_cells(
    image: Array, radius: Array, live: Mask, slopes: Array, bends: Array, sides: tuple[Array, Array], mesh: Array,
    q: Array, tables: Array, bend: Array, kinks: Array, reach: Array, prices: Array, wide: Array, close: Array,
) -> Array:  # fmt: skip
    """What every cell pays, law by law: interpolation along y, that of the rows, covariance, remainder, rounding.

    Parameters
    ----------
    slopes : (4, cells, nq - 1)
        Ranges of d_y y and d_y w.
    bends : (4, cells, nq - 1)
        |d_yy m| and |d_qq m|, two each.
    sides : (ndarray, ndarray)
        Widths along y and q.
    reach : (cells, nq - 1)
        How far the covariance's excess is followed along y.
    prices : (6, cells, nq - 1)
        Of ``wide`` (bent, mixed, bowed, lean_y, lean_q: of all laws) and of the last of ``close``.
    close : (2 laws, rows - 1, nq - 1)
        lift, which costs itself, and near, law by law.
    """
    found = np.zeros((len(bend), *live.shape))
    rates, ends, places, window = np.empty(6), np.empty(4), np.empty(4), np.zeros(4, dtype=np.intp)
    dense, lifted, tops = np.empty((len(bend), 2)), np.empty((len(bend), 4)), np.empty(max(len(wide), len(close)))
    leans, bents = wide[3:], wide[:3]
    for i in range(live.shape[0]):
        for j in range(live.shape[1]):
            if not live[i, j]:
                continue
            d, e = sides[0][i], sides[1][j]
            for axis in range(2):
                sag = (bends[axis, i, j] * d * d + bends[2 + axis, i, j] * e * e) / 8
                low, high = np.inf, -np.inf
                for a in range(2):
                    for b in range(2):
                        low = min(low, image[axis, i + a, j + b] - radius[axis, i + a, j + b])
                        high = max(high, image[axis, i + a, j + b] + radius[axis, i + a, j + b])
                ends[2 * axis], ends[2 * axis + 1] = low - sag, high + sag
                rates[2 * axis], rates[2 * axis + 1] = d * slopes[2 * axis, i, j], d * slopes[2 * axis + 1, i, j]
                rates[4 + axis] = bends[axis, i, j] * d * d
            _look(window, mesh, q, ends)
            for a in range(2):
                slack = bends[2, i, j] * e * e / 8 + max(radius[0, i + a, j], radius[0, i + a, j + 1])
                places[2 * a] = min(image[0, i + a, j], image[0, i + a, j + 1]) - slack
                places[2 * a + 1] = max(image[0, i + a, j], image[0, i + a, j + 1]) + slack
            _density(window, tables, rates, bend, dense)
            _crossed(window, kinks, mesh, places, rates, lifted)
            _largest(window, leans, tops)
            shared = prices[3, i, j] * tops[0] + prices[4, i, j] * tops[1]
            _largest(window, close, tops)
            for n in range(len(bend)):
                total = max(dense[n, 1], 0.0) / 8 + lifted[n, 0] + tops[2 * n] + prices[5, i, j] * tops[2 * n + 1]
                found[n, i, j] = total + shared
            ends[0], ends[1] = ends[0] - reach[i, j], ends[1] + reach[i, j]
            _look(window, mesh, q, ends)
            _largest(window, bents, tops)
            shared = prices[0, i, j] * tops[0] + prices[1, i, j] * tops[1] + prices[2, i, j] * tops[2]
            for n in range(len(bend)):
                found[n, i, j] += shared
    return found


@within
def _largest(window: Index, tables: Array, tops: Array) -> None:
    """The largest value of each of the tables over a window."""
    for n in range(len(tables)):
        tops[n] = -np.inf
    for k in range(window[0], window[1] + 1):
        for c in range(window[2], window[3] + 1):
            for n in range(len(tables)):
                tops[n] = max(tops[n], tables[n, k, c])
