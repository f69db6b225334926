"""What a tube takes from every face along a plan, in floating point: the tightening that the optimiser sees.

Two kinds of tube: a ball of a metric (tubes from constants; with what the initial set and the disturbance add to it),
and the linear response, whose sets depend on the plan. The verdict on the plan proves everything again.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.gaussian.response import StepEvents, level_scale
from certbound.problem.model import Tape, compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Quadratic
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.linear import Events, Linearisation, LinearRun, Share
from certbound.reach.nominal import initial_cells
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm
from certbound.synthesis.faces import Face
from certbound.synthesis.plant import Grid, Plant
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube

Rows = Callable[[Array, Array], Array]

CORNERS = 8
"""Most disturbances whose boxes are looked at corner by corner."""
NONLINEAR_SHARE = 0.1
"""Part of delta that the linear response spends on the coordinates that enter nonlinearly."""


class Tightening:
    """Extents of a tube along rows: what deviations can do, a . S at most."""

    def extents(self, rows: Rows, states: Array, times: Array, key: object = None) -> Array:
        """Extent along rows(states, times), (K, R, n), at every one of K points: shape (K, R).

        ``key`` names the rows, so that what was found for them may be used again.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class BallTube(Tightening):
    """{||S||_P <= radii[k]} at point k; ``inverse`` is P^-1."""

    radii: Array
    inverse: Array

    def extents(self, rows: Rows, states: Array, times: Array, key: object = None) -> Array:
        a = rows(states, times)
        size = np.sqrt(np.maximum(np.einsum("kri,ij,krj->kr", a, self.inverse, a), 0.0))
        return np.asarray(self.radii[:, None] * size)


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaledTube(Tightening):
    """Standard deviations of a linearised model, covariance (K, n, n): a shape to begin with."""

    covariance: Array

    def extents(self, rows: Rows, states: Array, times: Array, key: object = None) -> Array:
        a = rows(states, times)
        return np.asarray(np.sqrt(np.maximum(np.einsum("kri,kij,krj->kr", a, self.covariance, a), 0.0)))


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearTube(Tightening):
    """Extents of the linear response (Thm K7) along a plan, each row's level costing exp(log_share).

    In continuous time, where a level costs most to find, the rows of one face share that of their largest one, and
    ``factors`` keeps it (in standard deviations) from plan to plan: it hardly changes.
    """

    run: LinearRun
    bounds: tuple[Array, Array]
    events: Events
    log_share: float
    factors: dict[object, float]

    def extents(self, rows: Rows, states: Array, times: Array, key: object = None) -> Array:
        engine = self.run.engine
        nodes = engine.nodes[0]
        at = engine.times if not engine.continuous else (engine.times[:-1] + engine.times[1:]) / 2
        middle = nodes if not engine.continuous else (nodes[:-1] + nodes[1:]) / 2
        a = np.ascontiguousarray(rows(middle, at))
        support = engine.supports(0, a)
        _, high, _ = support.remainder(self.bounds[0][0], self.bounds[1][0])
        taken = support.y + high
        taken += self._levels(a, key)
        if not engine.continuous:
            return np.asarray(taken[np.round(times).astype(int)])
        place = times / engine.step
        before = np.clip(np.ceil(place - 1e-9).astype(int) - 1, 0, engine.pieces - 1)
        after = np.clip(np.floor(place + 1e-9).astype(int), 0, engine.pieces - 1)
        return np.asarray(np.maximum(taken[before], taken[after]))

    def _levels(self, rows: Array, key: object) -> Array:
        """Levels of Z along rows (N, R, n): a factor times the standard deviation."""
        if isinstance(self.events, StepEvents):
            steps = [self.events.along(rows[:, index]) for index in range(rows.shape[1])]
            return np.stack([event.capped(self._factor(event) * event.profile) for event in steps], axis=1)
        events = [self.events.along(rows[:, index]) for index in range(rows.shape[1])]
        shapes = np.stack([event.profile for event in events], axis=1)
        if key not in self.factors:
            self.factors[key] = self._factor(events[int(np.argmax(shapes.max(axis=0)))])
        return np.asarray(shapes * self.factors[key])

    def _factor(self, event: Any) -> float:
        """Standard deviations that a level takes; a guess (the union bound over the pieces) where none is proved."""
        if event.profile.max() <= 0:
            return 0.0
        found = level_scale(event, event.profile, self.log_share)
        return found if np.isfinite(found) else float(np.sqrt(2 * (np.log(2 * len(event.profile)) - self.log_share)))


def tighten(tube: Tightening, faces: Sequence[Face], states: Array, times: Array) -> Array:
    """Erosions (points, parts) of all faces at the points behind the start."""
    found = [face.erosion(tube.extents(face.rows, states[1:], times[1:], key)) for key, face in enumerate(faces)]
    return np.concatenate(found, axis=1) if found else np.zeros((len(times) - 1, 0))


