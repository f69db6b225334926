"""A problem whose model is affine with constant coefficients and additive noise, as a law in balls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import arb, arb_mat

from certbound.errors import InfeasibleError
from certbound.gaussian.affine import AffineLaw, Limit
from certbound.problem.model import Tape, edged, jacobian, reads, varying_outputs
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Faces
from certbound.problem.systems import ContinuousSystem
from certbound.reach.sets import limit_names

_MOST_STATES, _MOST_DRIVEN = 250, 80  # and where noise drives a limit's row itself, which takes covariance matrices

BALLS: dict[str, Callable[..., arb]] = {
    "const": arb, "neg": lambda x: -x, "add": lambda x, y: x + y, "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y, "div": lambda x, y: x / y, "sq": lambda x: x * x, "sqrt": arb.sqrt, "exp": arb.exp,
    "log": arb.log, "sin": arb.sin, "cos": arb.cos, "tan": arb.tan, "asin": arb.asin, "acos": arb.acos,
    "atan": arb.atan, "sinh": arb.sinh, "cosh": arb.cosh, "tanh": arb.tanh, "abs": abs,
    "pow": lambda x, y: x ** arb(y),
}  # fmt: skip
"""What constants of a model are made with; a model that uses anything else is left to other engines."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineModel:
    """Rows of the limits' directions, and the limits: their ``names``, and numbers of constraint and limit."""

    problem: Problem
    rows: tuple[tuple[float, ...], ...]
    limits: tuple[Limit, ...]
    names: tuple[str, ...]
    places: tuple[tuple[int, int], ...]
    extended: bool  # whether a state that is always 1 carries what is constant

    def law(self) -> AffineLaw:
        """The law at the working precision of balls."""
        problem, n = self.problem, self.problem.system.dimension
        system = problem.system
        assert isinstance(system, ContinuousSystem)
        size = n + self.extended
        box = system.disturbance
        middle = [] if box is None else [(arb(a) + arb(b)) / 2 for a, b in zip(box.low.tolist(), box.high.tolist())]
        slope = _values(problem, middle, jacobian(problem.closed_loop, columns=tuple(range(1, n + 1))))
        constant = _values(problem, middle, problem.closed_loop)
        entries = [[slope[i * n + j] for j in range(n)] + [constant[i]] * self.extended for i in range(n)]
        entries += [[arb(0)] * size] * self.extended
        noise = np.zeros((size, np.shape(system.diffusion)[1]))
        noise[:n] = system.diffusion
        start = problem.initial
        mean = [arb(float(x)) for x in np.asarray(start.middle)] + [arb(1)] * self.extended
        starts = covariance = None
        if start.random:
            covariance = arb_mat(_padded(np.asarray(start.covariance, dtype=float), size).tolist())
        elif not problem.fixed_start:
            hull = start.hull()
            mean[:n] = [(arb(a) + arb(b)) / 2 for a, b in zip(hull.lo.tolist(), hull.hi.tolist())]
            wide = [i for i in range(n) if hull.hi[i] > hull.lo[i]]
            starts = arb_mat(size, len(wide))
            for column, i in enumerate(wide):
                starts[i, column] = (arb(float(hull.hi[i])) - arb(float(hull.lo[i]))) / 2
        disturbances: list[arb_mat] = []
        if box is not None:
            gains = _values(problem, middle, _by_disturbances(problem))
            count = len(middle)
            for j, (a, b) in enumerate(zip(box.low.tolist(), box.high.tolist())):
                push = arb_mat(size, 1)
                for i in range(n):
                    push[i, 0] = gains[i * count + j] * (arb(b) - arb(a)) / 2
                disturbances.append(push)
        return AffineLaw(
            slope=arb_mat(entries), noise=arb_mat(noise.tolist()), horizon=float(problem.horizon),
            mean=arb_mat([[x] for x in mean]), starts=starts, covariance=covariance, disturbances=tuple(disturbances),
        )  # fmt: skip


