"""The proof by the exact law of an affine model (docs/theory.md, section 9, "Affine models exactly").

The file proposes pieces of time and, for rows with noise of their own, numbers of windows; the law is the checker's
own, from the problem alone. What the worst mean leaves of a limit on a piece is a level z_t that changes evenly. With a
path that first exceeds a limit in some piece one of these comes about, and their probabilities are added up:

- it is beyond the level of the first piece that is asked at its start;
- it is at most at the level of a piece at its start and exceeds it on the piece (`crossings`);
- at the end of a piece it lies between the level of the next one and its own, where that is lower.

What exceeds a limit of several is added up as well. No disturbance and no start can do better, whatever it sees: the
mean takes the worst of them at every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from flint import arb, arb_mat, ctx

from certbound.checker.affine.affine_limits import Affine, Limit, affine_of, limits_of, split_source
from certbound.checker.affine.crossings import CRUDE, Cost, Level, crude, rice, windows
from certbound.checker.affine.gramians import MOST_LEVELS, Transitions
from certbound.checker.affine.row_pieces import Follower, Leaf, Piece, leaves_of, sources_of
from certbound.checker.balls import matrix, tail, upper
from certbound.checker.reading import Record, wholes
from certbound.checker.report import STEP, Budget, Unproved
from certbound.checker.statement import Model
from certbound.errors import CertificateError

MOST_STATES = 250
MOST_PIECES = 100_000
"""Pieces of one grid."""
MOST_LIMITS = 1_000
FEWEST_BITS, MOST_BITS = 128, 3_000
MOST_WINDOWS = 10**9
"""Windows of one piece; their number costs nothing."""
_LEAF = 200
"""Bytes of the start of a piece, with the number of its place."""
_BITS = 128
"""Bits for the probability of a piece: nothing magnifies its balls."""

_PROOF = ("engine", "bits", "grids", "limits")


class Plan(NamedTuple):
    """Which grid a limit is followed on, and the windows of its pieces; None for a row without noise of its own."""

    grid: int
    windows: list[int] | None


def check_affine(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a limit of an affine model is exceeded.

    It holds for every start and every disturbance, even one that sees coming noise. CertificateError where the proof's
    data are malformed, Unproved where the problem is no affine model in continuous time with fixed half-spaces as
    limits, or where nothing is left for the noise.
    """
    record = Record(value, "proof", _PROOF, ("loss",))
    if model.dimension > MOST_STATES:
        raise Unproved(f"{model.dimension} states are too many for this proof")
    with ctx.workprec(record.whole("bits", FEWEST_BITS, MOST_BITS)):
        limits = limits_of(model, budget)
        if len(limits) > MOST_LIMITS:
            raise Unproved(f"{len(limits)} limits are too many for this proof")
        grids = _grids(record, budget)
        plans = _plans(record, limits, grids)
        lasting = [plan for limit, plan in zip(limits, plans) if limit.during is None]
        budget.expect(sum(len(grids[plan.grid]) for plan in lasting) * CRUDE)
        affine = affine_of(model, budget)
        gain, loss = split_source(affine, _loss(record, model.dimension), budget)
        law = _Law(affine, gain, loss, model.horizon, grids, budget)
        total = arb(0)
        for number, (limit, plan) in enumerate(zip(limits, plans)):
            total += law.cost(limit, plan, number)
        return upper(total)


def _grids(record: Record, budget: Budget) -> list[list[Leaf]]:
    found = []
    for index, item in enumerate(record.items("grids", 1, MOST_LIMITS)):
        path = f"{record.at('grids')}[{index}]"
        levels = wholes(item, path, 0, MOST_LEVELS)
        if not levels or len(levels) > MOST_PIECES:
            raise CertificateError(f"`{path}` must have 1 to {MOST_PIECES} entries, got {len(levels)}.")
        budget.take(_LEAF * len(levels))
        budget.spend(STEP * len(levels))
        leaves = leaves_of(levels)
        if leaves is None:
            raise CertificateError(
                f"`{path}` must be halves of halves of the horizon that follow each other from 0 to its end, without a "
                "gap; write the number of halvings of every piece."
            )
        found.append(leaves)
    return found


def _plans(record: Record, limits: Sequence[Limit], grids: Sequence[Sequence[Leaf]]) -> list[Plan]:
    found = []
    for index, item in enumerate(record.items("limits", len(limits), len(limits))):
        one = Record(item, f"{record.at('limits')}[{index}]", ("grid", "windows"))
        grid = one.whole("grid", 0, len(grids) - 1)
        counts = None
        if one["windows"] is not None:
            counts = wholes(one["windows"], one.at("windows"), 1, MOST_WINDOWS)
            if len(counts) != len(grids[grid]):
                words = f"`{one.at('windows')}` must have one entry for each of the {len(grids[grid])} pieces of its"
                raise CertificateError(f"{words} grid, got {len(counts)}.")
        found.append(Plan(grid=grid, windows=counts))
    return found


