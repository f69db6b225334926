"""Method of centres: the smallest c or L^2 over P and diagonal multipliers, by a log barrier.

A general semidefinite solver treats the unknown entries of P as unrelated columns; here the Hessian of
-log det F is assembled from products of W = F^-1 with the rows of [A B], so that a Newton step costs O(n^4)
numbers and one Cholesky factor of size n(n+1)/2. That is what makes n = 60 a matter of a minute. The result
proposes P and Lambda; ``recheck`` proves. With P given, the multipliers alone are found (k + 1 unknowns).

Symbols: F = v E'PE - H'PH - Chat'Lam Chat + Qhat'Lam Qhat in discrete time (v = L^2), with 2v E'PE - E'PH -
H'PE for the first two terms in continuous time (v = c); E = [I 0], H = [A B], Chat = [C 0], Qhat = [0 I].
Source: Boyd and El Ghaoui, "Method of centers for minimizing generalized eigenvalues" (1993); Sec. 6.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen
from certbound.constants.jacobians import JacobianSet
from certbound.constants.programs.barrier_blocks import Block, Pairs
from certbound.constants.programs.sectors import Sector, contraction_value, lmi_blocks, transformed

_SHRINK = 0.1
"""Share of the distance to the current value that the next target keeps."""

_FLOOR = 1e-5
"""Smallest eigenvalue of P (the largest is below 1) in the coordinates of the start."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Center:
    """A metric with multipliers (one array per block) that reach ``value`` in floating point."""

    metric: Array
    multipliers: tuple[Array, ...]
    value: float
    steps: int


def center_metric(
    blocks: Sequence[Array | Sector],
    *,
    continuous: bool,
    lower: float = -np.inf,
    tolerance: float = 1e-6,
    max_steps: int = 150,
) -> Center:
    """P and diagonal multipliers that nearly minimise c (continuous time) or L^2 (discrete time) over the blocks.

    The search stops once the value is within ``tolerance`` of ``lower``, a known (spectral) lower bound, or once the
    gains from one centre to the next, extrapolated, have less than that to go; at the latest after ``max_steps`` Newton
    steps.
    """
    root = np.asarray(np.linalg.cholesky(starting_metric(blocks, continuous=continuous)).T)
    inverse = np.asarray(np.linalg.inv(root), dtype=float)
    work = [Block(transformed(block, root, inverse), continuous=continuous) for block in blocks]
    n = work[0].n
    P = np.eye(n) / 2
    multipliers = [_first_multipliers(block, P) for block in work]
    value = max(block.smallest_value(P, lam) for block, lam in zip(work, multipliers))
    center = _Centring(work, Pairs(n), max_steps).descend(P, multipliers, value, lower, tolerance)
    return replace(center, metric=frozen(root.T @ center.metric @ root))


def starting_metric(blocks: Sequence[Array | Sector], *, continuous: bool) -> Array:
    """The best Lyapunov metric of the mean Jacobian, or the identity: of the right order of magnitude."""
    middle = np.mean([block.A if isinstance(block, Sector) else block for block in blocks], axis=0)
    n = len(middle)
    best, chosen = np.inf, np.eye(n)
    for share in (0.0, 0.1, 0.3, 1.0, 3.0, 10.0):
        try:
            metric = np.eye(n) if share == 0 else lyapunov_metric(middle, share, continuous=continuous)
        except np.linalg.LinAlgError:
            continue
        half = metric / 2
        value = -np.inf
        for block in blocks:
            work = Block(block, continuous=continuous)
            first = _first_multipliers(work, half)
            value = max(value, min(work.smallest_value(half, s * first) for s in (1.0, 4.0, 16.0, 64.0)))
        if value < best:
            best, chosen = value, metric
    return chosen


def lyapunov_metric(matrix: Array, share: float, *, continuous: bool) -> Array:
    """P of largest eigenvalue 1 in which one Jacobian contracts, with a margin of ``share`` of its decay.

    numpy.linalg.LinAlgError where the equation is singular in floating point (a Jordan block on the stability limit,
    very unlike units).
    """
    from scipy.linalg import LinAlgWarning, solve_continuous_lyapunov, solve_discrete_lyapunov

    n = len(matrix)
    eigenvalues = np.linalg.eigvals(matrix)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("error")
            if continuous:
                top = float(eigenvalues.real.max())
                shift = top + share * max(abs(top), 1e-3 * float(np.abs(eigenvalues).max()), 1e-9)
                metric = solve_continuous_lyapunov((matrix - shift * np.eye(n)).T, -np.eye(n))
            else:
                top = float(np.abs(eigenvalues).max()) ** 2
                scale = top + share * max(abs(1 - top), 1e-6)
                metric = solve_discrete_lyapunov(matrix.T / np.sqrt(scale), np.eye(n))
    except (LinAlgWarning, RuntimeWarning) as warning:
        raise np.linalg.LinAlgError(str(warning)) from warning
    metric = (metric + metric.T) / 2
    np.linalg.cholesky(metric)  # refuses what is positive definite on paper only
    return np.asarray(metric / np.linalg.norm(metric, 2))


