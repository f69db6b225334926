"""Convex programs that propose the polynomial V of a barrier exp(V), from points at which its conditions are asked.

Points are (t, x, d) of the safe set, x of the initial set, and x where a constraint is about to be broken. Polynomials
are in the states less a centre, over a scale; what they propose holds at the points alone, and is proved elsewhere.
"""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Any

import numpy as np

from certbound.arrays import Array, Integers
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.watch import poll, solver_limit

_LOG10 = math.log(10.0)
_STEPS = 40  # programs, each about the solution of the one before
_SETTLED = 0.01  # of the exponent: a step that gains less is the last
_WEIGHTS = (0.3, 0.1, 0.03)  # of the growth beside the height, for the polynomial to begin with
_DEEP, _HIGH = -40.0, 14.0  # V is looked at that far about the level

Points = tuple[Array, Array, Array]


class Polynomials:
    """Programs for one problem; see the module."""

    def __init__(self, problem: Problem, system: ContinuousSystem, center: Array, scale: Array) -> None:
        self.problem, self.system, self.center, self.scale = problem, system, center, scale
        self.n, self.noises = system.dimension, int(system.diffusion.shape[1])

    def slowest(self, exponents: Integers, points: Points) -> tuple[Array | None, float]:
        """Coefficients (the constant last) that minimise V at the start less V at the boundary plus T times the growth
        of exp(V), and log10 of the bound that this hopes for.
        """
        import cvxpy

        cp: Any = cvxpy
        program, (c, constant), _ = self._slow(exponents, points, 1.0)
        if not _solved(cp, program) or program.value >= 0:
            return None, 0.0
        return np.append(np.asarray(c.value, dtype=float), float(constant.value)), float(program.value) / _LOG10

    def steadiest(
        self, exponents: Integers, points: Points, begun: tuple[Array, float] | None = None
    ) -> tuple[Array | None, float]:
        """Coefficients with which the generator of exp(V) is at most e^m/T and V at the start at most m, and m.

        That is G(V) <= e^(m - V)/T, G the generator's expression of exp(V) over exp(V). The right-hand side is convex
        in m - V and not concave; its tangent at the last solution is below it, and is asked for instead. ``begun`` are
        coefficients and m to go on from.
        """
        import cvxpy

        cp: Any = cvxpy
        inner, initial, boundary = points
        horizon = float(self.problem.horizon)
        rows = self.monomials(exponents, inner[:, 1 : self.n + 1], ())
        linear, roots = self._terms(exponents, inner)
        if begun is None:
            begun = self._first(exponents, points)
            if begun is None:
                return None, 0.0
        coefficients, level = begun
        for left in reversed(range(_STEPS)):
            poll()
            level = min(level, self._least(exponents, points, coefficients))  # from above tangents lead down by 1 each
            depth = np.clip(level - rows @ coefficients[:-1] - coefficients[-1], _DEEP, _HIGH)
            c, constant, m = cp.Variable(len(exponents)), cp.Variable(), cp.Variable()
            most = cp.multiply(np.exp(depth) / horizon, 1 + m - rows @ c - constant - depth)
            asked = [
                linear @ c + 0.5 * sum(cp.square(root @ c) for root in roots) <= most,
                self.monomials(exponents, initial, ()) @ c + constant <= m,
                self.monomials(exponents, boundary, ()) @ c + constant >= 0,
            ]
            program = cp.Problem(cp.Minimize(m), asked)
            if not _solved(cp, program):
                break
            before, level = level, float(m.value)
            coefficients = np.append(np.asarray(c.value, dtype=float), float(constant.value))
            if abs(before - level) < _SETTLED * abs(level) or level > max(left * (before - level), 0.0) > 0:
                break  # or it will not fall below 0 at that rate
        return coefficients, level

    def _least(self, exponents: Integers, points: Points, coefficients: Array) -> float:
        """The least m that a polynomial serves at the points; infinite where it is below 0 at the boundary."""
        inner, initial, boundary = points
        value, start, exit_ = (
            self.monomials(exponents, states, ()) @ coefficients[:-1] + coefficients[-1]
            for states in (inner[:, 1 : self.n + 1], initial, boundary)
        )
        grown = self.generated(exponents, coefficients, inner) * float(self.problem.horizon)
        with np.errstate(divide="ignore"):
            needed = value + np.log(np.maximum(grown, 0.0))
        return max(float(start.max()), float(needed.max())) - float(exit_.min())

    def _first(self, exponents: Integers, points: Points) -> tuple[Array, float] | None:
        """A polynomial to begin with: high at the boundary, and of a growth that counts little."""
        import cvxpy

        best: tuple[Array, float] | None = None
        for weight in _WEIGHTS:
            program, (c, constant), (top, growth) = self._slow(exponents, points, weight)
            if not _solved(cvxpy, program):
                continue
            level = float(top.value) + math.log(max(float(growth.value) * float(self.problem.horizon), 1.0))
            if best is None or level < best[1]:
                best = np.append(np.asarray(c.value, dtype=float), float(constant.value)), level
        return best

    def _slow(self, exponents: Integers, points: Points, weight: float) -> tuple[Any, tuple[Any, Any], tuple[Any, Any]]:
        import cvxpy

        cp: Any = cvxpy
        inner, initial, boundary = points
        linear, roots = self._terms(exponents, inner)
        c, constant, top, growth = cp.Variable(len(exponents)), cp.Variable(), cp.Variable(), cp.Variable(nonneg=True)
        rows = [
            linear @ c + 0.5 * sum(cp.square(root @ c) for root in roots) <= growth,
            self.monomials(exponents, initial, ()) @ c + constant <= top,
            self.monomials(exponents, boundary, ()) @ c + constant >= 0,
        ]
        program = cp.Problem(cp.Minimize(top + weight * growth * self.problem.horizon), rows)
        return program, (c, constant), (top, growth)

    def _terms(self, exponents: Integers, inner: Array) -> tuple[Array, list[Array]]:
        """The generator's expression at points, linear @ c + 1/2 sum_j (roots[j] @ c)^2: matrices (points, K).

        InfeasibleError where the model is undefined at one of them.
        """
        states = inner[:, 1 : self.n + 1]
        drift = compile_numpy(self.problem.closed_loop)(*inner.T)
        diffusion = self.system.diffusion
        given = compile_numpy(diffusion)(*inner[:, : self.n + 1].T) if isinstance(diffusion, Tape) else diffusion
        spread = np.broadcast_to(given, (len(inner), self.n, self.noises))
        if not (np.isfinite(drift).all() and np.isfinite(spread).all()):
            raise InfeasibleError("the model is undefined somewhere in the safe set, where barriers are bounded.")
        slopes = np.stack([self.monomials(exponents, states, (i,)) for i in range(self.n)])
        linear = np.einsum("pi,ipk->pk", drift, slopes)
        square = np.einsum("pij,pkj->pik", spread, spread)
        for i, j in itertools.product(range(self.n), repeat=2):
            linear = linear + 0.5 * square[:, i, j, None] * self.monomials(exponents, states, (i, j))
        return linear, [np.einsum("pi,ipk->pk", spread[:, :, j], slopes) for j in range(self.noises)]

    def generated(self, exponents: Integers, coefficients: Array, inner: Array) -> Array:
        """The generator's expression of a polynomial (the constant last) at points."""
        linear, roots = self._terms(exponents, inner)
        c = coefficients[:-1]
        return np.asarray(linear @ c + 0.5 * sum((root @ c) ** 2 for root in roots))

    def monomials(self, exponents: Integers, states: Array, along: tuple[int, ...]) -> Array:
        """Monomials in the scaled states, differentiated along the given states: (points, K)."""
        y = (states - self.center) / self.scale
        powers, factor = exponents.copy(), np.ones(len(exponents))
        for i in along:
            factor = factor * powers[:, i] / self.scale[i]
            powers[:, i] -= 1
        powers = np.maximum(powers, 0)
        return np.asarray(factor * np.prod(y[:, None, :] ** powers, axis=-1))


def _solved(cp: Any, program: Any) -> bool:
    """Whether a program has a solution, which may be inaccurate: it is a proposal."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            program.solve(solver=cp.CLARABEL, **solver_limit())
    except cp.SolverError:
        return False
    values = [variable.value for variable in program.variables()]
    return program.value is not None and bool(np.isfinite(program.value)) and all(v is not None for v in values)
