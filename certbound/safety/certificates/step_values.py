"""Proofs by value functions in discrete time as data.

The grids are all: from them the checker finds the value functions itself, step by step backward. For normal and uniform
noise that moves every state it has polynomials of a higher degree than the engine's, so that its cells may be larger;
for other noise constants on cells (``pieces``).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.model import JUMPS, compile_numpy
from certbound.problem.noise import Law
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside
from certbound.problem.systems import DiscreteSystem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.values.chains import bound_chain, chain_grid
from certbound.values.discrete import FailureBounds, step_grids
from certbound.values.grids import Grid
from certbound.values.sets import active_at

ROOMS = (0.05, 0.15, 0.5)
"""What a claim leaves to the checker, effort after effort."""
INWARD = 1e-13
"""Of a side of the grid: its faces must lie in the safe set, whatever has been rounded."""
_SHARES = {1: (0.42, 0.3, 0.2), 2: (0.55, 0.4, 0.28), 3: (0.8, 0.6, 0.45)}
_UNIFORM_SHARES = (0.03, 0.01, 0.004)
_SIDES = {1: (400, 1600, 4800), 2: (40, 80, 160)}  # cells along each side, where noise is cut into pieces ...
_PIECES = {1: 0.8, 2: 0.4}  # ... so many for each of them, by the number of entries
_PARTS = (12, 24, 48)  # of one disturbance; of several, their product
_STARTS = ("box", "ball", "ellipsoid")  # sets of which lower bounds state points
_ALONG = {1: 9, 2: 5, 3: 3}  # of these, along each side of a box, by the number of states
_FARTHEST = 60.0  # standard deviations of the noise for which a cell reaches beyond the safe set
_BEYOND = 1000.0  # lengths of a side for which it does where these are not known
_LOOKED = 2000  # parts of an axis in which a jump is looked for
_NARROW = 1e-6  # half of a cell at a jump, of the length of an axis: with less the checker loses digits
_SLIVER = 1e-6  # of the length of an axis
_MOST_LOOKS = 5e7  # cells, times pieces of the noise, times steps, in two states: about a minute of the checker
_MOST_STEPS = 2000  # that the checker looks at
_MOST_CELLS, _COARSENED = 99_000, 8  # of a grid: the checker takes 100 000, and at jumps there are some more
_MORE = 1.25  # times the steps after which the engine's bounds were close


def induction_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0, *, lower: bool = False) -> Proof:
    """The proof's data, the claimed log10 of the probability (with ``lower``: of the lower bound), no assumptions.

    CertificateError where the checker knows no proof of what was bounded.
    """
    effort = min(attempt, len(ROOMS) - 1)
    if lower:
        check_starts(problem)
    steps = _steps(problem, answer.details)
    grids, pieces = _grids(problem, effort, steps)
    if pieces and effort == 0 and problem.horizon == steps:
        _check_pieces(problem, answer, lower)
    ends = partial(_outward, problem, bool(pieces)) if lower else partial(_inward, problem)
    jumps = _jumps(problem, grids[-1])  # over which the checker counts the worst
    plain = problem.reach is None and not problem.ending and steps == problem.horizon and not pieces and not any(jumps)
    if lower and problem.reach is not None and problem.reach.stays:  # what is not surely there is not valued by W
        for axis, face, _ in _faces(Inside(problem.reach.region), 0):
            jumps[axis].append(face)

    def moved(grid: Grid, step: int) -> list[Array]:
        return [_around(edges, places) for edges, places in zip(ends(grid, step), jumps)]

    first = 0 if problem.initial.random else 1
    distinct = {id(grid): (grid, step) for step, grid in enumerate(grids) if step >= first}
    place = {key: k for k, key in enumerate(distinct)}
    data: dict[str, Any] = {
        "engine": "values",
        "parts": _parts(problem, _PARTS[effort]),
        "grids": [exact(list(moved(grid, step))) for grid, step in distinct.values()],
        "steps": [place[id(grid)] for grid in grids[first:]],
    }
    data |= {"count": steps} if steps != problem.horizon else {}
    data |= {"pieces": pieces} if pieces else {}
    data |= {"side": "lower"} if lower else {}
    if not problem.initial.random:
        data |= {"starts": exact(some_starts(problem))} if lower else {"splits": exact(_splits(problem, grids[0].axes))}
    return data, _level(problem, answer, ROOMS[effort] if plain else None, lower=lower), []


def _check_pieces(problem: Problem, answer: EngineAnswer, lower: bool) -> None:
    """Refuse what constants on cells, all that the checker knows of such noise, hardly show.

    Their error falls with the cells' size, which is a quarter of the coarsest one at last.
    """
    system = problem.system
    if not isinstance(system, DiscreteSystem) or system.dimension != 2:
        return
    if system.gain is None and not system.noise.gaussian:
        return
    coarse = bound_chain(problem, seconds=1e-3)
    level, found = 10 ** _level(problem, answer, None, lower=lower), answer.log10_lower if lower else answer.log10_delta
    at_last = (3 * 10 ** (found or 0.0) + (coarse.lower if lower else coarse.upper)) / 4
    if at_last < level if lower else at_last > level:
        raise CertificateError(
            "in two states the checker knows noise that the state multiplies, or that is not independent from state to "
            "state, by functions that are constant on cells, which on its finest grid would say about "
            f"{at_last:.2g}, not {level:.2g}; the bound stands without a certificate."
        )


def _level(problem: Problem, answer: EngineAnswer, room: float | None, *, lower: bool) -> float:
    """The claim; without a ``room`` hardly more than the answer to the question, as the checker's own bound counts."""
    found = answer.log10_lower if lower else answer.log10_delta
    assert found is not None
    if room is not None:
        return (claimed_below if lower else claimed)(found, problem.delta, room)
    asked = math.log10(problem.delta)
    settled = found > asked if lower else found <= asked
    if lower:
        return asked + min(1e-6, (found - asked) / 2) if settled else 2 * found - 0.3
    return asked + 1e-6 * (found - asked) if settled else found / 4


