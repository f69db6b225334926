"""The noise-free reach tube of the constants proof (Thm K5): a nominal polynomial curve, its defect, its radius.

On piece k, t = m_k + tau, the file gives p(tau) = sum_j c_j tau^j, eta_k >= sup |p' - f(p, d, t)|_P over the piece and
all d, and rho_k >= |x_t - p_t|_P there. Proved: the defect is at most eta_k, and rho' = c rho + eta (discrete time
rho_{k+1} = L rho_k + eta_k) from the initial set on stays below rho_k, the curve's jumps added.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce
from math import comb

from flint import arb, arb_mat

from certbound.checker.balls import cholesky, column, largest_eigenvalue, magnitude
from certbound.checker.constants.kummer import growth_integral
from certbound.checker.expressions import Program, Undecided, expand
from certbound.checker.report import PRODUCT, Budget, Unproved
from certbound.checker.statement import Change, Model, Structure

ORDER = 6
KINK_PARTS, SLIP = 16, arb(2) ** -20
"""Parts of a piece with a kink inside, and how much wider than its share each is taken."""
CORNERS = 10


class Norm:
    """|x|_P = sqrt(x^T P x) for a positive definite P."""

    def __init__(self, metric: arb_mat, budget: Budget) -> None:
        self.metric, self.size, self.budget = metric, magnitude(metric), budget
        self.root = cholesky(metric, budget)
        self.n = metric.nrows()
        budget.products(self.n, self.n, self.n)
        self.inverse = metric.inv()

    def length(self, vector: Sequence[arb]) -> arb:
        """Upper bound of the norm of a box: that of its middle plus that of its radii."""
        self.budget.products(2, self.n, self.n + 12)
        middle = column([x.mid() for x in vector])
        radius = column([x.rad() for x in vector])
        squares = [(middle.transpose() * self.metric * middle)[0, 0], (radius.transpose() * self.size * radius)[0, 0]]
        return sum((arb.max(x.upper(), arb(0)).sqrt() for x in squares), arb(0)).upper()

    def dual(self, row: Sequence[arb]) -> arb:
        """Upper bound of sqrt(a^T P^-1 a)."""
        self.budget.products(self.n, self.n + 6)
        flat = arb_mat(1, self.n, list(row))
        return arb.max((flat * self.inverse * flat.transpose())[0, 0].upper(), arb(0)).sqrt().upper()

    def section(self, image: arb_mat) -> arb:
        """Upper bound of sup |W y| over |y|_P <= 1."""
        self.budget.products(image.nrows(), self.n, self.n + image.nrows())
        return largest_eigenvalue(image * self.inverse * image.transpose(), self.budget).sqrt().upper()

    def start(self, model: Model, low: Sequence[arb], high: Sequence[arb], centre: Sequence[arb], whole: bool) -> arb:
        """Upper bound of |x_0 - centre|_P over a box, or over a round initial set if the box is ``whole``."""
        sides = [(a - c, b - c) for a, b, c in zip(low, high, centre)]
        wide = [j for j, (a, b) in enumerate(sides) if a < b]
        bound = self.length([a.union(b) if a < b else a for a, b in sides])
        if 0 < len(wide) <= CORNERS:
            corners = arb(0)
            for choice in itertools.product((0, 1), repeat=len(wide)):
                picks = dict(zip(wide, choice))
                corners = arb.max(corners, self.length([pair[picks.get(j, 1)] for j, pair in enumerate(sides)]))
            bound = arb.min(bound, corners)
        initial = model.initial
        if whole and initial.kind in ("ball", "ellipsoid"):
            if initial.shape is None:
                reach = largest_eigenvalue(self.metric, self.budget).sqrt() * arb(initial.radius)
            else:
                inner = cholesky(initial.shape, self.budget)
                self.budget.products(2, self.n, self.n, self.n)
                reach = largest_eigenvalue(inner.transpose() * self.metric * inner, self.budget).sqrt()
            shift = self.length([arb(x) - c for x, c in zip(initial.centre, centre)])
            bound = arb.min(bound, reach + shift)
        return bound.upper()


@dataclass(frozen=True, eq=False, kw_only=True)
class CurvePiece:
    """One piece: its ends, its middle, and the coefficients (one list of n a power)."""

    start: arb
    end: arb
    middle: arb
    coefficients: list[list[arb]]

    def at(self, t: arb) -> list[arb]:
        """The curve at a time."""
        tau = t - self.middle
        value = self.coefficients[-1]
        for lower in self.coefficients[-2::-1]:
            value = [c + tau * v for c, v in zip(lower, value)]
        return value

    @property
    def work(self) -> int:
        """Operations of balls of its `hull`, or of its `series`."""
        return 3 * len(self.coefficients) ** 2 * (len(self.coefficients[0]) + 1)

    def hull(self) -> list[list[arb]]:
        """Bernstein points: the curve lies in their convex hull."""
        count = len(self.coefficients)
        degree, n = count - 1, len(self.coefficients[0])
        if degree == 0:
            return [self.coefficients[0]]
        first, length = _powers(self.start - self.middle, degree), _powers(self.end - self.start, degree)
        # powers of lambda in [0, 1], tau = first + length * lambda
        powers = [[arb(0)] * n for _ in range(count)]
        for j, row in enumerate(self.coefficients):
            for i in range(j + 1):
                factor = comb(j, i) * first[j - i] * length[i]
                powers[i] = [a + factor * c for a, c in zip(powers[i], row)]
        return [
            [sum((arb(comb(k, i)) / comb(degree, i) * powers[i][x] for i in range(k + 1)), arb(0)) for x in range(n)]
            for k in range(count)
        ]

    def series(self, tau: arb, order: int) -> list[list[arb]]:
        """Taylor coefficients of every state about ``tau``."""
        count = len(self.coefficients)
        powers = _powers(tau, count)
        return [
            [
                sum((comb(j, i) * self.coefficients[j][x] * powers[j - i] for j in range(i, count)), arb(0))
                for i in range(min(order, count - 1) + 1)
            ]
            for x in range(len(self.coefficients[0]))
        ]


class Tube:
    """Defects and radii along the curve of one cell; in discrete time a piece is a step, the last one the horizon."""

    def __init__(
        self, model: Model, structure: Structure, norm: Norm, pieces: Sequence[CurvePiece], budget: Budget
    ) -> None:
        self.model, self.norm, self.pieces, self.budget = model, norm, pieces, budget
        self.reach = [(arb(b) - arb(a)) / 2 for a, b in model.disturbance]
        self.middle = [(arb(b) + arb(a)) / 2 for a, b in model.disturbance]
        self.entries, nodes = list(structure.disturbances.nodes), list(structure.disturbances.nodes.values())
        self.gain = Program(
            structure.graph, nodes, structure.outputs, variables=len(model.dynamics.inputs), generalised=True
        )
        self.gain.prepare([])

    def inputs(self, k: int) -> list[arb]:
        """The plan's inputs on piece k (each row holds on an equal part of the horizon)."""
        plan = self.model.plan
        if plan is None:
            return []
        if not self.model.continuous:
            return [arb(x) for x in plan[min(k, len(plan) - 1)]]
        piece, count = self.pieces[k], len(plan)
        self.budget.balls(10 * (1 + len(plan[0])))
        horizon, first, last = (Fraction(float(x)) for x in (arb(self.model.horizon), piece.start, piece.end))
        near = horizon / 2**47
        row = min(int((first + last) / 2 * count / horizon), count - 1)
        if not (first >= horizon * row / count - near and last <= horizon * (row + 1) / count + near):
            raise Unproved(f"piece {k} does not lie between two changes of the plan")
        inputs = [arb(x) for x in plan[row]]
        # an end that misses the plan's change sees what is beyond it
        for edge, beyond in ((row, row - 1), (row + 1, row + 1)):
            change = self._change(edge)
            if change.first < change.last and change.first < last and first < change.last:
                inputs = [a.union(arb(b)).union(arb(c)) for a, b, c in zip(inputs, change.low, change.high)]
            if 0 <= beyond < count and (first < change.first if edge == row else last > change.last):
                inputs = [a.union(arb(b)) for a, b in zip(inputs, plan[beyond])]
        return inputs

    def _change(self, edge: int) -> Change:
        """What happens at an end of the equal pieces on which the plan's rows hold."""
        if self.model.changes is not None:
            return self.model.changes[edge]
        assert self.model.plan is not None
        time = Fraction(self.model.horizon) * edge / len(self.model.plan)
        return Change(time, time, [], [])

    def defect(self, k: int) -> arb:
        """Upper bound of |p' - f(p, d, t)|_P over piece k and all d (discrete time: of |p_{k+1} - f(p_k, d, k)|_P)."""
        self.budget.balls(3 * self.pieces[k].work)
        try:
            points, rest = self._at_centre(k)
            columns = [] if not self.reach else self._with_disturbance(k, rest)
        except Undecided as error:
            raise Unproved(f"the dynamics is not defined along the nominal curve on piece {k}") from error
        worst = arb(0)
        for point in points:
            for signs in itertools.product((-1, 1), repeat=len(columns)):
                self.budget.balls(2 * len(columns) * len(point))
                corner = list(point)
                for sign, values in zip(signs, columns):
                    corner = [a + sign * b for a, b in zip(corner, values)]
                worst = arb.max(worst, self.norm.length(corner))
        return (worst + self.norm.length(rest)).upper()

    def _at_centre(self, k: int) -> tuple[list[list[arb]], list[arb]]:
        """The defect at d0: points whose convex hull holds its Taylor polynomial, and a box for the rest."""
        model, piece = self.model, self.pieces[k]
        inputs = [[x] for x in [*self.inputs(k), *self.middle]]
        if not model.continuous:
            states = [[x] for x in piece.coefficients[0]]
            after = self.pieces[k + 1].coefficients[0]
            values = expand(model.dynamics, [[arb(k)], *states, *inputs], 0, self.budget)
            return [[a - value[0] for a, value in zip(after, values)]], [arb(0)] * model.dimension
        span = (piece.start - piece.middle).union(piece.end - piece.middle)
        try:
            return self._expanded(k, inputs, arb(0), span, ORDER)
        except Undecided:  # a kink inside the piece has series up to the first power: over short parts they do
            share, found = span.rad() / KINK_PARTS, []
            for i in range(KINK_PARTS):
                middle = span.mid() + share * (2 * i + 1 - KINK_PARTS)
                found.append(self._expanded(k, inputs, middle, arb(0, share * (1 + SLIP)), 1))
            rests = [reduce(arb.max, (abs(rest[x]).upper() for _, rest in found)) for x in range(model.dimension)]
            return [point for points, _ in found for point in points], [arb(0, rest) for rest in rests]

    def _expanded(
        self, k: int, inputs: list[list[arb]], centre: arb, span: arb, order: int
    ) -> tuple[list[list[arb]], list[arb]]:
        """The same over ``span`` about ``centre``, from the middle of the piece."""
        model, piece = self.model, self.pieces[k]
        self.budget.balls(4 * piece.work)
        parts = []
        for tau in (centre, centre + span):
            time = [piece.middle + tau, arb(1)]
            states = piece.series(tau, order + 1)
            parts.append((states, expand(model.dynamics, [time, *states, *inputs], order, self.budget)))
        (thin, thin_flow), (wide, wide_flow) = parts
        rows = [
            [_velocity(thin[x], j) - thin_flow[x][j] for x in range(model.dimension)] for j in range(order)
        ]
        size = _powers(span, order)[order]
        rest = [(_velocity(wide[x], order) - wide_flow[x][order]) * size for x in range(model.dimension)]
        return (rows if order == 1 else replace(piece, coefficients=rows).hull()), rest

    def _with_disturbance(self, k: int, rest: list[arb]) -> list[list[arb]]:
        """Columns of the linear effect of d; what is left of it is added to ``rest``."""
        n, piece = self.model.dimension, self.pieces[k]
        box = [low.union(high) for low, high in self.ranges(k)]
        time = piece.start.union(piece.end) if self.model.continuous else arb(k)
        disturbances = [m + arb(0, r) for m, r in zip(self.middle, self.reach)]
        values = self.gain.run([time, *box, *self.inputs(k), *disturbances])
        columns = [[arb(0)] * n for _ in self.reach]
        for (i, j), value in zip(self.entries, values):
            columns[j][i] = value.mid() * self.reach[j]
            rest[i] = rest[i] + arb(0, value.rad()) * self.reach[j]
        if len(columns) > CORNERS:
            raise Unproved(f"{len(columns)} disturbances are too many for this proof")
        return columns

    def ranges(self, k: int) -> list[tuple[arb, arb]]:
        """The box hull of the curve on a piece."""
        self.budget.balls(2 * self.pieces[k].work)
        points = self.pieces[k].hull()
        result = []
        for x in range(self.model.dimension):
            low = high = points[0][x]
            for point in points[1:]:
                low, high = arb.min(low, point[x]), arb.max(high, point[x])
            result.append((low.lower(), high.upper()))
        return result

    def prove(self, start: arb, slope: arb, eta: Sequence[arb], radii: Sequence[arb]) -> None:
        """Prove that the stated defects and radii hold."""
        n, many = self.model.dimension, 1 << len(self.reach) if len(self.reach) <= CORNERS else 1
        self.budget.expect(len(eta) * many * 2 * n * n * PRODUCT)
        rho = start
        for k, piece in enumerate(self.pieces):
            self.budget.balls(80 + 4 * piece.work)
            if k < len(eta) and not self.defect(k) <= eta[k]:
                raise Unproved(f"the defect of the nominal curve was not shown to be at most eta on piece {k}")
            after = rho
            if self.model.continuous:
                length = piece.end - piece.start
                after = (slope * length).exp() * rho + growth_integral(slope, length) * eta[k]
            if not arb.max(rho, after) <= radii[k]:
                raise Unproved(f"the reach tube was not shown to have the stated radius on piece {k}")
            if self.model.continuous and k + 1 < len(self.pieces):
                following = self.pieces[k + 1]
                jump = [a - b for a, b in zip(following.at(piece.end), piece.at(piece.end))]
                rho = (after + self.norm.length(jump)).upper()
            elif not self.model.continuous and k < len(eta):
                rho = (slope * rho + eta[k]).upper()


def _powers(x: arb, most: int) -> list[arb]:
    """1, x, ..., x^most."""
    result = [arb(1)]
    for _ in range(most):
        result.append(result[-1] * x)
    return result


def _velocity(series: list[arb], j: int) -> arb:
    return (j + 1) * series[j + 1] if j + 1 < len(series) else arb(0)
