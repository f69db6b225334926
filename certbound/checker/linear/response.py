"""The linear response of one cell in ball arithmetic: transition matrices, covariances, supports along rows.

On piece k of length h the slope is J(tau) = A + tau K, tau in [0, h]; Phi is its transition matrix. With
|J| h at most J_ = |A| h + |K| h^2 entry by entry,

- F = Phi(h, 0), Gamma = int_0^h Phi(h, u) du and Q = int_0^h Phi(h, u) W Phi(h, u)^T du are power series in h whose
  rests are bounded by scalar majorants;
- |Phi(s, u) - I| <= D = exp(J_) - I, and |Phi(h, u) - I - (h - u) A| <= S = D - |A| h, for all s, u in the piece.

Discrete time: F = A, Gamma = I, Q = W, D = S = 0. Source: Thm K7 of docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat, ctx

from certbound.checker.balls import column, diagonal, identity, magnitude, row_sums
from certbound.checker.report import PRODUCT, Budget, Unproved

_TERMS = 60
"""Of a series at the precision of a check; more at higher ones."""
_SWEEPS, _FARTHEST = 20, 300
_GUARD = 28
"""Bits of the working precision that the rest of a series may take: one that is the same at every precision is what
products of many transition matrices magnify."""
_ROWS, _BLOCK = 512, 3e6
"""Rows that are carried back together, and products of numbers between two looks at the clock."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Piece:
    """Linear data of one piece: the matrices of the module's docstring, and |A| and |K| themselves."""

    length: arb
    transition: arb_mat
    gathered: arb_mat
    noise: arb_mat
    deviation: arb_mat
    second: arb_mat
    slope: arb_mat
    size: arb_mat
    drift: arb_mat
    jump: bool = False

    @property
    def curvature(self) -> arb_mat:
        """Bound of |d^2 Phi(t, u)/dt^2| over the piece."""
        whole = self.size + self.drift * self.length
        return (self.drift + whole * whole) * (identity(whole.nrows()) + self.deviation)


def _tail(older: arb, newer: arb, alpha: arb, kappa: arb, count: int) -> arb | None:
    """Bound of the terms beyond ``count`` of m_{i+1} = (alpha m_i + kappa m_{i-1})/(i + 1); None if not yet small."""
    ratio = (alpha + kappa) / (count + 1)
    if not ratio < 0.5:
        return None
    return (4 * ratio * arb.max(older, newer)).upper()