def _steps(problem: Problem, found: FailureBounds) -> int:
    """How many steps the proof looks at: all that count, or enough of them."""
    target, horizon = problem.reach, problem.horizon
    if target is not None and not target.stays and target.during is not None:
        horizon = target.during[1]
    if horizon <= _MOST_STEPS:
        return int(horizon)
    after = _MOST_STEPS if found.before is None else int(_MORE * found.before[0]) + 2
    return min(after, _MOST_STEPS)


def _grids(problem: Problem, effort: int, steps: int) -> tuple[list[Grid], int]:
    """The grids of all steps, and in how many pieces an entry of the noise is cut (0: in none)."""
    try:
        law, shares = _law_of(problem), _SHARES[problem.system.dimension]
        share = (shares if law.gaussian else _UNIFORM_SHARES)[effort]
        grids = _fitting(problem, share)
        return (grids if len(grids) > 1 else grids * (steps + 1))[: steps + 1], 0
    except (CertificateError, InfeasibleError) as error:
        n, entries = problem.system.dimension, problem.system.noise_dimension
        if n not in _SIDES or entries not in _PIECES:
            raise CertificateError(str(error)) from error
    side = _SIDES[n][effort]
    try:
        grid = chain_grid(problem.replace(horizon=steps) if problem.endless else problem, side)
    except InfeasibleError as error:
        raise CertificateError(str(error)) from error
    pieces = max(2 * int(_PIECES[entries] * side / 2), 24)
    if n == 2 and math.prod(grid.shape) * pieces**entries * steps > _MOST_LOOKS:
        raise CertificateError("the checker would look at a grid as fine as this bound needs for more than a minute.")
    return [grid] * (steps + 1), pieces


def _fitting(problem: Problem, share: float) -> list[Grid]:
    """The grids of all steps with cells of this share of the noise, or larger ones where they would be too many."""
    for _ in range(_COARSENED):
        grids = step_grids(problem, share, _MOST_STEPS)
        most = max(math.prod(grid.shape) for grid in grids)
        if most <= _MOST_CELLS:
            return grids
        share *= 1.1 * (most / _MOST_CELLS) ** (1 / problem.system.dimension)
    raise CertificateError(f"the checker looks at no grids of more than {_MOST_CELLS} cells.")


def _parts(problem: Problem, most: int) -> int:
    count = len(problem.system.disturbance_names)
    return max(2, round((most / problem.system.dimension) ** (1 / count))) if count else 1


def _inward(problem: Problem, grid: Grid, step: int) -> list[Array]:
    """The edges, the outermost ones moved inward by next to nothing; but for a domain that they must hold."""
    return list(grid.axes) if problem.ending else [stretched(_without_slivers(edges), -INWARD) for edges in grid.axes]


