"""Linear models whose only noise is their start: the Gaussian mass of the starts whose paths fail."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.errors import EngineError
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.model import Tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.linear import Linearisation
from certbound.reach.remainder import hidden_jump
from certbound.reach.starts.cell_masses import StartBounds, StartCells
from certbound.reach.starts.crossed_limits import Limit
from certbound.reach.starts.drawn_directions import start_directions
from certbound.reach.starts.drawn_paths import node_maps, start_paths

_DIRECTIONS = 8  # that are cut into cells
_SKETCH = 300  # cells, from which the size of the probability is seen
_NODES = 400  # at which what matters is looked for
_MISSED = 1e-4  # of the probability: what the directions that are not cut may lie beyond their reach
_FARTHEST = 1e100  # standard deviations: squares of larger numbers overflow


def unserved(problem: Problem) -> str | None:
    """Why a random start is not averaged over in cells; None where it is."""
    box = problem.system.disturbance
    if not problem.initial.spread:
        return "the start is not random."
    if problem.endless or problem.reach is not None or problem.hold is not None:
        return "cells of a random start need a finite horizon, constraints only, and inputs that are not held."
    if box is not None and np.any(box.low < box.high):
        return "cells of a random start serve no disturbances; give each a value."
    return None


def is_silent(problem: Problem) -> bool:
    """Whether no noise comes after the start."""
    system = problem.system
    if isinstance(system, ContinuousSystem):
        return not isinstance(system.diffusion, Tape) and not np.any(system.diffusion)
    assert isinstance(system, DiscreteSystem)
    return not np.any(system.noise.proxy) or not np.any(np.asarray(system.noise_matrix))


def bound_silent_start(
    problem: Problem, *, most: int, enough: Callable[[StartBounds], bool],
    found: Callable[[StartBounds], object] = lambda bounds: None,
) -> StartBounds:
    """Bounds of the probability of failing over a normal start, for a linear model without noise after it.

    Proves: lower <= P(some constraint is broken within the horizon) <= upper.

    Parameters
    ----------
    most : int
        Cells.
    enough : callable
        Whether bounds need not be any closer.
    found : callable
        Takes bounds that hold already.

    Raises
    ------
    EngineError
        If the model is not linear, or something else does not fit; the message says what.
    """
    why = unserved(problem) or (None if is_silent(problem) else "cells of starts alone serve no noise after the start.")
    problem = problem if why else in_pieces(problem)
    why = why or hidden_jump(problem)
    if why:
        raise EngineError(why)
    engine = Linearisation.of(problem)
    if len(engine.model.active):
        raise EngineError("cells of a random start serve models that are linear in the state.")
    seen, missed = effects(problem, engine), _MISSED * problem.delta
    sketch = _cells(problem, engine, seen, missed)
    bounds = sketch.refine(_SKETCH, enough)
    found(bounds)
    if len(sketch.start.rest.T) and missed > _MISSED * bounds.upper:
        sketch = _cells(problem, engine, seen, max(_MISSED * bounds.upper, 1e-300))
    return sketch.refine(most, enough)


def _cells(problem: Problem, engine: Linearisation, seen: Array, missed: float) -> StartCells:
    start = start_directions(problem.initial, seen, most=_DIRECTIONS, missed=missed)
    paths, horizon = start_paths(engine, start), float(problem.horizon)
    kept = [Limit(constraint, paths, horizon) for constraint in problem.kept]
    broken = [] if problem.ending else kept[: len(problem.safe)]
    return StartCells(start, kept, broken)


def effects(problem: Problem, engine: Linearisation) -> Array:
    """Rows (m, n) over the start that say how constraints see it, where they are likeliest to be broken, in floats."""
    maps, nodes = node_maps(engine), engine.nodes[0]
    chosen = np.unique(np.linspace(0, len(nodes) - 1, min(len(nodes), _NODES)).round().astype(int))
    maps, nodes, times = maps[chosen], nodes[chosen], engine.times[chosen]
    spread = engine.response.covariance[0, chosen]
    found, sizes = [], []
    for constraint in problem.safe:
        region = constraint.region
        places = region.places(engine.n)
        local = nodes[:, places] - np.stack([region.center_at(float(t)) for t in times])
        if isinstance(region.form, Faces):
            rows, room = region.form.normals, local @ region.form.normals.T - region.form.bounds
        else:
            rows = region.form.root / max(region.form.radius, 1e-300)
            size = np.linalg.norm(local @ rows.T, axis=1)
            room = np.broadcast_to((size - 1)[:, None], (len(size), len(rows)))
        own = spread[np.ix_(range(len(spread)), places, places)]
        deviation = np.sqrt(np.maximum(np.einsum("ji,kil,jl->kj", rows, own, rows), 1e-300))
        first, last = (0.0, np.inf) if constraint.during is None else constraint.during
        apart = np.maximum(np.maximum(first - times, times - last), 0.0)  # a window may lie between two times
        far = np.where((apart == apart.min())[:, None], np.abs(room) / deviation, np.inf)
        far = np.minimum(far, _FARTHEST)
        unit = deviation[..., None] if isinstance(region.form, Faces) else 1.0  # of a round set: its own size
        found.append(np.einsum("ji,kil->kjl", rows, maps[:, places]) / unit)
        sizes.append(far)
    if not found:
        return np.eye(engine.n)
    nearest = min(float(far.min()) for far in sizes)
    weights = [np.exp(-0.25 * np.minimum(far**2 - nearest**2, 1e3)) for far in sizes]
    return np.concatenate([(w[..., None] * rows).reshape(-1, engine.n) for w, rows in zip(weights, found)])
