"""The boxes and grids of all steps: where value functions live, how fine, what that costs, and what comes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside, Outside, Quadratic, Region
from certbound.problem.systems import DiscreteSystem
from certbound.rigor.intervals import Interval
from certbound.values.discrete.dominance import tail
from certbound.values.discrete.kernels import REACH
from certbound.values.discrete.shocks import Inapplicable, Shocks
from certbound.values.discrete.steps import Dynamics
from certbound.values.grids import Grid, graded_axis
from certbound.values.sets import active_at, box_around

_COARSE = {1: 256, 2: 32, 3: 12}  # cells along each side when the reach of a step is bounded
_MOST_PLACES = 1e7  # along an axis
_PATHS = 400
_PAST = 6.0  # sizes of normal noise beyond a limit that most paths which break it keep to
_SMALLER = 0.9  # times the boxes that states surely keep to, below which boxes that end before are taken
_GROWTHS, _MOST_GROWN = 40, 1e4  # of a box that is to last: how often it grows, and by how many sizes of the noise
_BEYOND, _FARTHER = 0.6, 15.0  # how far beyond simulated paths space is cut: of their extent, and sizes of the noise


class Boxes:
    """Per step a box outside which a path counts as failed, and what that adds to the probability of failing.

    Parameters
    ----------
    low, high : ndarray, shape (T + 1, n)
        Ends.
    leak : float
        Upper bound of the probability that a path leaves a box through a side that no constraint has put there.
    cut : bool
        Whether the boxes, which reach beyond all limits, end where hardly a path gets to: from below such paths count
        as safe, from above as failing.
    """

    def __init__(self, low: Array, high: Array, leak: float, *, cut: bool = False) -> None:
        self.low, self.high, self.leak, self.cut = low, high, leak, cut

    @property
    def volume(self) -> float:
        """Of all steps together."""
        return float(np.prod(self.high - self.low, axis=1).sum())


def boxes_of(problem: Problem, shocks: Shocks, dynamics: Dynamics) -> Boxes:
    """The boxes of all steps; sides that no constraint gives come from where the states can get to.

    Raises
    ------
    Inapplicable
        If some state is not bounded at some step; the message says what bound would help.
    """
    n, horizon = problem.system.dimension, int(problem.horizon)
    if problem.ending:
        return _of_domain(problem, np.sqrt(shocks.sigma.hi**2 + shocks.factor.mag**2) * (REACH * (1 + 1e-12)))
    ends = np.array([box_around(active_at(problem.constraints, t), n, t) for t in range(horizon + 1)])
    low, high = ends[:, 0], ends[:, 1]
    lacking = np.flatnonzero(~np.isfinite(ends).all(axis=(1, 2)))  # steps without some side
    limits = low.min(axis=0), high.max(axis=0)
    if not len(lacking) or shocks.sizes is not None:
        return _reached(problem, shocks, dynamics, (low, high), lacking)
    cut = _cut(problem, shocks, *limits)
    if shocks.laplace or shocks.steps is not None:
        return cut
    try:
        reached = _reached(problem, shocks, dynamics, (low, high), lacking)
    except Inapplicable:  # the worst cases of all steps lead far beyond what any path does
        return cut
    return cut if cut.volume < _SMALLER * reached.volume else reached


def _reached(
    problem: Problem, shocks: Shocks, dynamics: Dynamics, ends: tuple[Array, Array], lacking: Integers
) -> Boxes:
    """The limits of each step, and where the states surely are in steps that have none."""
    (low, high), n, horizon = ends, problem.system.dimension, int(problem.horizon)
    far = max(REACH, shocks.reach)
    spread = far * (np.sqrt(shocks.sigma.hi**2 + shocks.factor.mag**2) * (1 + 1e-12))
    reach = start_box(problem)
    leak = 0.0
    for t in range(horizon + 1):
        free = ~np.isfinite(low[t]) | ~np.isfinite(high[t])
        if np.any(free):
            if shocks.sizes is not None:
                raise Inapplicable("value functions need limits on both sides of every state that multiplies noise.")
            leak += 2 * n * tail(REACH)
            below, above = np.isfinite(low[t]), np.isfinite(high[t])
            low[t] = np.where(below, low[t], reach[0] - 1e-9 * (1 + np.abs(reach[0])))
            high[t] = np.where(above, high[t], reach[1] + 1e-9 * (1 + np.abs(reach[1])))
        _check_box(problem, low[t], high[t], t, spread)
        if np.any(lacking > t):
            reach = _next_reach(dynamics, t, low[t], high[t], reach, spread)
    return Boxes(low, high, leak)


def _cut(problem: Problem, shocks: Shocks, low: Array, high: Array) -> Boxes:
    """One box for all steps: beyond simulated paths where nothing bounds a state, and beyond all limits."""
    system, hull = problem.system, start_box(problem)
    assert isinstance(system, DiscreteSystem)
    rng, horizon, n = np.random.default_rng(0), int(problem.horizon), system.dimension
    disturbance = problem.system.disturbance
    middle = [] if disturbance is None else list((disturbance.low + disturbance.high) / 2)
    step, x = compile_numpy(problem.closed_loop), rng.uniform(*hull, (_PATHS, n))
    least, most = x.min(axis=0), x.max(axis=0)
    for t in range(horizon):
        inputs = [] if problem.input_sequence is None else list(problem.input_sequence[t])
        noise = system.noise.sample(rng, _PATHS) @ system.noise_matrix.T
        with np.errstate(all="ignore"):
            x = np.broadcast_to(step(float(t), *x.T, *inputs, *middle), x.shape) + noise
        x = np.where(np.all((x >= low) & (x <= high), axis=1, keepdims=True), x, hull[0])
        least, most = np.minimum(least, x.min(axis=0)), np.maximum(most, x.max(axis=0))
    scale, far = np.sqrt(shocks.sigma.hi**2 + shocks.factor.mag**2), max(REACH, shocks.reach)
    room = _BEYOND * (most - least) + min(far, _FARTHER) * scale
    beyond = max(shocks.reach, _PAST) * scale * (1 + 1e-9)
    first = np.where(np.isinf(low), least - room, low - beyond)
    last = np.where(np.isinf(high), most + room, high + beyond)
    _check_box(problem, first, last, 0, scale * far)
    steps = (horizon + 1, 1)
    return Boxes(np.tile(first, steps), np.tile(last, steps), 0.0, cut=True)


def _of_domain(problem: Problem, spread: Array) -> Boxes:
    """The domain at all steps, where paths that leave it end."""
    low, high = np.asarray(problem.domain.low), np.asarray(problem.domain.high)
    if not np.isfinite([low, high]).all():
        raise Inapplicable("value functions need a domain that bounds every state, where leaving it ends a path.")
    _check_box(problem, low, high, 0, spread)
    steps = (int(problem.horizon) + 1, 1)
    return Boxes(np.tile(low, steps), np.tile(high, steps), 0.0)


def start_box(problem: Problem) -> tuple[Array, Array]:
    """Ends of a box around the starts; of random ones but for tails."""
    initial = problem.initial
    if initial.random:
        away = REACH * np.sqrt(np.diag(initial.covariance)) * (1 + 1e-12)
        return initial.mean - away, initial.mean + away
    around = initial.hull()
    return around.lo, around.hi


def _check_box(problem: Problem, low: Array, high: Array, t: int, spread: Array) -> None:
    for i, name in enumerate(problem.system.states):
        if not (np.isfinite(low[i]) and np.isfinite(high[i]) and high[i] - low[i] < 1e4 * spread[i]):
            raise Inapplicable(
                f"value functions need bounds on every state, and `{name}` has none at step {t} that is of use: add a "
                f"constraint or a `domain` that bounds `{name}` on both sides."
            )
        if not low[i] < high[i]:
            raise Inapplicable(f"value functions need a safe set with an interior, and `{name}` has none at step {t}.")


def lasting_box(problem: Problem, shocks: Shocks, dynamics: Dynamics) -> tuple[Array, Array] | None:
    """A box around the starts that states within the limits of step 0 do not leave, but for the tails of one step.

    Of a model that is the same at every step; None where none was found, or the noise depends on the state.
    """
    if shocks.sizes is not None or shocks.laplace:
        return None
    low, high = box_around(active_at(problem.constraints, 0), dynamics.n, 0)
    spread = max(REACH, shocks.reach) * (np.sqrt(shocks.sigma.hi**2 + shocks.factor.mag**2) * (1 + 1e-12))
    start, free = start_box(problem), (np.isinf(low), np.isinf(high))
    first, last = np.where(free[0], start[0], low), np.where(free[1], start[1], high)
    for more in 1.2 * 2 ** np.linspace(0, 10, _GROWTHS):  # a limit that is approached is passed at last
        below, above = _next_reach(dynamics, 0, low, high, (first, last), spread)
        grown = free[0] * np.maximum(first - below, 0.0), free[1] * np.maximum(above - last, 0.0)
        if not np.any(grown):
            return first, last
        if not np.all(np.sum(grown, axis=0) < _MOST_GROWN * spread):
            return None
        first, last = first - more * grown[0] - 1e-9 * spread, last + more * grown[1] + 1e-9 * spread
    return None


def _next_reach(
    dynamics: Dynamics, t: int, low: Array, high: Array, reach: tuple[Array, Array], spread: Array
) -> tuple[Array, Array]:
    """Where the states in the box can get to in one step, but for the noise's tails."""
    first, last = np.maximum(low, reach[0]), np.minimum(high, reach[1])
    last = np.maximum(first, last)
    count = _COARSE[dynamics.n]
    step = dynamics.step(t, Grid(axes=tuple(np.linspace(a, b, count + 1) for a, b in zip(first, last))))
    if not all(part.defined.all() for part in step.cells):
        return np.full(dynamics.n, -np.inf), np.full(dynamics.n, np.inf)
    below, above = step.hull()
    ends = Interval(below, above) + Interval(-spread, spread)
    return ends.lo, ends.hi


