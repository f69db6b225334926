"""A problem whose noise acts along one direction, in coordinates of which it moves one only.

X+ = f(t, X) + (g_p, g_q) w with normal w. In y = p - a q and q, a = g_p/g_q as a float, it is
    y+ = F(t, y, q) + e w,   q+ = g(t, y, q) + s w,   |e w| <= slip but for a probability below 1e-300,
with e = 0 where the noise acts on one state, and of the size of a roundoff else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.goals import check_end
from certbound.problem.model import Graph, Tape, compile_numpy, jacobian, sources
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Faces, Inside
from certbound.problem.systems import DiscreteSystem
from certbound.rigor.intervals import Interval, sqrt, stack
from certbound.values.discrete import evaluate
from certbound.values.sets import active_at, box_around

_MOST_STEPS = 5000
_FARTHEST = 40.0  # standard deviations
_EXACT = 1e-15  # to which s must be known
_PATHS = 400


@dataclass(frozen=True, eq=False, kw_only=True)
class Directed:
    """A problem in the coordinates (y, q).

    Parameters
    ----------
    order : (int, int)
        Which states p and q are.
    shear, noise, slip : float
        a, s and the bound of what the noise does to y.
    tape : Tape
        (F, g) over ("t", "y", "q", inputs).
    limits : tuple of Inside
        What paths respect; half-spaces along a state as boxes, whose faces are compared exactly. Of half-spaces to keep
        out of they are what these leave, without the face (`Inside.without_edge`).
    """

    problem: Problem
    order: tuple[int, int]
    shear: float
    noise: float
    slip: float
    tape: Tape
    limits: tuple[Inside, ...]

    @cached_property
    def slopes(self) -> Tape:
        """dF/dy, dF/dq, dg/dy, dg/dq."""
        return jacobian(self.tape, (1, 2))

    @property
    def steady(self) -> bool:
        """Whether every step is the same."""
        rows = self.problem.input_sequence
        return not any(0 in used for used in sources(self.tape)) and (rows is None or bool(np.all(rows == rows[0])))

    @property
    def horizon(self) -> int:
        """Number of steps."""
        return int(self.problem.horizon)

    def over(self, tape: Tape, t: int, boxes: Interval) -> tuple[Interval, Mask]:
        """Ranges of a tape over boxes of (y, q), shape (N, 2), and where it is undefined or jumps."""
        rows = self.problem.input_sequence
        inputs = [] if rows is None else [Interval.point(float(value)) for value in rows[t]]
        found, undefined, jumps = evaluate(tape, [Interval.point(float(t)), boxes[:, 0], boxes[:, 1], *inputs])
        return found, undefined | jumps | ~np.isfinite(found.mag).all(axis=1)

    def states(self, boxes: Interval) -> Interval:
        """Boxes around boxes of (y, q), in the order of the states."""
        y, q = boxes[:, 0], boxes[:, 1]
        p = y if self.shear == 0 else y + q * self.shear
        return stack([p, q] if self.order == (0, 1) else [q, p], axis=1)

    def coordinates(self, boxes: Interval) -> Interval:
        """Boxes of states, shape (N, 2), in the coordinates (y, q)."""
        p, q = boxes[:, self.order[0]], boxes[:, self.order[1]]
        return stack([p if self.shear == 0 else p - q * self.shear, q], axis=1)

    def ends(self, t: int) -> tuple[Array, Array]:
        """Ends of p and q that the constraints of a step set, infinite where they set none."""
        low, high = box_around(active_at(self.limits, t), 2, t)
        return low[list(self.order)], high[list(self.order)]

    def fails_on_ends(self, t: int) -> tuple[bool, bool]:
        """Whether a state on the lower, and on the upper end of p has failed at a step."""
        active = active_at(self.limits, t)
        (low, high), p = box_around([one for one in active if one.without_edge], 2, t), self.order[0]
        first, last = (end[0] for end in self.ends(t))
        return bool(low[p] >= first > -np.inf), bool(high[p] <= last < np.inf)

    def paths(self) -> tuple[Array, Array, Array]:
        """Of simulated paths: least and largest (y, q), and their standard deviations at all times, shape (T, 2)."""
        rng, step, hull = np.random.default_rng(0), compile_numpy(self.tape), self.problem.initial.hull()
        box = self.coordinates(Interval(hull.lo[None], hull.hi[None]))
        x = rng.uniform(box.lo, box.hi, (_PATHS, 2))
        least, most, widths = x.min(axis=0), x.max(axis=0), []
        for t in range(self.horizon):
            rows = self.problem.input_sequence
            low, high = self.ends(t + 1)
            with np.errstate(all="ignore"):
                ends = np.broadcast_to(step(float(t), *x.T, *([] if rows is None else rows[t])), x.shape)
            ends = ends + np.array([0.0, self.noise]) * rng.standard_normal((_PATHS, 1))
            place = np.stack([ends[:, 0] + self.shear * ends[:, 1], ends[:, 1]], axis=1)
            inside = np.isfinite(ends).all(axis=1) & np.all((place >= low) & (place <= high), axis=1)
            x = np.where(inside[:, None], ends, x)
            least, most = np.minimum(least, x.min(axis=0)), np.maximum(most, x.max(axis=0))
            widths.append(x.std(axis=0))
        return least, most, np.array(widths)


def directed(problem: Problem) -> Directed:
    """Read a problem.

    Raises
    ------
    InfeasibleError
        Unless two states are moved by normal noise along one direction; the message says what else there is.
    """
    system = problem.system
    if not isinstance(system, DiscreteSystem) or system.dimension != 2 or system.gain is not None:
        raise InfeasibleError("steps along lines serve two states in discrete time with noise of a fixed size.")
    if not system.noise.gaussian:
        raise InfeasibleError("steps along lines take normal noise.")
    if problem.reach is not None or problem.ending or problem.initial.random or system.disturbance is not None:
        raise InfeasibleError("steps along lines serve sets of starts, without targets, ending paths and disturbances.")
    check_end(problem, "a step by step induction")
    if problem.horizon > _MOST_STEPS:
        raise InfeasibleError(f"steps along lines are at most {_MOST_STEPS}, not {problem.horizon}.")
    load = _load(system)
    found = [_along(problem, load, int(place)) for place in np.flatnonzero(load.mag > 0)]
    return found[0] if len(found) == 1 else max(found, key=lambda one: one.noise / np.median(one.paths()[2][:, 1]))


def _along(problem: Problem, load: Interval, place: int) -> Directed:
    """The problem with q the state at a place."""
    order = (1 - place, place)
    p, q = load[order[0]], load[order[1]]
    noise, shear = abs(float(q.mid)), 0.0 if p.mag == 0 else float(p.mid) / float(q.mid)
    if not (1e-60 < noise < 1e60 and q.rad <= _EXACT * noise and np.isfinite(shear)):
        raise InfeasibleError("steps along lines need noise of a size that is known and fits.")
    slip = float((p - q * shear).mag) * _FARTHEST if shear else 0.0
    return Directed(
        problem=problem, order=order, shear=shear, noise=noise, slip=slip, tape=_sheared(problem, order, shear),
        limits=tuple(_boxed(one) for one in problem.kept),
    )  # fmt: skip


def _boxed(constraint: Inside) -> Inside:
    """A constraint whose faces bound one state each, by an entry of 1 or -1, as a box."""
    constraint = constraint.as_stay()
    region, form = constraint.region, constraint.region.form
    if constraint.outside or not isinstance(form, Faces) or form.axial or region.moving or np.any(region.center_at()):
        return constraint
    rows = region.lifted(form.normals, 2)
    if not (np.all(np.abs(rows).max(axis=1) == 1) and np.all(np.abs(rows).sum(axis=1) == 1)):
        return constraint
    low, high = np.full(2, -np.inf), np.full(2, np.inf)
    for row, bound in zip(rows, form.bounds):
        state = int(np.argmax(np.abs(row)))
        low[state] = max(low[state], -bound) if row[state] < 0 else low[state]
        high[state] = min(high[state], bound) if row[state] > 0 else high[state]
    return replace(constraint, region=Box(low, high)) if np.all(low < high) else constraint


def _load(system: DiscreteSystem) -> Interval:
    """The column (g_1, g_2) of standard deviations of the noise, with a common sign.

    Raises
    ------
    InfeasibleError
        If it has more than one direction, or none.
    """
    gain, covariance = system.noise_matrix, system.noise.enclosed_covariance()
    entries = np.flatnonzero(np.diag(covariance.mag) > 0)
    moved = np.flatnonzero(np.any(gain[:, entries] != 0, axis=1))
    if len(entries) == 1 and len(moved):
        return Interval.point(gain[:, entries[0]]) * sqrt(covariance[entries[0], entries[0]])
    if len(moved) == 1:
        row = Interval.point(gain[moved[0]])
        size = sqrt(((row[:, None] * covariance).sum(axis=0) * row).sum(axis=-1))
        return stack([size if i == moved[0] else Interval.point(0.0) for i in range(2)])
    raise InfeasibleError("steps along lines need noise along one direction: of one entry, or on one state.")


def _sheared(problem: Problem, order: tuple[int, int], shear: float) -> Tape:
    rows = problem.input_sequence
    graph = Graph(("t", "y", "q", *(f"u{k}" for k in range(0 if rows is None else rows.shape[1]))))
    y, q = graph.input(1), graph.input(2)
    p = y if shear == 0 else graph.apply("add", y, graph.apply("mul", graph.const(shear), q))
    states = [p, q] if order == (0, 1) else [q, p]
    rest = [graph.input(slot) for slot in range(3, len(graph.inputs))]
    ends = problem.closed_loop.evaluate(graph.arithmetic(), [graph.input(0), *states, *rest])
    p, q = (ends[place] for place in order)
    y = p if shear == 0 else graph.apply("sub", p, graph.apply("mul", graph.const(shear), q))
    return graph.tape([y, q], (2,))

