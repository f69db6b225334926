"""Noise level sigma and effective dimension nu in a metric, certified; isotropy found by exact arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.constants.enclosures import Metric, bound_supremum, enclose
from certbound.constants.model_data import Model
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.rigor.definite import eigenvalue_upper
from certbound.rigor.intervals import Interval, matmul
from certbound.rigor.rounding import TINY, lower, quiet, upper


@dataclass(frozen=True, eq=False, kw_only=True)
class NoiseBound:
    """sigma (a number, or one per piece) and nu, with tr(P g g^T) <= nu sigma^2 on every piece."""

    sigma: Any
    effective_dimension: float
    isotropic: bool
    gaussian: bool


def bound_noise(model: Model, norm: Metric, pieces: Interval | None = None) -> NoiseBound:
    """Certified sigma and nu of a model's noise in a metric.

    Proves: P^{1/2} g g^T P^{1/2} <= sigma^2 I and tr(P g g^T) <= nu sigma^2 over the model's ranges, or piece by piece
    over ``pieces`` (CT); for DT the same with the variance proxy G S G^T in place of g g^T. ``isotropic`` is True only
    if P g g^T (the covariance of Gaussian noise in DT) is a multiple of the identity in rational arithmetic.

    EnclosureError, ValueError or InfeasibleError where g is undefined, jumps or is unbounded over the ranges.
    """
    system = model.system
    if isinstance(system, ContinuousSystem) and isinstance(system.diffusion, Tape):
        return _state_dependent(model, norm, system.diffusion, pieces)
    if isinstance(system, DiscreteSystem):
        gain, proxy = system.noise_matrix, system.noise.proxy
        gaussian = system.noise.gaussian
        square = system.noise.exact_covariance() if gaussian else None
    else:
        assert isinstance(system.diffusion, np.ndarray)
        gain, proxy, gaussian = system.diffusion, np.eye(system.noise_dimension), True
        square = _fractions(np.eye(gain.shape[1]))
    if not (gain.any() and proxy.any()):
        silent: Any = 0.0 if pieces is None else np.zeros(len(pieces))
        nu = float(model.dimension)
        return NoiseBound(sigma=silent, effective_dimension=nu, isotropic=False, gaussian=gaussian)
    covariance = matmul(matmul(gain, proxy), np.swapaxes(gain, 0, 1))
    exact = None
    if square is not None and _may_be_isotropic(norm, covariance):
        exact = _product(_fractions(gain), square)
    level, trace = _level(norm, Interval(covariance.lo[None], covariance.hi[None]))
    isotropic = exact is not None and _is_isotropic(norm, exact)
    known = exact[0][0] if exact is not None and isotropic and norm.matrix is None else Fraction(float(level[0]))
    sigma = _root(known)
    nu = _effective(trace, np.array([sigma]), min(gain.shape))
    value = sigma if pieces is None else np.full(len(pieces), sigma)
    nu = float(model.dimension) if isotropic else nu
    return NoiseBound(sigma=value, effective_dimension=nu, isotropic=isotropic, gaussian=gaussian)


@quiet
def _may_be_isotropic(norm: Metric, covariance: Interval) -> bool:
    """False where P M is no multiple of the identity for any M in the interval matrix: rational arithmetic is slow."""
    product = covariance if norm.matrix is None else matmul(norm.matrix, covariance)
    diagonal = np.arange(norm.dimension)
    ends = product[diagonal, diagonal]
    off = (product.lo <= 0) & (product.hi >= 0)
    off[diagonal, diagonal] = True
    return bool(off.all() and float(ends.lo.max()) <= float(ends.hi.min()))


@quiet
def _level(norm: Metric, covariance: Interval) -> tuple[Array, Array]:
    """Upper bounds of lambda_max(P^{1/2} M P^{1/2}) and tr(P M) for batches of covariances M (..., n, n)."""
    if norm.matrix is None:
        diagonal = np.diagonal(covariance.hi, axis1=-2, axis2=-1)
        trace = Interval._raw(diagonal, diagonal).sum(axis=-1).hi
        return np.maximum(eigenvalue_upper(covariance), 0.0), np.maximum(trace, 0.0)
    # with W = P F and F^T P F = I + G: P^{1/2} M P^{1/2} is similar to (I + G)^{-1} W^T M W
    left = matmul(norm.frame.T, norm.matrix)
    inside = matmul(matmul(left, covariance), left.T)
    defect = norm.defect()
    square = upper(np.maximum(eigenvalue_upper(inside), 0.0) / lower(np.asarray(1.0 - defect)), tiny=TINY)
    return square, np.maximum((Interval.point(norm.matrix) * covariance).sum(axis=(-1, -2)).hi, 0.0)


def _state_dependent(model: Model, norm: Metric, tape: Tape, pieces: Interval | None) -> NoiseBound:
    """Branch and bound over (t, states); both bounds from the same enclosures of g g^T."""
    slots = model.dimension + 1
    ranges = model.ranges[:slots]

    def levels(boxes: Interval) -> tuple[Array, Array]:
        g = enclose(tape, [boxes[:, k] for k in range(slots)], undefined="infinite")
        return _level(norm, matmul(g, g.T))

    if pieces is not None:
        squares, traces = levels(pieces[:, :slots])
        bounded = np.asarray(np.isfinite(squares))
        if not bounded.all():
            _refuse(tape, pieces[:, :slots][int(np.argmin(bounded))], True)
        roots = np.array([_root(Fraction(float(entry))) for entry in squares])
        nu = _effective(traces, roots, min(tape.shape))
        return NoiseBound(sigma=roots, effective_dimension=nu, isotropic=False, gaussian=True)
    function = compile_numpy(tape)

    def values(points: Array, which: int) -> Array:
        with np.errstate(all="ignore"):
            g = np.broadcast_to(function(*points.T), (len(points), *tape.shape))
        matrix = g @ np.swapaxes(g, -1, -2)
        if norm.matrix is not None:
            matrix = norm.transform(matrix @ norm.matrix)
        defined = np.asarray(np.isfinite(matrix).all(axis=(-1, -2)))
        safe = np.where(defined[:, None, None], matrix, 0.0)
        found = np.linalg.norm(safe, 2, axis=(-2, -1)) if which == 0 else np.trace(safe, axis1=-2, axis2=-1)
        return np.where(defined, found, np.nan)

    results, reads = [], {node.args[0] for node in tape.nodes if node.op == "input"}
    used = np.array([slot in reads for slot in range(slots)])
    for which in (0, 1):
        start = values(ranges.mid[None], which)
        scale = float(start[0]) if np.isfinite(start[0]) else 1.0
        found = bound_supremum(  # mypy cannot type a lambda with a default
            lambda boxes, _, which=which: (levels(boxes)[which], _widths(boxes, ranges, used)),  # type: ignore[misc]  # a default binds the loop's value
            lambda points, which=which: values(points, which),  # type: ignore[misc]  # as above
            ranges,
            tolerance=1e-3 * (scale or 1e-300),
            budget=20_000,
        )
        if not np.isfinite(found.upper):
            _refuse(tape, found.worst, model.bounded_by_user)
        results.append(found.upper)
    sigma = _root(Fraction(results[0]))
    nu = _effective(np.array([results[1]]), np.array([sigma]), min(tape.shape))
    return NoiseBound(sigma=sigma, effective_dimension=nu, isotropic=False, gaussian=True)


def _widths(boxes: Interval, whole: Interval, used: Mask) -> Array:
    """Widths as shares of the whole range, whatever its units; 0 for what the diffusion does not read."""
    with np.errstate(all="ignore"):
        share = (boxes.hi - boxes.lo) / (whole.hi - whole.lo)
        finite = np.where(np.isnan(share) | np.isinf(whole.hi - whole.lo), boxes.hi - boxes.lo, share)
    bounded = np.isfinite(boxes.lo) & np.isfinite(boxes.hi)
    return np.where(used, np.where(bounded, finite, np.inf), 0.0)


def _refuse(tape: Tape, box: Interval, bounded_by_user: bool) -> None:
    try:
        enclose(tape, [x.reshape(1) for x in (box[k] for k in range(len(tape.inputs)))])
    except EnclosureError as error:
        if bounded_by_user:
            raise
        message = f"the diffusion is unbounded on all of R^n: {error} Or give `domain=`."
        raise InfeasibleError(message) from error
    if bounded_by_user:
        raise EnclosureError("`domain` must keep the diffusion bounded; give a smaller `domain=`.")
    raise InfeasibleError("the diffusion is unbounded on all of R^n; give `domain=cb.Box(low, high)`.")


@quiet
def _root(square: Fraction) -> float:
    """The least float that is at least the square root."""
    root = float(np.nextafter(np.sqrt(float(square)), 0.0))
    while Fraction(root) ** 2 < square:
        root = float(np.nextafter(root, np.inf))
    return root


def _effective(trace: Array, sigma: Array, rank: int) -> float:
    """nu with trace <= nu sigma^2 on every piece; never above the rank that g g^T can have."""
    with np.errstate(all="ignore"):
        ratio = upper(trace / lower(sigma * sigma, tiny=TINY), tiny=TINY)
    useful = ratio[np.isfinite(ratio) & (sigma > 0)]
    largest = float(np.max(useful, initial=0.0))
    return min(float(rank), largest) if largest > 0 else float(rank)


Rational = list[list[Fraction]]


def _fractions(matrix: Array) -> Rational:
    return [[Fraction(float(entry)) for entry in row] for row in matrix]


def _times(a: Rational, b: Rational) -> Rational:
    """The product; what is 0 in a row is left out, for large matrices are mostly that."""
    found = []
    for row in a:
        terms = [(x, b[k]) for k, x in enumerate(row) if x]
        found.append([sum((x * other[j] for x, other in terms), Fraction(0)) for j in range(len(b[0]))])
    return found


def _product(gain: Rational, covariance: Rational) -> Rational:
    """G C G^T in rational arithmetic."""
    return _times(_times(gain, covariance), [list(column) for column in zip(*gain)])


def _is_isotropic(norm: Metric, covariance: Rational) -> bool:
    """Whether P M = s I exactly with s > 0."""
    if norm.matrix is not None:
        covariance = _times(_fractions(norm.matrix), covariance)
    level = covariance[0][0]
    pairs = ((i, j) for i in range(norm.dimension) for j in range(norm.dimension))
    return level > 0 and all(covariance[i][j] == (level if i == j else 0) for i, j in pairs)
