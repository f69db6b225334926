"""Slepian's comparison of a rough Gaussian process with an Ornstein-Uhlenbeck process in a clock of its own.

Let x_t = xi_t/s_t (unit variance) and psi(s, t) = -log corr(xi_s, xi_t). If a nondecreasing clock satisfies
clock(t) - clock(s) >= psi(s, t) for **all** s < t of a block, then P(exists t in the block: x_t > q_t) is
at most the probability that the stationary Ornstein-Uhlenbeck process exceeds q in that clock (Slepian's
inequality).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Index
from certbound.checks import frozen
from certbound.gaussian.scalar.normal import EPS
from certbound.gaussian.scalar.ornstein_uhlenbeck import log_polygon_crossing
from certbound.gaussian.scalar.pairs import total
from certbound.rigor.rounding import quiet

_WEIGHT = 2.0  # window clock times the square of the least level: near the optimum for levels of 3 to 6
_MOST_WINDOWS = 2000
_LEAST_CLOCK = 1e-9  # a piece of less clock is given this much
_MISFIT, _FAR_BELOW, _SPLITS = 0.1, 0.5, 6  # a chord may pass a node this much above or below, times the level
_FAR_ABOVE = 20.0  # levels with (z/s)^2 this much above the least do not matter


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clock:
    """A clock on K pieces, linear in time on each: clock(t) - clock(s) >= -log corr within every block."""

    increments: Array  # (K,): clock of each piece
    starts: Index  # first piece of each block, beginning with 0


def node_clock(durations: ArrayLike, near: ArrayLike, needs: ArrayLike, *, limit: float = 0.35) -> Clock:
    """The least clock that decorrelations at the nodes allow, by a forward maximum over them.

    Proves: clock(t) - clock(s) >= psi(s, t) for all s < t in one block, given that for s < t in one part k, and for s
    in part k - 1 and t in part k, d psi/dt <= near[k]; and that for s in part i and t in part j >= i + 2 psi(s, t)
    is at most the bilinear interpolation of ``needs`` at the four corners (t_i or t_{i+1}, t_j or t_{j+1}). The
    clock is linear on each part, so clock(t) - clock(s) is such an interpolation itself: it suffices that it is at
    least ``needs`` at the nodes, and grows by near[k] h_k on part k (the integral of d psi/dt from s on).

    Parameters
    ----------
    durations : array_like, shape (K,)
        Lengths h of the parts, > 0.
    near : array_like, shape (K,)
        Finite upper bounds as above.
    needs : array_like, shape (K + 1, K + 1)
        Entries a < b are read; +inf allowed beyond the first upper diagonal: no block goes that far.
    limit : float
        A new block begins at the part at whose end a need exceeds it.

    Raises
    ------
    ValueError
        If shapes disagree, a duration is not positive, or a near rate or a need of neighbours is not finite.

    Examples
    --------
    >>> needs = [[0, 0.5, 0.9], [0, 0, 0.5], [0, 0, 0]]
    >>> node_clock([0.5, 0.5], [1.0, 1.0], needs, limit=1.0).increments.round(9).tolist()
    [0.5, 0.5]
    """
    h, rate = (np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in (durations, near))
    need = np.asarray(needs, dtype=np.float64)
    count = len(h)
    if h.ndim != 1 or not np.all((h > 0) & (h < np.inf)):
        raise ValueError("`durations` must be a row of positive numbers.")
    if rate.shape != (count,) or need.shape != (count + 1, count + 1):
        raise ValueError(f"`near` and `needs` must have shapes ({count},) and ({count + 1}, {count + 1}).")
    if not (np.all(np.isfinite(rate)) and np.all(np.isfinite(np.diagonal(need, 1))) and not np.any(np.isnan(need))):
        raise ValueError("`near` and the `needs` of neighbours must be finite; take shorter parts.")
    increments = np.maximum(rate, 0.0) * h * (1 + 2 * EPS)
    clock = np.zeros(count + 1)
    starts, block = [0], 0
    for j in range(count):
        asked = need[block : j + 1, j + 1]
        if j > block and not np.all(asked <= limit):
            starts.append(j)
            block = j
            asked = asked[-1:]
        ahead = float(np.max(clock[block : j + 1] + asked)) - clock[j]
        increments[j] = max(increments[j], ahead + 8 * EPS * (1 + abs(clock[j])))
        clock[j + 1] = clock[j] + increments[j]
    return Clock(increments=frozen(increments), starts=np.asarray(starts, dtype=np.intp))


NO_CUTS: Index = np.zeros(1, dtype=np.intp)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Windows:
    """Lines below a boundary: first piece, clock and end levels of each window."""

    first: Index
    spans: Array
    starts: Array
    stops: Array


@quiet
def group_windows(
    clock: Array, left: Array, right: Array, span: float, forced: Index = NO_CUTS
) -> Windows:
    """Windows of about ``span`` over the nodes of ``clock``, cut at ``forced``, split where a line fits badly.

    Proves: each line, a chord in Brownian coordinates, lies below the boundary that on piece l runs at or
    above the chord from ``left[l]`` to ``right[l]`` (see `_lines`).
    """
    first = _cut(clock, span, forced)
    cap = np.sqrt(min(float(np.min(left)), float(np.min(right))) ** 2 + _FAR_ABOVE)
    lines, line = _lines(clock, left, right, first)
    for _ in range(_SPLITS):
        last = np.append(first[1:], len(left))
        room = np.minimum(np.minimum(left[1:], right[:-1]), cap) - line  # at the nodes inside
        inside = np.ones(len(room), dtype=bool)
        inside[first[1:] - 1] = False
        misfit = np.where(inside, np.abs(room) * np.maximum(cap, line), 0.0)
        misfit = np.where(room > 0, misfit / _FAR_BELOW, misfit / _MISFIT)
        window = np.repeat(np.arange(len(first)), last - first)[1:]
        worst = np.zeros(len(first))
        np.maximum.at(worst, window, misfit)
        bad = (worst > 1) & (lines.spans > _LEAST_CLOCK)
        if not np.any(bad):
            break
        more = [int(i) + 1 + int(np.argmax(misfit[i : j - 1])) for i, j in zip(first[bad], last[bad])]
        first = np.unique(np.concatenate([first, np.asarray(more, dtype=np.intp)]))
        lines, line = _lines(clock, left, right, first)
    return lines


def _lines(clock: Array, left: Array, right: Array, first: Index) -> tuple[Windows, Array]:
    """One line per window from node ``first[k]`` to the next; the levels of the chords at the inner nodes.

    The chord between the window's ends is lowered by its largest excess over the nodes inside, and by 1e-12
    relative for rounding.
    """
    count = len(left)
    last = np.append(first[1:], count)
    window = np.repeat(np.arange(len(first)), last - first)
    origin = clock[first]
    spans = clock[last] - origin
    low, high = left[first], right[last - 1] * np.exp(spans)
    slope = (high - low) / np.expm1(2 * spans)
    excess = np.zeros(len(first))
    for node, level in ((np.arange(count), left), (np.arange(1, count + 1), right)):
        offset = clock[node] - origin[window]
        chord = low[window] + slope[window] * np.expm1(2 * offset)
        if level is left:
            line = (chord * np.exp(-offset))[1:]
        excess = np.maximum(excess, np.maximum.reduceat(chord - level * np.exp(offset), first))
    excess = excess + 1e-12 * (low + high)
    stops = (high - excess) * np.exp(-spans)
    stops = stops - 32 * EPS * np.abs(stops)
    return Windows(first=first, spans=spans, starts=low - excess, stops=stops), line


def _cut(clock: Array, span: float, forced: Index) -> Index:
    """First pieces of windows of about ``span`` between forced cuts, none but whole blocks below a tenth."""
    nodes, first, start = clock.tolist(), [0], 0.0
    blocks = {*forced.tolist(), len(nodes) - 1}
    fresh = True
    for k in range(1, len(nodes)):
        if k in blocks:
            if not fresh and nodes[k] - start < 0.1 * span:
                first.pop()
            fresh = True
        elif nodes[k] - start >= (1 - 1e-9) * span:
            fresh = False
        else:
            continue
        first.append(k)
        start = nodes[k]
    return np.asarray(first[:-1], dtype=np.intp)


@quiet
def clock_crossing(clock: Clock, levels: ArrayLike) -> float:
    """Upper bound of log10 P(exists t: xi_t > z_t) for a process compared with an OU process by its `Clock`.

    Proves: with A_k the exceedance in block k and x continuous from block to block, P <= P(A_0) + sum_k
    [P(A_k) - P(A_k, x > q at the end of block k - 1)], and P(A_k) by Slepian and the window sums of
    `log_polygon_crossing`; a boundary linear in the clock and >= 0 is concave in Brownian coordinates,
    hence above its chords.

    Parameters
    ----------
    clock : Clock
        From `node_clock`.
    levels : array_like, shape (K,) or (K, 2)
        Lower bounds of z_t/s_t on each piece: one number, or its two ends when z_t/s_t is at least the
        linear interpolation (in t) between them. +inf allowed.

    Returns
    -------
    float
        0.0 (probability 1) where a level is negative.

    Notes
    -----
    Where xi starts from rest the rates grow like 1/(2t): begin at a small t_0, let the pieces grow
    geometrically, and add a bound for [0, t_0] (any crude one: z/s is large there).

    Examples
    --------
    >>> clock = Clock(increments=np.full(10, 0.5), starts=np.zeros(1, dtype=int))
    >>> bool(-2.59 < clock_crossing(clock, [4.0] * 10) < -2.54)  # -2.592 by the differential equation
    True
    """
    d = np.asarray(clock.increments, dtype=np.float64)
    q = np.asarray(levels, dtype=np.float64)
    if q.ndim == 1:
        q = np.stack([q, q], axis=-1)
    if q.shape != (len(d), 2) or np.any(np.isnan(q)):
        raise ValueError(f"`levels` must have shape ({len(d)},) or ({len(d)}, 2) without NaN, got {q.shape}.")
    least = float(np.min(q))
    if least < 0:
        return 0.0
    if least == np.inf:
        return -np.inf
    q = np.minimum(q, 3 * least + 40)
    span = max(_WEIGHT / max(least, 0.5) ** 2, float(np.sum(d)) / _MOST_WINDOWS)
    parts = np.maximum(np.ceil(3 * d / span), 1).astype(np.intp)
    nodes, left, right = _subdivide(d, q, parts)
    forced = (np.cumsum(parts) - parts)[clock.starts]
    lines = group_windows(nodes, left, right, span, forced)
    fresh = np.isin(lines.first, forced)
    logs = log_polygon_crossing(lines.spans, lines.starts, lines.stops, fresh=fresh)
    return float(total(logs))


def _subdivide(d: Array, q: Array, parts: Index) -> tuple[Array, Array, Array]:
    """Each piece cut into equal parts: the clock at the nodes, and levels at the two ends of each part.

    The clock grows by at least d/parts on each part, whatever the rounding of its sum.
    """
    piece = np.repeat(np.arange(len(d)), parts)
    index = np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)
    share = 1.0 / parts[piece]
    base, rise = q[piece, 0], (q[:, 1] - q[:, 0])[piece]
    guard = 32 * EPS * (q[piece, 0] + q[piece, 1])
    left = np.where(index == 0, base, base + rise * index * share - guard)
    right = np.where(index + 1 == parts[piece], q[piece, 1], base + rise * (index + 1) * share - guard)
    steps = np.maximum((d / parts)[piece] * (1 + 8 * EPS), _LEAST_CLOCK)
    steps = steps + 8 * EPS * float(np.sum(steps))
    return np.concatenate([[0.0], np.cumsum(steps)]), left, right