def _jumps(problem: Problem, grid: Grid) -> list[list[float]]:
    """Where the model jumps along every state while the others are in the middle; of no consequence but for the bound.

    A difference between neighbours that does not get smaller as they get closer.
    """
    system = problem.system
    gain = system.gain if isinstance(system, DiscreteSystem) else None
    tapes = [problem.closed_loop, *([] if gain is None else [gain])]
    if problem.input_sequence is not None or not any(node.op in JUMPS for tape in tapes for node in tape.nodes):
        return [[] for _ in grid.axes]
    box = system.disturbance
    pushes = [] if box is None else list((box.low + box.high) / 2)
    found = []
    for i, edges in enumerate(grid.axes):
        middle = [float(axis.mean()) for axis in grid.axes]

        def at(x: Array, i: int = i, middle: list[float] = middle) -> Array:
            states = [x if k == i else np.full(len(x), value) for k, value in enumerate(middle)]
            parts = [
                np.broadcast_to(compile_numpy(tape)(0.0, *states, *more), (len(x), *tape.shape)).reshape(len(x), -1)
                for tape, more in zip(tapes, (pushes, []))
            ]
            return np.concatenate(parts, axis=1)

        ends = np.linspace(edges[0], edges[-1], _LOOKED + 1)
        low, high = ends[:-1], ends[1:]  # without a gap, in which a jump might lie
        for _ in range(60):
            middles = (low + high) / 2
            left = np.abs(at(middles) - at(low)).sum(axis=1) >= np.abs(at(high) - at(middles)).sum(axis=1)
            low, high = np.where(left, low, middles), np.where(left, middles, high)
        far = np.abs(at(high) - at(low)).sum(axis=1) > 1e-9 * (edges[-1] - edges[0])
        found.append(sorted({float(place) for place in low[far]}))
    return found


def _around(edges: Array, places: Sequence[float]) -> Array:
    """The edges with one on both sides of some places: what lies between them is next to nothing."""
    off = _NARROW * (edges[-1] - edges[0])
    for place in places:
        if edges[0] + off < place < edges[-1] - off:
            edges = edges[np.abs(edges - place) > 2 * off]
            edges = np.sort(np.concatenate([edges, [place - off, place + off]]))
    return edges


def _without_slivers(edges: Array) -> Array:
    """The edges without cells at the ends that are next to nothing."""
    widths = np.diff(edges) > _SLIVER * (edges[-1] - edges[0])
    first, last = np.argmax(widths), len(widths) - np.argmax(widths[::-1])
    return edges[first : last + 1]


def _outward(problem: Problem, pieces: bool, grid: Grid, step: int) -> list[Array]:
    """The edges, those at faces moved to where the constraint is broken, and a cell beyond each end."""
    limits = problem.safe if problem.ending else problem.kept
    asked = [*active_at(limits, step), *([] if problem.reach is None else [Inside(problem.reach.region)])]
    faces = [face for constraint in asked for face in _faces(constraint, step)]
    found = []
    for i, edges in enumerate(grid.axes):
        edges = edges.copy() if problem.ending else _without_slivers(edges).copy()
        length = edges[-1] - edges[0]
        for axis, place, sign in faces:
            if axis == i:
                edges[np.abs(edges - place) <= INWARD * length] += 2 * sign * INWARD * length
        below, above = (_BEYOND * length,) * 2 if pieces else _past(problem, grid, step, i)
        found.append(edges if problem.ending else np.concatenate([[edges[0] - below], edges, [edges[-1] + above]]))
    return found


def _past(problem: Problem, grid: Grid, step: int, i: int) -> tuple[float, float]:
    """How far beyond a grid its images may get, along a state."""
    system, edges = problem.system, grid.axes[i]
    assert isinstance(system, DiscreteSystem)
    most = _FARTHEST * float(np.sqrt((system.noise_matrix @ system.noise.proxy @ system.noise_matrix.T)[i, i]))
    low, high = _images(problem, grid, step)
    below, above = (
        float(np.clip(most / 6 + gap, most / 6, most)) for gap in (edges[0] - low[i], high[i] - edges[-1])
    )
    return below, above


def _faces(constraint: Inside, step: int) -> Iterator[tuple[int, float, int]]:
    """(state, place, side on which the constraint is broken) of its faces across single states."""
    region, form = constraint.region, constraint.region.form
    if not isinstance(form, Faces):
        return
    center, places = region.center_at(step), region.places(region.dimension)
    for normal, bound in zip(form.normals, form.bounds):
        used = np.flatnonzero(normal)
        if len(used) == 1:
            sign = int(np.sign(normal[used[0]])) * (-1 if constraint.outside else 1)
            yield places[used[0]], float(bound / normal[used[0]] + center[used[0]]), sign