def widths_of(
    problem: Problem, dynamics: Dynamics, shocks: Shocks, boxes: Boxes, t: int, when: int
) -> list[tuple[Array, Array]]:
    """Per axis places in the box of step t and the lengths over which phi changes: 1/sqrt(sum_k (J_ki/s_k)^2).

    In plain floats; J is that of step ``when``. Where the noise depends on the state, log s changes little as well.
    """
    n = problem.system.dimension
    count = {1: 257, 2: 33, 3: 13}[n]
    axes = [np.linspace(a, b, count) for a, b in zip(boxes.low[t], boxes.high[t])]
    points = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    disturbance = problem.system.disturbance
    middle = [] if disturbance is None else list((disturbance.low + disturbance.high) / 2)
    inputs = [] if problem.input_sequence is None else list(problem.input_sequence[when])
    slopes = compile_numpy(dynamics.slopes)(float(when), *points.T, *inputs, *middle)[:, :, :n]
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    sizes = shocks.sigma.mid if shocks.sizes is None else np.maximum(shocks.sizes(points), 1e-3 * shocks.sigma.mid)
    square = np.sum((slopes / sizes[..., :, None]) ** 2, axis=1).reshape([count] * n + [n])
    if shocks.sizes is not None:
        logs = np.log(sizes).reshape(square.shape)
        for i, axis in enumerate(axes):
            square[..., i] += _STEADY**2 * np.sum(np.gradient(logs, axis, axis=i) ** 2, axis=-1)
    found = []
    for i, axis in enumerate(axes):
        others = tuple(k for k in range(n) if k != i)
        rate = np.sqrt(square[..., i].mean(axis=others) if others else square[..., i])
        longest = (axis[-1] - axis[0]) / 4
        found.append((axis, 1 / np.maximum(rate, 1 / longest)))
    return found


