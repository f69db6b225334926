"""The proof by quadratic value bounds (theory, Section 14): definite matrices, and nothing of what found them.

For every wall V = z' H(t) z / 2 with H linear between stated times, and R = V_t + f . grad V + tr(g g' V'')/2
+ |g' grad V|^2/2. At both ends of a piece, on every cell and at every corner (the ends of the held coordinates s, of
the disturbances and of the remainders that are corners),

    M = -(H' + H A + A' H + sum_c G_c' H G_c)/2 - D(s) - H G G' H/2 - toll - sum_i mu_i B_i,     mu >= 0,

with forms B_i >= 0 on the cell and z' D(s) z = 0: where M + lam/|z|^2 is positive definite, R <= lam. G holds the
columns of g, and sqrt(r_i/q) e_i for each remainder r_i that is no corner, whose toll is r_i q/2. In the same way
V >= -gap on the wall. Then P(leaving) <= sum over the walls of exp(sum_k lam_k h_k + gap + V(0, x)), whose supremum
over a box of starts is that over its corners once every V(0, .) has been made convex; of a ball each V has its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from flint import arb, arb_mat

from certbound.checker.balls import identity, is_positive_definite, largest_eigenvalue, matrix, upper
from certbound.checker.reading import Record, entries, numbers, whole, wholes
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model
from certbound.checker.values.packed import unpacked
from certbound.checker.values.second_order import Flow, Local
from certbound.checker.values.walls import Key, Surroundings, Wall
from certbound.errors import CertificateError

MOST_STATES = 12
MOST_MATRICES = 500_000
MOST_NUMBERS = 2_000_000
_STEEP = arb(8)  # q
_MOST_CORNERS = 10
_NAMES = (
    "wall", "held", "large", "cuts", "times", "matrices", "moves", "weights", "wall_weights", "wall_rows", "lam", "gap",
)  # fmt: skip
Place = tuple[int, int, int]


def check_quadratic(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    record = Record(value, "proof", ("engine", "center", "width", "walls"))
    n = model.dimension
    if not model.continuous:
        raise Unproved("quadratic value bounds prove nothing in discrete time")
    if n > MOST_STATES:
        raise Unproved(f"quadratic value bounds are proved for at most {MOST_STATES} states")
    if model.plan is not None:
        raise Unproved("this proof does not treat a plan with steps in time")
    flow = Flow(model, budget)
    around = Surroundings(model, record, flow)
    stated: dict[Key, _Value] = {}
    for k, item in enumerate(record.items("walls", 0, 2 * n + 1000)):
        one = _Value(around, flow, item, f"proof.walls[{k}]", budget)
        stated[one.key] = one
    if set(stated) != set(around.walls):
        raise Unproved("the walls were not shown to be all that paths can leave through")
    for one in stated.values():
        one.prove()
    return _worst(around, list(stated.values()))


def _worst(around: Surroundings, walls: Sequence[_Value]) -> arb:
    """At least the supremum over the starts of the sum over the walls."""
    found = _at_corners(around, walls)
    if around.model.initial.kind == "ball":
        found = arb.min(found, sum((_over_ball(around, wall) for wall in walls), arb(0)))
    return arb.min(upper(found), arb(1))


def _at_corners(around: Surroundings, walls: Sequence[_Value]) -> arb:
    """Over a box of starts, by its corners: every V(0, .) is made convex first."""
    wide = [i for i, (low, high) in enumerate(around.start) if not (low - high).is_zero()]
    if len(wide) > _MOST_CORNERS:
        raise Unproved(f"this proof treats starts that are wide along at most {_MOST_CORNERS} states")
    half = [(high - low) / 2 for low, high in around.start]
    lifts = []
    for wall in walls:
        bend = [[-half[i] * half[j] * wall.matrices[0][i, j] for j in wide] for i in wide]
        lifts.append(largest_eigenvalue(matrix(bend)) * len(wide) / 2 if wide else arb(0))
    worst = arb(0)
    for ends in itertools.product((0, 1), repeat=len(wide)):
        z = [low.union(high) for low, high in around.start]
        for i, end in zip(wide, ends):
            z[i] = around.start[i][end]
        parts = [(wall.paid + lift + wall.at(z)).exp() for wall, lift in zip(walls, lifts)]
        worst = arb.max(worst, sum(parts, arb(0)))
    return worst


def _over_ball(around: Surroundings, wall: _Value) -> arb:
    """One wall's part over a ball of starts: V at its centre, its slope and half its largest bend there, in radii."""
    initial, n = around.model.initial, around.n
    radius = [arb(initial.radius) / w for w in around.width]
    z = [(arb(c) - m) / w for c, m, w in zip(initial.centre, around.center, around.width)]
    here = wall.matrices[0]
    slope = (here * arb_mat(n + 1, 1, [*z, arb(1)])).entries()[:n]
    rise = sum(((r * x) ** 2 for r, x in zip(radius, slope)), arb(0)).sqrt()
    bend = largest_eigenvalue(matrix([[radius[i] * radius[j] * here[i, j] for j in range(n)] for i in range(n)]))
    return (wall.paid + wall.at(z) + rise + bend / 2).exp()


