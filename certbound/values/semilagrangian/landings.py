"""The smoothed function at the images of nodes and over the images of cells, compiled.

With phi0 = (linear interpolation between rows) o m, m the flow, a path x(tau), tau in [0, 1], along a side of a cell
has the image (y(tau), w(tau)) and, in the sense of distributions,
    -phi0'' <= (-W'') w_t^2 - 2 X y_t w_t + |W_y| |y_tt| + |W_w| |w_tt| + sum_k (-KW_k)^+ |y_t| delta(tau - tau_k),
tau_k where the path crosses the row Y_k. phi0 exceeds its chord by int G(tau, .) of that: at most tau (1 - tau)/2 times
a bound of the density, and tau_k (1 - tau_k) a unit of mass; where y_t may vanish a kink exceeds the chord by at most
its slope times the range of y. Of a bound that is linear in tau the mean and a sixth of the change are enough, as the
integral of G(tau, s) (s - 1/2) is tau (1 - tau)/2 times (2 tau - 1)/6.
Along q the density goes into the parabola, along y it is paid as a constant.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.lazy import compiled, within


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


@within
def _density(window: Index, tables: Array, rates: Array, bend: Array, share: float) -> float:
    """sup of the density over a window; ``tables`` cross_low, cross_high, steep_y, steep_w; ``rates`` y_t, w_t ranges.

    The last two of ``rates`` are bounds of |y_tt| and |w_tt|; ``share`` is 1, or 0 to leave -W'' w_t^2 out.
    """
    y0, y1, w0, w1 = rates[0], rates[1], rates[2], rates[3]
    largest = max(abs(w0), abs(w1)) ** 2
    smallest = 0.0 if w0 <= 0.0 <= w1 else min(abs(w0), abs(w1)) ** 2
    p = min(min(y0 * w0, y0 * w1), min(y1 * w0, y1 * w1))
    r = max(max(y0 * w0, y0 * w1), max(y1 * w0, y1 * w1))
    best = -np.inf
    for k in range(window[0], window[1] + 1):
        for c in range(window[2], window[3] + 1):
            b = share * max(bend[k, c], bend[k + 1, c])
            a, d = tables[0, k, c], tables[1, k, c]
            mixed = min(min(a * p, a * r), min(d * p, d * r))
            total = (b * largest if b > 0 else b * smallest) - 2 * mixed
            total += tables[2, k, c] * rates[4] + tables[3, k, c] * rates[5]
            best = max(best, total)
    return best


@within
def _mean_bent(
    window: Index, q: Array, ends: tuple[float, float], loose: float, rates: Array, sagging: Array, sway: Array
) -> float:
    """Mean and a sixth of the change of a linear bound of -W'' w_t^2 along a side whose image has these ends in w."""
    count = window[3] - window[2] + 3
    place, level = np.empty(count), np.full(count, -np.inf)
    place[0], place[count - 1] = ends[0], ends[1]
    for n in range(1, count - 1):
        place[n] = q[min(max(window[2] + n, 0), len(q) - 1)]
    steep, more = 0.0, 0.0
    for k in range(window[0], window[1] + 2):
        for c in range(window[2], window[3] + 1):
            more = max(more, sway[k, c])
            steep = max(steep, abs(sagging[k, c + 1] - sagging[k, c]) / (q[c + 1] - q[c]))
        for n in range(count):
            c = min(max(_cell_of(q, place[n]), 0), len(q) - 2)
            t = min(max((place[n] - q[c]) / (q[c + 1] - q[c]), 0.0), 1.0)
            level[n] = max(level[n], (1 - t) * sagging[k, c] + t * sagging[k, c + 1])
    above, span = 0.0, ends[1] - ends[0]
    for n in range(1, count - 1):
        t = (place[n] - ends[0]) / span if span != 0.0 else 0.0
        if 0.0 < t < 1.0:
            above = max(above, level[n] - (1 - t) * level[0] - t * level[count - 1])
    above += more + steep * loose
    largest = max(abs(rates[2]), abs(rates[3])) ** 2
    smallest = 0.0 if rates[2] <= 0.0 <= rates[3] else min(abs(rates[2]), abs(rates[3])) ** 2
    one, two = level[0] + above, level[count - 1] + above
    first, last = max(one * largest, one * smallest), max(two * largest, two * smallest)
    return float((first + last) / 2 + abs(last - first) / 6)


@within
def _kinked(window: Index, kinks: Array, mesh: Array, longest: float) -> float:
    """Upper bound of the sum of the kinks that a path of that length in y crosses within a window."""
    total, largest, least = 0.0, 0.0, np.inf
    for k in range(window[0] + 1, window[1] + 1):
        most = 0.0
        for c in range(window[2], window[3] + 1):
            most = max(most, kinks[k, c])
        total += most
        largest = max(largest, most)
        least = min(least, mesh[k + 1] - mesh[k])
    if largest == 0.0:
        return 0.0
    return float(min(total, largest * (1 + np.floor(longest / least * 1.000001))))


@within
def _crossed(window: Index, kinks: Array, mesh: Array, ends: Array, rates: Array) -> float:
    """What kinks that a path crosses lift it above its chord: |y_t| tau (1 - tau) times each, tau where it does.

    ``ends`` holds the ranges of y at both ends. Where y_t may vanish a kink costs its slope times the range of y.
    """
    longest = max(abs(rates[0]), abs(rates[1]))
    whole = longest * _kinked(window, kinks, mesh, longest)
    if rates[0] <= 0.0 <= rates[1]:
        return float(whole)
    sign = 1.0 if rates[0] > 0.0 else -1.0
    slow, fast = min(abs(rates[0]), abs(rates[1])), longest
    start, stop = (ends[0], ends[1]), (ends[2], ends[3])
    if sign < 0.0:
        start, stop = (-ends[1], -ends[0]), (-ends[3], -ends[2])
    total = 0.0
    for k in range(window[0] + 1, window[1] + 1):
        most, place = 0.0, sign * mesh[k]
        for c in range(window[2], window[3] + 1):
            most = max(most, kinks[k, c])
        early = max((place - start[1]) / fast, 1 - (stop[1] - place) / slow) - 1e-6
        late = min((place - start[0]) / slow, 1 - (stop[0] - place) / fast) + 1e-6
        early, late = max(early, 0.0), min(late, 1.0)
        if early <= late:
            nearest = min(max(0.5, early), late)
            total += most * nearest * (1 - nearest)
    return float(min(0.25 * whole, longest * total))


@within
def _window(mesh: Array, q: Array, y0: float, y1: float, w0: float, w1: float) -> Index:
    found = np.empty(4, dtype=np.intp)
    found[0], found[1] = _cell_of(mesh, y0), _cell_of(mesh, y1)
    found[2], found[3] = _cell_of(q, w0), _cell_of(q, w1)
    return found


@compiled
def at_nodes(
    image: Array, radius: Array, wanted: Mask, mesh: Array, q: Array, values: Array, bend: Array, steep: Array
) -> Array:
    """phi0 at the images, from above; ``image`` and ``radius`` (2, nx, nq), ``steep`` (2, rows - 1, nq - 1)."""
    found = np.zeros(wanted.shape)
    for i in range(wanted.shape[0]):
        for j in range(wanted.shape[1]):
            if not wanted[i, j]:
                continue
            y, w = image[0, i, j], image[1, i, j]
            k, c = _cell_of(mesh, y), _cell_of(q, w)
            d = q[c + 1] - q[c]
            t = min(max((y - mesh[k]) / (mesh[k + 1] - mesh[k]), 0.0), 1.0)
            s = min(max((w - q[c]) / d, 0.0), 1.0)
            arch = s * (1 - s) * d * d / 2
            low = (1 - s) * values[k, c] + s * values[k, c + 1] + arch * bend[k, c]
            high = (1 - s) * values[k + 1, c] + s * values[k + 1, c + 1] + arch * bend[k + 1, c]
            near_y, near_w = 0.0, 0.0
            for a in range(max(k - 1, 0), min(k + 2, steep.shape[1])):
                for e in range(max(c - 1, 0), min(c + 2, steep.shape[2])):
                    near_y, near_w = max(near_y, steep[0, a, e]), max(near_w, steep[1, a, e])
            found[i, j] = (1 - t) * low + t * high + radius[0, i, j] * near_y + radius[1, i, j] * near_w
    return found


@compiled
def along_q(
    image: Array, radius: Array, live: Mask, bends: Array, dq: Array, mesh: Array, q: Array, tables: Array,
    bend: Array, kinks: Array, sags: tuple[Array, Array],
) -> tuple[Array, Array]:  # fmt: skip
    """Per line and cell of the q-axis: the parabola's coefficient and the constant for kinks.

    ``live`` (cells, nq - 1); ``bends`` (2, cells, nq - 1): |d_qq m|; lines are the cells' ends; ``sags`` as `Rows` has
    ``sagging`` and ``sway``.
    """
    lines, columns = image.shape[1], image.shape[2] - 1
    curve, extra = np.zeros((lines, columns)), np.zeros((lines, columns))
    rates, places = np.empty(6), np.empty(4)
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
                spare = size * square / 2 + radius[axis, i, j] + radius[axis, i, j + 1]
                step = image[axis, i, j + 1] - image[axis, i, j]
                rates[2 * axis], rates[2 * axis + 1], rates[4 + axis] = step - spare, step + spare, size * square
            sag_y = rates[4] / 8 + max(radius[0, i, j], radius[0, i, j + 1])
            sag_w = rates[5] / 8 + max(radius[1, i, j], radius[1, i, j + 1])
            y0, y1 = min(image[0, i, j], image[0, i, j + 1]) - sag_y, max(image[0, i, j], image[0, i, j + 1]) + sag_y
            w0, w1 = min(image[1, i, j], image[1, i, j + 1]) - sag_w, max(image[1, i, j], image[1, i, j + 1]) + sag_w
            window = _window(mesh, q, y0, y1, w0, w1)
            ends = (image[1, i, j], image[1, i, j + 1])
            mean = _mean_bent(window, q, ends, sag_w, rates, sags[0], sags[1])
            mean += _density(window, tables, rates, bend, 0.0)
            curve[i, j] = min(mean, _density(window, tables, rates, bend, 1.0)) / square
            for side in range(2):
                slack = radius[0, i, j + side]
                places[2 * side], places[2 * side + 1] = image[0, i, j + side] - slack, image[0, i, j + side] + slack
            extra[i, j] = _crossed(window, kinks, mesh, places, rates)
    return curve, extra


@compiled
def over_cells(
    image: Array, radius: Array, live: Mask, slopes: Array, bends: Array, sides: tuple[Array, Array], mesh: Array,
    q: Array, tables: Array, bend: Array, kinks: Array, reach: Array, prices: Array, wide: Array, close: Array,
) -> Array:  # fmt: skip
    """What every cell pays: interpolation along y, the rows' interpolation, covariance, remainder, rounding.

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
        Of ``wide`` (three: bent, mixed, bowed), and of ``close`` but for its third: lean_y, lean_q, lift (which costs
        itself), near.
    """
    found = np.zeros(live.shape)
    rates, ends, places = np.empty(6), np.empty(4), np.empty(4)
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
            window = _window(mesh, q, ends[0], ends[1], ends[2], ends[3])
            for a in range(2):
                slack = bends[2, i, j] * e * e / 8 + max(radius[0, i + a, j], radius[0, i + a, j + 1])
                places[2 * a] = min(image[0, i + a, j], image[0, i + a, j + 1]) - slack
                places[2 * a + 1] = max(image[0, i + a, j], image[0, i + a, j + 1]) + slack
            total = max(_density(window, tables, rates, bend, 1.0), 0.0) / 8
            total += _crossed(window, kinks, mesh, places, rates)
            total += _largest(window, close[2]) + prices[5, i, j] * _largest(window, close[3])
            total += prices[3, i, j] * _largest(window, close[0]) + prices[4, i, j] * _largest(window, close[1])
            window = _window(mesh, q, ends[0] - reach[i, j], ends[1] + reach[i, j], ends[2], ends[3])
            for part in range(3):
                total += prices[part, i, j] * _largest(window, wide[part])
            found[i, j] = total
    return found


@within
def _largest(window: Index, table: Array) -> float:
    best = -np.inf
    for k in range(window[0], window[1] + 1):
        for c in range(window[2], window[3] + 1):
            best = max(best, table[k, c])
    return best