def _series(
    a: arb_mat, k: arb_mat, start: arb_mat, force: arb_mat | None, *, twosided: bool
) -> arb_mat:
    """Sum of X_{i+1} = (a X_i + k X_{i-1} [+ transposes] + [i = 0] force)/(i + 1), with its rest."""
    n = a.nrows()
    alpha, kappa = row_sums(a), row_sums(k)
    if twosided:
        alpha, kappa = alpha + row_sums(a.transpose()), kappa + row_sums(k.transpose())
    older, newer, total = start * 0, start, start
    small, big = arb(0), row_sums(start)
    least = arb(2) ** (_GUARD - ctx.prec)
    for i in range(max(_TERMS, _TERMS * ctx.prec // 128)):
        term = a * newer + k * older
        if twosided:
            term = term + term.transpose()
        size = alpha * big + kappa * small
        if i == 0 and force is not None:
            term, size = term + force, size + row_sums(force)
        older, newer = newer, term * (arb(1) / (i + 1))
        small, big = big, (size / (i + 1)).upper()
        total = total + newer
        rest = _tail(small, big, alpha, kappa, i + 1)
        if rest is not None and rest < least * (1 + row_sums(total)):
            return total + arb_mat(n, n, [arb(0, rest)] * (n * n))
    raise Unproved("the pieces are too long for the slope: its norm times a piece's length is beyond all use")


def balance(a: arb_mat) -> list[arb]:
    """Powers of two u for which the rows and columns of a_ij u_j / u_i are about equal: any choice serves."""
    n = a.nrows()
    sizes = [[float(a[i, j].abs_upper()) if i != j else 0.0 for j in range(n)] for i in range(n)]
    exponents = [0] * n
    for _ in range(_SWEEPS):
        before = list(exponents)
        for i in range(n):
            row = sum(sizes[i][j] * 2.0 ** (exponents[j] - exponents[i]) for j in range(n))
            down = sum(sizes[j][i] * 2.0 ** (exponents[i] - exponents[j]) for j in range(n))
            if 0 < row < math.inf and 0 < down < math.inf:
                exponents[i] = max(-_FARTHEST, min(_FARTHEST, exponents[i] + round(math.log2(row / down) / 2)))
        if exponents == before:
            break
    return [arb(2) ** exponent for exponent in exponents]


def continuous_piece(
    slope: arb_mat, drift: arb_mat, length: arb, noise: arb_mat, units: Sequence[arb] = ()
) -> Piece:
    """The data of one piece in continuous time; ``noise`` is g g^T, and the series run in ``units`` of the states."""
    n = slope.nrows()
    unit = diagonal(units or [arb(1)] * n)
    back = diagonal([1 / value for value in units] or [arb(1)] * n)
    own = _piece(back * slope * unit, back * drift * unit, length, back * noise * back)
    return Piece(
        length=length, transition=unit * own.transition * back, gathered=unit * own.gathered * back,
        noise=unit * own.noise * unit, deviation=magnitude(unit * own.deviation * back),
        second=magnitude(unit * own.second * back), slope=slope, size=magnitude(slope), drift=magnitude(drift),
    )  # fmt: skip


def _piece(slope: arb_mat, drift: arb_mat, length: arb, noise: arb_mat) -> Piece:
    n = slope.nrows()
    a, k, one = slope * length, drift * (length * length), identity(n)
    size = magnitude(slope)
    whole = size * length + magnitude(drift) * (length * length)
    if not row_sums(whole) < 20:
        raise Unproved("the pieces are too long for the slope: its norm times a piece's length is beyond 20")
    deviation = magnitude(whole.exp() - one)
    return Piece(
        length=length,
        transition=_series(a, k, one, None, twosided=False),
        gathered=_series(a, k, one * 0, one * length, twosided=False),
        noise=_series(a, k, one * 0, noise * length, twosided=True),
        deviation=deviation,
        second=magnitude(deviation - size * length),
        slope=slope,
        size=size,
        drift=magnitude(drift),
    )


def work_of_piece(n: int) -> tuple[int, int]:
    """Products of matrices of n states that `continuous_piece` takes at most, as a shape."""
    terms = max(_TERMS, _TERMS * ctx.prec // 128)
    return n * n, 8 * terms * (n + 4) + 40 * n


def discrete_piece(slope: arb_mat, noise: arb_mat) -> Piece:
    """The data of one step in discrete time; ``noise`` is the covariance of what is added."""
    one = identity(slope.nrows())
    nothing = one * 0
    return Piece(
        length=arb(1), transition=slope, gathered=one, noise=noise, deviation=nothing, second=nothing, slope=slope,
        size=magnitude(slope), drift=nothing,
    )


def jump_piece(matrix: arb_mat, length: arb) -> Piece:
    """A sampling time, at which z jumps to ``matrix`` z plus ``length`` times its remainder."""
    one = identity(matrix.nrows())
    nothing = one * 0
    return Piece(
        length=length, transition=matrix, gathered=one * length, noise=nothing, deviation=nothing, second=nothing,
        slope=nothing, size=nothing, drift=nothing, jump=True,
    )


def covariances(pieces: Sequence[Piece], start: arb_mat, budget: Budget) -> list[arb_mat]:
    """Covariances of Z at the nodes: V_{k+1} = F V_k F^T + Q."""
    result = [start]
    n = start.nrows()
    budget.hold(len(pieces) * n**2)
    for piece in pieces:
        budget.products(n, n, 2 * n + 12)
        v = piece.transition * result[-1] * piece.transition.transpose() + piece.noise
        result.append((v + v.transpose()) * arb(0.5))
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class Load:
    """What one piece adds at its end: R gets ``centre`` +- ``radius``, y the segments ``generators`` and +- ``box``."""

    centre: arb_mat
    radius: list[arb]
    generators: arb_mat | None
    box: list[arb]


@dataclass(frozen=True, eq=False, kw_only=True)
class Supports:
    """Along every row of every node: bounds ``low`` <= row . R <= ``high`` and |row . y| <= ``reach``."""

    low: list[list[arb]]
    high: list[list[arb]]
    reach: list[list[arb]]


def supports(
    transitions: Sequence[arb_mat], rows: Sequence[Sequence[Sequence[arb]]], loads: Sequence[Load],
    start: Sequence[arb], budget: Budget,
) -> Supports:
    """Bounds at the nodes along ``rows[k]`` (a list of rows at node k), by the adjoint rows of every earlier piece.

    ``transitions`` and ``loads`` have one entry a piece, ``rows`` one more; ``start`` are the half-widths of the box of
    y at node 0.
    """
    n = transitions[0].nrows()
    budget.hold(3 * (n + 1) * sum(map(len, rows)))
    columns = [
        (load.centre, arb_mat(n, 2, [x for pair in zip(load.radius, load.box) for x in pair]), load.generators)
        for load in loads
    ]
    low: list[list[arb]] = [[] for _ in rows]
    high: list[list[arb]] = [[] for _ in rows]
    size: list[list[arb]] = [[] for _ in rows]
    pairs = [(node, row) for node, own in enumerate(rows) for row in own]
    most = max(1, min(_ROWS, int(_BLOCK / (n * n))))
    budget.expect(sum(node * n * n for node, _ in pairs) * PRODUCT)
    for first in range(0, len(pairs), most):
        part = pairs[first : first + most]
        centre, spread = _carried(part, transitions, columns, start, budget)
        for i, (node, _) in enumerate(part):
            low[node].append((centre[i, 0] - spread[i, 0]).lower())
            high[node].append((centre[i, 0] + spread[i, 0]).upper())
            size[node].append(spread[i, 1].upper())
    return Supports(low=low, high=high, reach=size)


def _carried(
    pairs: Sequence[tuple[int, Sequence[arb]]], transitions: Sequence[arb_mat],
    columns: Sequence[tuple[arb_mat, arb_mat, arb_mat | None]], start: Sequence[arb], budget: Budget,
) -> tuple[arb_mat, arb_mat]:
    """Of pairs (node, row), nodes in order: sums of row . centre; of |row| . radius and what reaches y, in two columns.

    The last nodes' rows start; those of earlier nodes join them on the way back.
    """
    n, left = transitions[0].nrows(), len(pairs)
    rows, centre, spread = arb_mat(0, n), arb_mat(0, 1), arb_mat(0, 2)
    for node in range(pairs[-1][0], -1, -1):
        _, _, segments = columns[node - 1] if node else columns[0]
        width = n + 12 if segments is None else 2 * segments.ncols() + n + 12
        budget.products(len(pairs) - left, n, width)
        own = left
        while left and pairs[left - 1][0] == node:
            left -= 1
        if left < own:  # in front, so that the order of the pairs stays
            flat = [x for _, row in pairs[left:own] for x in row]
            rows = arb_mat(len(pairs) - left, n, flat + rows.entries())
            centre = arb_mat(len(pairs) - left, 1, [arb(0)] * (own - left) + centre.entries())
            spread = arb_mat(len(pairs) - left, 2, [arb(0)] * (2 * (own - left)) + spread.entries())
        if node == 0:
            break
        middle, boxes, generators = columns[node - 1]
        centre, spread = centre + rows * middle, spread + magnitude(rows) * boxes
        if generators is not None:
            spread = spread + magnitude(rows * generators) * arb_mat(
                generators.ncols(), 2, [arb(0), arb(1)] * generators.ncols()
            )
        rows = rows * transitions[node - 1]
    return centre, spread + magnitude(rows) * arb_mat(n, 2, [x for value in start for x in (arb(0), value)])


def over_piece(
    piece: Piece, rows: Sequence[Sequence[arb]], found: Supports, k: int, box: tuple[list[arb], list[arb]],
    gain: list[arb] | None,
) -> tuple[list[arb], list[arb], list[arb]]:
    """From a piece's start to all of it: the chord between both ends, its bulge, and what the piece adds.

    ``found`` holds at node k bounds along the unit rows, ``rows``, and ``rows`` times the transition matrix; ``box``
    are middle and radius of the remainder's box, ``gain`` a bound of |E (d - d0)|. Returns low, high and reach.
    """
    n, count = piece.transition.nrows(), len(rows)
    h, one = piece.length, identity(n)
    bend = piece.curvature * (h * h / 8)
    middle, radius = box
    sizes = [arb.max(abs(a), abs(b)) for a, b in zip(found.low[k][:n], found.high[k][:n])]
    added_r = (piece.deviation * column([abs(m) + r for m, r in zip(middle, radius)]) + column(radius)) * h
    columns = [bend * column(sizes) + added_r, bend * column(found.reach[k][:n])]
    if gain is not None:
        columns[1] = columns[1] + (one + piece.deviation) * column(gain) * h
    low, high, reach = [], [], []
    for i, row in enumerate(rows):
        weights = arb_mat(1, n, [x.abs_upper() for x in row])
        rest, spread = ((weights * item)[0, 0] for item in columns)
        linear = (arb_mat(1, n, list(row)) * column(middle))[0, 0] * h
        first, last = n + i, n + count + i
        low.append((arb.min(found.low[k][first], found.low[k][last]) + arb.min(linear, arb(0)) - rest).lower())
        high.append((arb.max(found.high[k][first], found.high[k][last]) + arb.max(linear, arb(0)) + rest).upper())
        reach.append((arb.max(found.reach[k][first], found.reach[k][last]) + spread).upper())
    return low, high, reach
