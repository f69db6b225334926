"""Two states: propose V, prove it, and hand what the proof had to pay back to the proposal as a source.

R, the residual, is bounded on every patch. Where it is positive the theorem pays for the worst patch of each slab all
over the plane, which is far too much where the worst ones lie in corners that hardly a path visits. With s >= R as a
source of V's equation the residual of the next proposal is about R - s <= 0, and u grows only by what a path meets on
its way out. The residual is sampled first and bounded later: all this is proposal, the proof is that of `hypotheses`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.values.continuous.hypotheses import (
    Model,
    covers,
    examine_upper,
    extreme_over,
    sampled_residual,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane_proposal import Pair, Plan, Plane, Source, propose_plane
from certbound.values.continuous.room import Room, starts_of
from certbound.values.continuous.surface import Surface

_FACTOR = 1.12
_TOP = -0.02  # where V is above, the proof may lift it over 0 instead
_CAP = 50.0


def two_states(
    problem: Problem, model: Model, room: Room, deadline: float
) -> tuple[float, None, str, list[tuple[Surface, Payment]]]:
    """Refine the upper bound until the time is spent; lower bounds in two states are not looked for."""
    starts = starts_of(problem)
    inner = _plane(problem, model, room.inner_low, room.inner_high, starts)
    level = _rough_level(inner)
    upper, done = 0.0, []
    proposed: list[tuple[Surface, Payment]] = []
    for plan in _plans(inner, level, 36 if deadline - time.perf_counter() < 15 else 50):
        begin = time.perf_counter()
        for surface, payment in _uppers(inner, model, starts, plan):
            if payment.log < upper:
                upper = payment.log
                proposed.append((surface, payment))
            if time.perf_counter() > deadline:
                break
        done.append(f"{plan.cells}^2")
        spent = time.perf_counter() - begin
        if time.perf_counter() + 2 * spent > deadline:
            break
    words = f"value function in two states, cells: {', '.join(done) or 'none came to an end'}"
    return upper, None, words, proposed


def _plans(plane: Plane, level: float, cells: int) -> Iterator[Plan]:
    growth, lead = 0.28 * (36 / cells) ** 0.6, 0.36 / cells
    for _ in range(5):
        yield Plan(cells=cells, growth=growth, lead=lead * plane.horizon, floor=level - 5)
        cells, growth, lead = int(1.35 * cells), growth / 1.2, lead * 0.8


def _rough_level(plane: Plane) -> float:
    """log P from a coarse proposal; the floor is lowered until it does not matter."""
    level = 0.0
    for floor in (-8.0, -20.0, -45.0):
        plan = Plan(cells=28, growth=0.4, lead=0.02 * plane.horizon, floor=floor)
        surface = propose_plane(plane, plan)
        if surface is None:
            continue
        level = min(level, float(extreme_over(surface, plane.starts, upper=True)))
        if level > floor + 2:
            break
    return level


def _uppers(plane: Plane, model: Model, starts: list[Pair], plan: Plan) -> Iterator[tuple[Surface, Payment]]:
    """Proved upper bounds, one after another."""
    surface = propose_plane(plane, plan)
    if surface is None:
        return
    source = _source(surface, *sampled_residual(surface, model))
    for attempt in range(2):
        better = propose_plane(plane, plan, source)
        if better is None and attempt:
            return
        candidate = better or surface  # without a better one the first one is proved as it is
        if not covers(candidate, plane.horizon, plane.low, plane.high, within=True):
            return
        payment, excess, low = examine_upper(candidate, model, starts)
        yield candidate, payment
        if better is None:
            return
        source = source.plus(_source(better, excess, low))


def _source(surface: Surface, excess: Array, low: Array) -> Source:
    needed = np.where(low < _TOP, np.clip(excess, 0.0, _CAP), 0.0)
    return Source.above(surface, _FACTOR * needed)


def _plane(
    problem: Problem, model: Model, low: tuple[float, ...], high: tuple[float, ...], starts: list[Pair]
) -> Plane:
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]

    def drifts(t: float, x: Array, y: Array) -> Array:
        return np.array([np.moveaxis(drift(t, x, y, *corner), -1, 0) for corner in corners])

    return Plane(
        low=(low[0], low[1]), high=(high[0], high[1]), horizon=float(problem.horizon), drift=drifts,
        square=lambda t, x, y: np.moveaxis(square(t, x, y), (-2, -1), (0, 1)), starts=starts,
        autonomous=model.autonomous,
    )  # fmt: skip