def center_multipliers(
    metric: Array, block: Sector, *, continuous: bool, tolerance: float = 1e-7, max_steps: int = 200
) -> Center:
    """Diagonal multipliers that nearly minimise c or L^2 of a sector in a given metric (k + 1 unknowns)."""
    work = Block(block, continuous=continuous)
    P = np.asarray(metric, dtype=float)
    P = P / (2 * np.linalg.norm(P, 2))
    if not work.k:
        empty = np.zeros(0)
        return Center(metric=frozen(P), multipliers=(frozen(empty),), value=work.smallest_value(P, empty), steps=0)
    first, value = _shared_multipliers(work, P)
    ends = np.array([block.A + sign * block.B @ block.C for sign in (-1.0, 0.0, 1.0)])
    lower = contraction_value(P, ends, continuous=continuous)
    lower = lower if continuous else lower**2
    gap = value - lower
    if gap <= tolerance * max(1.0, abs(value)):
        return Center(metric=frozen(P), multipliers=(frozen(first),), value=value, steps=0)
    return _Centring([work], None, max_steps).descend(P, [first], value, lower, tolerance, offset=0.3 * gap)


def _shared_multipliers(block: Block, P: Array) -> tuple[Array, float]:
    """Multipliers with one unknown scale: all equal, or in the proportion of what goes in and out; and their value."""
    from scipy.linalg import eigh
    from scipy.optimize import minimize_scalar

    inner = block.H[:, block.n :].T @ P @ block.H[:, block.n :]
    C = block.Chat[:, : block.n]
    enters = np.maximum(np.diag(inner), 1e-300)
    leaves = np.maximum(np.sum(C * np.linalg.solve(P, C.T).T, axis=1), 1e-300)
    found = []
    for shape in (np.ones(block.k), np.sqrt(enters / leaves)):
        root = 1 / np.sqrt(shape)
        smallest = 0.0 if block.continuous else float(eigh(inner * np.outer(root, root), eigvals_only=True)[-1])
        unit = smallest or float(np.max(np.sqrt(enters / leaves) / shape))
        scale = minimize_scalar(
            _value_along, args=(block, P, shape, smallest, unit), bounds=(-25.0, 12.0), method="bounded",
            options={"xatol": 1e-5, "maxiter": 60},
        )  # fmt: skip
        found.append((float(scale.fun), shape * (smallest + unit * np.exp(scale.x))))
    value, best = min(found, key=lambda pair: pair[0])
    return best, block.smallest_value(P, best) if value < 1e300 else float(np.inf)


def _value_along(y: float, block: Block, P: Array, shape: Array, smallest: float, unit: float) -> float:
    """The value at multipliers of one shape, ``smallest`` + ``unit`` exp(y) times; 1e300 where there is none."""
    return min(block.smallest_value(P, shape * (smallest + unit * np.exp(y))), 1e300)


def reachable_value(metric: Array, jacobians: JacobianSet, *, continuous: bool) -> float:
    """c or L^2 that a metric reaches on the set, in floating point (by vertices, or by its multipliers)."""
    values = []
    for block in lmi_blocks(jacobians):
        if isinstance(block, Sector):
            values.append(center_multipliers(metric, block, continuous=continuous).value)
        else:
            reached = contraction_value(metric, block[None], continuous=continuous)
            values.append(reached if continuous else reached**2)
    return max(values)


def _first_multipliers(block: Block, P: Array) -> Array:
    inner = block.H[:, block.n :].T @ P @ block.H[:, block.n :]
    size = np.linalg.norm(inner, 2) if block.k else 0.0
    return np.full(block.k, 2 * float(size) + 1e-6)


