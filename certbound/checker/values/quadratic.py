"""The proof by quadratic value bounds (theory, Section 14): definite matrices, and nothing of what found them.

For every wall, or some together, V = z' H(t) z / 2 with H a polynomial of degree 1 or 2 between stated times, by its
control points in Bernstein form, and R = V_t + f . grad V + tr(g g' V'')/2 + |g' grad V|^2/2. At fixed t, x, f and g, R
is convex in (H, H'), which is a convex combination of the control points and their slopes. At each of these, on every
cell and at every corner (the ends of the held coordinates s and of the disturbances),

    M = -(H' + H A + A' H + sum_c G_c' H G_c)/2 - D(s) - H G G' H/2 - E - sum_i mu_i B_i,     mu >= 0,

with forms B_i >= 0 on the cell and z' D(s) z = 0: where M + lam/|z|^2 is positive definite, R <= lam. What is missing
of f_i is at most sum_b r_ib |eta_b| (`Local`), for which sum_ib r_ib (q eta_b^2 + p_i^2/q)/2 pays, p = H z: E holds the
first part, and G, besides the columns of g, sqrt(sum_b r_ib/q) e_i. In the same way V >= -gap on the walls that V is
for, in its window of time. Then P(leaving) <= the sum of exp(sum_k lam_k h_k + gap + V(0, x)), over V whose windows
cover the horizon at every wall. Its supremum over a box of starts is that over its corners once every V(0, .) has been
made convex; of a ball each V has its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from flint import arb, arb_mat

from certbound.checker.balls import identity, is_positive_definite, largest_eigenvalue, matrix, upper
from certbound.checker.reading import Record, entries, numbers, unpacked, whole, wholes
from certbound.checker.report import FUNCTION, PRODUCT, Budget, Unproved
from certbound.checker.statement import Model
from certbound.checker.values.second_order import Flow, Local
from certbound.checker.values.walls import Key, Wall, WorkingBox
from certbound.errors import CertificateError

MOST_STATES = 12
MOST_MATRICES = 500_000
MOST_NUMBERS = 2_000_000
_STEEP = arb(8)  # q
_MOST_CORNERS = 10
_MOST_WALLS = 100
_MOST_BOUNDS = 1000
_NAMES = (
    "walls", "first", "degree", "held", "cuts", "times", "matrices", "moves", "weights", "wall_weights", "wall_rows",
    "lam", "gap",
)  # fmt: skip
_SLOPES = {1: ((0, 1, 1), (0, 1, 1)), 2: ((0, 1, 2), (0, 2, 1), (1, 2, 2))}
"""(a, b, c) of each control point of a piece: its slope is c (H_b - H_a) / length."""
Place = tuple[int, int, int]


def check_quadratic(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    record = Record(value, "proof", ("engine", "center", "width", "bounds"))
    n = model.dimension
    if not model.continuous:
        raise Unproved("quadratic value bounds prove nothing in discrete time")
    if n > MOST_STATES:
        raise Unproved(f"quadratic value bounds are proved for at most {MOST_STATES} states")
    if model.plan is not None:
        raise Unproved("this proof does not treat a plan with steps in time")
    flow = Flow(model, budget)
    around = WorkingBox(model, record, flow)
    stated: list[_Value] = []
    for k, item in enumerate(record.items("bounds", 0, _MOST_BOUNDS)):
        budget.check()
        stated.append(_Value(around, flow, item, f"proof.bounds[{k}]", budget))
        if sum(one.moves.size + one.weights.size for one in stated) > MOST_NUMBERS:
            raise CertificateError(f"`proof.bounds` must hold at most {MOST_NUMBERS} multipliers.")
    _check_covered(around, stated)
    for one in stated:
        one.prove()
    return _worst(around, stated)


def _check_covered(around: WorkingBox, stated: Sequence[_Value]) -> None:
    """Every wall that paths can leave through is looked at, at all times."""
    for key in around.walls:
        windows = sorted((one.window for one in stated if key in one.keys), key=lambda window: float(window[0]))
        if not windows:
            raise Unproved("the walls were not shown to be all that paths can leave through")
        reached = arb(0)
        for start, end in windows:
            if not start <= reached:
                raise Unproved("the windows of a wall were not shown to cover the horizon")
            reached = arb.max(reached, end)
        if not reached >= arb(around.model.horizon):
            raise Unproved("the windows of a wall were not shown to cover the horizon")


def _worst(around: WorkingBox, walls: Sequence[_Value]) -> arb:
    """At least the supremum over the starts of the sum over the walls."""
    found = _at_corners(around, walls)
    if around.model.initial.kind == "ball":
        found = arb.min(found, sum((_over_ball(around, wall) for wall in walls), arb(0)))
    return arb.min(upper(found), arb(1))


def _at_corners(around: WorkingBox, walls: Sequence[_Value]) -> arb:
    """Over a box of starts, by its corners: every V(0, .) is made convex first."""
    wide = [i for i, (low, high) in enumerate(around.start) if not (low - high).is_zero()]
    if len(wide) > _MOST_CORNERS:
        raise Unproved(f"this proof treats starts that are wide along at most {_MOST_CORNERS} states")
    half = [(high - low) / 2 for low, high in around.start]
    budget, n = around.model.budget, around.n
    budget.products(len(walls), n + 1, n + 1, 60 + 20 * n)
    budget.products(len(walls) << len(wide), n + 1, n + 20)
    budget.balls(len(walls) << len(wide), FUNCTION)
    lifts = []
    for wall in walls:
        bend = [[-half[i] * half[j] * wall.matrices[0][i, j] for j in wide] for i in wide]
        lifts.append(largest_eigenvalue(matrix(bend), budget) * len(wide) / 2 if wide else arb(0))
    worst = arb(0)
    for ends in itertools.product((0, 1), repeat=len(wide)):
        z = [low.union(high) for low, high in around.start]
        for i, end in zip(wide, ends):
            z[i] = around.start[i][end]
        parts = [(wall.paid + lift + wall.at(z)).exp() for wall, lift in zip(walls, lifts)]
        worst = arb.max(worst, sum(parts, arb(0)))
    return worst


def _over_ball(around: WorkingBox, wall: _Value) -> arb:
    """One wall's part over a ball of starts: V at its centre, its slope and half its largest bend there, in radii."""
    initial, n = around.model.initial, around.n
    radius = [arb(initial.radius) / w for w in around.width]
    z = [(arb(c) - m) / w for c, m, w in zip(initial.centre, around.center, around.width)]
    here = wall.matrices[0]
    slope = (here * arb_mat(n + 1, 1, [*z, arb(1)])).entries()[:n]
    rise = sum(((r * x).abs_upper() ** 2 for r, x in zip(radius, slope)), arb(0)).sqrt()
    budget = around.model.budget
    bend = largest_eigenvalue(
        matrix([[radius[i] * radius[j] * here[i, j] for j in range(n)] for i in range(n)]), budget
    )
    return (wall.paid + wall.at(z) + rise + bend / 2).exp()


