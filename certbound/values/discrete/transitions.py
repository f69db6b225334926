"""phi(x, d) = h(f(x, d)) on a grid: its values at the nodes, and bounds of its second derivatives over the cells.

Between the mesh's nodes h is interpolated by polynomials through `POINTS` nodes an axis. With L_i the interpolation
along axis i, Lambda its norm and omega_p = max prod |theta - k|/p!,
    |h - L_1 ... L_n h| <= sum_i Lambda^(i-1) omega_p delta_i^p sup |d_i^p h|.
Over a mesh cell a derivative g of h lies between its least and largest corner, widened by sum_i delta_i^2/8 sup
|d_ii g|; d_ii g is known from second differences at the nodes.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.rigor.intervals import Interval
from certbound.values.discrete.dominance import dominance
from certbound.values.discrete.fields import POINTS, Field, Tables
from certbound.values.discrete.scans import cell_ranges, in_space, window_extremes
from certbound.values.discrete.steps import CellImages, Step
from certbound.values.grids import over_corners

Alpha = tuple[int, ...]

_DIRECT = 16  # entries of windows, in units of the table's, below which they are read one by one


@lru_cache(maxsize=8)
def rule_constants(points: int) -> tuple[float, float]:
    """Lambda and omega_p of the interpolation on the middle interval, rounded up."""
    first = -(points // 2 - 1)
    theta = Interval(np.arange(256) / 256, np.arange(1, 257) / 256)
    norm = Interval.point(np.zeros(256))
    for k in range(points):
        term = Interval.point(np.ones(256))
        for j in range(points):
            if j != k:
                term = term * ((theta - float(first + j)) / Interval.point(float(k - j)))
        norm = norm + Interval(term.mig, term.mag)
    odd = math.prod(range(1, points, 2)) / 2.0 ** (points // 2)
    return float(norm.hi.max()), odd**2 / math.factorial(points) * (1 + 1e-6)


class Places:
    """Where points lie in a mesh: the first node of the stencil and the weights, axis by axis."""

    def __init__(self, image: Interval, usable: Mask, tables: Tables, *, points: int = POINTS) -> None:
        mesh, n = tables.mesh, tables.n
        middle = np.where(usable[:, None], np.nan_to_num(image.mid), 0.0)
        self.radius = np.where(usable[:, None], image.rad, np.inf)
        self.usable = usable & np.all(self.radius <= mesh.step / 2, axis=1)
        self.points = points
        self.base: list[Integers] = []
        self.weights: list[list[Array]] = []
        for i in range(n):
            place = np.clip((middle[:, i] - mesh.start[i]) / mesh.step[i], 0, mesh.count[i] - 1)
            base = np.clip(np.floor(place).astype(np.int64) - (points // 2 - 1), 0, mesh.count[i] - points)
            theta = place - base
            self.base.append(base)
            self.weights.append(_weights(theta, points))

    def flat(self, count: tuple[int, ...], shift: tuple[int, ...]) -> Integers:
        """Flat index of the stencils' nodes ``shift``."""
        total: Integers = np.zeros(len(self.base[0]), dtype=np.int64)
        for base, size, more in zip(self.base, count, shift):
            total = total * size + base + more
        return total

    def interpolate(self, table: Array) -> Array:
        """The interpolated table, at every point."""
        flat = table.ravel()
        n = len(self.base)
        strides = [int(np.prod(table.shape[i + 1 :])) for i in range(n)]
        start = self.flat(table.shape, (0,) * n)

        def along(axis: int, index: Integers) -> Array:
            total = np.zeros(len(index))
            for k in range(self.points):
                moved = index + k * strides[axis]
                inner = flat.take(moved) if axis == n - 1 else along(axis + 1, moved)
                total += self.weights[axis][k] * inner
            return total

        return along(0, start)


def _weights(theta: Array, points: int) -> list[Array]:
    found = []
    for k in range(points):
        weight = np.ones_like(theta)
        for j in range(points):
            if j != k:
                weight = weight * ((theta - j) / (k - j))
        found.append(weight)
    return found