def _images(problem: Problem, grid: Grid, step: int) -> tuple[Array, Array]:
    """About the box that the nodes of a grid are led into; of no consequence but for how much is proved."""
    points = np.stack([axis.ravel() for axis in np.meshgrid(*grid.axes, indexing="ij")])
    rows = problem.input_sequence
    inputs = [] if rows is None else list(rows[min(step, len(rows) - 1)])
    box = problem.system.disturbance
    corners = [()] if box is None else itertools.product(*zip(box.low, box.high))
    move = compile_numpy(problem.closed_loop)
    with np.errstate(all="ignore"):
        found = np.concatenate([
            np.broadcast_to(move(float(step), *points, *inputs, *corner), (points.shape[1], len(points)))
            for corner in corners
        ])  # fmt: skip
    found = np.where(np.isfinite(found), found, points.mean())
    return found.min(axis=0), found.max(axis=0)


def _law_of(problem: Problem) -> Law:
    """The law of the noise, which the checker must know."""
    system = problem.system
    if isinstance(system, DiscreteSystem) and system.gain is not None:
        raise CertificateError("the checker knows value functions of noise that the state multiplies in two states.")
    if system.dimension > max(_SHARES):
        raise CertificateError(f"the checker knows value functions of at most {max(_SHARES)} states.")
    if not isinstance(system, DiscreteSystem) or not (system.noise.gaussian or system.noise.uniform):
        raise CertificateError("the checker knows value functions for normal and uniform noise only.")
    if system.noise.uniform and system.dimension > 1:
        raise CertificateError("the checker knows value functions for uniform noise in one state only.")
    if not _independent(system):
        raise CertificateError("the checker knows polynomials for noise only that is independent from state to state.")
    return system.noise


def _independent(system: DiscreteSystem) -> bool:
    """Whether each state has noise of its own."""
    covariance = np.asarray(system.noise_matrix) @ system.noise.proxy @ np.asarray(system.noise_matrix).T
    return not np.any(covariance - np.diag(np.diag(covariance)))


def _splits(problem: Problem, axes: tuple[Array, ...]) -> list[Any]:
    """Edges of cells that cover the starts, half as wide as those of the grid."""
    around = problem.initial.hull()
    most = {1: 64, 2: 12, 3: 6}[len(axes)]
    found = []
    for low, high, edges in zip(around.lo, around.hi, axes):
        inside = int(np.sum((edges > low) & (edges < high)))
        count = min(2 * (inside + 1), most) if low < high else 1
        row = [float(x) for x in np.linspace(low, high, count + 1)]
        found.append(sorted({float(low), *row, float(high)}) if low < high else [float(low), float(high)])
    return found


def some_starts(problem: Problem) -> list[Array]:
    """Points of the initial set, among them those from which failing is likely: its corners, or all around it."""
    data = problem.initial.data(_STARTS)
    if data["kind"] == "box":
        low, high = np.asarray(data["low"]), np.asarray(data["high"])
        count = _ALONG[len(low)]
        sides = [sorted({a, *np.linspace(a, b, count)[1:-1].tolist(), b}) for a, b in zip(low.tolist(), high.tolist())]
        return [np.array(point) for point in itertools.product(*sides)]
    center = np.asarray(data["center"], dtype=float)
    if data["kind"] == "ball":
        factor = float(data["radius"]) * np.eye(len(center))
    else:
        factor = np.linalg.cholesky(data["shape"])
    rows = np.array(list(itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=len(center))))
    sizes = np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1.0)
    return list(center + (1 - 1e-9) * (rows / sizes) @ factor.T)


def check_starts(problem: Problem) -> None:
    """Refuse starts of which lower bounds state no points, with a CertificateError."""
    if not problem.initial.random and problem.initial.data(_STARTS)["kind"] not in _STARTS:
        raise CertificateError("lower bounds are stated from starts in a box, a ball or an ellipsoid, or normal ones.")


def stretched(edges: Array, share: float) -> Array:
    """The edges, the outermost ones moved outward by a share of the whole length."""
    step = share * (edges[-1] - edges[0])
    return np.concatenate([[edges[0] - step], edges[1:-1], [edges[-1] + step]])


def claimed(log10: float, delta: float, share: float) -> float:
    """log10 of a probability a little above, and not above delta where the other was not."""
    room = share * max(1.0, -0.1 * log10)
    left = math.log10(delta) - log10
    return min(log10 + (min(room, left / 2) if left > 0 else room), 0.0)


def claimed_below(log10: float, delta: float, share: float) -> float:
    """log10 of a probability a little below, and above delta where the other was."""
    room = share * max(1.0, -0.1 * log10)
    left = log10 - math.log10(delta)
    return log10 - (min(room, left / 2) if left > 0 else room)