class _Value:
    """What the file states of one wall."""

    def __init__(self, around: WorkingBox, flow: Flow, value: object, path: str, budget: Budget) -> None:
        self.record = record = Record(value, path, _NAMES)
        self.around, self.flow, self.budget, self.n = around, flow, budget, around.n
        self.held = wholes(record["held"], record.at("held"), 0, self.n - 1)
        if any(a >= b for a, b in pairwise(self.held)):
            raise CertificateError(f"`{path}.held` must rise.")
        flow.held(self.held)
        self.degree = whole(record["degree"], record.at("degree"), 1, 2)
        self.keys = [self._key(pair) for pair in entries(record["walls"], record.at("walls"), 1, _MOST_WALLS)]
        self.walls = [around.walls[key] for key in self.keys]
        self.times = [arb(t) for t in record.array("times", None)]
        if len(self.times) < 2 or any(not a < b for a, b in pairwise(self.times)):
            raise CertificateError(f"`{record.at('times')}` must be two or more numbers that rise.")
        if self.times[0] != 0:
            raise Unproved("the pieces do not begin at time 0")
        self.first = whole(record["first"], record.at("first"), 0, len(self.times) - 2)
        self.window = self.times[self.first], self.times[-1]
        self.cells = self._cells()
        self._read()

    def _key(self, value: object) -> Key:
        """What a wall is."""
        path = self.record.at("walls")
        pair = entries(value, path, 2, 2)
        key = whole(pair[0], path, -self.n, 1000), whole(pair[1], path, 0, 100_000)
        if key not in self.around.walls:
            raise Unproved(f"`{path}` holds what is no wall of the problem")
        return key

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
        many = count
        self.corners = len(self.held) + self.flow.q - self.n
        count *= (self.degree + 1) * (len(self.times) - 1)
        if self.corners > 20 or count << self.corners > MOST_MATRICES:
            raise CertificateError(f"`{path}` must make at most {MOST_MATRICES} matrices.")
        self.budget.take(many * (200 + 16 * self.n))
        self.budget.spend(many * (1_000 + 50 * self.n))
        boxes = itertools.product(*(list(pairwise(row)) for row in rows))
        return [([a for a, _ in box], [b for _, b in box]) for box in boxes]

    def _read(self) -> None:
        record, n = self.record, self.n
        pieces, cells, ends = len(self.times) - 1, len(self.cells), self.degree + 1
        many = len(self.held) * (n + 1) * (n + 2)
        self.budget.take(150 * many)
        self.budget.spend(3_000 * many)
        self.splits = splitting(n, self.held)
        self.matrices = []
        for k, rows in enumerate(record.array("matrices", self.degree * pieces + 1, n + 1, n + 1)):
            if any(rows[i][j] != rows[j][i] for i in range(n + 1) for j in range(i)):
                raise CertificateError(f"`{record.at('matrices')}[{k}]` must be symmetric.")
            self.matrices.append(matrix(rows))
        forms = n + len(self.around.inside)
        shapes = {"moves": (pieces, ends, cells, len(self.splits)),
                  "weights": (pieces, ends, 1 << self.corners, cells, forms)}  # fmt: skip
        if any(math.prod(shape) > MOST_NUMBERS for shape in shapes.values()):
            raise CertificateError(f"`{record.path}` must hold at most {MOST_NUMBERS} multipliers.")
        found = (
            unpacked(record[name], record.at(name), math.prod(shape), self.budget) for name, shape in shapes.items()
        )
        self.moves, self.weights = (np.array(part).reshape(shape) for part, shape in zip(found, shapes.values()))
        self.wall_weights, self.wall_rows = (self._on_walls(name, forms) for name in ("wall_weights", "wall_rows"))
        if not ((self.weights >= 0).all() and all(mu >= 0 for rows in self.wall_weights for row in rows for mu in row)):
            raise CertificateError(f"`{record.path}` must not have a negative weight.")
        self.lam = [arb(x) for x in record.array("lam", pieces)]
        self.gap = arb(record.number("gap", least=0.0))
        if not all(rate >= 0 for rate in self.lam):
            raise CertificateError(f"`{record.at('lam')}` must not be negative.")
        self.growth = sum((rate * (b - a) for rate, (a, b) in zip(self.lam, pairwise(self.times))), arb(0))

    def _on_walls(self, name: str, forms: int) -> list[list[list[float]]]:
        """Numbers of every wall at every control point in the window."""
        record, many = self.record, self.degree * (len(self.times) - 1 - self.first) + 1
        found = []
        for wall, value in zip(self.walls, entries(record[name], record.at(name), len(self.walls), len(self.walls))):
            size = forms + len(wall.forms) if name == "wall_weights" else 0 if wall.row is None else self.n + 1
            rows = entries(value, record.at(name), many, many)
            found.append([numbers(row, record.at(name), size) for row in rows])
        return found

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
        for given in zip(self.walls, self.wall_weights, self.wall_rows, strict=True):
            self._on_wall(*given)
        around = self.around
        gains = self.flow.gain(around.center, around.width)
        n, many = self.n + 1, 2 + len(self.held) + self.flow.q - self.n
        points = len(self.cells) * (self.degree + 1) * (len(self.times) - 1) << self.corners
        self.budget.expect(points * n * n * 4 * (self.flow.columns + n) * PRODUCT)
        self.budget.hold(len(self.cells) * many * n * n)
        locals_ = [self.flow.over(low, high, self.held, around.center, around.width) for low, high in self.cells]
        steps = [b - a for a, b in pairwise(self.times)]
        for k, (side, (a, b, factor)) in itertools.product(range(len(steps)), enumerate(_SLOPES[self.degree])):
            at = self.degree * k
            slope = (self.matrices[at + b] - self.matrices[at + a]) * (factor / steps[k])
            here = self.matrices[at + side]
            self.budget.products(2 * len(gains) + 4, n, n, n + 20)
            trace = sum((g.transpose() * here * g for g in gains), slope)
            for c, local in enumerate(locals_):
                self._on_cell((k, side, c), trace, local, gains)

    def _on_cell(self, place: Place, known: arb_mat, local: Local, gains: Sequence[arb_mat]) -> None:
        """M + lam/|z|^2 at all corners of a cell; ``known`` is the part of -2 M that is the same everywhere."""
        k, side, c = place
        n, forms = self.n + 1, self.n + len(self.around.inside)
        self.budget.balls(4 * len(self.splits) + 4 * n * n * (1 + len(self.held)))
        low, high = self.cells[c]
        here = self.matrices[self.degree * k + side]
        reach = sum((arb.max(a * a, b * b) for a, b in zip(low, high)), arb(1))
        shift = identity(self.n + 1) * (self.lam[k] / reach)
        missing = missing_form(local)
        extra = [(sum(row, arb(0)) / _STEEP).sqrt() for row in local.rest]
        splits = self._splits(self.moves[k, side, c])
        for number, bits in enumerate(itertools.product((0, 1), repeat=self.corners)):
            self.budget.products(n, n, 4 * (len(gains) + n) + forms + 6 * self.corners + 60)
            self.budget.balls(n * (len(gains) + 3 * n + 6))
            ends = [high[a] if bit else low[a] for a, bit in zip(self.held, bits)]
            drift = self._drift(local, ends, bits)
            total = here * drift
            total = known + total + total.transpose()
            spread = self._spread(gains, ends, extra)
            border = here * spread
            total = (total + border * border.transpose()) * arb(0.5)
            total = total + sum((part * end for part, end in zip(splits, ends)), self._sides(place, number) + missing)
            if not is_positive_definite(shift - total, self.budget):
                raise Unproved("the growth of a quadratic bound was not shown to be as small as stated")

    def _drift(self, local: Local, ends: Sequence[arb], bits: Sequence[int]) -> arb_mat:
        """A at a corner."""
        total = local.base
        for a, end in zip(self.held, ends):
            total = total + local.along[a] * (end - local.middle[a])
        for part, bit in zip(local.pushed, bits[len(self.held) :]):
            total = total + part * arb(2 * bit - 1)
        return total

    def _spread(self, gains: Sequence[arb_mat], ends: Sequence[arb], extra: Sequence[arb]) -> arb_mat:
        """Columns of g at a corner, and of the remainders."""
        z = [arb(0)] * self.n + [arb(1)]
        for a, end in zip(self.held, ends):
            z[a] = end
        point = arb_mat(self.n + 1, 1, z)
        columns = [(g * point).entries() for g in gains]
        for i, x in enumerate(extra):
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

    def _on_wall(self, wall: Wall, wall_weights: list[list[float]], wall_rows: list[list[float]]) -> None:
        """V >= -gap on a wall, at all control points of H in the window, and so between them."""
        n, forms = self.n, self.n + len(self.around.inside)
        low, high = [arb(-1)] * n, [arb(1)] * n
        room = identity(n + 1) * (self.gap / (n + 1))
        matrices = self.matrices[self.degree * self.first :]
        for here, weights, row in zip(matrices, wall_weights, wall_rows, strict=True):
            self.budget.products(n + 1, n + 1, 2 * forms + 3 * len(wall.forms) + 60)
            total = here * arb(0.5) + room - self._weighed(weights[:forms], low, high)
            for form, mu in zip(wall.forms, weights[forms:], strict=True):
                total = total - form * arb(float(mu))
            if wall.row is not None:
                outer = arb_mat(n + 1, 1, wall.row) * arb_mat(1, n + 1, [arb(x) for x in row])
                total = total - (outer + outer.transpose()) * arb(0.5)
            if not is_positive_definite(total, self.budget):
                raise Unproved("a quadratic bound was not shown to be at least 0 on its wall")