def grid_of(
    low: Array, high: Array, lengths: list[tuple[Array, Array]], share: float, constraints: Sequence[Inside],
    target: Region | None, shocks: Shocks, t: int,
) -> Grid:  # fmt: skip
    """A grid whose cells are ``share`` of those lengths, finer where constraints do not follow the axes."""
    axes = []
    for i, (places, wanted) in enumerate(lengths):
        widths = share * wanted
        marks: list[float] = []
        for constraint in constraints:
            widths, more = _finer(constraint, i, places, widths, share / 3 * float(shocks.sigma.mid[i]), t)
            marks += more
        if target is not None:
            widths, more = _finer(Outside(target), i, places, widths, share / 3 * float(shocks.sigma.mid[i]), t)
            marks += more
        widths = np.maximum(widths, (high[i] - low[i]) / _MOST_PLACES)  # more are refused anyway
        axes.append(graded_axis(float(low[i]), float(high[i]), places, widths, marks))
    return Grid(axes=tuple(axes))


def _finer(
    constraint: Inside, axis: int, places: Array, widths: Array, fine: float, t: int
) -> tuple[Array, list[float]]:
    """Widths cut down along a round or slanted constraint, and faces that become nodes."""
    region = constraint.region
    used = region.places(region.dimension)
    if axis not in used:
        return widths, []
    place = used.index(axis)
    center = region.center_at(t)[place]
    match region.form:
        case Faces() as form:
            alone = [np.count_nonzero(row) == 1 for row in form.normals]
            rows = [(row[place], bound, one) for row, bound, one in zip(form.normals, form.bounds, alone) if row[place]]
            slanted = not all(one for _, _, one in rows)
            faces = [float(bound / entry + center) for entry, bound, one in rows if one]
            return (np.minimum(widths, fine) if slanted else widths), faces
        case Quadratic() as form:
            if not constraint.outside:
                return np.minimum(widths, fine), []
            half = float(form.radius * np.sqrt(form.shape[place, place]))
            near = np.abs(places - center) <= half + float(np.max(np.diff(places)))
            return np.where(near, np.minimum(widths, fine), widths), []


