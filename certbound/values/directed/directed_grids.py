"""Grids for functions on lines: lines close to each other where paths may leave, nodes a share of the noise apart.

Of no consequence but for the bounds. Cells across which functions jump (a limit of p is met there, now or a step later)
are dear: their corners are 1, and where the jump goes through the grid in uneven steps the means have kinks that every
cell around pays for. So lines go through the places where the jump meets nodes: that took three quarters off what
was lost by a pendulum's symplectic step.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.rigor.intervals import Interval
from certbound.values.directed.noise_directions import Directed
from certbound.values.grids import Grid, graded_axis

PLANS = (
    (1.5, 0.5), (1.8, 0.35), (2.1, 0.25), (2.5, 0.18), (3.0, 0.13), (3.5, 0.09), (4.0, 0.065), (5.0, 0.045),
    (6.0, 0.03), (8.0, 0.02), (10.0, 0.015),
)  # fmt: skip
"""Nodes along q to a standard deviation of the noise, and lines' largest distance in units of how far paths spread."""
_WIDEN = 0.12  # of the distance from a limit, the lines' distance there
_BEYOND, _DEVIATIONS = 3.5, 1.0  # of how far paths spread, and of the noise: where the grid ends if no limit is there
_SLIVER = 1e-3
_INWARD = 1e-12  # by which lines lie inside of a limit, for rounding
_FINE, _FEWEST = 4.0, 3  # lines that meet every third node at most, if they are closer than wanted by so much
_GAP = 10  # lines between the places where paths meet two limits, or else one lattice serves both
_LEAST, _MOST = 60, 2000  # lines over the grid, at least, and nodes along an axis, at most
_SAMPLES = 9