def missing_form(local: Local) -> arb_mat:
    """E: sum_b (sum_i r_ib) (q/2) eta_b^2 over a cell, as a form over z."""
    n = len(local.rest)
    rows = [[arb(0)] * (n + 1) for _ in range(n + 1)]
    for b in range(n):
        weight = sum((row[b] for row in local.rest), arb(0)) * _STEEP / 2
        slope, offset = 1 / local.size[b], -local.middle[b] / local.size[b]
        rows[b][b] += weight * slope**2
        rows[b][n] += weight * slope * offset
        rows[n][b] += weight * slope * offset
        rows[n][n] += weight * offset**2
    rows[n][n] += sum((row[n] for row in local.rest), arb(0)) * _STEEP / 2
    return matrix(rows)


def splitting(n: int, held: Sequence[int]) -> list[tuple[Place, Place]]:
    """Pairs of places (a, i, j) of the same monomial s_a z_i z_j, s = z[held]: D moves a share of it between the two.

    The monomials in the order in which they are met, a first, then i <= j; each one's first place with every later one.
    """
    found: dict[tuple[int, ...], list[Place]] = {}
    for a, axis in enumerate(held):
        for i, j in itertools.combinations_with_replacement(range(n + 1), 2):
            found.setdefault(tuple(sorted((axis, i, j))), []).append((a, i, j))
    return [(first, other) for first, *others in found.values() for other in others]