def start_grid(region: Region, lengths: list[tuple[Array, Array]], share: float) -> Grid:
    """A grid of its own over the starts, its cells no larger than .7 ``share`` of the least length there."""
    n, around = len(lengths), region.hull()
    low, high = around.lo, around.hi
    least = 1 if region.form.axial else {1: 1, 2: 24, 3: 10}[n]
    axes = []
    for i, (places, wanted) in enumerate(lengths):
        near = wanted[max(np.searchsorted(places, low[i]) - 1, 0) : np.searchsorted(places, high[i]) + 1]
        count = max(least, math.ceil((high[i] - low[i]) / (0.7 * share * float(near.min()))))
        axes.append(np.linspace(low[i], high[i], count + 1) if low[i] < high[i] else np.array([low[i], high[i]]))
    return Grid(axes=tuple(axes))


_SHARES = {
    1: (0.33, 0.15, 0.07, 0.035, 0.0175, 0.01),
    2: (0.5, 0.33, 0.22, 0.2, 0.15, 0.1, 0.07, 0.05, 0.035),
    3: (0.4, 0.17, 0.14, 0.1, 0.07),
}
"""Sizes of the cells that are tried, relative to the lengths over which the solution changes."""
_UNIFORM_SHARES = {
    1: (0.2, 0.07, 0.025, 0.01, 0.005),
    2: (0.3, 0.15, 0.07, 0.035, 0.02, 0.012),
    3: (0.5, 0.3, 0.2, 0.12),
}
_SCALED_SHARES = (0.33, 0.24, 0.18, 0.13, 0.1)
_CELL_SECONDS = 4e-6  # what a cell takes for one step, both bounds; measured once
_CUBIC_SHARES = {
    1: (0.33, 0.2, 0.12, 0.07, 0.035, 0.0175, 0.01),
    2: (0.43, 0.4, 0.37, 0.34, 0.3, 0.26, 0.22, 0.18, 0.15, 0.1, 0.07, 0.05, 0.035),
    3: (0.3, 0.26, 0.22, 0.19, 0.16, 0.13, 0.1, 0.07),
}
_ORDER, _UNIFORM_ORDER, _CUBIC_ORDER = 2.5, 2.0, 5.5
"""About the power of the cells' size with which the logarithm of upper over lower falls; measured."""
_COMMON_FACTOR = 20.0  # how much more that is with a common factor in the noise
_UNIFORM_FACTOR = 0.4
_SCALED_FACTOR = 8.0
_STEADY = 6.0  # by how much less noise may change over a cell than what it smoothes
_OVERHEAD = 250  # cells that every step is worth in addition
_NEARLY = 1.15  # times the share that would do
_WIDEST = 10.0  # upper over lower beyond which nothing is known of how it will fall