class Layout:
    """What the grids of a problem have in common: their ends, where lines have to be close, how far apart elsewhere.

    Parameters
    ----------
    work : Directed
        Whose safe set may be of any shape; beyond the ends states count as failed (above) or as safe (below).
    """

    def __init__(self, work: Directed) -> None:
        self.work = work
        least, most, spreads = work.paths()
        self.spread = np.median(spreads, axis=0)
        limits = np.array([work.ends(t) for t in range(work.horizon + 1)])
        self.low, self.high = limits[:, 0].min(axis=0), limits[:, 1].max(axis=0)
        if not np.all(self.low < self.high):
            raise InfeasibleError("value functions need a safe set with an interior.")
        more = _BEYOND * spreads.max(axis=0) + (most - least) / 10
        more += np.array([abs(work.shear), 1.0]) * _DEVIATIONS * work.noise
        more = np.maximum(more, _SLIVER * (1 + np.maximum(np.abs(least), np.abs(most))))
        self.q = max(self.low[1], least[1] - more[1]), min(self.high[1], most[1] + more[1])
        turned = sorted(work.shear * end for end in self.q)
        far = 1e-9 * abs(work.shear) * (1 + abs(self.q[0]) + abs(self.q[1]))
        low = self.low[0] - turned[1] - far if np.isfinite(self.low[0]) else least[0] - more[0]
        high = self.high[0] - turned[0] + far if np.isfinite(self.high[0]) else most[0] + more[0]
        self.y = low, high
        if not (low < high and self.q[0] < self.q[1] and np.isfinite([*self.y, *self.q]).all()):
            raise InfeasibleError("value functions need a bounded set that paths stay in.")
        self.near = [(end - turned[1], end - turned[0]) for end in (self.low[0], self.high[0]) if np.isfinite(end)]
        self.marks = self._marks()
        self.push = max(abs(work.shear), self._push()) * work.noise

    def _marks(self) -> tuple[list[float], list[float]]:
        """Faces along the coordinates that become nodes, of y and of q."""
        found: tuple[list[float], list[float]] = [], []
        for constraint in self.work.limits:
            if not constraint.outside:
                continue
            region, (p, q) = constraint.region, self.work.order
            places = region.places(2)
            if region.moving:
                continue
            hull = region.hull()
            for state, into in ((p, found[0]), (q, found[1])):
                if state in places:
                    into.extend(float(end[places.index(state)]) for end in (hull.lo, hull.hi))
        for t in range(self.work.horizon + 1):
            ends = self.work.ends(t)
            for axis in (0, 1):
                found[axis].extend(float(end[axis]) for end in ends if float(end[axis]) not in found[axis])
        finite = [[end for end in ends if math.isfinite(end)] for ends in found]
        return (finite[0] if self.work.shear == 0 else []), finite[1]

    def _push(self) -> float:
        """How far one step moves y where q is moved: the median of |dF/dq|, in floats."""
        work = self.work
        axes = np.meshgrid(*(np.linspace(*ends, _SAMPLES) for ends in (self.y, self.q)))
        rows = work.problem.input_sequence
        with np.errstate(all="ignore"):
            slopes = compile_numpy(work.slopes)(0.0, *(a.ravel() for a in axes), *([] if rows is None else rows[0]))
        slopes = np.abs(np.broadcast_to(slopes, (axes[0].size, 2, 2))[:, 0, 1])
        known = slopes[np.isfinite(slopes)]
        return float(np.median(known)) if len(known) else 0.0

    def grid(self, plan: tuple[float, float]) -> Grid:
        """The grid of a plan.

        Raises
        ------
        InfeasibleError
            If it has too many nodes along q.
        """
        count, apart = plan
        length, width = self.y[1] - self.y[0], self.work.noise / count
        widest = min(max(apart * float(self.spread[0]), length / _MOST), length / _LEAST)
        if (self.q[1] - self.q[0]) / width > _MOST:
            raise InfeasibleError("value functions on lines would need too many nodes: the noise is small.")
        if self.work.shear and self.near:
            return self._oblique(width, widest)
        nodes = graded_axis(*self.q, np.array(self.q), np.array([width, width]), self.marks[1])
        nodes = nodes if len(nodes) > 3 else np.linspace(*self.q, 5)
        lines = self._filled(self._met(nodes, widest), max(self.push / count, widest / 100), widest)
        if len(lines) > 2 * _MOST:
            raise InfeasibleError("value functions on lines would need too many of these.")
        return Grid(axes=(lines, nodes))

    def _met(self, nodes: Array, widest: float) -> Array:
        """The ends, and lines from which a step leads to a limit of p just where q is at a node, in floats.

        Paths leave from beyond a curve: where lines met it anywhere between nodes, it would have uneven steps.
        """
        middle, found = (self.y[0] + self.y[1]) / 2, [np.array(self.y)]
        model, rows = compile_numpy(self.work.tape), self.work.problem.input_sequence
        inputs = [] if rows is None else list(rows[0])
        for sign, limit in ((-1.0, self.y[0]), (1.0, self.y[1])):
            if limit not in (self.low[0], self.high[0]):
                continue
            near, far = np.full(len(nodes), limit), np.full(len(nodes), middle)
            with np.errstate(all="ignore"):
                ends = [np.broadcast_to(model(0.0, y, nodes, *inputs), (len(nodes), 2))[:, 0] for y in (near, far)]
                usable = (sign * (ends[0] - limit) > 0) & (sign * (ends[1] - limit) < 0)
                for _ in range(60):
                    half = (near + far) / 2
                    over = sign * (np.broadcast_to(model(0.0, half, nodes, *inputs), (len(nodes), 2))[:, 0] - limit) > 0
                    near, far = np.where(over, half, near), np.where(over, far, half)
            places, last = [], limit
            for place in sorted(far[usable] - sign * _INWARD * (1 + abs(limit)), key=lambda y: abs(y - limit)):
                if abs(place - last) >= min(_WIDEN * abs(place - limit), widest) + _INWARD:
                    places.append(place)
                    last = place
            found.append(np.array(places))
        lines = np.unique(np.concatenate(found))
        return np.asarray(lines[np.concatenate([[True], np.diff(lines[:-1]) > widest / 1000, [True]])])

    def _filled(self, lines: Array, finest: float, widest: float) -> Array:
        """More lines between those that are farther apart than wanted, but for the closest ones."""
        marks, found = [], [lines]
        for mark in self.marks[0]:
            if np.abs(lines - mark).min() > finest / 10:
                marks.append(mark)
        ends = [end for pair in self.near for end in pair] + self.marks[0]
        lines = np.union1d(lines, marks)
        for a, b in itertools.pairwise(lines):
            places = np.linspace(a, b, 257)
            away = np.min([np.abs(places - end) for end in ends], axis=0) if ends else np.full(257, math.inf)
            wanted = np.minimum(np.maximum(_WIDEN * away, finest), max(widest, finest))
            if b - a > 1.5 * wanted.max():
                found.append(graded_axis(a, b, places, wanted))
        return np.asarray(np.unique(np.concatenate([lines, *found])))

    def _oblique(self, width: float, widest: float) -> Grid:
        """Lines that meet the limits of p at nodes, for the same reason."""
        shear, (low, high) = abs(self.work.shear), (self.low[0], self.high[0])
        inward = _INWARD * (1 + abs(self.y[0]) + abs(self.y[1]))
        every = min(max(int(widest / (_FINE * shear * width)), 1), _FEWEST)
        if len(self.near) == 2 and self.near[0][1] + _GAP * shear * width > self.near[1][0]:
            step = shear * every
            width = (high - low - 2 * inward) / (step * math.ceil((high - low) / (step * width)))
        nodes = self.q[0] + width * np.arange(math.floor((self.q[1] - self.q[0]) / width) + 1)
        turned, parts = self.work.shear * nodes[::every], [np.array(self.y)]
        if np.isfinite(low):
            parts.append(low - turned + inward)
        if np.isfinite(high):
            parts.append(high - turned - inward)
        lines = np.sort(np.concatenate(parts))
        lines = lines[np.concatenate([[True], np.diff(lines) > 0.3 * shear * width])]
        inner = nodes[(nodes > self.q[0] + 0.3 * width) & (nodes < self.q[1] - 0.3 * width)]
        axes = self._filled(lines, every * shear * width, widest), np.concatenate([[self.q[0]], inner, [self.q[1]]])
        if max(map(len, axes)) > 2 * _MOST:
            raise InfeasibleError("value functions on lines would need too many of these.")
        return Grid(axes=axes)

    def start_grid(self, grid: Grid) -> Grid:
        """A grid over the starts whose cells are about as small as those of ``grid`` there."""
        box, axes = self._start_box(), []
        plain = self.work.problem.initial.form.axial and self.work.shear == 0
        for (low, high), axis in zip(box, grid.axes):
            near = np.diff(axis)[max(np.searchsorted(axis, low) - 1, 0) : max(int(np.searchsorted(axis, high)), 1)]
            width = float(near.min()) if len(near) else high - low
            count = min(max(1 if plain else 24, math.ceil((high - low) / width)), _MOST)
            axes.append(np.linspace(low, high, count + 1) if low < high else np.array([low, high]))
        return Grid(axes=tuple(axes))

    def _start_box(self) -> list[tuple[float, float]]:
        hull = self.work.problem.initial.hull()
        box = self.work.coordinates(Interval(hull.lo[None], hull.hi[None]))
        return [(float(box.lo[0, k]), float(box.hi[0, k])) for k in (0, 1)]

    def beyond(self, t: int, grid: Grid) -> tuple[tuple[bool, bool], tuple[bool, bool]]:
        """Whether every state below and above the ends of y, and of q, is surely unsafe at step t."""
        (low, high), shear = self.work.ends(t), self.work.shear
        y, q = grid.axes
        across = bool(q[0] <= low[1]), bool(q[-1] >= high[1])
        if shear == 0:
            return (bool(y[0] <= low[0]), bool(y[-1] >= high[0])), across
        turned = sorted((shear * low[1], shear * high[1]))
        room = 1e-12 * (abs(turned[0]) + abs(turned[1]))
        if not math.isfinite(room):
            return (False, False), across
        return (bool(y[0] + turned[1] + room < low[0]), bool(y[-1] + turned[0] - room > high[0])), across
