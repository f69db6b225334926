"""What the noise of one step makes of a function on the grid, as a majorant on the mesh of a band's rows.

The function is, for y in [y_i, y_{i+1}], linear in y between the lines L_i(q), and every L_i is continuous and, on each
cell of the q-axis, linear plus b_ij (q - q_j)(q_{j+1} - q)/2. With V_i = E L_i(. + s_q z) (smooth, known with two
derivatives at the nodes) the mean is T(y, w) = sum_i E h_i(y + s_y z) V_i(w). Exactly, before rounding,

- the rows W_k = T(Y_k, .) and their derivatives are products with ``rows``;
- over a cell of the q-axis a function g differs from its values at the ends by at most D^2/8 sup |g''|; for -V_i'' and
  the slopes' derivatives S_i' (S_i = (V_{i+1} - V_i)/D_i) that supremum is a sum over kinks of L_i:
  V'''' = sum kappa_j phi'' - sum b_j int phi'', and so on with |phi'|, |phi| for lower orders;
- d_yy T = sum_i K_i(w) phi(y - y_i), K_i = S_i - S_{i-1}; the rows' own kinks are KW_k = sum_i E h_k(y_i + s z) K_i;
  between the rows T <= linear interpolation + sum_i (-K_i)^+ E D_k tau (1 - tau), tau where y_i + s z is in cell k;
- d_ww T, |d_yw T|, |d_yy T| lie below sums with non-negative coefficients of densities or masses at kinks and cells:
  sum_i ceiling_ki sum_j (kappa_ij^+ + (-b_ij)^+ D_j) phi, sum_i mass_ki sum_j sup |d_q S_i| P, sum_i density_ki sum_j
  sup |K_i| P; with the supremum over s in [s_q, s_q stretch] they bound the means over a further N(0, (stretch^2 - 1)
  s_q^2) of w, too.

All of this is a majorant on cells [Y_k, Y_{k+1}] x [w_l, w_{l+1}], which is what `Rows` holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.semilagrangian.smoothers import Across, Along, across_by

_UP = 1 + 1e-9


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Lines:
    """A function on the grid: ``nodal`` (ny, nq), and ``bend`` b (ny, nq - 1) on the cells of every line."""

    nodal: Array
    bend: Array


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Rows:
    """The majorant of the smoothed function, for the rows of one band.

    Attributes
    ----------
    values : ndarray, shape (rows, nq)
        W_k at the nodes.
    sagging, sway : ndarray, shapes (rows, nq), (rows, nq - 1)
        -W_k'' at the nodes, and by how much it may exceed its linear interpolation on cells.
    bend, arch : ndarray, shape (rows, nq - 1)
        Upper bounds of -W_k'' on cells, and b such that W_k lies below its chords plus b (w - w_l)(w_{l+1} - w)/2: of
        what is linear in -W_k'' the mean and a sixth of the change.
    kinks : ndarray, shape (rows, nq - 1)
        Upper bounds of -KW_k on cells.
    lift : ndarray, shape (rows - 1, nq - 1)
        T minus the linear interpolation between rows, from above.
    cross_low, cross_high : ndarray, shape (rows - 1, nq - 1)
        Range of the derivative by w of the rows' slope.
    bent, mixed, bowed : ndarray, shape (rows - 1, nq - 1)
        Upper bounds of d_ww T (at least 0), |d_yw T|, |d_yy T|.
    steep_y, steep_w : ndarray, shape (rows - 1, nq - 1)
        Bounds of the interpolation's first derivatives, in size.
    near : ndarray, shape (rows - 1, nq - 1)
        The dominating mean of |U|, in which errors are measured.
    lean_y, lean_q : ndarray, shape (rows - 1, nq - 1)
        Dominating means of |U|'s slopes near a point.
    fourth : ndarray, shape (rows - 1, nq - 1)
        Upper bound of |d_wwww T|, for all s in [s_q, s_q stretch].
    """

    values: Array
    sagging: Array
    sway: Array
    bend: Array
    arch: Array
    kinks: Array
    lift: Array
    cross_low: Array
    cross_high: Array
    bent: Array
    mixed: Array
    bowed: Array
    steep_y: Array
    steep_w: Array
    near: Array
    lean_y: Array
    lean_q: Array
    fourth: Array


def smoothed(
    lines: Lines, slopes: tuple[Array, Array], places: tuple[Array, Array], mesh: tuple[Array, Array], one: Along,
    two: Across, least: Rows | None = None,
) -> Rows:  # fmt: skip
    """The majorant on the rows and nodes at ``mesh``, from the lines and nodes at ``places``.

    Parameters
    ----------
    lines : Lines
        At ``places``: what is within reach only.
    slopes : (ndarray, ndarray), shape (lines - 1, nodes - 1)
        Bounds of |d_y U|, |d_q U| near every cell.
    least : Rows, optional
        The same with a smaller s_q whose stretch reaches this one's: what depends on second derivatives and dominating
        means alone is then as there.
    """
    dy, dq = np.diff(places[0])[:, None], np.diff(places[1])
    dm, dw = np.diff(mesh[0])[:, None], np.diff(mesh[1])
    eighth = dw**2 / 8 * _UP
    u, b = lines.nodal, lines.bend
    spans = two.spans
    v, v1, v2 = (
        across_by(u, value, spans) + across_by(b, parabola, spans)
        for value, parabola in zip(two.values, two.parabolas)
    )
    fourth = across_by(_kinks(u, b, dq), two.sup[2], spans) * eighth
    down = _ends(np.maximum, -v2) + fourth
    mean = -(v2[:, 1:] + v2[:, :-1]) / 2 + np.abs(np.diff(v2, axis=1)) / 6 * _UP + fourth
    slope_u, slope_b = np.diff(u, axis=0) / dy, np.diff(b, axis=0) / dy
    turn = across_by(_kinks(slope_u, slope_b, dq), two.sup[1], spans) * eighth
    jump = np.diff(np.diff(v, axis=0) / dy, axis=0)
    wave = across_by(_kinks(np.diff(slope_u, axis=0), np.diff(slope_b, axis=0), dq), two.sup[0], spans) * eighth
    edge = ((1, 1), (0, 0))
    drop = np.pad(_ends(np.maximum, -jump) + wave, edge)
    rows, rows1, bend = one.rows @ v, one.rows @ v1, one.rows @ down
    cross = np.diff(rows1, axis=0) / dm
    spare = one.mass @ turn
    low, high = _ends(np.minimum, cross) - spare, _ends(np.maximum, cross) + spare
    if least is None:
        tilt = across_by(np.abs(np.diff(slope_u, axis=1)) / dq + np.abs(slope_b) * dq / 2, two.mass, spans)
        bow = _ends(np.maximum, np.abs(np.diff(slope_u, axis=0))) + np.abs(np.diff(slope_b, axis=0)) * (dq**2 / 8 * _UP)
        size = np.pad(across_by(bow, two.mass, spans), edge)
        bent, mixed, bowed, lean_y, lean_q, quartic = (
            one.ceiling @ across_by(_rising(u, b, dq), two.density, spans) * _UP, (one.mass @ tilt) * _UP,
            (one.density @ size) * _UP, _wide(slopes[0], one, two), _wide(slopes[1], one, two),
            one.ceiling @ across_by(_kinks(u, b, dq), two.fourth, spans) * _UP,
        )  # fmt: skip
    else:
        bent, mixed, bowed, lean_y, lean_q, quartic = (
            least.bent, least.mixed, least.bowed, least.lean_y, least.lean_q, least.fourth,
        )  # fmt: skip
    inner = np.maximum(np.maximum(bend[:-1], bend[1:]), bent)
    rate = np.abs(np.diff(rows, axis=1)) / dw
    return Rows(
        values=rows, sagging=-(one.rows @ v2), sway=one.rows @ fourth, bend=bend, arch=one.rows @ mean,
        kinks=one.spread @ drop, lift=(one.cells @ np.maximum(drop, 0.0)) * _UP,
        cross_low=low, cross_high=high, bent=bent, mixed=mixed, bowed=bowed,
        steep_y=_ends(np.maximum, np.abs(np.diff(rows, axis=0)) / dm) + dw / 2 * np.maximum(np.abs(low), np.abs(high)),
        steep_w=np.maximum(rate[:-1], rate[1:]) + dw / 2 * np.maximum(inner, 0.0),
        near=_wide(_corners(u) + _sides(np.abs(b)) * (dq**2 / 8 * _UP), one, two),
        lean_y=lean_y, lean_q=lean_q, fourth=quartic,
    )  # fmt: skip


def _kinks(u: Array, b: Array, dq: Array) -> Array:
    """|kappa_j| + |b_j| D_j, assigned to the cells right of the kinks, and a share for rounding."""
    slope, half = np.diff(u, axis=1) / dq, b * dq / 2
    found = np.abs(b) * dq
    found[:, 1:] += np.abs((slope + half)[:, 1:] - (slope - half)[:, :-1])
    found[:, 0] += np.abs((slope + half)[:, 0])
    found += 1e-13 * (np.abs(u[:, 1:]) + np.abs(u[:, :-1])) / dq
    return found


def _rising(u: Array, b: Array, dq: Array) -> Array:
    """kappa_j^+ + (-b_j)^+ D_j, assigned to the cells right of the kinks."""
    slope, half = np.diff(u, axis=1) / dq, b * dq / 2
    found = np.maximum(-b, 0.0) * dq + 1e-13 * (np.abs(u[:, 1:]) + np.abs(u[:, :-1])) / dq
    found[:, 1:] += np.maximum((slope + half)[:, 1:] - (slope - half)[:, :-1], 0.0)
    found[:, 0] += np.maximum((slope + half)[:, 0], 0.0)
    return np.asarray(found)


def _ends(pick: np.ufunc, values: Array) -> Array:
    """Largest or smallest of the two ends of every cell of the last axis."""
    return np.asarray(pick(values[..., :-1], values[..., 1:]))


def _corners(u: Array) -> Array:
    size = _ends(np.maximum, np.abs(u))
    return np.asarray(np.maximum(size[:-1], size[1:]))


def _sides(b: Array) -> Array:
    return np.asarray(np.maximum(b[:-1], b[1:]))


def _wide(cellwise: Array, one: Along, two: Across) -> Array:
    return across_by(one.wide @ cellwise, two.wide, two.spans) * _UP