@dataclass(frozen=True, eq=False, kw_only=True)
class FailureBounds:
    """lower <= largest P(failure within the horizon) over starts and disturbances <= upper; a random start is averaged.

    Parameters
    ----------
    upper, lower : float
        Certified.
    cells : tuple of int
        Of the finest grid.
    share : float
        Its cells' size, relative to the lengths over which the solution changes.
    seconds : float
        Spent on all grids.
    tried : tuple of (float, float, float)
        Share, upper and lower of every grid.
    rate : (float, float), optional
        Of a long horizon: of what is still safe, within one step at least and at most this share leaves ...
    before : (int, float, float), optional
        ... after so many steps n, within which leaving has at least and at most these probabilities p:
        1 - (1 - p)(1 - rate)^(T - n) bounds P(leaving within T) for every T >= n.
    """

    upper: float
    lower: float
    cells: tuple[int, ...]
    share: float
    seconds: float
    tried: tuple[tuple[float, float, float], ...]
    rate: tuple[float, float] | None = None
    before: tuple[int, float, float] | None = None


def shares_of(states: int, shocks: Shocks, *, cubic: bool = False) -> list[float]:
    """Sizes of the cells that are tried, relative to the lengths over which the solution changes."""
    if cubic:
        return list(_CUBIC_SHARES[states])
    if shocks.sizes is not None:
        return list(_SCALED_SHARES)
    return list((_UNIFORM_SHARES if shocks.uniform else _SHARES)[states])


def seconds_of(layout: list[Grid], shocks: Shocks) -> float:
    """Seconds that the grids of all steps stand for, without disturbances."""
    rate = _CELL_SECONDS * (_COMMON_FACTOR if shocks.common else 1.0) * (_UNIFORM_FACTOR if shocks.uniform else 1.0)
    rate *= 1.0 if shocks.sizes is None else _SCALED_FACTOR
    return rate * sum(_OVERHEAD + math.prod(grid.shape) for grid in layout)


def order_of(shocks: Shocks, cubic: bool) -> float:
    """About the power of the cells' size with which the logarithm of upper over lower falls."""
    return _CUBIC_ORDER if cubic else _UNIFORM_ORDER if shocks.uniform else _ORDER


def without_hopeless(
    shares: list[float], last: tuple[float, float, float], ratio: float, order: float,
    affordable: Callable[[float], bool],
) -> list[float]:  # fmt: skip
    """The shares without those that would leave upper > ratio * lower, as long as the next one is affordable.

    Parameters
    ----------
    shares : list of float
        Falling; what is left to try.
    last : tuple of float
        The share of the last grid, upper and lower.
    ratio : float
        What is wanted.
    order : float
        As `order_of` has it.
    affordable : callable
        Whether a share may be tried.
    """
    share, upper, lower = last
    if not 0 < lower < upper < _WIDEST * lower:
        return shares
    wanted = share * (math.log(ratio) / math.log(upper / lower)) ** (1 / order)
    nearly = _NEARLY if order < _CUBIC_ORDER else 1.0
    while len(shares) > 1 and shares[0] > nearly * wanted and affordable(shares[1]):
        shares = shares[1:]
    return shares
