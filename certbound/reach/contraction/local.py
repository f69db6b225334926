"""Local constants: contraction and noise bounds that hold along a tube only, and the tubes that they prove.

- Reach (Thm K5): c_k bounds mu_P(D_x f) on p(t) + {||y||_P <= guess_k} over piece k; the radius rho that follows is
  proved on every piece up to the first one where it is not below the guess.
- Tube (Thm K4): a tube r computed from constants of the sets reach + {||y||_P <= guess} is a tube if r <= guess at
  every time. Only trajectory-level tubes survive this (7.7).

Source: Thms K4, K5 (theory).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.bounds import constants_along
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.reach.contraction.slopes import LocalSlopes
from certbound.reach.contraction.uniform import bound_forcing, integrate_radius, jump_sizes
from certbound.reach.nominal import Curve, Flow, initial_cells, nominal_curve
from certbound.reach.sets import ReachTube
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm
from certbound.tubes.constants import Constants
from certbound.tubes.question import Start
from certbound.tubes.tube import Tube, supremum
from certbound.tubes.tuning import tune_tube
from certbound.watch import poll

BLOCK = 16
ITERATIONS = 12
INFLATION = 1.03
GUESSES = 12
TUBE_INFLATION = 1.1
SEGMENTS = 48
REFINE = 16  # sub-boxes per piece
SUPREMUM_GAP = 2e-3
_FARTHEST = 1e150  # radius beyond which nothing is looked for: its square must be finite


def local_contraction_tube(
    problem: Problem | Flow,
    *,
    metric: Array | None = None,
    cells: int | None = None,
    curve: Curve | None = None,
) -> ReachTube:
    """Noise-free reach tube whose contraction rate is bounded along the tube itself (Thm K5).

    Proves: every associated trajectory x from the initial set, under every disturbance, satisfies
    ||x_t - p(t)||_P <= rho_t up to the end of the returned tube, which may come before the horizon (see
    ``ReachTube.end``): the tube stops where no guess of its size confirmed itself.

    Parameters
    ----------
    metric : array_like, shape (n, n), optional
        P; the identity when omitted.
    cells : int, optional
        Parts along each side of the initial set.
    curve : Curve, optional
        The nominal curves, when they are known already.

    Raises
    ------
    EnclosureError
        If not even the first piece is proved.
    ValueError
        If the nominal trajectory cannot be followed.
    """
    flow = problem if isinstance(problem, Flow) else Flow(problem)
    parts = initial_cells(flow.problem, cells)
    if curve is None:
        curve = nominal_curve(flow, parts.centres)
    norm = Norm(flow.dimension, metric)
    march = _March(flow, curve, norm)
    radius = march.run(parts.radii(norm, curve.initial()))
    proved = radius.shape[1]
    if proved == 0:
        raise EnclosureError(
            "the noise-free reach tube could not be proved on its first piece; use more cells of the initial set, "
            "a smaller disturbance, or check where the model is defined."
        )
    return ReachTube(curve=curve.until(proved), radius=radius, metric=metric, method="contraction (local rates)")


class _March:
    """Guess and confirm radii, a block of pieces at a time."""

    def __init__(self, flow: Flow, curve: Curve, norm: Norm) -> None:
        self.curve = curve
        self.slopes = LocalSlopes(flow, norm)
        self.eta = bound_forcing(flow, curve, norm)
        self.gaps = jump_sizes(curve, norm)
        self.least = 1e-12 * float(np.max(norm.length(curve.range()))) + 1e-280  # more than what rounding takes

    def run(self, rho: Array) -> Array:
        """Radii of all pieces that could be proved, shape (B, proved)."""
        blocks: list[Array] = []
        first, size = 0, BLOCK
        slope = self.slopes.bound(self.curve.section(0, 1), rho[:, None])[:, 0]
        while first < self.curve.pieces:
            last = min(first + size, self.curve.pieces)
            result = self._confirm(first, last, rho, slope)
            if result is not None:
                radius, rho, slope = result
                blocks.append(radius)
                first, size = last, min(2 * size, BLOCK)
            elif size == 1:
                break
            else:
                size = max(1, size // 4)
        return np.concatenate(blocks, axis=1) if blocks else np.empty((len(rho), 0))

    def _confirm(self, first: int, last: int, rho: Array, slope: Array) -> tuple[Array, Array, Array] | None:
        """Radii over a block that confirm themselves, the radius after it, and its last slope.

        The first guess is what ``slope`` predicts.
        """
        part = self.curve.section(first, last)
        eta, gaps = self.eta[:, first:last], self.gaps[:, first:last]
        slopes = np.broadcast_to(slope[:, None], eta.shape)
        guess = np.zeros(eta.shape)
        for _ in range(ITERATIONS):
            poll("noise-free tube")
            radius, after = integrate_radius(part, gaps, rho, slopes, eta)
            if np.all(radius < guess):
                return radius, after, slopes[:, -1]
            if not np.all(radius < _FARTHEST):
                return None
            guess = np.where(radius < guess, guess, INFLATION * radius + self.least)
            slopes = self.slopes.bound(part, guess)
        return None


def local_constants(
    problem: Problem, reach: ReachTube, extra: ArrayLike = 0.0, *, segments: int = SEGMENTS
) -> Constants:
    """Constants per piece that hold on reach + {||y||_P <= extra}, in the metric of ``reach`` (Thm K4).

    Parameters
    ----------
    reach : ReachTube
        Noise-free tube over the whole horizon.
    extra : array_like, shape (K,) or ()
        Room for the stochastic deviation on each piece.
    segments : int
        Neighbouring pieces are joined, at their largest values, until so many are left (continuous time).

    Raises
    ------
    ValueError, EnclosureError
        If the Jacobian is unbounded or undefined there.
    """
    hull = reach.boxes(extra)
    boxes = Interval(hull.lo.min(axis=0), hull.hi.max(axis=0))
    curve = reach.curve
    if curve.continuous:
        times = np.append(curve.starts, curve.ends[-1])
    else:
        times, boxes = curve.starts, boxes[:-1]
    along = constants_along(problem, times, boxes, metric=reach.metric, refine=REFINE)
    return along.with_fewer_pieces(segments) if curve.continuous else along


def local_tube(problem: Problem, reach: ReachTube, *, delta: float, method: str = "auto") -> tuple[Tube, Array]:
    """A tube whose constants hold on reach + tube only, and its radius over each piece of ``reach`` (Thm K4).

    Proves: P(||X_t - x_t||_P <= radius over the piece of t, for all t) >= 1 - delta for every associated trajectory
    x in ``reach``. A guess r is accepted when the tube computed from the constants of reach + r is nowhere larger.

    Raises
    ------
    InfeasibleError
        If no guess confirmed itself, or the initial state is random: its spread is no part of ``reach``.
    ValueError
        If the method's level is one time: such a bound must not be combined with local constants (7.7).
    """
    if problem.initial.random and np.any(problem.initial.covariance):
        raise InfeasibleError(
            "no local tube: local constants need a bounded initial set, and `initial` is a GaussianStart; use "
            'method "linear", or give `domain=cb.Box(low, high)` for constants that hold on a domain.'
        )
    guess = np.zeros(reach.curve.pieces)
    for _ in range(GUESSES):
        try:
            constants = local_constants(problem, reach, guess)
        except (ValueError, EnclosureError) as error:
            raise InfeasibleError(
                f"no local tube at delta = {delta:g}: with {np.max(guess):.3g} of room, {error} "
                "Use more cells, less noise, or a larger delta."
            ) from error
        tube = tune_tube(constants, horizon=reach.end, delta=delta, method=method)
        if tube.level != "trajectory":
            raise ValueError(f"`method` must be of trajectory level with local constants, got {method!r}.")
        radius = radius_over_pieces(tube, reach.curve)
        if np.all(radius <= guess):
            return tube, radius
        guess = np.maximum(guess, TUBE_INFLATION * radius)
    raise InfeasibleError(
        f"no local tube at delta = {delta:g}: no radius up to {np.max(guess):.3g} confirmed itself; "
        "use more cells, less noise, or a larger delta."
    )


def radius_over_pieces(tube: Tube, curve: Curve) -> Array:
    """Upper bounds of a tube's radius over each piece of a curve, shape (K,); 0 at step 0 of discrete time.

    In continuous time neighbouring pieces share one bound, ``SEGMENTS`` of them over the horizon.
    """
    if not curve.continuous:
        radius = np.asarray(tube.bound(curve.starts[1:], curve.ends[1:]), dtype=float)
        return np.concatenate([[0.0], radius])
    edges = np.unique(np.linspace(0, curve.pieces, min(SEGMENTS, curve.pieces) + 1).astype(int))
    starts, ends = curve.starts[edges[:-1]].tolist(), curve.ends[edges[1:] - 1].tolist()
    values = np.array([_supremum(tube, start, end) for start, end in zip(starts, ends)])
    return np.repeat(values, np.diff(edges))


def needed_radius(tube: Tube, curve: Curve, start: Start) -> Array:
    """Radius of a tube over each piece; step 0 of discrete time owes nothing unless the start is random."""
    radius = radius_over_pieces(tube, curve)
    if not curve.continuous and start != Start():
        radius[0] = tube.bound(0.0, 0.0)
    return radius


def random_start(problem: Problem, constants: Constants) -> Start:
    """X_0 - mean as isotropic sub-Gaussian noise: the least s found with covariance <= s^2 P^-1 (item 7.4).

    Proved through s^2 P - P C P > 0. The tube then needs nu = n, see `Constants.effective_dimension`.
    """
    if not problem.initial.random or not np.any(problem.initial.covariance):
        return Start()
    covariance = np.asarray(problem.initial.covariance, dtype=float)
    metric = constants.matrix
    root = np.linalg.cholesky(metric)
    square = float(np.linalg.eigvalsh(root.T @ covariance @ root)[-1])
    inner = Interval.point(metric) @ Interval.point(covariance) @ Interval.point(metric)
    for slack in 10.0 ** np.arange(-12.0, 1.0):
        factor = square * (1 + slack)
        if bool(is_positive_definite(Interval.point(metric) * factor - inner)):
            return Start(sigma=math.nextafter(math.sqrt(factor), math.inf))
    raise EnclosureError("the random start could not be bounded in the metric; it is too ill-conditioned.")


def _supremum(tube: Tube, start: float, end: float) -> float:
    """``tube.bound``, searched less closely."""
    profiles = [tube.profile] if tube.bounded is None else [tube.profile, tube.bounded]
    return min(supremum(profile, start, end, whole=False, gap=SUPREMUM_GAP) for profile in profiles)
