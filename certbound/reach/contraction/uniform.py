"""The contraction tube: one scalar equation bounds every noise-free trajectory around a nominal curve.

With mu_P(D_x f) <= c on the set, ||x_t - p(t)||_P <= rho(t) where rho' = c rho + eta, rho(0) = the initial
set's extent; eta bounds the defect of p and the effect of the disturbance. On a piece of length h with
constant c and eta

    rho(s) <= e^{c s} rho(0) + eta (e^{c s} - 1)/c,

which is monotone in s, so that its largest value on the piece is at an end. Discrete time: rho+ = L rho +
eta.

Source: Thm K5 (theory), 7.8 for the jumps between pieces.
"""

from __future__ import annotations

import itertools

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError
from certbound.problem.problem import Problem
from certbound.reach.nominal import Curve, Flow, bound_defect, bound_disturbance_slope, initial_cells, nominal_curve
from certbound.reach.sets import ReachTube
from certbound.rigor import intervals as iv
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm, largest_over_box
from certbound.tubes.constants import Constants
from certbound.watch import poll

CORNER_LIMIT = 6


def contraction_tube(
    problem: Problem | Flow,
    constants: Constants,
    *,
    cells: int | None = None,
    curve: Curve | None = None,
) -> ReachTube:
    """Noise-free reach tube in the constants' metric (Thm K5).

    Proves: every associated trajectory x from the initial set, under every disturbance, satisfies
    ||x_t - p(t)||_P <= rho_t, provided that the constants hold on the tube. Constants that hold on a domain
    only prove it as long as the tube lies in the domain: check `distance_to` its constraint.

    Parameters
    ----------
    constants : Constants
        rate (continuous time) or gain (discrete time) in its metric; sigma is not used.
    cells : int, optional
        Parts along each side of the initial set, one curve each.
    curve : Curve, optional
        The curves, when they are known already; they must start one in each cell.

    Returns
    -------
    ReachTube
        It may end before the horizon (see ``ReachTube.end``), where the closed loop has no enclosure.

    Raises
    ------
    ValueError
        If rate and time do not fit, or the nominal trajectory cannot be followed.
    EnclosureError
        If the closed loop has no enclosure on the first piece already.
    """
    flow = problem if isinstance(problem, Flow) else Flow(problem)
    if constants.continuous != flow.continuous:
        word = "rate" if flow.continuous else "gain"
        raise ValueError(f"`constants` must state a {word}, as the problem's time asks.")
    parts = initial_cells(flow.problem, cells)
    if curve is None:
        curve = nominal_curve(flow, parts.centres)
    norm = constants.norm
    slopes = values_on_pieces(constants.slope, constants.times, curve)
    rho = parts.radii(norm, curve.initial())
    radius, _ = integrate_radius(curve, jump_sizes(curve, norm), rho, slopes, bound_forcing(flow, curve, norm))
    proved = first_infinite(radius)
    if proved == 0:
        raise EnclosureError(
            "the closed loop has no enclosure on the first piece of the nominal curve; check where the model is "
            "defined."
        )
    return ReachTube(
        curve=curve.until(proved),
        radius=radius[:, :proved],
        metric=constants.metric,
        assumption="" if constants.certified else "the stated constants",
    )


def first_infinite(radius: Array) -> int:
    """Number of pieces before the first unbounded one."""
    finite = np.all(np.isfinite(radius), axis=0)
    return len(finite) if finite.all() else int(np.argmin(finite))


def bound_forcing(flow: Flow, curve: Curve, norm: Norm) -> Array:
    """Upper bounds eta of sup_d ||p' - f(p, d, t)||_P over pieces, shape (B, K); inf where f is undefined.

    Discrete time: of sup_d ||p_{t+1} - f(p_t, d, t)||_P for the step from t to t + 1, with 0 for the last
    time.
    """
    eta = norm.length(bound_defect(flow, curve))
    width = flow.disturbance - flow.centre_disturbance
    if flow.disturbance.shape[0] and np.any(width.mag > 0):
        slope = bound_disturbance_slope(flow, curve)[:, : eta.shape[1]]
        eta = (Interval.point(_finite(eta)) + Interval.point(_finite(_largest_image(norm, slope, width)))).hi
        eta = np.where(eta >= 1e300, np.inf, eta)
    if not curve.continuous:
        eta = np.concatenate([eta, np.zeros((len(eta), 1))], axis=1)
    return np.asarray(eta)


def _finite(values: Array) -> Array:
    return np.minimum(values, 1e300)