class Windows:
    """Which mesh cells the images of cells meet, in groups of one window size."""

    def __init__(self, images: CellImages, tables: Tables) -> None:
        mesh, n = tables.mesh, tables.n
        last = np.array(mesh.count) - 2
        low = np.where(images.steady[:, None], images.image.lo, 0.0)
        high = np.where(images.steady[:, None], images.image.hi, 0.0)
        first = np.floor((low - mesh.start) / mesh.step - 1e-6)
        final = np.floor((high - mesh.start) / mesh.step + 1e-6)
        first = np.clip(first, 0, last).astype(np.int64)
        final = np.clip(final, 0, last).astype(np.int64)
        length = final - first + 1
        typical = np.maximum(np.median(length, axis=0), 1)
        scale = np.max(length / typical, axis=1)
        levels = [1.0, 1.34, 1.67, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 32.0, 64.0, 1e9]
        group = np.searchsorted(levels, scale - 1e-9)
        self.groups: list[tuple[tuple[int, ...], Integers, Integers]] = []
        for g in np.unique(group):
            members = np.flatnonzero(group == g)
            size = np.minimum(length[members].max(axis=0), last + 1)
            start = np.minimum(first[members], last + 1 - size)
            flat: Integers = np.zeros(len(members), dtype=np.int64)
            for i in range(n):
                flat = flat * (mesh.count[i] - 1) + start[:, i]
            self.groups.append((tuple(int(s) for s in size), members, flat))
        self.count = len(images.steady)

    def extreme(self, table: Array, *, largest: bool) -> Array:
        """Over the window of every cell, of a table over mesh cells."""
        found = np.empty(self.count)
        pick = np.maximum if largest else np.minimum
        for size, members, flat in self.groups:
            if math.prod(size) * len(members) < _DIRECT * table.size:
                whole = np.empty(len(members))
                depth, rows, columns = (1,) * (3 - len(size)) + size
                window_extremes(in_space(table), flat, (depth, rows, columns), largest, whole)
                found[members] = whole
                continue
            part = table
            for axis, width in enumerate(size):
                part = sliding(pick, part, width, axis)
            found[members] = part.ravel().take(flat)
        return found


def sliding(pick: np.ufunc, table: Array, width: int, axis: int) -> Array:
    """The extreme over ``width`` entries from every entry on along an axis (fewer at the end), by doubling."""
    moved = np.moveaxis(table, axis, 0)
    done = 1
    while done < width:
        hop = min(done, width - done)
        longer = moved.copy()
        pick(moved[:-hop], moved[hop:], out=longer[:-hop])
        moved, done = longer, done + hop
    return np.moveaxis(moved, 0, axis)


