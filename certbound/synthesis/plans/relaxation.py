"""Proofs that the eroded set cannot be kept: what infeasible means, as opposed to a solver that found no point.

For discrete-time systems the proof is a linear program: every node of the dynamics that is no affine function of
states and inputs is replaced by an unknown in its proved range (tanh lies in [-1, 1], whatever its argument), so that

    s <= max { s : a_j . z_k + s e_jk <= b_j, z+ = A z + B u + C q + c, u in its box, q in its ranges },

and the multipliers of the program that a solver proposes give a bound on that maximum by weak duality, evaluated in
ball arithmetic. A bound below 1 proves that no inputs keep the noise-free state in the eroded set.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, arb_mat, fmpq

from certbound.arrays import Array, Mask
from certbound.constants.enclosures import enclose
from certbound.errors import EnclosureError
from certbound.problem.model import Node, Tape
from certbound.problem.problem import Problem
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval
from certbound.synthesis.faces import Face, Plane, Round, with_parts
from certbound.synthesis.plant import Grid, middle_of

Form = dict[int, Fraction]

_BITS = 256


def empty_at_once(faces: tuple[Face, ...], erosion: Array, times: Array) -> tuple[str, float] | None:
    """A face that no state satisfies at some point (proved), or opposite planes that exclude each other.

    Returns its label and time, or None where the check decides nothing.
    """
    planes: list[tuple[Plane, int]] = []
    for face, parts in with_parts(faces):
        asked = face.asked(times[1:])
        if isinstance(face, Round) and not face.outside:
            empty = asked & (erosion[:, parts.start] > face.size * (1 + 1e-12))
            if np.any(empty):
                k = int(np.argmax(empty))
                return face.label, float(times[k + 1])
        elif isinstance(face, Plane):
            planes.append((face, parts.start))
    for i, (first, a) in enumerate(planes):
        for second, b in planes[i + 1 :]:
            if first.coordinates != second.coordinates or not np.array_equal(first.normal, -second.normal):
                continue
            if first.center is not second.center and np.any(first.center) | np.any(second.center):
                continue
            total = first.bound + second.bound
            taken = (erosion[:, a] + erosion[:, b]) * (1 - 1e-12)
            empty = first.asked(times[1:]) & second.asked(times[1:]) & (taken > total + 1e-12 * abs(total))
            if np.any(empty):
                k = int(np.argmax(empty))
                return first.label, float(times[k + 1])
    return None


def bound_scale(problem: Problem, grid: Grid, faces: tuple[Face, ...], erosion: Array) -> float:
    """Upper bound of the largest s for which s times the erosion leaves a noise-free trajectory; inf if not proved.

    Proves: for every input sequence within the bounds, some plane constraint a_j . z_k + s e_jk <= b_j is broken for
    every s above the bound. Discrete time, bounded inputs, a point start (or the middle of the initial set).

    Faces other than fixed planes are left out; ``erosion`` (points, parts) is taken as exact.
    """
    box = problem.system.inputs
    if grid.continuous or box is None or not box.bounded:
        return math.inf
    try:
        model = _relaxed(problem)
    except EnclosureError:
        return math.inf
    planes, columns = [], []
    for face, parts in with_parts(faces):
        if isinstance(face, Plane) and isinstance(face.center, np.ndarray):
            planes.append(face)
            columns.append(parts.start)
    if not planes:
        return math.inf
    taken = erosion[:, columns]
    times = grid.times()
    asked = np.stack([plane.asked(times[1:]) for plane in planes], axis=1)
    multipliers = _propose(model, problem, planes, taken, asked)
    if multipliers is None or not np.any(multipliers > 0):
        return math.inf
    return _dual_bound(model, problem, planes, taken, np.where(asked, np.maximum(multipliers, 0.0), 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Relaxed:
    """z+ = A z + B u + C q + c with q in [low, high]; exact rationals (rows of coefficients)."""

    state: list[list[Fraction]]
    inputs: list[list[Fraction]]
    free: list[list[Fraction]]
    offset: list[Fraction]
    low: Array
    high: Array

    def floats(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C, c as floats."""
        matrices = (self.state, self.inputs, self.free)
        parts = [np.array([[float(v) for v in row] for row in m]).reshape(len(m), -1) for m in matrices]
        return parts[0], parts[1], parts[2], np.array([float(v) for v in self.offset])