def _loss(record: Record, n: int) -> arb_mat | None:
    """L of a normal start, (n, k) with k up to 2 n."""
    if record["loss"] is None:
        return None
    rows = record.array("loss", n, None)
    if not 1 <= len(rows[0]) <= 2 * n or any(len(row) != len(rows[0]) for row in rows):
        raise CertificateError(f"`{record.at('loss')}` must hold a matrix of 1 to {2 * n} columns.")
    return matrix(rows)


class _Law:
    """The law of the model, and the rows that were followed already."""

    def __init__(
        self, affine: Affine, gain: arb_mat, loss: arb_mat | None, horizon: float, grids: Sequence[list[Leaf]],
        budget: Budget,
    ) -> None:  # fmt: skip
        self.affine, self.grids, self.budget = affine, grids, budget
        n = affine.slope.nrows()
        budget.products(n, n, n * (6 + len(affine.disturbances)))
        sources = sources_of(affine, gain, loss)
        drift = None if all(x.is_zero() for x in affine.drift.entries()) else affine.drift
        finest = max(leaf.level for leaves in grids for leaf in leaves)
        self.transitions = Transitions(affine.slope, sources, drift, horizon, finest, budget)
        self.follower = Follower(affine, self.transitions, budget)
        self._known: dict[tuple[int, bool, tuple[float, ...]], list[Piece]] = {}

    def cost(self, limit: Limit, plan: Plan, number: int) -> arb:
        """Upper bound of P(row . X exceeds the bound while that is asked)."""
        pieces, sign = self._followed(limit, plan)
        with ctx.workprec(_BITS):
            own = self._own(limit.row)
            if own.is_zero() != (plan.windows is None):
                words = "must be null: no noise drives" if own.is_zero() else "must be a list: noise drives"
                raise CertificateError(f"`proof.limits[{number}].windows` {words} the row of this limit itself.")
            kept = [k for k, piece in enumerate(pieces) if _meets(piece, limit.during)]
            costs = []
            for k in kept:
                self.budget.check()
                level = _level(limit, sign, pieces[k])
                count = None if plan.windows is None else plan.windows[k]
                costs.append(_least(level, pieces[k], own, count, self.budget))
            found = _chained(costs)
        if not found < 1:
            raise Unproved(f"nothing is left for the noise by \"{limit.label}\"")
        return found

    def _own(self, row: Sequence[float]) -> arb:
        """Upper bound of a G G^T a^T; 0 just where that is 0."""
        diffusion = self.affine.diffusion
        self.budget.products(2, diffusion.nrows(), diffusion.ncols())
        image = arb_mat([[arb(x) for x in row]]) * diffusion
        return upper(sum((x * x for x in image.entries()), arb(0)))

    def _followed(self, limit: Limit, plan: Plan) -> tuple[list[Piece], int]:
        """The pieces of the row or of its opposite, followed once, and whose they are (1 or -1)."""
        self.budget.balls(2 * len(limit.row))
        sign = 1 if next((x for x in limit.row if x), 1.0) > 0 else -1
        row, smooth = tuple(sign * x + 0.0 for x in limit.row), plan.windows is None  # without a -0
        key = plan.grid, smooth, row
        if key not in self._known:
            self._known[key] = self.follower.pieces(list(map(arb, row)), self.grids[plan.grid], smooth=smooth)
        return self._known[key], sign


def _meets(piece: Piece, during: tuple[float, float] | None) -> bool:
    """Whether a piece, its ends included, meets a window of time."""
    return during is None or (piece.end >= Fraction(during[0]) and piece.start <= Fraction(during[1]))


def _level(limit: Limit, sign: int, piece: Piece) -> Level:
    """What the worst mean leaves of a limit on a piece."""
    low_first, low_last, high_first, high_last = piece.means
    ends = (high_first, high_last) if sign > 0 else (-low_first, -low_last)
    first, last = ((limit.bound - end).lower() for end in ends)
    if not (first > 0 and last > 0):
        raise Unproved(f"nothing is left for the noise by \"{limit.label}\"")
    return Level(first=first, last=last)


def _least(level: Level, piece: Piece, own: arb, count: int | None, budget: Budget) -> Cost:
    """The smaller one of what crossings cost and of what is sure from any start."""
    plain = crude(level, piece, own, budget)
    found = rice(level, piece, budget) if count is None else windows(level, piece, own, count, budget)
    return plain if found is None or plain.probability <= found.probability else found


def _chained(costs: Sequence[Cost]) -> arb:
    """The sum over pieces that follow each other, with what lies between the levels of two of them where they meet."""
    total, left = arb(0), None
    for index, cost in enumerate(costs):
        total += cost.probability
        if cost.enters is not None and not (index and left is not None and cost.enters >= left):
            below = tail(cost.enters)
            total += below if not index or left is None else upper(arb.max(below - tail(left), arb(0)))
        left = cost.leaves
    return upper(total)