class Transition:
    """One step from a grid into the field of the next function."""

    def __init__(self, step: Step, tables: Tables) -> None:
        self.step, self.tables, self.n = step, tables, tables.n
        self.places = [Places(image, usable, tables) for image, usable in step.vertices]
        pairs = self.windows_and_forms(step, tables)
        self.windows, self.forms = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        ratio = tables.mesh.step / tables.sigma
        self._ratio = ratio
        norm, omega = rule_constants(POINTS)
        reach = [min(float(r) * POINTS / 2, 3.0) for r in ratio]
        mass = [dominance(0, r) for r in reach]
        self.missing = sum(
            norm**i * omega * float(ratio[i]) ** POINTS * dominance(POINTS, reach[i]) * math.prod(mass) / mass[i]
            for i in range(self.n)
        ) * (1 + 1e-9)
        self.beyond = sum(
            norm**i
            * omega
            * float(ratio[i]) ** POINTS
            * tables.beyond(tuple(POINTS if k == i else 0 for k in range(self.n)))
            for i in range(self.n)
        )
        self.sensitivity = [
            dominance(1, reach[i]) * math.prod(mass) / mass[i] / tables.sigma[i] for i in range(self.n)
        ]
        self.norm = norm**self.n

    @staticmethod
    def windows_and_forms(step: Step, tables: Tables) -> list[tuple[Windows, Forms]]:
        """Per box of disturbances: where the cells land, and f's derivatives over them."""
        return [(Windows(images, tables), Forms(images, tables.n)) for images in step.cells]

    # ---- values at nodes -------------------------------------------------------------------------------------

    def at_nodes(self, field: Field) -> list[tuple[Array, Array]]:
        """Per vertex of the disturbances: phi at the nodes, and a bound of its error (inf where f is undefined)."""
        zero = (0,) * self.n
        table, wide = field.tables[zero], field.dominant
        for axis in range(self.n):
            wide = sliding(np.maximum, wide, POINTS, axis)
        found = []
        for places in self.places:
            value = places.interpolate(table)
            middle = places.flat(field.mesh.count, (POINTS // 2 - 1,) * self.n)
            close = field.dominant.ravel().take(middle)
            largest = wide.ravel().take(places.flat(field.mesh.count, zero))
            error = self.missing * close + self.beyond * field.largest
            error += self.norm * (field.error[zero] + 1e-13) * largest + self.norm * field.floor[zero]
            for i in range(self.n):
                error += places.radius[:, i] * self.sensitivity[i] * close
            error = np.where(places.usable, error * (1 + 1e-9), np.inf)
            shape = self.step.grid.node_shape
            found.append((value.reshape(shape), error.reshape(shape)))
        return found

    # ---- over cells ------------------------------------------------------------------------------------------

    def ranges(self, field: Field) -> tuple[Array, Array]:
        """The least and the largest h over the mesh's cells."""
        return self._over_mesh(field, [((0,) * self.n, _ONE)], over_corners(np.maximum, field.dominant))

    def bends(self, field: Field, variables: range, *, above: bool) -> list[list[Array]]:
        """Per box of disturbances and variable: the least (else largest) second derivative of phi over every cell.

        Where f is not smooth but steady, numbers that serve the same purpose: -+2 (range of the slope)/width. Unbounded
        where neither is known.
        """
        close = over_corners(np.maximum, field.dominant)
        if all(form.constant for form in self.forms):
            found = []
            for i in variables:
                low, high = self._over_mesh(field, self.forms[0].terms(i), close)
                table = low if above else high
                found.append([windows.extreme(table, largest=not above) for windows in self.windows])
            return [list(box) for box in zip(*found)]
        bounds = {a: self._over_mesh(field, [(a, _ONE)], close) for a in field.tables if sum(a) > 0}
        boxes = [self._of_box(k, bounds, variables) for k in range(len(self.step.cells))]
        return [[bend.lo if above else bend.hi for bend in box] for box in boxes]

    def _over_mesh(self, field: Field, terms: list[tuple[Alpha, Interval]], close: Array) -> tuple[Array, Array]:
        """A sum g of derivatives of h with constant factors over the mesh's cells: least and largest.

        At the nodes d_ii g is the second difference up to delta_i^2/12 sup |d_i^4 g|; over a cell |d_ii g| is at most
        its interpolation plus sum_j delta_j^2/8 sup |d_jj d_ii g|. At the mesh's ends |d_ii g| itself is dominated.
        ``close`` is the largest H at a cell's corners.
        """
        table, near, beyond = np.zeros(field.mesh.count), 0.0, 0.0
        ends = np.zeros((self.n, 2))
        noise = 1 + self.n / 2  # of a corner, and of second differences (4 of them, times 1/8) along every axis
        for alpha, factor in terms:
            scale = math.prod(float(self.tables.sigma[i]) ** -alpha[i] for i in range(self.n)) * float(factor.mag)
            table += float(factor.mid) * field.tables[alpha]
            loose = (float(factor.rad) / float(factor.mag) + 16 * 2.0**-53) * math.prod(dominance(a) for a in alpha)
            near += (loose * scale * 1.01 + field.error[alpha] * float(factor.mag)) * noise
            beyond += field.floor[alpha] / field.largest * float(factor.mag) * noise
            for i in range(self.n):
                more = self._fourth(alpha, i)
                near, beyond = near + more[0] * scale, beyond + more[1] * scale
                order, share = _raised(alpha, i, 2), float(self._ratio[i]) ** 2 / 8 * scale
                ends[i, 0] += share * math.prod(dominance(a, float(r) / 2) for a, r in zip(order, self._ratio))
                ends[i, 1] += share * self.tables.beyond(order)
        low, high = cell_ranges(table, close, near * (1 + 1e-9), beyond * field.largest * (1 + 1e-9))
        for i in range(self.n):
            for end in (0, -1):
                side = (*(slice(None),) * i, end)
                more = (ends[i, 0] * close[side] + ends[i, 1] * field.largest) * (1 + 1e-9)
                low[side] -= more
                high[side] += more
        return low, high

    def _fourth(self, alpha: Alpha, i: int) -> tuple[float, float]:
        """What the second difference along axis i misses, times delta_i^2/8: relative to H, and beyond its reach."""
        share = float(self._ratio[i]) ** 2 / 8
        parts = [(float(self._ratio[i]) ** 2 / 12, _raised(alpha, i, 4), [float(r) for r in self._ratio])]
        for j in range(self.n):
            half = [float(r) / 2 for r in self._ratio]
            parts.append((float(self._ratio[j]) ** 2 / 8, _raised(_raised(alpha, i, 2), j, 2), half))
        near = sum(c * math.prod(dominance(a, r) for a, r in zip(order, reach)) for c, order, reach in parts)
        return share * near, share * sum(c * self.tables.beyond(order) for c, order, _ in parts)

    def _of_box(self, k: int, bounds: dict[Alpha, tuple[Array, Array]], variables: range) -> list[Interval]:
        windows, images, forms = self.windows[k], self.step.cells[k], self.forms[k]
        over = {
            alpha: Interval(windows.extreme(low, largest=False), windows.extreme(high, largest=True))
            for alpha, (low, high) in bounds.items()
        }
        found = []
        for i in variables:
            bend = forms.second(over, i)
            if not images.smooth.all():
                width = self.step.width(k, i)
                jump = forms.first(over, i).width * 2 / width * (1 + 1e-12)
                rough = Interval(-jump, jump)
                low = np.where(images.smooth, bend.lo, np.where(images.steady, rough.lo, -np.inf))
                high = np.where(images.smooth, bend.hi, np.where(images.steady, rough.hi, np.inf))
                bend = Interval(np.minimum(low, high), high)
            found.append(bend)
        return found


class Forms:
    """Products of f's derivatives, made once: d_ii phi = sum_kl h_kl J_ki J_li + sum_k h_k B_ki."""

    def __init__(self, images: CellImages, n: int) -> None:
        self.n, self.whole = n, bool(images.smooth.all())
        slopes = _cleaned(images.slopes, images.steady)
        bends = _cleaned(images.bends, images.smooth)
        variables = slopes.shape[2]
        self.linear = [[_short(slopes[:, k, i]) for k in range(n)] for i in range(variables)]
        self.bent = [[_short(bends[:, k, i]) for k in range(n)] for i in range(variables)]
        self.square: list[list[tuple[Alpha, Interval | None]]] = []
        for i in range(variables):
            row: list[tuple[Alpha, Interval | None]] = []
            for k in range(n):
                for m in range(k + 1):
                    alpha = tuple((j == k) + (j == m) for j in range(n))
                    first, second = self.linear[i][k], self.linear[i][m]
                    if first is None or second is None:
                        row.append((alpha, None))
                    else:
                        row.append((alpha, first**2 if k == m else first * second * 2.0))
            self.square.append(row)

    @property
    def constant(self) -> bool:
        """Whether f is affine and the same on all cells."""
        straight = all(factor is None for row in self.bent for factor in row)
        return self.whole and straight and all(f is None or f.ndim == 0 for row in self.square for _, f in row)

    def terms(self, i: int) -> list[tuple[Alpha, Interval]]:
        """Constant factors of h's second derivatives in d_ii phi."""
        return [(alpha, factor) for alpha, factor in self.square[i] if factor is not None]

    def every(self, i: int) -> list[tuple[Alpha, Interval]]:
        """Factors of h's first and second derivatives in d_ii phi."""
        bent = [(_unit(k, self.n), factor) for k, factor in enumerate(self.bent[i])]
        return [(alpha, factor) for alpha, factor in self.square[i] + bent if factor is not None]

    def first(self, over: dict[Alpha, Interval], i: int) -> Interval:
        """d_i phi."""
        terms = [(_unit(k, self.n), factor) for k, factor in enumerate(self.linear[i])]
        return _combined(over, terms)

    def second(self, over: dict[Alpha, Interval], i: int) -> Interval:
        """d_ii phi."""
        terms = [(_unit(k, self.n), factor) for k, factor in enumerate(self.bent[i])]
        return _combined(over, self.square[i] + terms)


def _combined(over: dict[Alpha, Interval], terms: list[tuple[Alpha, Interval | None]]) -> Interval:
    total: Interval | None = None
    for alpha, factor in terms:
        if factor is None:
            continue
        term = factor * over[alpha]
        total = term if total is None else total + term
    return Interval.point(np.zeros(next(iter(over.values())).shape)) if total is None else total


def _raised(alpha: Alpha, i: int, by: int) -> Alpha:
    return tuple(a + (by if k == i else 0) for k, a in enumerate(alpha))


_ONE = Interval.point(1.0)


def _unit(k: int, n: int) -> Alpha:
    return tuple(int(j == k) for j in range(n))


def _cleaned(x: Interval, keep: Mask) -> Interval:
    """Zeros where the numbers do not count."""
    mask = keep[:, None, None]
    return Interval(np.where(mask, x.lo, 0.0), np.where(mask, x.hi, 0.0))


def _short(x: Interval) -> Interval | None:
    """None for zeros, one number for a constant."""
    if not x.mag.any():
        return None
    if np.all(x.lo == x.lo[0]) and np.all(x.hi == x.hi[0]):
        return Interval(x.lo[0], x.hi[0])
    return x
