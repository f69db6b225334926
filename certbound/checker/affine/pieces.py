"""What of the law one row needs over pieces of time that are halves of halves of the horizon.

For a row a let r_t = a F(t), xi = a Z and eta = a A Z, with s^2 = Var xi, c = cov(xi, eta), e = Var eta and b = Var(a
A^2 Z). From the start of a piece on V changes by D+ - D-, where 0 <= D+-(t) <= D+-(h), so that ("Enclosures over a
piece" in docs/theory.md, section 9)

- a variance x V x^T lies within x D-(h) x^T below and x D+(h) x^T above its first value, and, seen from the end of the
  piece, within x D+(h) x^T below and x D-(h) x^T above its last one;
- c lies within half of the sum over both signs of the root of (r D r^T)(r A D (r A)^T) of the mean of its ends;
- the mean u_t = a m + int r v has u'' = r A v, so that u lies within h^(3/2)/sqrt(48) times the root of
  int (r A v)^2 of its chord; the same holds for each r_t e_i with r A^2 e_i;
- disturbances add at most int |r E_j| <= sqrt(h int (r E_j)^2) on the piece.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

from flint import arb, arb_mat

from certbound.checker.affine.coefficients import Affine, Row
from certbound.checker.affine.transitions import Transitions
from certbound.checker.balls import column, diagonal, upper
from certbound.checker.report import Budget

GAIN, LOSS, MEAN, WIDE, PUSH = "gain", "loss", "mean", "wide", "push"

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
    b_high: arb
    mean_high: arb  # of the mean with the worst start and disturbances along the row
    mean_low: arb  # and of the least one


class _Change(NamedTuple):
    """What s^2, c, e and b change by over a piece, the part of one sign."""

    s: arb
    c: arb
    e: arb
    b: arb


@dataclass(frozen=True, eq=False, kw_only=True)
class Leaf:
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
    for j, push in enumerate(affine.pushes):
        found[f"{PUSH}{j}"] = push * push.transpose()
    return {name: matrix for name, matrix in found.items() if any(not x.is_zero() for x in matrix.entries())}


def work_of(pieces: int, states: int, sources: int) -> tuple[int, int, int]:
    """Products of ball matrices by which a row is followed over so many pieces."""
    return pieces, states, states * (4 + 3 * sources) + 40 * (sources + 2)


class Follower:
    """Follows rows over grids of pieces."""

    def __init__(self, affine: Affine, transitions: Transitions, budget: Budget) -> None:
        self.affine, self.transitions, self.budget = affine, transitions, budget

    def pieces(self, row: Row, leaves: Sequence[Leaf]) -> list[Piece]:
        """The pieces of a grid, with what is known of a row over each."""
        n, names = len(row), self.transitions.gramians
        self.budget.products(*work_of(len(leaves), n, len(names)))
        self.budget.balls(len(leaves) * 80)
        with self.budget.passing():
            self.budget.hold(len(leaves) * (n + 40))
            rows = self._rows(row, leaves)
            found: dict[int, list[arb]] = {}
            changes: dict[int, tuple[_Change, _Change]] = {}
            for level in sorted({leaf.level for leaf in leaves}):
                own = [k for k, leaf in enumerate(leaves) if leaf.level == level]
                self._level(arb_mat([rows[k] for k in own]), own, level, found, changes)
            variances = self._variances(row, [changes[k] for k in range(len(leaves))])
            means = self._means(rows, [found[k] for k in range(len(leaves))])
        self.budget.hold(len(leaves) * 12)
        return [
            self._piece(leaf, leaves, changes[k], (variances[k], variances[k + 1]), means[k])
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

    def _level(
        self, rows: arb_mat, own: list[int], level: int, found: dict[int, list[arb]],
        changes: dict[int, tuple[_Change, _Change]],
    ) -> None:  # fmt: skip
        """What is known over pieces of one level: changes of variances, and errors and steps of the mean."""
        gramians, slope, h = self.transitions.gramians, self.affine.slope, self.transitions.step(level)
        moved = rows * slope
        again = moved * slope
        both = []
        for name in (GAIN, LOSS):
            if name in gramians:
                gramian = gramians[name][level]
                images = _lists(rows * gramian)
                speeds = _squares(moved, gramian)
                crosses = [_dot(image, q) for image, q in zip(images, _lists(moved))]
                sizes = [_square(_dot(image, r)) for image, r in zip(images, _lists(rows))]
                both.append([_Change(*one) for one in zip(sizes, crosses, speeds, _squares(again, gramian))])
            else:
                both.append([_Change(_ZERO, _ZERO, _ZERO, _ZERO)] * len(own))
        chord = (h * h * h / 48).sqrt()
        errors = [_ZERO] * len(own)
        starts = len([x for x in self.affine.radius.entries() if not x.is_zero()])
        for name, factor in ((MEAN, chord), (WIDE, chord * arb(starts).sqrt())):
            if name in gramians:
                squares = _squares(rows, gramians[name][level])
                errors = [error + factor * _root(square) for error, square in zip(errors, squares)]
        pushed = [_ZERO] * len(own)
        for name in gramians:
            if name.startswith(PUSH):
                squares = _squares(rows, gramians[name][level])
                pushed = [push + h.sqrt() * _root(square) for push, square in zip(pushed, squares)]
        drifts = self.transitions.drifts
        steps = (rows * drifts[level]).entries() if drifts else [_ZERO] * len(own)
        for i, k in enumerate(own):
            found[k] = [steps[i], errors[i], pushed[i]]
            changes[k] = both[0][i], both[1][i]

    def _variances(self, row: Row, changes: Sequence[tuple[_Change, _Change]]) -> list[_Change]:
        """s^2, c, e and b at the ends of the pieces."""
        covariance = self.affine.covariance
        at = _Change(_ZERO, _ZERO, _ZERO, _ZERO)
        if covariance is not None:
            flat = arb_mat([row])
            moved = flat * self.affine.slope
            again = moved * self.affine.slope
            image = (flat * covariance).entries()
            at = _Change(
                _square(_dot(image, row)), _dot(image, moved.entries()), _squares(moved, covariance)[0],
                _squares(again, covariance)[0],
            )  # fmt: skip
        found = [at]
        for gain, loss in changes:
            at = _Change(*(now + more - less for now, more, less in zip(at, gain, loss)))
            found.append(at)
        return found

    def _means(self, rows: Sequence[Row], found: Sequence[Sequence[arb]]) -> list[tuple[arb, arb]]:
        """The least and the largest mean along the row over every piece, with all starts and disturbances."""
        middle, radius = self.affine.middle.entries(), self.affine.radius.entries()
        at, pushed = _dot(rows[0], middle), _ZERO
        spread = [sum((abs(x) * y for x, y in zip(row, radius) if not y.is_zero()), _ZERO) for row in rows]
        result = []
        for k, (step, error, push) in enumerate(found):
            pushed = pushed + push
            more = upper(error + pushed)
            ends = ((at, spread[k]), (at + step, spread[k + 1]))
            high = arb.max(*(upper(u + w) for u, w in ends)) + more
            low = arb.max(*(upper(w - u) for u, w in ends)) + more
            result.append((-upper(low), upper(high)))
            at = at + step
        return result

    def _piece(
        self, leaf: Leaf, leaves: Sequence[Leaf], change: tuple[_Change, _Change], ends: tuple[_Change, _Change],
        mean: tuple[arb, arb],
    ) -> Piece:  # fmt: skip
        gain, loss = change
        first, last = ends
        bend = (_root(gain.s * gain.e) + _root(loss.s * loss.e)) / 2
        cross = (first.c + last.c) / 2
        whole = Fraction(float(self.transitions.horizon))
        start = Fraction(leaf.place, 1 << max(one.level for one in leaves))
        return Piece(
            start=whole * start, end=whole * (start + Fraction(1, 1 << leaf.level)),
            length=self.transitions.step(leaf.level), first_high=_most(first.s), last_low=_least(last.s),
            s_low=arb.max(_least(first.s - loss.s), _least(last.s - gain.s)),
            s_high=arb.min(_most(first.s + gain.s), _most(last.s + loss.s)),
            c_low=-upper(bend - cross), c_high=upper(bend + cross),
            e_high=arb.min(_most(first.e + gain.e), _most(last.e + loss.e)),
            b_high=arb.min(_most(first.b + gain.b), _most(last.b + loss.b)), mean_low=mean[0], mean_high=mean[1],
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
