"""What of the law one row needs over pieces of time that are halves of halves of the horizon.

For a row a let r_t = a F(t), xi = a Z and eta = a A Z, with s^2 = Var xi, c = cov(xi, eta), e = Var eta, d = cov(xi, a
A^2 Z) and v = Var(a A^3 Z). From the start of a piece on V changes by D+ - D-, where 0 <= D+-(t) <= D+-(h), so that
("Enclosures over a piece" in docs/theory.md, section 9)

- a variance x V x^T lies within x D-(h) x^T below and x D+(h) x^T above its first value, and, seen from the end of the
  piece, within x D+(h) x^T below and x D-(h) x^T above its last one;
- c lies within half of the sum over both signs of the root of (r D r^T)(r A D (r A)^T) of the mean of its ends, and d
  likewise with A^2 in the place of A;
- the mean u_t = a m + int r v has u'' = r A v, so that u lies within h^(3/2)/sqrt(48) times the root of
  int (r A v)^2 of its chord; the same holds for each r_t e_i with r A^2 e_i;
- disturbances add at most int |r E_j| <= sqrt(h int (r E_j)^2) on the piece.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from flint import arb, arb_mat

from certbound.checker.affine.affine_limits import Affine
from certbound.checker.affine.gramians import Transitions
from certbound.checker.balls import diagonal, upper
from certbound.checker.report import Budget

GAIN, LOSS, MEAN, WIDE, DISTURBANCE = "gain", "loss", "mean", "wide", "disturbance"

_PIECE = 24
"""Memory of a piece that is kept, in balls: eleven of them, and two times as fractions."""

Row = list[arb]
_ZERO = arb(0)


class Piece(NamedTuple):
    """One piece of time: exact numbers that enclose what is known of a row over it."""

    start: Fraction
    end: Fraction
    length: arb
    first_high: arb  # of s^2 at the start
    last_low: arb  # of s^2 at the end
    s_low: arb  # of s^2 on the piece
    s_high: arb
    c_low: arb
    c_high: arb
    e_high: arb
    d_low: arb
    v_high: arb
    means: Means


class Means(NamedTuple):
    """The mean along the row over a piece lies between the chords of these bounds, for all starts and disturbances."""

    low_first: arb
    low_last: arb
    high_first: arb
    high_last: arb


class _Moments(NamedTuple):
    """s^2, c, e, d, Var(a A^2 Z) and v: their values, or what they change by over a piece, the part of one sign."""

    s: arb
    c: arb
    e: arb
    d: arb = _ZERO
    b: arb = _ZERO
    v: arb = _ZERO


class Leaf(NamedTuple):
    """The start of a piece in units of the finest step of its grid, and its level."""

    place: int
    level: int


def leaves_of(levels: Sequence[int]) -> list[Leaf] | None:
    """Pieces of the levels one after the other; None where they are no halves of halves that fill the horizon."""
    finest, place, found = max(levels), 0, []
    for level in levels:
        size = 1 << (finest - level)
        if place % size:
            return None
        found.append(Leaf(place=place, level=level))
        place += size
    return found if place == 1 << finest else None


def sources_of(affine: Affine, gain: arb_mat, loss: arb_mat | None) -> dict[str, arb_mat]:
    """The matrices whose Gramians `Follower` reads, by name."""
    slope = affine.slope
    turned = slope * affine.drift
    found = {GAIN: gain, MEAN: turned * turned.transpose()}
    if loss is not None:
        found[LOSS] = loss
    if any(not x.is_zero() for x in affine.radius.entries()):
        wide = slope * slope * diagonal(affine.radius.entries())
        found[WIDE] = wide * wide.transpose()
    for j, disturbance in enumerate(affine.disturbances):
        found[f"{DISTURBANCE}{j}"] = disturbance * disturbance.transpose()
    return {name: matrix for name, matrix in found.items() if any(not x.is_zero() for x in matrix.entries())}


def work_of(pieces: int, states: int, sources: int) -> tuple[int, int, int]:
    """Products of ball matrices by which a row is followed over so many pieces."""
    return pieces, states, states * (5 + 5 * sources) + 50 * (sources + 2)


class Follower:
    """Follows rows over grids of pieces."""

    def __init__(self, affine: Affine, transitions: Transitions, budget: Budget) -> None:
        self.affine, self.transitions, self.budget = affine, transitions, budget

    def pieces(self, row: Row, leaves: Sequence[Leaf], *, smooth: bool) -> list[Piece]:
        """The pieces of a grid, with what is known of a row over each; ``smooth``: d and v are not asked for."""
        n, names = len(row), self.transitions.gramians
        self.budget.products(*work_of(len(leaves), n, len(names)))
        self.budget.balls(len(leaves) * 80)
        with self.budget.passing():
            self.budget.hold(len(leaves) * (n + 40))
            rows = self._rows(row, leaves)
            found: dict[int, tuple[arb, arb, arb]] = {}
            changes: dict[int, tuple[_Moments, _Moments]] = {}
            for level in sorted({leaf.level for leaf in leaves}):
                own = [k for k, leaf in enumerate(leaves) if leaf.level == level]
                matrix = arb_mat([rows[k] for k in own])
                changes |= dict(zip(own, self._changes(matrix, level, smooth)))
                found |= dict(zip(own, self._errors(matrix, level)))
            variances = self._variances(row, [changes[k] for k in range(len(leaves))], smooth)
            means = self._means(rows, [found[k] for k in range(len(leaves))])
        self.budget.hold(len(leaves) * _PIECE)
        finest = max(leaf.level for leaf in leaves)
        return [
            self._piece(leaf, finest, changes[k], (variances[k], variances[k + 1]), means[k])
            for k, leaf in enumerate(leaves)
        ]

    def _rows(self, row: Row, leaves: Sequence[Leaf]) -> list[Row]:
        """r at the start of every piece, and at the horizon.

        At a place it follows from the one without the last binary digit, so that no more balls are multiplied than
        there are levels.
        """
        finest = max(leaf.level for leaf in leaves)
        known = {0: row}
        for leaf in leaves[1:]:
            step = leaf.place & -leaf.place
            level = finest - (step.bit_length() - 1)
            before = arb_mat([known[leaf.place - step]])
            known[leaf.place] = (before * self.transitions.transitions[level]).entries()
        last = (arb_mat([row]) * self.transitions.transitions[0]).entries()
        return [*(known[leaf.place] for leaf in leaves), last]

    def _changes(self, rows: arb_mat, level: int, smooth: bool) -> list[tuple[_Moments, _Moments]]:
        """What the moments gain and lose over pieces of one level."""
        gramians, nothing = self.transitions.gramians, [_Moments(_ZERO, _ZERO, _ZERO)] * rows.nrows()
        both = [
            self._moments(rows, gramians[name][level], smooth) if name in gramians else nothing
            for name in (GAIN, LOSS)
        ]
        return list(zip(*both))

    def _moments(self, rows: arb_mat, form: arb_mat, smooth: bool) -> list[_Moments]:
        """The moments of rows under a covariance."""
        slope = self.affine.slope
        moved = rows * slope
        images, own, first = _lists(rows * form), _lists(rows), _lists(moved)
        found = [
            [_square(_dot(image, r)) for image, r in zip(images, own)],
            [_dot(image, q) for image, q in zip(images, first)], _squares(moved, form),
        ]  # fmt: skip
        if not smooth:
            again = moved * slope
            found.append([_dot(image, q) for image, q in zip(images, _lists(again))])
            found += [_squares(again, form), _squares(again * slope, form)]
        return [_Moments(*one) for one in zip(*found)]

    def _errors(self, rows: arb_mat, level: int) -> list[tuple[arb, arb, arb]]:
        """Over pieces of one level: the mean's step, how far it is from its chord, and what disturbances add."""
        gramians, h = self.transitions.gramians, self.transitions.step(level)
        errors, disturbed = [_ZERO] * rows.nrows(), [_ZERO] * rows.nrows()
        starts = len([x for x in self.affine.radius.entries() if not x.is_zero()])
        for name, found in gramians.items():
            if name in (MEAN, WIDE):
                factor = (h * h * h * (starts if name == WIDE else 1) / 48).sqrt()
                errors = [e + factor * _root(square) for e, square in zip(errors, _squares(rows, found[level]))]
            elif name.startswith(DISTURBANCE):
                disturbed = [e + h.sqrt() * _root(square) for e, square in zip(disturbed, _squares(rows, found[level]))]
        drifts = self.transitions.drifts
        steps = (rows * drifts[level]).entries() if drifts else [_ZERO] * rows.nrows()
        return list(zip(steps, errors, disturbed))

    def _variances(
        self, row: Row, changes: Sequence[tuple[_Moments, _Moments]], smooth: bool
    ) -> list[_Moments]:  # fmt: skip
        """The moments at the ends of the pieces."""
        covariance, at = self.affine.covariance, _Moments(_ZERO, _ZERO, _ZERO)
        if covariance is not None:
            at = self._moments(arb_mat([row]), covariance, smooth)[0]
        found = [at]
        for gain, loss in changes:
            at = _Moments(*(now + more - less for now, more, less in zip(at, gain, loss)))
            found.append(at)
        return found

    def _means(self, rows: Sequence[Row], found: Sequence[Sequence[arb]]) -> list[Means]:
        """Bounds of the mean along the row over every piece."""
        middle, radius = self.affine.middle.entries(), self.affine.radius.entries()
        at, disturbed = _dot(rows[0], middle), _ZERO
        spread = [sum((abs(x) * y for x, y in zip(row, radius) if not y.is_zero()), _ZERO) for row in rows]
        result = []
        for k, (step, error, disturbance) in enumerate(found):
            disturbed = disturbed + disturbance
            more = upper(error + disturbed)
            ends = ((at, spread[k] + more), (at + step, spread[k + 1] + more))
            result.append(Means(*(-upper(w - u) for u, w in ends), *(upper(u + w) for u, w in ends)))
            at = at + step
        return result

    def _piece(
        self, leaf: Leaf, finest: int, change: tuple[_Moments, _Moments], ends: tuple[_Moments, _Moments],
        means: Means,
    ) -> Piece:  # fmt: skip
        gain, loss = change
        first, last = ends
        bend = (_root(gain.s * gain.e) + _root(loss.s * loss.e)) / 2
        twice = (_root(gain.s * gain.b) + _root(loss.s * loss.b)) / 2
        cross = (first.c + last.c) / 2
        whole = Fraction(float(self.transitions.horizon))
        start = Fraction(leaf.place, 1 << finest)
        return Piece(
            start=whole * start, end=whole * (start + Fraction(1, 1 << leaf.level)),
            length=self.transitions.step(leaf.level), first_high=_most(first.s), last_low=_least(last.s),
            s_low=arb.max(_least(first.s - loss.s), _least(last.s - gain.s)),
            s_high=arb.min(_most(first.s + gain.s), _most(last.s + loss.s)),
            c_low=-upper(bend - cross), c_high=upper(bend + cross),
            e_high=arb.min(_most(first.e + gain.e), _most(last.e + loss.e)),
            d_low=-upper(twice - (first.d + last.d) / 2),
            v_high=arb.min(_most(first.v + gain.v), _most(last.v + loss.v)), means=means,
        )  # fmt: skip


def _lists(a: arb_mat) -> list[Row]:
    columns, entries = a.ncols(), a.entries()
    return [entries[i : i + columns] for i in range(0, len(entries), columns)]


def _dot(first: Row, second: Row) -> arb:
    total = _ZERO
    for x, y in zip(first, second):
        total += x * y
    return total


def _square(value: arb) -> arb:
    """What is known not to be negative."""
    return value if value >= 0 or not value.is_finite() else _ZERO.union(arb.max(value.upper(), _ZERO))


def _squares(rows: arb_mat, form: arb_mat) -> list[arb]:
    """r Q r^T for each of the rows."""
    return [_square(_dot(image, row)) for image, row in zip(_lists(rows * form), _lists(rows))]


def _root(value: arb) -> arb:
    """Upper bound of the root of what is not negative."""
    return upper(arb.max(upper(value), _ZERO).sqrt())


def _least(value: arb) -> arb:
    """Lower bound, at least 0."""
    return arb.max(value.lower(), _ZERO) if value.is_finite() else _ZERO


def _most(value: arb) -> arb:
    """Upper bound, at least 0."""
    return arb.max(upper(value), _ZERO)