def _relaxed(problem: Problem) -> _Relaxed:
    """The dynamics as an affine map of states, inputs and unknowns with proved ranges."""
    system = problem.system
    tape = system.dynamics
    n, m = system.dimension, len(system.input_names)
    box, middle = system.inputs, middle_of(system.disturbance)
    assert box is not None
    ranges = [Interval(np.array(0.0), np.array(float(problem.horizon)))]
    ranges += [Interval(np.array(-np.inf), np.array(np.inf)) for _ in range(n)]
    ranges += [Interval(np.array(a), np.array(b)) for a, b in zip(box.low, box.high)]
    ranges += [Interval.point(np.array(d)) for d in middle]
    forms = _forms(tape, n + m + 1, middle)
    nodes = sorted({k for output in tape.outputs for k in forms[output][1] if k >= 0})
    free = [k for k in nodes if not _is_signal(tape.nodes[k], n + m)]
    lows = highs = np.zeros(0)
    if free:
        chosen = Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=tuple(free), shape=(len(free),))
        values = enclose(chosen, ranges)
        lows, highs = np.asarray(values.lo).reshape(-1), np.asarray(values.hi).reshape(-1)
    if not (np.all(np.isfinite(lows)) and np.all(np.isfinite(highs))):
        raise EnclosureError("a nonlinear term of the dynamics is unbounded.")
    place = {k: tape.nodes[k].args[0] - 1 for k in nodes if k not in free}
    state = [[Fraction(0)] * n for _ in range(n)]
    inputs = [[Fraction(0)] * m for _ in range(n)]
    unknown = [[Fraction(0)] * len(free) for _ in range(n)]
    offset = []
    for row, output in enumerate(tape.outputs):
        constant, terms = forms[output]
        offset.append(constant)
        for k, value in terms.items():
            if k not in place:
                unknown[row][free.index(k)] += value
            elif place[k] < n:
                state[row][place[k]] += value
            else:
                inputs[row][place[k] - n] += value
    return _Relaxed(state=state, inputs=inputs, free=unknown, offset=offset, low=lows, high=highs)


def _is_signal(node: Node, last: int) -> bool:
    return node.op == "input" and 1 <= node.args[0] <= last


def _forms(tape: Tape, first_disturbance: int, middle: Array) -> list[tuple[Fraction, Form]]:
    """Every node as an exact affine function of nodes that are none (the disturbance is its middle)."""
    forms: list[tuple[Fraction, Form]] = []
    zero = Fraction(0)

    def combined(a: tuple[Fraction, Form], b: tuple[Fraction, Form], factor: Fraction) -> tuple[Fraction, Form]:
        terms = dict(a[1])
        for key, value in b[1].items():
            terms[key] = terms.get(key, zero) + factor * value
        return a[0] + factor * b[0], {key: value for key, value in terms.items() if value}

    for index, node in enumerate(tape.nodes):
        args = [] if node.op == "input" else [forms[arg] for arg in node.args]
        form: tuple[Fraction, Form] = (zero, {index: Fraction(1)})
        if node.op == "input" and node.args[0] >= first_disturbance:
            form = (Fraction(float(middle[node.args[0] - first_disturbance])), {})
        elif node.op == "const":
            form = (Fraction(node.value), {})
        elif node.op in ("add", "sub"):
            form = combined(args[0], args[1], Fraction(1 if node.op == "add" else -1))
        elif node.op == "neg":
            form = combined((zero, {}), args[0], Fraction(-1))
        elif node.op == "mul" and not (args[0][1] and args[1][1]):
            factor, other = (args[0][0], args[1]) if not args[0][1] else (args[1][0], args[0])
            form = combined((zero, {}), other, factor)
        elif node.op == "div" and not args[1][1] and args[1][0]:
            form = combined((zero, {}), args[0], 1 / args[1][0])
        forms.append(form)
    return forms


