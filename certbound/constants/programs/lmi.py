"""Linear matrix inequalities: the one place where a semidefinite solver is called.

Nothing here is a proof: a solver proposes P, multipliers or a feedback gain, and ``recheck`` evaluates the
bound from the proposal in rigorous arithmetic. Symbols of docs/theory.md, Sec. 6: the value is rho = L^2
(discrete time, J^T P J <= rho P) or c (continuous time, J^T P + P J <= 2 c P); sector form J = A + B Delta C
with multipliers; G noise matrix; a_j directions; w the largest a_j^T P^-1 a_j / clearance_j^2.

A status other than ``optimal`` is never read as infeasibility: the margin of a rate program is free, so that
it has a solution for every value, and a stall is answered by another setting, another solver, or
``SolverError``.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import frozen
from certbound.constants.jacobians import JacobianSet
from certbound.constants.programs.sectors import Sector, contraction_value, lmi_blocks, transformed
from certbound.errors import InfeasibleError, SolverError
from certbound.watch import poll, solver_limit


def solve(problem: Any) -> str:
    """Solve a cvxpy problem and return its status; a second setting and a second solver are tried on a stall.

    SolverError where no attempt ends with values for the variables.
    """
    cp = _cvxpy()

    attempts: list[tuple[str, dict[str, Any]]] = [
        ("CLARABEL", {}),
        ("CLARABEL", {"static_regularization_constant": 1e-7, "equilibrate_max_iter": 50, "max_iter": 300}),
        ("SCS", {"eps": 1e-6, "max_iters": 5_000}),
    ]
    statuses = []
    for name, options in attempts:
        poll()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            options = options | (solver_limit() if name == "CLARABEL" else {})
            try:
                problem.solve(solver=name, **options)
            except (cp.SolverError, ArithmeticError, ValueError) as error:
                statuses.append(f"{name}: {type(error).__name__}")
                continue
        statuses.append(f"{name}: {problem.status}")
        if problem.status == cp.OPTIMAL or (name == "SCS" and problem.status == cp.OPTIMAL_INACCURATE):
            return str(problem.status)
    raise SolverError(
        f"no semidefinite solver finished ({'; '.join(statuses)}); scale the states to like sizes, or give a metric."
    )


def _contraction(
    P: Any, value: Any, blocks: Sequence[Array | Sector], margin: Any, *, continuous: bool, full: bool = False
) -> list[Any]:
    """Constraints: every Jacobian of every block contracts at ``value`` in the norm of P, by a margin."""
    cp = _cvxpy()

    constraints: list[Any] = []
    n = P.shape[0]
    P_value = 2 * value * P if continuous else value * P
    for block in blocks:
        if isinstance(block, Sector):
            k = len(block.groups)
            base = P_value - (block.A.T @ P + P @ block.A if continuous else block.A.T @ P @ block.A)
            cross = -(P @ block.B) if continuous else -(block.A.T @ P @ block.B)
            corner = np.zeros((k, k)) if continuous else -(block.B.T @ P @ block.B)
            Q, S, R, extra = _multipliers(block.groups, full=full)
            lift = np.block([[block.C, np.zeros((k, k))], [np.zeros((k, n)), np.eye(k)]])
            block_matrix = cp.bmat([[base, cross], [cross.T, corner]]) - lift.T @ cp.bmat([[Q, S], [S.T, R]]) @ lift
            constraints += [*extra, (block_matrix + block_matrix.T) / 2 >> margin * np.eye(n + k)]
        else:
            drift = block.T @ P + P @ block if continuous else block.T @ P @ block
            constraints.append(P_value - drift >> margin * np.eye(n))
    return constraints


def _multipliers(groups: tuple[int, ...], *, full: bool) -> tuple[Any, Any, Any, list[Any]]:
    """Q, S, R with [z; q]^T [[Q, S], [S^T, R]] [z; q] >= 0 whenever q = Delta z, and what makes it so.

    Diagonal: z^T D z - q^T D q with D >= 0, a block (and a skew term) where entries of Delta are equal.
    Full block: any symmetric matrix that is concave in each delta and non-negative at the vertices of Delta.
    """
    cp = _cvxpy()

    k = len(groups)
    if full:
        if k > 10:
            raise ValueError(f"full-block multipliers need 2**k inequalities; k = {k} exceeds 10.")
        Q, R = cp.Variable((k, k), symmetric=True), cp.Variable((k, k), symmetric=True)
        S = cp.Variable((k, k))
        signs = 2.0 * ((np.arange(1 << k)[:, None] >> np.arange(k)) & 1) - 1
        signs = signs[[all(s[i] == s[groups.index(g)] for i, g in enumerate(groups)) for s in signs]]
        vertex = [Q + S @ np.diag(s) + np.diag(s) @ S.T + np.diag(s) @ R @ np.diag(s) >> 0 for s in signs]
        concave = []
        for g in sorted(set(groups)):
            index = [i for i, other in enumerate(groups) if other == g]
            select = np.eye(k)[index]
            concave.append(select @ R @ select.T << 0)
        return Q, S, R, [*vertex, *concave]
    D: Any = 0
    S = 0
    extra = []
    single = [i for i, g in enumerate(groups) if groups.count(g) == 1]
    if single:
        weights = cp.Variable(len(single), nonneg=True)
        D = D + np.eye(k)[:, single] @ cp.diag(weights) @ np.eye(k)[single]
    for g in sorted({g for g in groups if groups.count(g) > 1}):
        select = np.eye(k)[[i for i, other in enumerate(groups) if other == g]]
        r = len(select)
        block, skew = cp.Variable((r, r), PSD=True), cp.Variable((r, r))
        extra.append(skew + skew.T == 0)
        D = D + select.T @ block @ select
        S = S + select.T @ skew @ select
    if isinstance(S, int):
        S = np.zeros((k, k))
    return D, S, -D, extra


class RateProgram:
    """max margin over P with I <= max_condition^{1/2} P <= max_condition I: positive where the value is reached.

    The value is c (continuous time) or L^2 (discrete time). ``max_condition`` bounds the condition number of P in the
    coordinates of ``start``, a metric of the right order of magnitude in whose coordinates the program is solved.
    ``form`` is that of `lmi_blocks`; ``full``: full-block instead of diagonal multipliers in the sector form (at most
    10 parameters).
    """

    def __init__(
        self,
        jacobians: JacobianSet,
        *,
        continuous: bool,
        max_condition: float = 1e6,
        form: str = "auto",
        full: bool = False,
        start: ArrayLike | None = None,
    ) -> None:
        cp = _cvxpy()
        if not max_condition > 1:
            raise ValueError(f"`max_condition` must exceed 1, got {max_condition}.")
        n = jacobians.dimension
        identity = np.eye(n)
        self._root: Array = identity
        if start is not None:
            self._root = np.asarray(np.linalg.cholesky(np.asarray(start, dtype=float)).T)
        inverse = np.asarray(np.linalg.inv(self._root), dtype=float)
        blocks = [transformed(block, self._root, inverse) for block in lmi_blocks(jacobians, form=form)]
        self._metric = cp.Variable((n, n), symmetric=True)
        self._value = cp.Parameter()
        self._margin = cp.Variable()
        middle = np.sqrt(max_condition)
        constraints = [self._metric >> identity / middle, middle * identity - self._metric >> 0]
        constraints += _contraction(self._metric, self._value, blocks, self._margin, continuous=continuous, full=full)
        self._problem = cp.Problem(cp.Maximize(self._margin), constraints)
        self.status = "not solved"

    def propose(self, value: float) -> tuple[Array, float]:
        """The metric of the largest margin at a given c or L^2, and that margin."""
        self._value.value = float(value)
        self.status = solve(self._problem)
        return _symmetric(self._root.T @ self._metric.value @ self._root), float(self._margin.value)


class ErosionProgram:
    """min w over P: the contraction value fixed, the noise normalised, the erosions weighted (Sec. 6, 7.17).

    The noise is normalised by alpha t + beta tr(G^T P G) <= 1, G^T P G <= t I: with alpha = g - g' nu and beta = g'
    this majorises sigma^2 g(nu), g the squared radius at unit sigma, which is concave in nu.

    ``directions`` are one (n,) normal or (n, r) matrix per constraint: the erosion is r sqrt(lambda_max(a^T P^-1 a)).
    ``noise`` are matrices G (n, m), all of which the metric must serve. ``start`` is a metric of the right order of
    magnitude: the program is solved in its coordinates, where P is near I.
    """

    def __init__(
        self,
        jacobians: JacobianSet,
        directions: Sequence[ArrayLike],
        noise: Sequence[ArrayLike],
        start: ArrayLike,
        *,
        continuous: bool,
        form: str = "auto",
    ) -> None:
        cp = _cvxpy()
        n = jacobians.dimension
        self._root = np.linalg.cholesky(np.asarray(start, dtype=float)).T
        inverse = np.linalg.inv(self._root)
        blocks = [transformed(block, self._root, inverse) for block in lmi_blocks(jacobians, form=form)]
        normals = [inverse.T @ np.asarray(a, dtype=float).reshape(n, -1) for a in directions]
        factors = [self._root @ np.asarray(G, dtype=float).reshape(n, -1) for G in noise]
        self._sizes = np.array([max(float(np.linalg.norm(a, 2)), 1e-300) for a in normals])
        unit = max([float(np.linalg.norm(G, 2)) for G in factors] + [1e-300])
        self._metric = cp.Variable((n, n), symmetric=True)
        self._value = cp.Parameter()
        self._alpha, self._beta = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._weights = cp.Parameter(len(normals), nonneg=True)
        top, worst = cp.Variable(), cp.Variable()
        constraints = _contraction(self._metric, self._value, blocks, 0.0, continuous=continuous)
        for matrix in factors:
            G = matrix[:, matrix.any(axis=0)] / unit
            inner = G.T @ self._metric @ G
            constraints += [top * np.eye(G.shape[1]) - inner >> 0]
            constraints += [self._alpha * top + self._beta * cp.trace(inner) <= 1]
        for j, a in enumerate(normals):
            a = a / self._sizes[j]
            corner = (worst * self._weights[j]) * np.eye(a.shape[1])
            constraints.append(cp.bmat([[self._metric, a], [a.T, corner]]) >> 0)
        self._problem = cp.Problem(cp.Minimize(worst), constraints)
        self.status = "not solved"

    def propose(self, value: float, alpha: float, beta: float, clearances: ArrayLike) -> Array:
        """The metric of least max_j a_j^T P^-1 a_j / clearance_j^2."""
        weights = np.asarray(clearances, dtype=float) / self._sizes
        self._value.value, self._alpha.value, self._beta.value = float(value), float(alpha), float(beta)
        self._weights.value = (weights / weights.max()) ** 2
        self.status = solve(self._problem)
        return _symmetric(self._root.T @ self._metric.value @ self._root)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FeedbackDesign:
    """A feedback u = K x and a metric P proposed together; the value is the solver's, to be certified."""

    feedback: Array  # (m, n): K
    metric: Array  # (n, n): P
    value: float  # c (continuous time) or L (discrete time) of J + B K in the metric, in floating point


