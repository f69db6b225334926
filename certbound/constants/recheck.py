"""The recheck: what a proposed metric proves over a Jacobian set, evaluated in outward-rounded arithmetic.

Every number follows from P (and multipliers) as they are, whatever proposed them. S is a floating-point inverse
of a Cholesky factor R of P; it only chooses coordinates, and S^T P S is enclosed with everything else: J^T P J <=
L^2 P holds with L^2 = lambda_max(S^T J^T P J S) / lambda_min(S^T P S), and likewise for c. Vertices suffice
because mu_P and ||.||_P are convex. Above ``VERTEX_WORK`` the sector inequality of size n + k is proved instead:
F > 0 with diagonal multipliers (S-procedure). Source: Sec. 1 and 6 of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.jacobians import (
    AffineSet,
    IntervalMatrixSet,
    JacobianSet,
    SectorSet,
    UnionSet,
    as_set,
    induced_norm,
    matrix_measure,
    square_matrix,
)
from certbound.constants.programs import center_multipliers, centred, varying
from certbound.errors import EnclosureError
from certbound.rigor.definite import eigenvalue_lower, eigenvalue_upper, is_positive_definite
from certbound.rigor.intervals import Interval, down, matmul, up

VERTEX_WORK = 2e7
"""Largest count * n^3 for which a parametric set is proved vertex by vertex."""
QUICK_WORK = 5e5
"""The same, up to which the sector inequality is not even tried."""
MOST_VERTICES = 1 << 16
"""What a set returns as vertices at most."""
SECTOR_LOSS = 1e-3
"""What the sector inequality may lose to the vertices, relative to c or 1 - L^2, before these are proved instead."""

_CHUNK = 4096


def certify_rate(metric: ArrayLike, jacobians: JacobianSet | ArrayLike) -> float:
    """Upper bound c of the matrix measure: J^T P + P J <= 2 c P for every J in the set.

    Parameters
    ----------
    metric : array_like, shape (n, n)
        P, symmetric; proved positive definite on the way.
    jacobians : JacobianSet or array_like
        A set, a matrix (n, n) or vertices (v, n, n).

    Returns
    -------
    float
        c in 1/s.

    Raises
    ------
    ValueError
        If P is not symmetric positive definite, or of another size.
    EnclosureError
        If no finite bound could be proved.

    Examples
    --------
    >>> round(certify_rate([[1.0, 0.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, -2.0]]), 9)
    -1.0
    """
    return _certify(metric, jacobians, continuous=True)


def certify_gain(metric: ArrayLike, jacobians: JacobianSet | ArrayLike) -> float:
    """Upper bound L of the induced norm: J^T P J <= L^2 P for every J in the set.

    Parameters, raises: as ``certify_rate``. Returns L > 0 per step.

    Examples
    --------
    >>> round(certify_gain([[1.0, 0.0], [0.0, 1.0]], [[0.0, 0.5], [-0.5, 0.0]]), 9)
    0.5
    """
    squared = _certify(metric, jacobians, continuous=False)
    return float(up(np.sqrt(max(squared, np.finfo(float).tiny))))


def holds_rate(metric: ArrayLike, jacobians: JacobianSet | ArrayLike, rate: float) -> bool:
    """Whether mu_P(J) <= rate is proved for every J in the set; False means not proved."""
    return _within(metric, jacobians, rate, continuous=True)


def holds_gain(metric: ArrayLike, jacobians: JacobianSet | ArrayLike, gain: float) -> bool:
    """Whether ||J||_P <= gain is proved for every J in the set; False means not proved."""
    return _within(metric, jacobians, gain, continuous=False)


def _certify(metric: ArrayLike, jacobians: JacobianSet | ArrayLike, *, continuous: bool) -> float:
    """c, or L^2."""
    members = as_set(jacobians)
    frame = _coordinates(metric)
    n = members.dimension
    if len(frame.P) != n:
        raise ValueError(f"`metric` must be {n} x {n}, got {len(frame.P)} x {len(frame.P)}.")
    value = max(_member_value(frame, part, continuous=continuous) for part in _members(members))
    if not np.isfinite(value):
        raise EnclosureError("no finite contraction bound was proved; bound the domain, or give another metric.")
    return value


def _members(jacobians: JacobianSet) -> Iterator[JacobianSet]:
    if isinstance(jacobians, UnionSet):
        for member in jacobians.members:
            yield from _members(member)
    else:
        yield jacobians.affine if isinstance(jacobians, IntervalMatrixSet) else jacobians


class _Frame(NamedTuple):
    """P, the coordinates S with S^T P S nearly I, and an enclosure of S^T P S, proved positive definite."""

    P: Array
    S: Array
    gram: Interval


def _member_value(frame: _Frame, member: JacobianSet, *, continuous: bool) -> float:
    work = member.vertex_count * member.dimension**3
    if work <= QUICK_WORK or not isinstance(member, (AffineSet, SectorSet)):
        return _vertex_value(frame, member, continuous=continuous)
    sector = member if isinstance(member, SectorSet) else member.sector()
    value = _sector_value(frame, sector, continuous=continuous)
    if work > VERTEX_WORK or member.vertex_count > MOST_VERTICES:
        return value
    measured = matrix_measure if continuous else induced_norm
    reached = float(np.max(measured(member.vertices(), 2, weights=frame.P)))
    least, scale = (reached, abs(reached)) if continuous else (reached**2, abs(1 - reached**2))
    if value - least <= SECTOR_LOSS * max(scale, 1e-9 * abs(least)):
        return value
    return min(value, _vertex_value(frame, member, continuous=continuous))


def _coordinates(metric: ArrayLike) -> _Frame:
    """The frame of a metric; it is proved on the way."""
    P = square_matrix("metric", metric)
    if not np.array_equal(P, P.T):
        raise ValueError("`metric` must be exactly symmetric; use (P + P.T) / 2.")
    try:
        S: Array = np.asarray(np.linalg.inv(np.linalg.cholesky(P)).T, dtype=float)
    except np.linalg.LinAlgError as error:
        raise ValueError("`metric` must be positive definite; its Cholesky factorisation fails.") from error
    gram = matmul(S.T, matmul(P, S))
    if not float(eigenvalue_lower(gram)) > 0:
        raise ValueError("`metric` must be positive definite; it is too close to singular for a proof.")
    return _Frame(P, S, gram)


def _vertices(member: JacobianSet, points: Array) -> Interval:
    """Enclosures of the vertices with the given parameter values (or of given matrices)."""
    if isinstance(member, SectorSet):
        assert member.groups is not None
        order = sorted(set(member.groups))
        delta = points[:, None, [order.index(g) for g in member.groups]]
        scaled = Interval.point(member.left) * Interval.point(delta)
        return matmul(scaled, member.right) + _with_slack(member.affine)
    if isinstance(member, AffineSet):
        n = member.dimension
        flat = matmul(points, member.M.reshape(len(member.M), n * n))
        return flat.reshape(len(points), n, n) + _with_slack(member)
    return Interval.point(points)


def _with_slack(member: AffineSet) -> Interval:
    if not member.error.any():
        return Interval.point(member.J0)
    return Interval(down(member.J0 - member.error), up(member.J0 + member.error))


def _vertex_value(frame: _Frame, member: JacobianSet, *, continuous: bool) -> float:
    P, S, gram = frame
    if isinstance(member, SectorSet):
        points = member.affine.corners()
    else:
        points = member.corners() if isinstance(member, AffineSet) else member.vertices()
    low, high = float(eigenvalue_lower(gram)), float(eigenvalue_upper(gram))
    worst = -np.inf
    for start in range(0, len(points), _CHUNK):
        J = matmul(_vertices(member, points[start : start + _CHUNK]), S)
        if continuous:
            half = matmul(matmul(S.T, P), J)
            form = half + half.swapaxes(-1, -2)
        else:
            form = matmul(J.swapaxes(-1, -2), matmul(P, J))
        worst = max(worst, float(np.max(eigenvalue_upper(form))))
    worst = float(up(worst / 2)) if continuous else worst
    return float(up(worst / (low if worst >= 0 else high)))


def _sector_value(frame: _Frame, sector: SectorSet, *, continuous: bool) -> float:
    """Smallest value found for which F > 0 is proved; F in the coordinates of S, multipliers from a barrier."""
    P, block = frame.P, centred(sector)
    guess = center_multipliers(P, block, continuous=continuous)
    wide = varying(sector)
    # the barrier works at P / (2 ||P||) and with scaled columns: undo both
    weights = guess.multipliers[0] * (2 * np.linalg.norm(P, 2)) / block.scale**2
    low, high = sector.box[:, wide]
    middle = (low + high) / 2
    radius = np.maximum(up(high - middle), up(middle - low))
    B, C = sector.left[:, wide], sector.right[wide]
    fixed = np.setdiff1d(np.arange(sector.box.shape[1]), wide)
    A = _with_slack(sector.affine)
    A = A + matmul(Interval.point(B) * Interval.point(middle), C)
    if len(fixed):
        A = A + matmul(
            Interval.point(sector.left[:, fixed]) * Interval.point(sector.box[0, fixed]), sector.right[fixed]
        )
    right = matmul(C, frame.S) * Interval.point(radius)[:, None]
    F0 = _sector_matrix(frame, A, B, right, weights, continuous=continuous)
    size = abs(guess.value) + float(np.abs(F0.mid).max())
    return _least_proved(F0, frame.gram, guess.value, 1e-12 * size, factor=2.0 if continuous else 1.0)


def _least_proved(F0: Interval, gram: Interval, guess: float, step: float, *, factor: float) -> float:
    """The smallest value near a guess for which F0 + factor value E^T P E > 0 is proved: doubling, then bisection."""

    def proved(value: float) -> bool:
        return bool(is_positive_definite(_shifted(F0, gram, factor * value)))

    low, high = guess, guess + step
    while not proved(high):
        step *= 2
        low, high = high, high + step
        if not np.isfinite(high) or step > 1e6 * (1 + abs(guess)):
            return float(np.inf)
    while high - low > 1e-3 * (high - guess):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        low, high = (low, middle) if proved(middle) else (middle, high)
    return float(high)


def _sector_matrix(
    frame: _Frame, A: Interval, B: Array, CS: Interval, weights: Array, *, continuous: bool
) -> Interval:
    """F at value 0, after the congruence diag(S, lambda^{-1/2}) (a floating-point scaling, applied exactly)."""
    P, S, _ = frame
    n, k = len(P), len(weights)
    scale = 1 / np.sqrt(weights)
    AS = matmul(A, S)
    BS = Interval.point(B) * Interval.point(scale)
    Lam = Interval.point(weights)
    first = matmul(CS.swapaxes(-1, -2), CS * Lam[:, None])
    corner = Lam * Interval.point(scale) * Interval.point(scale)
    if continuous:
        half = matmul(matmul(S.T, P), AS)
        top = -(half + half.swapaxes(-1, -2)) - first
        cross = -matmul(matmul(S.T, P), BS)
        bottom = Interval.point(np.zeros((k, k)))
    else:
        top = -matmul(AS.swapaxes(-1, -2), matmul(P, AS)) - first
        cross = -matmul(AS.swapaxes(-1, -2), matmul(P, BS))
        bottom = -matmul(BS.swapaxes(-1, -2), matmul(P, BS))
    low, high = np.zeros((n + k, n + k)), np.zeros((n + k, n + k))
    diagonal = bottom + Interval(np.diag(corner.lo), np.diag(corner.hi))
    for part, rows, columns in (
        (top, slice(0, n), slice(0, n)),
        (cross, slice(0, n), slice(n, n + k)),
        (cross.swapaxes(-1, -2), slice(n, n + k), slice(0, n)),
        (diagonal, slice(n, n + k), slice(n, n + k)),
    ):
        low[rows, columns], high[rows, columns] = part.lo, part.hi
    return Interval(low, high)


def _shifted(F: Interval, gram: Interval, value: float) -> Interval:
    """F + value E^T P E in the coordinates of S."""
    n = gram.shape[-1]
    added = gram * Interval.point(value)
    low, high = F.lo.copy(), F.hi.copy()
    low[:n, :n] = down(low[:n, :n] + added.lo)
    high[:n, :n] = up(high[:n, :n] + added.hi)
    return Interval(low, high)


def _within(metric: ArrayLike, jacobians: JacobianSet | ArrayLike, value: float, *, continuous: bool) -> bool:
    try:
        proved = _certify(metric, jacobians, continuous=continuous)
    except EnclosureError:
        return False
    if continuous:
        return proved <= float(value)
    return float(value) > 0 and proved <= float(down(float(value) ** 2))