class _Centring:
    """The method of centres over some inequalities; without ``pairs`` P is fixed, and the multipliers are sought."""

    def __init__(self, blocks: Sequence[Block], pairs: Pairs | None, max_steps: int) -> None:
        self.blocks, self.pairs, self.max_steps = blocks, pairs, max_steps

    def descend(
        self, P: Array, multipliers: list[Array], value: float, lower: float, tolerance: float,
        offset: float | None = None,
    ) -> Center:
        """Shrink the target towards the value reached, and centre again, until it no longer pays.

        The first target lies by ``offset`` above the value; a tenth of it when omitted.
        """
        best = P, multipliers, value
        away = max(1e-3, 0.1 * abs(value)) if offset is None else offset
        steps, target, before, last = 0, value + away, np.inf, np.inf
        while steps < self.max_steps:
            P, multipliers, used = self._recenter(P, multipliers, target, self.max_steps - steps)
            steps += used
            reached = max(block.smallest_value(P, lam) for block, lam in zip(self.blocks, multipliers))
            if reached < best[2]:
                best = P, multipliers, reached
            gain = before - reached
            # gains shrink geometrically: what is left to gain is about gain * ratio / (1 - ratio)
            left = gain * gain / (last - gain) if 0 <= gain < last < np.inf else np.inf
            if best[2] <= lower + tolerance or left <= tolerance or gain <= 1e-3 * tolerance:
                break
            before, last = reached, gain
            target = reached + _SHRINK * (target - reached)
        P, multipliers, value = best
        return Center(
            metric=frozen(P), multipliers=tuple(frozen(lam) for lam in multipliers), value=value, steps=steps
        )

    def _recenter(
        self, P: Array, multipliers: list[Array], value: float, budget: int
    ) -> tuple[Array, list[Array], int]:
        """Damped Newton steps to the analytic centre of {F > 0, floor < P < I} at a fixed value."""
        from scipy.linalg import cho_factor, cho_solve

        for step in range(1, min(budget, 30) + 1):
            try:
                gradient, hessian = self._derivatives(P, multipliers, value)
                direction = -cho_solve(cho_factor(hessian + 1e-14 * np.diag(np.diag(hessian))), gradient)
            except np.linalg.LinAlgError:
                return P, multipliers, step
            decrement = float(np.sqrt(max(-float(gradient @ direction), 0.0)))
            length = 1.0 if decrement < 0.25 else 1 / (1 + decrement)
            if decrement >= 0.25:  # a longer step where it stays feasible and descends
                length = self._search(P, multipliers, value, direction, length, float(gradient @ direction))
            P, multipliers = self._moved(P, multipliers, direction, length)
            if decrement < 0.1:
                return P, multipliers, step
        return P, multipliers, step

    def _moved(
        self, P: Array, multipliers: list[Array], direction: Array, length: float
    ) -> tuple[Array, list[Array]]:
        offset = 0
        if self.pairs is not None:
            offset = self.pairs.size
            P = P + length * self.pairs.matrix(direction[:offset])
        moved = []
        for lam in multipliers:
            moved.append(lam + length * direction[offset : offset + len(lam)])
            offset += len(lam)
        return P, moved

    def _barrier(self, P: Array, multipliers: list[Array], value: float) -> float:
        matrices = [block.matrix(value, P, lam) for block, lam in zip(self.blocks, multipliers)]
        total = 0.0
        identity = np.eye(len(P))
        for matrix in (P - _FLOOR * identity, identity - P, *matrices):
            try:
                total -= 2 * float(np.log(np.diagonal(np.linalg.cholesky(matrix))).sum())
            except np.linalg.LinAlgError:
                return float(np.inf)
        return total

    def _search(
        self, P: Array, multipliers: list[Array], value: float, direction: Array, safe: float, slope: float
    ) -> float:
        """Backtracking from 1 down to the step that self-concordance guarantees."""
        here, length = self._barrier(P, multipliers, value), 1.0
        while length > safe:
            if self._barrier(*self._moved(P, multipliers, direction, length), value) <= here + 0.1 * length * slope:
                return length
            length *= 0.6
        return safe

    def _derivatives(self, P: Array, multipliers: list[Array], value: float) -> tuple[Array, Array]:
        pairs = self.pairs
        size = 0 if pairs is None else pairs.size
        total = size + sum(len(lam) for lam in multipliers)
        gradient, hessian = np.zeros(total), np.zeros((total, total))
        if pairs is not None:
            identity = np.eye(len(P))
            for sign, matrix in ((1.0, P - _FLOOR * identity), (-1.0, identity - P)):
                inverse = _inverse(matrix)
                gradient[:size] -= sign * pairs.gradient(inverse)
                hessian[:size, :size] += pairs.hessian(inverse, inverse)
        offset = size
        for block, lam in zip(self.blocks, multipliers):
            here = slice(offset, offset + block.k)
            block.add_barrier(value, _inverse(block.matrix(value, P, lam)), pairs, here, gradient, hessian)
            offset += block.k
        hessian[size:, :size] = hessian[:size, size:].T
        return gradient, hessian


def _inverse(matrix: Array) -> Array:
    from scipy.linalg import cho_factor, cho_solve

    inverse = cho_solve(cho_factor(matrix), np.eye(len(matrix)))
    return np.asarray((inverse + inverse.T) / 2)