def design_feedback(
    jacobians: JacobianSet,
    input_matrix: ArrayLike,
    *,
    continuous: bool,
    max_gain: float = 1e3,
    max_condition: float = 1e6,
    tolerance: float = 1e-4,
    at_most: float | None = None,
) -> FeedbackDesign:
    """P and K together with the smallest c (or L) of J + B K: an LMI in X = P^-1 and Y = K X.

    Parameters
    ----------
    jacobians : JacobianSet
        Open-loop Jacobians; their vertices are used.
    input_matrix : array_like, shape (n, m)
        B.
    continuous : bool
    max_gain : float
        Bound on ||K||_2; without one, a controllable system has no smallest c.
    max_condition : float
    tolerance : float
        Of the bisection.
    at_most : float, optional
        The value that the caller needs.

    Raises
    ------
    InfeasibleError
        If the smallest value found exceeds ``at_most``.
    SolverError
    """
    cp = _cvxpy()

    n = jacobians.dimension
    B = np.asarray(input_matrix, dtype=float)
    if B.ndim != 2 or B.shape[0] != n or not np.all(np.isfinite(B)):
        raise ValueError(f"`input_matrix` must be a finite ({n}, m) matrix, got shape {B.shape}.")
    m = B.shape[1]
    X, Y, margin, value = (
        cp.Variable((n, n), symmetric=True),
        cp.Variable((m, n)),
        cp.Variable(),
        cp.Parameter(),
    )
    identity = np.eye(n)
    # ||Y|| <= gain and X >= I give ||K|| <= gain
    constraints = [X >> identity, max_condition * identity - X >> 0]
    constraints += [cp.bmat([[max_gain * identity, Y.T], [Y, max_gain * np.eye(m)]]) >> 0]
    for J in jacobians.vertices():
        closed = J @ X + B @ Y
        if continuous:
            constraints.append(2 * value * X - closed - closed.T >> margin * identity)
        else:
            constraints.append(cp.bmat([[value * X, closed.T], [closed, value * X]]) >> margin * np.eye(2 * n))
    problem = cp.Problem(cp.Maximize(margin), constraints)
    spread = float(np.max(np.linalg.norm(jacobians.vertices(), ord=2, axis=(1, 2))))
    best = FeedbackDesign(feedback=frozen(np.zeros((m, n))), metric=frozen(identity), value=spread)
    high = spread
    low = -spread - max_gain * float(np.linalg.norm(B, 2)) if continuous else 0.0
    while high - low > tolerance * max(1.0, abs(high)):
        middle = (low + high) / 2
        value.value = middle
        solve(problem)
        if float(margin.value) > 0:
            metric = _symmetric(np.linalg.inv(_symmetric(X.value)))
            feedback: Array = np.asarray(Y.value, dtype=float) @ metric
            reached = contraction_value(metric, jacobians.vertices() + B @ feedback, continuous=continuous)
            if reached < best.value:
                best = FeedbackDesign(feedback=frozen(feedback), metric=frozen(_symmetric(metric)), value=reached)
            high = min(middle, max(reached, low))
        else:
            low = middle
    if at_most is not None and best.value > at_most:
        raise InfeasibleError(
            f"the smallest value found is {best.value:.6g} > {at_most:g} with ||K|| <= {max_gain:g} and "
            f"cond(P) <= {max_condition:g}; raise one of the three bounds, or shrink the Jacobian set."
        )
    return best


def _cvxpy() -> Any:
    return importlib.import_module("cvxpy")  # a second to import: only when a program is solved


def _symmetric(value: Any) -> Array:
    matrix = np.asarray(value, dtype=float)
    return np.asarray((matrix + matrix.T) / 2)
