"""Floating-point proposals of the probability U itself in a region with curved walls; nothing here is certified.

The solver is that of a box (`straight`), its equation being asked for by least squares: at nine points of a cell as far
as they lie in the region, beside U = 1 on the walls, and that the splines which hardly any point sees are smooth.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags, kron, vstack
from scipy.sparse.linalg import splu

from certbound.arrays import Array, Mask
from certbound.values.continuous.curved.boundaries import Deep, Walls
from certbound.values.continuous.curved.continuation import crowded_nodes, wall_points
from certbound.values.continuous.curved.cuts import Cuts
from certbound.values.continuous.curved.proof import least_on_walls
from certbound.values.continuous.curved.proof_below import highest_within
from certbound.values.continuous.plane import Plan, Plane, Source
from certbound.values.continuous.straight import PAST, Ramps, Solve, left_at, ramp_of, stage_rates
from certbound.values.continuous.surface import Surface

_CROWD = {False: 0.7, True: 1.3}  # how much denser the grid is around walls than it would be; from below
_PLACES = (0.1127, 0.5, 0.8873)  # in a cell, along each state: Gauss's
_ON_WALL = 3.0  # the weight of U = 1 on the walls, that of the equation being about 1 for U itself
_AGE = {False: 0.8, True: 4.0}  # of a ramp, in units of a cell's width squared over the noise's variance
_LAYER, _ZONE = 1.5, 2.0  # widths of layers at faces, and of where the drift is weakened, in cells
_SMOOTH = {False: 1e-3, True: 1e-4}  # of third differences of coefficients outside
_SMALLER = 2.0**-16  # e of V = e (U - 1) from below: Q2 is next to nothing then, and left out
_GROWTH, _LONGEST, _FIRST = 0.2, 16, 0.1  # of steps from below: over tau, of the horizon, of a ramp
_BEYOND = 0.45  # of a cell: how far beyond a wall the equation is asked for from below
_LED = 0.8  # of what U misses of 1 on the walls, that the next proposal gets beyond them
_UNDER = 0.3  # of P: how far U is below 0 at faces that are no limits
_FADING = 0.2  # of the box: over which U falls to 0 on walls that meet these
_ROUND = 1.0  # corners of obstacles from below, in cells
_HAIR = 1e-6
_ALL = ((True, True), (True, True))
_SYMMETRIC = {"SymmetricMode": True}  # normal equations need no pivots, so that their order may keep them sparse


class WalledRamps(Ramps):
    """U = 1 on the walls, but for the ramp at T.

    For lower bounds ``below`` is about P. Then the equation is asked for a little beyond the walls too, as far as a
    proof looks at cells that they cut, and U is given on a curve there: 1, and more where the last proposal missed 1 on
    the wall itself. Corners of obstacles are rounded within them. At faces that are no limits U is a little below 0,
    where nothing is asked, and walls that meet them have less.
    """

    def __init__(self, plane: Plane, walls: Deep, cells: int, *, below: float | None = None) -> None:
        self.walls, self.curve = walls, wall_points(walls, plane, 4 * cells)
        self.below, self.deep = below is not None, walls
        super().__init__(plane, cells, _lead(plane, cells, _AGE[self.below]), below=self.below)
        self.shown, self.goal = self.curve, np.ones(len(self.curve))
        if below is not None:
            self._set_below(below)
        self.points = [(nodes[:-1, None] + np.diff(nodes)[:, None] * _PLACES).ravel() for nodes in self.nodes]
        x, y = np.meshgrid(*self.points, indexing="ij")
        self.asked = self.due(x, y).ravel()
        own = [[csr_matrix(one.spline(at, order)) for order in range(3)] for one, at in zip(self.splines, self.points)]
        (force,), a = plane.drift(0.0, x, y), plane.square(0.0, x, y) * np.ones((2, 2, *x.shape))
        force = self._weakened(force, a, (x, y), plane.cut if self.below else _ALL)

        def part(weight: Array | float, i: int, j: int) -> csr_matrix:
            chosen = kron(own[0][i], own[1][j], format="csr")[self.asked]
            return csr_matrix(diags((weight * np.ones(x.shape)).ravel()[self.asked]) @ chosen)

        self.values = part(1.0, 0, 0)
        self.rates = part(force[0], 1, 0) + part(force[1], 0, 1) + part(a[0, 1], 1, 1)
        self.rates += part(a[0, 0] / 2, 2, 0) + part(a[1, 1] / 2, 0, 2)
        across = [a[k, k].ravel()[self.asked] / np.median(np.diff(self.nodes[k])) ** 2 for k in (0, 1)]
        self.speed = across[0] + across[1]
        self.at_walls, self.at_shown = self._at(self.curve), self._at(self.shown)
        self.led: dict[float, Array] = {}
        self.smooth = _differences(np.asarray(self.deep.depth(*self.places) + self._beyond(*self.places) < 0))

    def grid(self, axis: int, plan: Plan) -> Array:
        return crowded_nodes(self.plane, plan, axis, self.curve, _CROWD[self.below])

    def _set_below(self, level: float) -> None:
        self.small, self.growth, self.longest, self.begun = _SMALLER, _GROWTH, _LONGEST, _FIRST
        self.first = self.first * (_UNDER * level / PAST)
        assert isinstance(self.walls, Walls)
        self.deep = _Rounded(walls=self.walls, rho=_ROUND * min(float(np.median(np.diff(one))) for one in self.nodes))
        self.curve = wall_points(_Moved(walls=self.deep, by=self._beyond), self.plane, 4 * (len(self.nodes[0]) - 1))
        self.shown = _feet(self.deep, self.curve)
        self.goal = self._fading()

    def due(self, x: Array, y: Array) -> Mask:
        """Where the equation is asked for; from below a little beyond the walls too, up to where it will be proved."""
        return np.asarray(self.deep.depth(x, y) + self._beyond(x, y) > 0)

    def _beyond(self, x: Array, y: Array) -> Array:
        """How far beyond the walls."""
        wide = [np.interp(place, nodes[:-1], np.diff(nodes)) for place, nodes in zip((x, y), self.nodes)]
        return np.asarray(self.below * _BEYOND * np.maximum(*wide))

    def least(self, whole: Surface) -> float:
        assert isinstance(self.walls, Walls)
        return min(super().least(whole), least_on_walls(whole, Cuts.of(whole.axes, self.walls)))

    def _at(self, points: Array) -> csr_matrix:
        """What leads from the coefficients to U at some points."""
        rows = [one.spline(points[:, axis]) for axis, one in enumerate(self.splines)]
        return csr_matrix(np.einsum("pi,pj->pij", *rows).reshape(len(points), len(self.count)))

    def top(self, whole: Surface) -> float:
        assert isinstance(self.walls, Walls)
        return 1 + highest_within(whole.raised(-1.0), Cuts.of(whole.axes, self.walls), self.walls)

    def _fading(self) -> Array:
        """1 on the walls, and down to 0 where they meet faces that are no limits, on which U = 0."""
        found = np.ones(len(self.curve))
        for axis, side in itertools.product((0, 1), (0, 1)):
            if self.plane.cut[axis][side]:
                nodes = self.nodes[axis]
                width = _FADING * (nodes[-1] - nodes[0])
                s = np.clip(np.abs(self.curve[:, axis] - nodes[-side]) / width - 1e-9, 0.0, 1.0)
                found *= s**3 * (10 - 15 * s + 6 * s * s)
        return found

    def _weakened(self, force: Array, a: Array, places: Sequence[Array], faces: Sequence[tuple[bool, bool]]) -> Array:
        """The drift, less of it leading inside near faces, whose layers then fit the cells.

        U only grows by that where it rises towards the face, as from above, and falls where it is 0 on it.
        """
        found = force.copy()
        for axis, (nodes, place) in enumerate(zip(self.nodes, places)):
            ends = ((1, nodes[0], nodes[1] - nodes[0]), (-1, nodes[-1], nodes[-1] - nodes[-2]))
            for sign, end, width in itertools.compress(ends, faces[axis]):
                away = np.abs(place - end) / width
                most = a[axis, axis] / (_LAYER * width) * np.maximum(1.0, away / _ZONE) ** 4
                found[axis] = np.where(sign * found[axis] > most, sign * most, found[axis])
        return found

    def fed(self, source: Source) -> Array:
        rows = [super().fed(source), source.at(self.points)]
        flat = [row.reshape(len(row), -1) for row in rows]
        return np.concatenate([flat[0], flat[1][:, self.asked]], axis=1)

    def _step(self, value: Array, step: float, fed: Array, ages: Array) -> Array:
        fed = fed * np.ones(len(value) + self.values.shape[0])
        edges = self.edges(value, step, fed[:, : len(value)], ages)
        asked = np.outer(stage_rates(step), np.asarray(self.values @ value)) + fed[:, len(value) :]
        walls = np.outer(1 - left_at(ages / self.lead), self.goal)
        if not self.below:
            return self.solved(step, np.concatenate([edges, asked, walls], axis=1))
        walls = walls + self.at_walls @ self.first
        before = self.led.get(ages[2], np.zeros(walls.shape))
        found = self.solved(step, np.concatenate([edges, asked, walls + before], axis=1))
        self.led[ages[2]] = before + _LED * (walls - (self.at_shown @ found.T).T)
        return found

    def factor(self, root: complex) -> Solve:
        weights = 1 / (abs(root) + self.speed)
        parts = [diags(weights) @ (root * self.values - self.rates), _ON_WALL * self.at_walls]
        whole = csc_matrix(vstack([*parts, _SMOOTH[self.below] * self.smooth]))
        free = np.setdiff1d(np.arange(whole.shape[1]), self.edge)
        own, given = whole[:, free], whole[:, self.edge]
        back = csr_matrix(own.conj().T)
        normal = splu(csc_matrix(back @ own), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=_SYMMETRIC)
        count = len(self.edge)

        def solve(right: Array) -> Array:
            asked = right[count : count + len(weights)] * weights
            walls = _ON_WALL * right[count + len(weights) :]
            wanted = np.concatenate([asked, walls, np.zeros(self.smooth.shape[0])]) - given @ right[:count]
            found = np.zeros(whole.shape[1], dtype=right.dtype)
            found[self.edge], found[free] = right[:count], normal.solve(back @ wanted)
            return found

        return solve


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Moved:
    """Walls that are moved away from the safe side."""

    walls: Deep
    by: Callable[[Array, Array], Array]

    def depth(self, x: Array, y: Array) -> Array:
        return np.asarray(self.walls.depth(x, y) + self.by(x, y))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Rounded:
    """Walls, the corners of obstacles rounded within them: U is smoother there, and what U < 1 costs is little."""

    walls: Walls
    rho: float

    def depth(self, x: Array, y: Array) -> Array:
        best = np.full(np.shape(x), np.inf)
        for walls, outside in self.walls.groups:
            gaps = np.array([wall.distance(x, y) for wall in walls])
            own = self.rho * np.logaddexp.reduce(gaps / self.rho) if outside else -np.max(gaps, axis=0)
            best = np.minimum(best, own)
        return np.asarray(best)


def _feet(walls: Deep, points: Array) -> Array:
    """About the points of the walls that are nearest to some points."""
    (x, y), deep = points.T, walls.depth(*points.T)
    ahead = [walls.depth(x + _HAIR, y) - deep, walls.depth(x, y + _HAIR) - deep]
    slope = np.array(ahead) / _HAIR
    return np.asarray(points - (deep * slope / np.maximum((slope**2).sum(axis=0), _HAIR)).T)


def _lead(plane: Plane, cells: int, age: float) -> float:
    """How long a ramp takes, so that layers at walls are about a cell wide."""
    widths = [(high - low) / cells for low, high in zip(plane.low, plane.high)]
    x, y = np.meshgrid(*(np.linspace(low, high, 9) for low, high in zip(plane.low, plane.high)))
    square = plane.square(0.0, x, y)
    ages = [age * width**2 / max(float(np.median(square[k, k])), 1e-300) for k, width in enumerate(widths)]
    return max(ramp_of(cells) * plane.horizon, min(*ages, 0.1 * plane.horizon))


def _differences(outside: Mask) -> csr_matrix:
    """Third differences of coefficients along both axes, where one of them stands outside."""
    count = outside.size
    numbers, rows = np.arange(count).reshape(outside.shape), []
    for own, away in ((numbers, outside), (numbers.T, outside.T)):
        places = np.stack([own[k : len(own) - 3 + k] for k in range(4)], axis=-1)
        met = np.any([away[k : len(own) - 3 + k] for k in range(4)], axis=0)
        rows.append(places[met])
    places = np.concatenate(rows)
    entries = np.tile([-1.0, 3.0, -3.0, 1.0], len(places))
    lines = np.repeat(np.arange(len(places)), 4)
    return csr_matrix((entries, (lines, places.ravel())), shape=(len(places), count))