def _padded(matrix: np.ndarray[Any, Any], size: int) -> np.ndarray[Any, Any]:
    result = np.zeros((size, size))
    result[: len(matrix), : len(matrix)] = matrix
    return result


def _by_disturbances(problem: Problem) -> Tape:
    box, tape = problem.system.disturbance, problem.closed_loop
    count = 0 if box is None else len(box.low)
    return jacobian(tape, columns=tuple(range(len(tape.inputs) - count, len(tape.inputs))))


def _values(problem: Problem, middle: list[arb], tape: Tape) -> list[arb]:
    """A tape's outputs in balls, with all states at 0, an array plan's only row and disturbances in their middle."""
    rows = problem.input_sequence
    inputs = [] if rows is None else [arb(float(x)) for x in rows[0]]
    slots = [arb(0)] * (1 + problem.system.dimension) + inputs + middle
    return tape.evaluate(BALLS, slots)


def affine_model(problem: Problem) -> AffineModel | None:
    """The problem as an affine law with limits; None where it is none, or its limits are no fixed half-spaces."""
    system = problem.system
    if not isinstance(system, ContinuousSystem) or isinstance(system.diffusion, Tape) or problem.hold is not None:
        return None
    if problem.reach is not None or problem.random or not math.isfinite(problem.horizon) or len(problem.starts) > 1:
        return None
    if system.inputs is not None and problem.plan is None:
        return None
    n = system.dimension
    rows = problem.input_sequence
    if n > _MOST_STATES or (rows is not None and np.any(rows != rows[0])):
        return None
    tape = problem.closed_loop
    if edged(tape) or any(varying_outputs(jacobian(tape, columns=tuple(range(1, n + 1))))):
        return None
    if any(varying_outputs(_by_disturbances(problem))) or any(0 in slots for slots in reads(tape)):
        return None
    limits = _limits(problem)
    if limits is None or not limits[1]:
        return None
    if n > _MOST_DRIVEN and any(np.any(np.asarray(row) @ np.asarray(system.diffusion)) for row in limits[0]):
        return None
    box = system.disturbance
    middle = [] if box is None else [(arb(a) + arb(b)) / 2 for a, b in zip(box.low.tolist(), box.high.tolist())]
    try:
        constant = _values(problem, middle, tape)
    except KeyError:  # an operation that is not looked at
        return None
    extended = not all(x.is_zero() for x in constant)
    directions = tuple((*row, 0.0) if extended else tuple(row) for row in limits[0])
    return AffineModel(
        problem=problem, rows=directions, limits=tuple(limits[1]), names=tuple(limits[2]), places=tuple(limits[3]),
        extended=extended,
    )


Found = tuple[list[tuple[float, ...]], list[Limit], list[str], list[tuple[int, int]]]


def _limits(problem: Problem) -> Found | None:
    """Directions, limits, their names and numbers; None where some constraint is no fixed polyhedron to stay in."""
    try:
        constraints = problem.constraints
    except InfeasibleError:
        return None
    rows: dict[tuple[float, ...], int] = {}
    limits, names, places = [], [], []
    for number, constraint in enumerate(constraints):
        region = constraint.region
        if not isinstance(region.form, Faces) or constraint.outside or region.changing or region.moving:
            return None
        centre = None if region.center is None else np.asarray(region.center)
        if centre is not None and np.any(centre != 0) and not isinstance(region, Box):
            return None
        if centre is not None and np.any(centre != 0):
            return None
        own = number if number < len(problem.safe) else -1
        named = limit_names(constraint, problem.system)
        for place, (normal, bound) in enumerate(zip(region.form.normals, region.form.bounds)):
            row = np.asarray(region.lifted(normal, problem.system.dimension), dtype=float) + 0.0
            first = row[np.flatnonzero(row)[0]] if np.any(row) else 1.0
            sign = 1 if first > 0 else -1
            key = tuple((sign * row + 0.0).tolist())
            direction = rows.setdefault(key, len(rows))
            limits.append(Limit(direction=direction, sign=sign, bound=float(bound), during=constraint.during))
            names.append(named[place])
            places.append((own, place))
    return list(rows), limits, names, places
