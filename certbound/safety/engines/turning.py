"""A problem in other coordinates y = T x, with T and its inverse exact in floats: nothing is rounded but the start.

X solves dX = f dt + g dW and breaks a constraint just where Y = T X solves dY = T f(T^-1 Y) dt + T g(T^-1 Y) dW and
breaks the same one, stated in y. The start is enclosed by a box, so that upper bounds are kept, and no lower ones.

Or y_i = log x_i for some states that limits keep positive: until one is broken Y_i = log X_i solves the equation that
Ito's formula gives, and the same paths break x_i <= b and y_i <= log b. Limits are rounded inward, starts outward.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.checks import assign
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy, in_logarithms, jacobian, turned_tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Faces, HalfSpace, Inside, Polytope, Region
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.balls import lower, precision, upper

_FINEST = 0.25  # of a turn of the dynamics, a first step
_ORDER = 8
_SWEEPS = 10
_MOST_DOUBLINGS = 60
_LONGEST = 300  # operations, which recursion goes through


def scales_of(problem: Problem) -> Array | None:
    """Exponents of powers of two near what the noise and the starts make of each state, in floats; None if unknown.

    The covariance along the dynamics at the middle of the starts, whose norm is that of balanced states.
    """
    system, n = problem.system, problem.system.dimension
    if not isinstance(system, ContinuousSystem) or not is_plain(problem) or not np.isfinite(problem.horizon):
        return None
    hull = problem.initial.hull()
    place = [np.float64(value) for value in (0.0, *(hull.lo + hull.hi) / 2)]
    signals = [box for box in (system.inputs, system.disturbance) if box is not None]
    missing = len(problem.closed_loop.inputs) - len(place)
    with np.errstate(all="ignore"):
        pushes = [np.nan_to_num(value) for box in signals for value in (box.low + box.high) / 2]
        pushes = pushes[len(pushes) - missing :]  # an input that follows the state is none
        slopes = np.asarray(compile_numpy(jacobian(problem.closed_loop, tuple(range(1, n + 1))))(*place, *pushes))
        given = system.diffusion
        gain = np.asarray(compile_numpy(given)(*place) if isinstance(given, Tape) else given, dtype=float)
        if not (np.isfinite(slopes).all() and np.isfinite(gain).all()):
            return None
        slopes = slopes.reshape(n, n)
        size = _balance(slopes)
        slopes = slopes * size / size[:, None]
        gain, radius = gain / size[:, None], (hull.hi - hull.lo) / 2 / size
        speed = float(np.abs(slopes).sum(axis=1).max()) * problem.horizon
        doublings = int(np.clip(np.ceil(np.log2(max(speed, 1.0) / _FINEST)), 0, _MOST_DOUBLINGS))
        step = problem.horizon / 2.0**doublings
        moved, spread = np.eye(n) + sum(_powers(slopes * step)), gain @ gain.T * step
        largest = np.diag(spread) + radius**2
        for _ in range(doublings + 1):
            found = np.diag(spread + (moved * radius**2) @ moved.T)
            if not np.isfinite(found).all():
                break
            largest = np.maximum(largest, found)
            spread, moved = spread + moved @ spread @ moved.T, moved @ moved
        extent = np.sqrt(largest) * size
    known = np.isfinite(extent) & (extent > 0)
    if not known.any():
        return None
    extent = np.where(known, extent, np.exp(np.log(extent[known]).mean()))
    return np.asarray(np.clip(np.round(np.log2(extent)), -900, 900).astype(int))


def is_plain(problem: Problem) -> bool:
    """Whether it has one set of starts, limits and a model that follows the state at once, and nothing else."""
    drawn = problem.ending or problem.initial.random or problem.random
    return not drawn and len(problem.starts) == 1 and problem.hold is None and problem.reach is None


def _powers(matrix: Array) -> Iterator[Array]:
    """A^k / k! from k = 1 on."""
    power = np.eye(len(matrix))
    for k in range(1, _ORDER + 1):
        power = power @ matrix / k
        yield power


def _balance(matrix: Array) -> Array:
    """Sizes D of states such that rows and columns of D^-1 A D are about as large (Osborne's sweeps)."""
    size, rest = np.ones(len(matrix)), np.abs(matrix * (1 - np.eye(len(matrix))))
    for _ in range(_SWEEPS):
        for i in range(len(matrix)):
            column, row = (rest[:, i] / size).sum() * size[i], (rest[i] * size).sum() / size[i]
            if column > 0 and row > 0:
                size[i] *= math.sqrt(row / column)
    return size


def exact_product(a: Array, b: Array) -> Array:
    """a b for matrices; InfeasibleError where an entry is no float."""
    columns = [[Fraction(x) for x in column] for column in np.asarray(b).T.tolist()]
    rows = [[sum((Fraction(x) * y for x, y in zip(row, column) if x), Fraction(0)) for column in columns]
            for row in np.asarray(a).tolist()]  # fmt: skip
    found = np.array([[float(x) for x in row] for row in rows]).reshape(len(rows), len(columns))
    if any(Fraction(y) != x for row, own in zip(rows, found.tolist()) for x, y in zip(row, own)):
        raise InfeasibleError("the problem is not exact in other coordinates: a product of its numbers is no float.")
    return found


def turned_problem(problem: Problem, matrix: Array, inverse: Array) -> Problem:
    """The problem of y = T x.

    Proves: P(failing) is at most the largest probability of failing in y.

    Raises
    ------
    InfeasibleError
        If T and its inverse are not, or the problem cannot be stated exactly in y.
    """
    system, n = problem.system, problem.system.dimension
    if not np.array_equal(exact_product(matrix, inverse), np.eye(n)):
        raise InfeasibleError("the matrices of other coordinates must be inverse to each other.")
    if not isinstance(system, ContinuousSystem) or not is_plain(problem):
        raise InfeasibleError("other coordinates serve plain problems in continuous time.")
    moved = {j for j in range(n) if np.any(inverse[j] != np.eye(n)[j])}
    if problem.domain is not None and any(np.isfinite([problem.domain.low[j], problem.domain.high[j]]).any()
                                          for j in moved):  # fmt: skip
        raise InfeasibleError("the domain bounds a state that other coordinates replace.")
    law, signals = isinstance(problem.plan, Tape), _signals(problem)
    turned = ContinuousSystem(
        turned_tape(problem.closed_loop, inverse, matrix)[0], states=system.states,
        diffusion=_diffusion(system.diffusion, matrix, inverse), **signals,
    )  # fmt: skip
    assign(turned, turn=matrix)
    safe = [_constraint(one, inverse, moved) for one in problem.safe]
    start, plan = _start(problem, matrix), None if law else problem.plan
    try:
        return problem.replace(system=turned, initial=start, safe=safe, plan=plan, cost=None, units=None)
    except ValueError as error:
        raise InfeasibleError(f"a box around the starts in other coordinates is too large: {error}") from error


def _signals(problem: Problem) -> dict[str, Any]:
    """The inputs that no law replaces, and the disturbances."""
    system, found = problem.system, dict[str, Any]()
    if system.inputs is not None and not isinstance(problem.plan, Tape):
        found |= {"inputs": system.inputs, "input_names": system.input_names}
    if system.disturbance is not None:
        found |= {"disturbance": system.disturbance, "disturbance_names": system.disturbance_names}
    return found


def _diffusion(diffusion: Array | Tape, matrix: Array, inverse: Array) -> Array | Tape:
    if not isinstance(diffusion, Tape):
        return exact_product(matrix, diffusion)
    tape = turned_tape(diffusion, inverse, matrix)[0]
    if all(node.op != "input" for node in tape.nodes):
        raise InfeasibleError("the noise does not depend on the state in other coordinates, which is not stated so.")
    return tape


def _start(problem: Problem, matrix: Array) -> Box:
    """A box around the starts, rounded outward."""
    hull = problem.initial.hull()
    ends = [[Fraction(x) for x in side.tolist()] for side in (hull.lo, hull.hi)]
    low, high = [], []
    for row in matrix.tolist():
        parts = [(Fraction(c), a, b) if c > 0 else (Fraction(c), b, a) for c, a, b in zip(row, *ends) if c]
        low.append(_outward(sum((c * a for c, a, _ in parts), Fraction(0)), -math.inf))
        high.append(_outward(sum((c * b for c, _, b in parts), Fraction(0)), math.inf))
    return Box(low, high)


def _outward(value: Fraction, side: float) -> float:
    found = float(value)
    beyond = Fraction(found) >= value if side > 0 else Fraction(found) <= value
    return found if beyond else math.nextafter(found, side)


def _constraint(constraint: Inside, inverse: Array, moved: set[int]) -> Inside:
    region: Region = constraint.region
    n = len(inverse)
    if not moved & set(region.places(n)) or (isinstance(region.form, Faces) and not len(region.form.bounds)):
        return constraint
    if not isinstance(region.form, Faces) or region.moving or np.any(region.center_at()):
        raise InfeasibleError(f"'{constraint.label}' is not stated in other coordinates: it is round, or moves.")
    rows, bounds = exact_product(region.lifted(region.form.normals, n), inverse), region.form.bounds
    turned = HalfSpace(rows[0], bounds[0]) if region.kind == "halfspace" else Polytope(rows, bounds)
    return type(constraint)(turned, during=constraint.during, label=constraint.label)


def logarithmic(problem: Problem, *, below: bool = False) -> tuple[tuple[int, ...], Problem] | None:
    """The states that are stated by their logarithms, and the problem stated so; None where there are none.

    Proves: P(failing) is at most the largest probability of failing in the problem that is returned; with ``below`` it
    is at least that, as fewer paths start there and limits are wider.

    Raises
    ------
    InfeasibleError
        If the problem cannot be stated so: a start has no room once it is rounded, say.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: 0.1 * x, states=["price"], diffusion=lambda x: [[0.2 * x[0]]])
    >>> problem = cb.Problem(system, initial=[1.0], safe=[cb.Inside(cb.Box([0.5], [2.0]))], horizon=1.0)
    >>> places, stated = logarithmic(problem)
    >>> places, stated.system.diffusion.tolist(), round(float(stated.safe[0].region.high[0]), 3)
    ((0,), [[0.2]], 0.693)
    """
    system, n = problem.system, problem.system.dimension
    if not isinstance(system, ContinuousSystem) or not isinstance(system.diffusion, Tape) or not is_plain(problem):
        return None
    if problem.domain is not None or not np.isfinite(problem.horizon):
        return None
    if max(len(system.diffusion.nodes), len(problem.closed_loop.nodes)) > _LONGEST:
        return None
    positive, barred = _limited(problem)
    found = in_logarithms(problem.closed_loop, system.diffusion, positive - barred)
    if found is None:
        return None
    places, dynamics, diffusion = found
    law = isinstance(problem.plan, Tape)
    names, signals = tuple(f"log_{x}" if i in places else x for i, x in enumerate(system.states)), _signals(problem)
    given: Array | Tape = diffusion
    constants = [diffusion.nodes[output] for output in diffusion.outputs]
    if all(node.op == "const" for node in constants):
        given = np.array([node.value for node in constants]).reshape(diffusion.shape)
    elif all(node.op != "input" for node in diffusion.nodes):
        raise InfeasibleError("the noise is constant in logarithms, which is not stated so.")
    try:
        turned = ContinuousSystem(
            replace(dynamics, inputs=("t", *names, *dynamics.inputs[n + 1 :])), states=names,
            diffusion=replace(given, inputs=("t", *names)) if isinstance(given, Tape) else given, **signals,
        )  # fmt: skip
        return places, problem.replace(
            system=turned, initial=_start_by(problem, places, below),
            safe=[_image(one, places, n, below) for one in problem.safe],
            plan=None if law else problem.plan, cost=None, units=None,
        )  # fmt: skip
    except ValueError as error:
        raise InfeasibleError(f"the problem is not stated in logarithms: {error}") from error


def plainly(reason: str) -> str:
    """Words about a problem in logarithms, its limits as those of the states themselves."""
    return re.sub(
        r"'log_(\w+) (<=|>=) ([-+.\de]+)'",
        lambda side: f"'{side[1]} {side[2]} {math.exp(float(side[3])):.5g}'", reason,
    )  # fmt: skip


def _limited(problem: Problem) -> tuple[set[int], set[int]]:
    """States that a limit for all time keeps positive, and states that some limit asks for in another way."""
    n = problem.system.dimension
    positive, barred = set[int](), set[int]()
    for constraint in problem.safe:
        region: Region = constraint.region
        flat = isinstance(region.form, Faces) and region.kind in ("box", "halfspace", "polytope")
        if not flat or region.moving or np.any(region.center_at()):
            barred |= set(region.places(n))
            continue
        assert isinstance(region.form, Faces)
        for row, bound in zip(region.lifted(region.form.normals, n), region.form.bounds):
            own = np.flatnonzero(row).tolist()
            if len(own) > 1:
                barred |= set(own)
            elif row[own[0]] < 0 and bound < 0 and not constraint.outside and constraint.during is None:
                positive.add(own[0])
            elif bound * row[own[0]] <= 0:
                barred.add(own[0])
    return positive, barred


def _log(value: arb, *, up: bool) -> float:
    with precision():
        return upper(value.log()) if up else lower(value.log())


def _start_by(problem: Problem, places: tuple[int, ...], below: bool) -> Box:
    """A box around the starts, rounded outward, or one of starts alone where it is for a bound from ``below``."""
    hull, start = problem.initial.hull(), problem.initial
    low, high = hull.lo.copy(), hull.hi.copy()
    if below and not (isinstance(start, Box) and np.array_equal([low, high], [start.low, start.high])):
        raise InfeasibleError("the starts are no box.")
    for i in places:
        if not low[i] > 0:
            raise InfeasibleError("a start is not positive.")
        low[i], high[i] = _log(arb(low[i]), up=below), _log(arb(high[i]), up=not below)
        if low[i] > high[i]:
            raise InfeasibleError("no logarithm of a start is a floating-point number.")
    return Box(low, high)


def _image(constraint: Inside, places: tuple[int, ...], n: int, below: bool) -> Inside:
    region: Region = constraint.region
    if not set(places) & set(region.places(n)):
        return constraint
    assert isinstance(region.form, Faces)
    rows, bounds = region.lifted(region.form.normals, n).copy(), region.form.bounds.copy()
    for number, row in enumerate(rows):
        i = int(np.flatnonzero(row)[0])
        if i in places:
            with precision():
                end = arb(float(bounds[number])) / arb(float(row[i]))
            positive = bool(row[i] > 0)
            side = _log(end, up=(constraint.outside == positive) != below)
            rows[number], bounds[number] = 0.0, side if positive else -side
            rows[number, i] = 1.0 if positive else -1.0
    if region.kind == "box":
        low, high = np.full(n, -math.inf), np.full(n, math.inf)
        for row, bound in zip(rows, bounds):
            i = int(np.flatnonzero(row)[0])
            low[i], high[i] = (low[i], bound) if row[i] > 0 else (-bound, high[i])
        kept = list(region.places(n))
        stated: Any = Box(low[kept], high[kept], coordinates=region.coordinates)
    else:
        stated = HalfSpace(rows[0], bounds[0]) if region.kind == "halfspace" else Polytope(rows, bounds)
    return type(constraint)(stated, during=constraint.during, label=constraint.label)