class _Value:
    """What the file states of one wall."""

    def __init__(self, around: Surroundings, flow: Flow, value: object, path: str, budget: Budget) -> None:
        self.record = record = Record(value, path, _NAMES)
        self.around, self.flow, self.budget, self.n = around, flow, budget, around.n
        self.held, self.large = (wholes(record[name], record.at(name), 0, self.n - 1) for name in ("held", "large"))
        if any(a >= b for a, b in pairwise(self.held)) or len(set(self.large)) != len(self.large):
            raise CertificateError(f"`{path}.held` must rise, and `large` must hold different states.")
        flow.held(self.held)
        pair = entries(record["wall"], record.at("wall"), 2, 2)
        self.key = whole(pair[0], record.at("wall"), -self.n, 1000), whole(pair[1], record.at("wall"), 0, 100_000)
        if self.key not in around.walls:
            raise Unproved(f"`{record.at('wall')}` is no wall of the problem")
        self.wall: Wall = around.walls[self.key]
        self.times = [arb(t) for t in record.array("times", None)]
        horizon = arb(around.model.horizon)
        if len(self.times) < 2 or any(not a < b for a, b in pairwise(self.times)):
            raise CertificateError(f"`{record.at('times')}` must be two or more numbers that rise.")
        if not (self.times[0] == 0 and self.times[-1] == horizon):
            raise Unproved("the pieces do not cover the horizon")
        self.cells = self._cells()
        self._read()

    def _cells(self) -> list[tuple[list[arb], list[arb]]]:
        """Lower and upper ends of cells that cover [-1, 1]^n, cut along the coordinates that are held."""
        rows = [[arb(-1), arb(1)] for _ in range(self.n)]
        path, count = self.record.at("cuts"), 1
        for a, row in zip(self.held, entries(self.record["cuts"], path, len(self.held), len(self.held))):
            edges = numbers(row, path, None)
            if len(edges) < 2 or edges[0] != -1 or edges[-1] != 1 or any(not x < y for x, y in pairwise(edges)):
                raise CertificateError(f"`{path}` must rise from -1 to 1.")
            rows[a] = [arb(x) for x in edges]
            count *= len(edges) - 1
        self.corners = len(self.held) + self.flow.q - self.n + len(self.large)
        count *= 2 * (len(self.times) - 1)
        if self.corners > 20 or count << self.corners > MOST_MATRICES:
            raise CertificateError(f"`{path}` must make at most {MOST_MATRICES} matrices.")
        boxes = itertools.product(*(list(pairwise(row)) for row in rows))
        return [([a for a, _ in box], [b for _, b in box]) for box in boxes]

    def _read(self) -> None:
        record, n = self.record, self.n
        pieces, cells = len(self.times) - 1, len(self.cells)
        self.splits = splitting(n, self.held)
        self.matrices = []
        for k, rows in enumerate(record.array("matrices", pieces + 1, n + 1, n + 1)):
            if any(rows[i][j] != rows[j][i] for i in range(n + 1) for j in range(i)):
                raise CertificateError(f"`{record.at('matrices')}[{k}]` must be symmetric.")
            self.matrices.append(matrix(rows))
        forms = n + len(self.around.inside)
        shapes = {"moves": (pieces, 2, cells, len(self.splits)),
                  "weights": (pieces, 2, 1 << self.corners, cells, forms)}  # fmt: skip
        if any(math.prod(shape) > MOST_NUMBERS for shape in shapes.values()):
            raise CertificateError(f"`{record.path}` must hold at most {MOST_NUMBERS} multipliers.")
        self.moves, self.weights = (unpacked(record[name], record.at(name), shapes[name]) for name in shapes)
        self.wall_weights = np.array(record.array("wall_weights", pieces + 1, forms + len(self.wall.forms)))
        size = 0 if self.wall.row is None else n + 1
        self.wall_rows = record.array("wall_rows", pieces + 1, size)
        if not ((self.weights >= 0).all() and (self.wall_weights >= 0).all()):
            raise CertificateError(f"`{record.path}` must not have a negative weight.")
        self.lam = [arb(x) for x in record.array("lam", pieces)]
        self.gap = arb(record.number("gap", least=0.0))
        if not all(rate >= 0 for rate in self.lam):
            raise CertificateError(f"`{record.at('lam')}` must not be negative.")
        self.growth = sum((rate * (b - a) for rate, (a, b) in zip(self.lam, pairwise(self.times))), arb(0))

    @property
    def paid(self) -> arb:
        """What is added to V(0, .) for the logarithm of the wall's part."""
        return self.growth + self.gap

    def at(self, z: Sequence[arb]) -> arb:
        """V at time 0."""
        point = arb_mat(1, self.n + 1, [*z, arb(1)])
        return (point * self.matrices[0] * point.transpose())[0, 0] / 2

    # ---- the inequalities ------------------------------------------------------------------------------------

    def prove(self) -> None:
        """Everything that the wall's part of the bound rests on."""
        self._on_wall()
        around = self.around
        gains = self.flow.gain(around.center, around.width)
        locals_ = [self.flow.over(low, high, self.held, around.center, around.width) for low, high in self.cells]
        steps = [b - a for a, b in pairwise(self.times)]
        for k, side in itertools.product(range(len(steps)), (0, 1)):
            slope = (self.matrices[k + 1] - self.matrices[k]) * (1 / steps[k])
            here = self.matrices[k + side]
            trace = sum((g.transpose() * here * g for g in gains), slope)
            for c, local in enumerate(locals_):
                self._on_cell((k, side, c), trace, local, gains)

    def _on_cell(self, place: Place, known: arb_mat, local: Local, gains: Sequence[arb_mat]) -> None:
        """M + lam/|z|^2 at all corners of a cell; ``known`` is the part of -2 M that is the same everywhere."""
        k, side, c = place
        low, high = self.cells[c]
        here = self.matrices[k + side]
        reach = sum((arb.max(a * a, b * b) for a, b in zip(low, high)), arb(1))
        shift = identity(self.n + 1) * (self.lam[k] / reach)
        small = [i for i in range(self.n) if i not in self.large]
        toll = sum((local.rest[i] for i in small), arb(0)) * _STEEP / 2
        extra = [(local.rest[i] / _STEEP).sqrt() for i in small]
        splits = self._splits(self.moves[k, side, c])
        middle = [((a + b) / 2).mid() for a, b in zip(low, high)]
        for number, bits in enumerate(itertools.product((0, 1), repeat=self.corners)):
            self.budget.check()
            ends = [high[a] if bit else low[a] for a, bit in zip(self.held, bits)]
            drift = self._drift(local, ends, middle, bits)
            total = here * drift
            total = known + total + total.transpose()
            spread = self._spread(gains, ends, small, extra)
            border = here * spread
            total = (total + border * border.transpose()) * arb(0.5)
            total = total + sum((part * end for part, end in zip(splits, ends)), self._sides(place, number))
            entry = total[self.n, self.n] + toll
            total[self.n, self.n] = entry
            if not is_positive_definite(shift - total):
                raise Unproved("the growth of a quadratic bound was not shown to be as small as stated")

    def _drift(self, local: Local, ends: Sequence[arb], middle: Sequence[arb], bits: Sequence[int]) -> arb_mat:
        """A at a corner."""
        total = local.base
        for a, end in zip(self.held, ends):
            total = total + local.along[a] * (end - middle[a])
        count = len(self.held)
        for part, bit in zip(local.pushed, bits[count:]):
            total = total + part * arb(2 * bit - 1)
        if self.large:
            total = arb_mat(total)
            for i, bit in zip(self.large, bits[count + len(local.pushed) :]):
                total[i, self.n] = total[i, self.n] + local.rest[i] * (2 * bit - 1)
        return total

    def _spread(
        self, gains: Sequence[arb_mat], ends: Sequence[arb], small: Sequence[int], extra: Sequence[arb]
    ) -> arb_mat:
        """Columns of g at a corner, and of the remainders that are none."""
        z = [arb(0)] * self.n + [arb(1)]
        for a, end in zip(self.held, ends):
            z[a] = end
        point = arb_mat(self.n + 1, 1, z)
        columns = [(g * point).entries() for g in gains]
        for i, x in zip(small, extra):
            columns.append([x if j == i else arb(0) for j in range(self.n + 1)])
        return matrix([list(row) for row in zip(*columns)])

    def _splits(self, moves: Sequence[float]) -> list[arb_mat]:
        """D_a for every held coordinate."""
        size = self.n + 1
        rows = [[[arb(0)] * size for _ in range(size)] for _ in self.held]
        for move, (first, other) in zip(moves, self.splits):
            for (a, i, j), sign in ((other, 1), (first, -1)):
                part = arb(float(move)) * sign / (1 if i == j else 2)
                rows[a][i][j] += part
                if i != j:
                    rows[a][j][i] += part
        return [matrix(row) for row in rows]

    def _sides(self, place: Place, number: int) -> arb_mat:
        """sum mu_i B_i at a corner of a cell."""
        k, side, c = place
        return self._weighed(self.weights[k, side, number, c], *self.cells[c])

    def _weighed(self, weights: Sequence[float], low: Sequence[arb], high: Sequence[arb]) -> arb_mat:
        """The forms of a box, (xi_i - low_i)(high_i - xi_i), and of the inside, with weights."""
        n = self.n
        rows = [[arb(0)] * (n + 1) for _ in range(n + 1)]
        for i, (a, b) in enumerate(zip(low, high)):
            mu = arb(float(weights[i]))
            rows[i][i] = -mu
            rows[i][n] = rows[n][i] = mu * (a + b) / 2
            rows[n][n] -= mu * a * b
        return sum((form * arb(float(mu)) for form, mu in zip(self.around.inside, weights[n:])), matrix(rows))

    def _on_wall(self) -> None:
        """V >= -gap on the wall, at all times at which H is stated, and so between them."""
        n, forms = self.n, self.n + len(self.around.inside)
        low, high = [arb(-1)] * n, [arb(1)] * n
        room = identity(n + 1) * (self.gap / (n + 1))
        for here, weights, row in zip(self.matrices, self.wall_weights, self.wall_rows):
            total = here * arb(0.5) + room - self._weighed(weights[:forms], low, high)
            for form, mu in zip(self.wall.forms, weights[forms:]):
                total = total - form * arb(float(mu))
            if self.wall.row is not None:
                outer = arb_mat(n + 1, 1, self.wall.row) * arb_mat(1, n + 1, [arb(x) for x in row])
                total = total - (outer + outer.transpose()) * arb(0.5)
            if not is_positive_definite(total, self.budget):
                raise Unproved("a quadratic bound was not shown to be at least 0 on its wall")


def splitting(n: int, held: Sequence[int]) -> list[tuple[Place, Place]]:
    """Pairs of places (a, i, j) of the same monomial s_a z_i z_j, s = z[held]: D moves a share of it between the two.

    The monomials in the order in which they are met, a first, then i <= j; each one's first place with every later one.
    """
    found: dict[tuple[int, ...], list[Place]] = {}
    for a, axis in enumerate(held):
        for i, j in itertools.combinations_with_replacement(range(n + 1), 2):
            found.setdefault(tuple(sorted((axis, i, j))), []).append((a, i, j))
    return [(first, other) for first, *others in found.values() for other in others]