def _largest_image(norm: Norm, slope: Interval, width: Interval) -> Array:
    """Upper bounds of ||E v||_P over E in ``slope`` and v in a box; convex in v, so corners suffice."""
    wide = np.flatnonzero(width.width > 0)
    if len(wide) > CORNER_LIMIT or not np.all(np.isfinite(slope.mag)):
        box = (slope * width).sum(axis=-1)
        if not np.all(np.isfinite(box.mag)):
            return norm.length(box)
        return largest_over_box(norm, box)
    best = np.zeros(slope.shape[:-2])
    for choice in itertools.product((False, True), repeat=len(wide)):
        corner = width.lo.copy()
        corner[wide] = np.where(choice, width.hi[wide], width.lo[wide])
        best = np.maximum(best, norm.length((slope * Interval.point(corner)).sum(axis=-1)))
    return best


def integrate_radius(curve: Curve, gaps: Array, rho: Array, slopes: Array, eta: Array) -> tuple[Array, Array]:
    """rho over each piece, shape (B, K), and after the last one, shape (B,), rounded up.

    ``gaps`` (B, K) are the jumps of the curve after each of its K pieces (see `jump_sizes`), ``rho`` (B,) the radius at
    the start of the first one; ``slopes`` and ``eta``, broadcastable to (B, K), are c (CT) or L (DT), and the forcing.
    Once a radius is infinite it stays so.
    """
    slopes = np.broadcast_to(slopes, eta.shape)
    radius = np.empty(eta.shape)
    if curve.continuous:
        factor, integral = growth(slopes, curve)
    else:
        factor, integral = slopes, np.ones(slopes.shape)
    for k in range(curve.pieces):
        poll()
        after = _step(factor[:, k], rho, integral[:, k], eta[:, k])
        radius[:, k] = np.maximum(rho, after) if curve.continuous else rho
        rho = np.nextafter(after + gaps[:, k], np.inf)
    return radius, rho


def jump_sizes(curve: Curve, norm: Norm) -> Array:
    """Upper bounds of the curve's jump after each piece, shape (B, K); 0 after the last and in discrete time."""
    gaps = np.zeros((curve.cells, curve.pieces))
    if curve.continuous and curve.pieces > 1:
        gaps[:, :-1] = norm.length(curve.jumps())
    return gaps


def _step(factor: Array, rho: Array, integral: Array, eta: Array) -> Array:
    """Upper bound of factor rho + integral eta (all nonnegative), inf-safe."""
    with np.errstate(all="ignore"):
        grown = np.nextafter(factor * rho, np.inf)
        forced = np.nextafter(integral * eta, np.inf)
        total = np.nextafter(grown + forced, np.inf)
    return np.where(np.isnan(total), np.inf, total)


def growth(rates: Array, curve: Curve) -> tuple[Array, Array]:
    """Upper bounds of e^{c h} and int_0^h e^{c s} ds for the pieces' lengths h, in the shape of ``rates``.

    The integral is h phi(c h), phi(x) = (e^x - 1)/x = 1 + x/2 (1 + x/3 (1 + ...)); the series is cut after 16
    terms, whose rest is below 0.6^16/17! < 1e-17 for |x| <= 0.6, and used up to |x| = 0.5.
    """
    finite = np.isfinite(rates)
    h = Interval.point(curve.ends) - curve.starts
    x = Interval.point(np.where(finite, rates, 0.0)) * h
    factor = iv.exp(x)
    large = np.abs(x.mid) > 0.5
    quotient = (factor - 1.0) / Interval(np.where(large, x.lo, 1.0), np.where(large, x.hi, 1.0))
    small = Interval(np.where(large, 0.0, x.lo), np.where(large, 0.0, x.hi))
    total = Interval.point(np.ones(x.shape))
    for j in range(16, 1, -1):
        total = total * small / float(j) + 1.0
    total = total + Interval(-1e-17, 1e-17)
    phi = np.clip(np.where(large, quotient.hi, total.hi), 0.0, 1e300)
    integral = (Interval.point(phi) * h).hi
    finite &= phi < 1e300
    return np.where(finite, factor.hi, np.inf), np.where(finite, integral, np.inf)


def values_on_pieces(values: object, times: Array | None, curve: Curve) -> Array:
    """Largest of piecewise-constant values over each piece of the curve (values hold on [t_j, t_{j+1}))."""
    array = np.atleast_1d(np.asarray(values, dtype=float))
    if times is None or len(array) == 1:
        return np.full(curve.pieces, array.max())
    if curve.ends[-1] > times[-1]:
        raise ValueError(f"`times` must reach the horizon {curve.ends[-1]:g}, got {times[-1]:g}.")
    last = len(array) - 1
    first = np.clip(np.searchsorted(times, curve.starts, side="right") - 1, 0, last)
    final = np.clip(np.searchsorted(times, curve.ends, side="left") - 1, 0, last)
    return np.array([array[a : max(a, b) + 1].max() for a, b in zip(first, final)])