def _propose(
    model: _Relaxed, problem: Problem, planes: list[Plane], taken: Array, asked: Mask
) -> Array | None:
    """Multipliers (points, planes) of the linear program, in floating point; None where the solver has no optimum."""
    optimize: Any = importlib.import_module("scipy.optimize")
    lil_matrix: Any = importlib.import_module("scipy.sparse").lil_matrix

    a, b, c, offset = model.floats()
    n, m, q, steps = len(a), b.shape[1], c.shape[1], len(taken)
    width = n + m + q
    size = steps * width + 1
    equal, right = lil_matrix((steps * n, size)), np.tile(offset, steps)
    rows = int(asked.sum())
    less, most = lil_matrix((rows, size)), np.zeros(rows)
    start = problem.initial.middle
    row = 0
    for k in range(steps):
        base = k * width  # u_k, q_k, z_{k+1}
        block = slice(k * n, (k + 1) * n)
        equal[block, base + m + q : base + width] = np.eye(n)
        equal[block, base : base + m] = -b
        equal[block, base + m : base + m + q] = -c
        if k:
            equal[block, base - n : base] = -a
        else:
            right[block] += a @ start
        for j in np.flatnonzero(asked[k]):
            less[row, base + m + q : base + width] = planes[j].row
            less[row, size - 1] = taken[k, j]
            most[row] = _bound(planes[j])
            row += 1
    box = problem.system.inputs
    assert box is not None
    sides = [*zip(box.low, box.high), *zip(model.low, model.high), *[(None, None)] * n] * steps + [(None, 1e6)]
    objective = np.zeros(size)
    objective[-1] = -1.0
    found = optimize.linprog(objective, less.tocsr(), most, equal.tocsr(), right, sides, method="highs")
    if found.status != 0:
        return None
    multipliers = np.zeros(asked.shape)
    multipliers[asked] = -np.asarray(found.ineqlin.marginals)
    return multipliers


def _dual_bound(model: _Relaxed, problem: Problem, planes: list[Plane], taken: Array, multipliers: Array) -> float:
    """Weak duality in ball arithmetic: s sum(lambda e) <= sum(lambda b) - min over u, q of sum(lambda a . z)."""
    box = problem.system.inputs
    assert box is not None
    with precision(_BITS):
        state, inputs, free = (_balls(matrix) for matrix in (model.state, model.inputs, model.free))
        offset = [_ball(value) for value in model.offset]
        n, steps = len(offset), len(taken)
        weight = sum((arb(float(x)) * arb(float(e)) for x, e in zip(multipliers.ravel(), taken.ravel())), arb(0))
        total = arb(0)
        adjoint = arb_mat(1, n)
        normals = [arb_mat([[arb(float(v)) for v in plane.row]]) for plane in planes]
        for k in range(steps - 1, -1, -1):
            for j, plane in enumerate(planes):
                value = float(multipliers[k, j])
                if value:
                    adjoint += arb(value) * normals[j]
                    # the bound of a plane with a centre is a sum of products of floats: evaluate it in balls
                    total += arb(value) * _exact_bound(plane)
            total -= sum((adjoint[0, i] * offset[i] for i in range(n)), arb(0))
            if model.inputs and box.dimension:
                total -= _least(adjoint * inputs, box.low, box.high)
            if len(model.low):
                total -= _least(adjoint * free, model.low, model.high)
            adjoint = adjoint * state
        total -= sum((adjoint[0, i] * arb(float(v)) for i, v in enumerate(problem.initial.middle)), arb(0))
        if not lower(weight) > 0:
            return math.inf
        return upper(total / weight)


def _least(row: Any, low: Array, high: Array) -> arb:
    """A ball whose lower end is at most the least value of row . x over the box."""
    total = arb(0)
    for i in range(row.ncols()):
        ends = row[0, i] * arb(float(low[i])), row[0, i] * arb(float(high[i]))
        total += arb.min(ends[0], ends[1])
    return total


def _ball(value: Fraction) -> arb:
    return arb(fmpq(value.numerator, value.denominator))


def _balls(matrix: list[list[Fraction]]) -> arb_mat:
    rows = [[_ball(value) for value in row] for row in matrix]
    return arb_mat(rows) if rows and rows[0] else arb_mat(len(rows), 0)


def _bound(plane: Plane) -> float:
    return float(plane.bound + plane.normal @ plane.center)


def _exact_bound(plane: Plane) -> arb:
    return arb(plane.bound) + sum((arb(float(a)) * arb(float(c)) for a, c in zip(plane.normal, plane.center)), arb(0))