def linear_tube(problem: Problem, rows: int, delta: float, factors: dict[object, float]) -> LinearTube | None:
    """The linear response along the problem's plan for ``rows`` one-sided rows; None where it feeds itself."""
    run = LinearRun(Linearisation.of(problem))
    levels, events = run.levels(Share.of(delta * NONLINEAR_SHARE))
    with np.errstate(all="ignore"):
        bounds = run.include(levels, 1)
    if bounds is None:
        return None
    share = Share.of(delta * (1 - NONLINEAR_SHARE) / max(rows, 1))
    return LinearTube(run=run, bounds=bounds, events=events[0], log_share=share.log, factors=factors)


def spread_tube(problem: Problem, plant: Plant, grid: Grid, states: Array, inputs: Array) -> ScaledTube:
    """Covariance of the linearised deviation along a plan, the initial set as if it were random."""
    n = plant.dimension
    slope = compile_numpy(jacobian(plant.dynamics, range(1, 1 + n)))
    times = grid.times()
    held = np.repeat(inputs, grid.substeps, axis=0)
    values = slope(times[:-1], *states[:-1].T, *held.T, *(np.full(grid.points, d) for d in plant.disturbance))
    step = grid.step / grid.substeps
    covariance = _start_covariance(problem.initial)
    found = []
    for k in range(grid.points):
        j = values[k] if not grid.continuous else np.eye(n) + step * values[k] + step**2 / 2 * values[k] @ values[k]
        covariance = np.clip(j @ covariance @ j.T, -1e12, 1e12) + step * _noise(problem, float(times[k]), states[k])
        found.append(covariance)
    stack = np.array(found)
    floor = 1e-6 * max(float(np.trace(stack, axis1=1, axis2=2).max()), 1e-6)
    return ScaledTube(covariance=stack + floor * np.eye(n))


def _noise(problem: Problem, time: float, state: Array) -> Array:
    system = problem.system
    if isinstance(system, DiscreteSystem):
        g = np.asarray(system.noise_matrix)
        return np.asarray(g @ np.asarray(system.noise.proxy) @ g.T)
    assert isinstance(system, ContinuousSystem)
    diffusion = system.diffusion
    matrix = compile_numpy(diffusion)(time, *state) if isinstance(diffusion, Tape) else np.asarray(diffusion)
    return np.asarray(matrix @ matrix.T)


def _start_covariance(initial: Any) -> Array:
    if initial.random:
        return np.asarray(initial.covariance, dtype=float)
    if isinstance(initial.form, Quadratic):
        return np.asarray(initial.form.matrix / 9)
    around = initial.hull()
    return np.diag(((around.hi - around.lo) / 2) ** 2) / 9


def nominal_spread(
    problem: Problem, plant: Plant, grid: Grid, constants: Constants, states: Array, inputs: Array
) -> Array:
    """rho (points + 1,) with ||x_t - z_t||_P <= rho for every start and disturbance (Thm K5, in floating point)."""
    norm, slope = constants.norm, constants.worst_slope
    step = grid.step / grid.substeps
    start = np.atleast_2d(problem.initial.middle)
    found = [float(initial_cells(problem).radii(norm, Interval.point(start))[0])]
    held = np.repeat(inputs, grid.substeps, axis=0)
    for k in range(grid.points):
        push = _push(norm, problem.system.disturbance, plant, np.array([k * step, *states[k], *held[k]]))
        if grid.continuous:
            growth = np.expm1(slope * step) / slope if abs(slope) > 1e-12 else step
            found.append(float(np.exp(slope * step) * found[-1] + growth * push))
        else:
            found.append(slope * found[-1] + push)
    return np.array(found)


def _push(norm: Norm, box: Box | None, plant: Plant, point: Array) -> float:
    """||f(point, d) - f(point, d0)||_P at most: over all corners of the disturbance's box, over its image if many."""
    if box is None:
        return 0.0
    base = plant.evaluate(*point, *plant.disturbance)
    if box.dimension <= CORNERS:
        corners = np.array(list(itertools.product(*zip(box.low, box.high))))
        moved = Interval.point(plant.evaluate(*point, *corners.T))
    else:
        slots = Interval(np.concatenate([point, box.low]), np.concatenate([point, box.high]))
        moved = enclose(plant.dynamics, [slots[k] for k in range(len(slots))], undefined="infinite").reshape(1, -1)
    return float(np.max(norm.length(moved - base)))


def ball_tube(tube: Tube, grid: Grid, spread: Array) -> BallTube:
    """A tube from constants as balls at the points, widened by the noise-free spread (points + 1,)."""
    times = np.minimum(grid.times(), tube.horizon)
    radius = np.asarray(tube.radius(np.round(times) if not grid.continuous else times))
    total = radius + spread
    if grid.continuous:  # a piece counts from end to end
        total = np.maximum(total, np.append(total[1:], total[-1]))
    return BallTube(radii=total[1:], inverse=tube.constants.inverse)
