"""The mean of a piecewise polynomial after normal noise, and how far its Taylor polynomials may be trusted.

U is a polynomial in xi in [-1, 1]^n on every cell of a grid and constant beyond it. With w of independent N(0, s_i^2),

    h(m) = E U(m + w),      D_a(m) = s^a d^a h(m) / a!,

D_a is a sum over the cells of products over the axes of (1/a_i!) int xi^k He_(a_i)(z) phi(z) dz, z = (y - m)/s, which
has a closed form (`_integrals`): integration by parts with He_a phi = -(He_(a-1) phi)'.

For complex mu in units of s, |phi(z - mu)| <= sqrt(2) exp(|mu|^2/2) phi_2(z), phi_2 the density of N(0, 2): the
difference of the exponents is (z/sqrt(2) - sqrt(2) Re mu)^2/2 >= 0. So with H(m) = E |U|(m + sqrt(2) w) and Cauchy's
estimate on the line through m and m + s v, over |mu| <= r,

    |h(m + s v) - sum over |a| < p of D_a(m) v^a| <= 2^(n/2) exp(r^2/2) H(m) (|v|/r)^p / (1 - |v|/r).

The same H measures the rounding of all sums.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.report import Budget
from certbound.checker.values.batches import Array, above

ORDER = 8
"""p of the module: the derivatives up to ``ORDER`` - 1 are tabulated."""
RADIUS = math.sqrt(ORDER)
"""r of the module."""
PER_DEVIATION = 3
"""Points of the mesh per standard deviation."""
FARTHEST = 14.0
"""Standard deviations beyond which the density is counted as an error, below `_FAR` in all."""
_FAR, _NOTHING = 1e-30, 17.0
"""... and those beyond which N(0, 2) has less than that: Q(17/sqrt(2)) < 2e-33."""
_TINY_BALL = arb(0, 1e-33)  # Q, and He_a phi for a < 8, beyond 15
_UNIT = 2.0**-52
_UP = 1 + 2.0**-30
_FAR_PAIR, _NEAR_ENTRY = 30_000, 4_000
"""Units of work of a point and an edge, and of every integral of a cell that lies near: 10 to 20 and 2 to 5 us."""


@dataclass(frozen=True, eq=False)
class AxisTable:
    """The integrals of one axis, from ``points`` (M) to the cells between ``edges`` (N + 1) and the two beyond.

    Attributes
    ----------
    integrals : ndarray, shape (ORDER, degree + 1, M, N + 2)
        Nearly int xi^k He_a phi / a!; the outer cells have k = 0 only.
    size, off : ndarray, shape (ORDER,)
        What their absolute values and their errors are at most, in units of ``weight`` and but for `_FAR` in all.
    weight : ndarray, shape (M, N + 2)
        At least the probability that N(m, 2 s^2) gives to each cell.
    """

    points: Array
    integrals: Array
    size: Array
    off: Array
    weight: Array


def axis_table(points: Array, edges: Array, deviation: arb, degree: int, budget: Budget) -> AxisTable:
    """The integrals of one axis for every point of the mesh and every cell, from balls."""
    shape = (len(points), len(edges) + 1)
    pairs, last = math.prod(shape), len(edges) - 1
    budget.take(8 * pairs * (ORDER * (degree + 1) + 1))
    budget.fits(8 * pairs * (2 * ORDER + degree + 1))
    budget.floats(2 * pairs, len(points))
    reach = above(deviation) * _NOTHING
    with np.errstate(over="ignore"):
        spans = [np.searchsorted(edges - point, (-reach, reach)).tolist() for point in points]
    spans = [(max(first - 1, 0), min(end, last)) for first, end in spans]
    budget.balls(sum(end - first + 2 for first, end in spans), _FAR_PAIR)
    integrals, off = np.zeros((ORDER, degree + 1, *shape)), np.zeros((ORDER, *shape))
    weight = np.full(shape, 2 * _FAR)
    inverse, nowhere = 1 / deviation, _Edge(None, arb(0), arb(0), [])
    for j, (point, (first, end)) in enumerate(zip(points, spans)):
        row = [_at((arb(edge) - arb(float(point))) * inverse) for edge in edges[first : end + 1]]
        row = [*[nowhere] * (first == 0), *row, *[nowhere] * (end == last)]
        for k, (left, right) in enumerate(pairwise(row), first + (first > 0)):
            weight[j, k] = above(_mass(left, right, wide=True)) + _FAR
            if _is_near(left, right):
                budget.balls(ORDER * (degree + 1), _NEAR_ENTRY)
                found = _integrals(left, right, degree)
                for a, line in enumerate(found):
                    for i, ball in enumerate(line):
                        integrals[a, i, j, k] = number = float(ball)
                        wrong = abs(number) * 2 * _UNIT + 1e-300
                        if ball.rel_accuracy_bits() < 60:  # else its radius is below 2^-58 of it
                            wrong += above(abs(ball - number))
                        if wrong > off[a, j, k]:
                            off[a, j, k] = wrong
    size = np.array([(np.abs(part) / weight).max() for part in integrals]) * _UP
    return AxisTable(points, integrals, size, np.array([(part / weight).max() for part in off]) * _UP, weight)


@dataclass(frozen=True, eq=False)
class _Edge:
    """z at an edge (None: infinite), Q(|z|) for s and for sqrt(2) s, and He_a phi for a < ORDER - 1."""

    z: arb | None
    tail: arb
    wide: arb
    hermite: list[arb]


def _at(z: arb) -> _Edge:
    size = abs(z)
    if size > FARTHEST + 1:  # nothing but Q for the wider density is asked of it, or its signs
        return _Edge(z, _TINY_BALL, (size / 2).erfc() / 2, [_TINY_BALL] * (ORDER - 1))
    density = (-z * z / 2).exp() / (2 * arb.pi()).sqrt()
    hermite = [density, z * density]
    for a in range(1, ORDER - 2):
        hermite.append(z * hermite[a] - a * hermite[a - 1])
    return _Edge(z, (size / arb(2).sqrt()).erfc() / 2, (size / 2).erfc() / 2, hermite)


def _is_near(left: _Edge, right: _Edge) -> bool:
    """Whether a part of the cell lies within `FARTHEST`."""
    return not (left.z is not None and left.z > FARTHEST) and not (right.z is not None and right.z < -FARTHEST)


def _mass(left: _Edge, right: _Edge, *, wide: bool = False) -> arb:
    """The probability of a cell, from Q(|z|) at its edges."""
    one, two = (left.wide, right.wide) if wide else (left.tail, right.tail)
    if left.z is not None and left.z >= 0:
        return one - two
    if right.z is not None and right.z < 0:
        return two - one
    before = arb(0) if left.z is None else _lower_tail(left.z, one)
    beyond = arb(0) if right.z is None else _lower_tail(-right.z, two)
    return 1 - before - beyond


def _lower_tail(z: arb, tail: arb) -> arb:
    """P(N(0, 1) < z) from Q(|z|)."""
    return 1 - tail if z > 0 else tail if z <= 0 else tail.union(1 - tail)


def _integrals(left: _Edge, right: _Edge, degree: int) -> list[list[arb]]:
    """(1/a!) int xi^k He_a phi over a cell, for a < ORDER and k <= degree (an unbounded cell: k = 0 only)."""
    ends = [left.hermite or [arb(0)] * (ORDER - 1), right.hermite or [arb(0)] * (ORDER - 1)]
    table = [[_mass(left, right)]]
    if left.z is None or right.z is None:
        table += [[ends[0][a] - ends[1][a]] for a in range(ORDER - 1)]
    else:
        rate, middle = 2 / (right.z - left.z), (left.z + right.z) / 2
        for k in range(1, degree + 1):
            term = ends[0][0] * (-1) ** (k - 1) - ends[1][0] - middle * table[0][k - 1]
            table[0].append(rate * (term + (k - 1) * rate * table[0][k - 2] if k > 1 else term))
        for a in range(ORDER - 1):
            line = [ends[0][a] - ends[1][a]]
            for k in range(1, degree + 1):
                line.append(k * rate * table[a][k - 1] + ends[0][a] * (-1) ** k - ends[1][a])
            table.append(line)
    return [[ball / math.factorial(a) for ball in line] for a, line in enumerate(table)]


# ---- tables over a mesh ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MeanTable:
    """D_a at every point of a mesh, and what is wrong with it and with the Taylor polynomials; see the module."""

    derivatives: dict[tuple[int, ...], Array]
    dominant: Array
    rounding: float
    far: float

    def missing(self, reach: Array) -> Array:
        """Error of the Taylor polynomial at a distance of at most ``reach``, in units of the dominant; inf beyond 1.4.
        """
        n = self.dominant.ndim
        share = np.minimum(reach / (RADIUS * (1 - 1e-12)), 0.5) * _UP
        tail = 2 ** (n / 2) * math.exp(RADIUS**2 / 2) * share**ORDER / (1 - share) * _UP
        total = tail + self.rounding * np.maximum(1.0, reach) ** ORDER
        return np.where(reach < RADIUS / 2, total * _UP, np.inf)


def mean_table(axes: list[AxisTable], pieces: Array, budget: Budget) -> MeanTable:
    """The table of one function: ``pieces`` are its coefficients, shape (degree + 1, ..., cells + 2, ...) by axes."""
    n = len(axes)
    _count(axes, pieces, budget)
    sizes = np.abs(pieces).sum(axis=tuple(range(n)))
    dominant = sizes
    for axis, table in enumerate(axes):
        dominant = _along(table.weight, dominant, axis)
    derivatives = _in_space(axes, pieces, budget)
    most = float(sizes.max())
    return MeanTable(derivatives, np.asarray(dominant * _UP), _rounding(axes, pieces), 4 * _FAR * n * most * ORDER**n)


def _count(axes: list[AxisTable], pieces: Array, budget: Budget) -> None:
    """Count the sums of a table, one axis after the other as `_in_space` takes them, and the arrays between."""
    n, points, cells, largest, total = len(axes), 1, math.prod(pieces.shape[len(axes) :]), pieces.size, 0
    powers = pieces.size // cells
    for done, axis in enumerate(reversed(axes)):
        inner = pieces.shape[2 * n - 1 - done]
        total += math.comb(ORDER + done, done + 1) * powers * cells * len(axis.points) * points
        points, cells, powers = points * len(axis.points), cells // inner, powers // pieces.shape[0]
        largest = max(largest, powers * cells * points)
    budget.fits(8 * (3 * largest + 2 * pieces.size + math.comb(ORDER - 1 + n, n) * points))
    budget.floats(total // 2 + 4 * pieces.size, ORDER**n * pieces.shape[0])


def _on_line(table: AxisTable, pieces: Array) -> dict[tuple[int, ...], Array]:
    return {(a,): sum(part @ row for part, row in zip(table.integrals[a], pieces)) for a in range(ORDER)}


def _in_space(axes: list[AxisTable], pieces: Array, budget: Budget) -> dict[tuple[int, ...], Array]:
    """The sums over the last state's cells first, which serve all derivatives by the others; ``pieces`` as there."""
    if len(axes) == 1:
        return _on_line(axes[0], pieces)
    found: dict[tuple[int, ...], Array] = {}
    n, degree = len(axes), len(pieces) - 1
    last = axes[-1].integrals
    for b in range(ORDER):
        budget.check()
        inner = sum(np.take(pieces, k, axis=n - 1) @ last[b, k].T for k in range(degree + 1))
        # the powers and cells of the others, and the points of the last state as if they were a batch
        for rest, part in _others(axes[:-1], np.asarray(inner), ORDER - b, budget).items():
            found[(*rest, b)] = part
    return found


def _others(axes: list[AxisTable], pieces: Array, order: int, budget: Budget) -> dict[tuple[int, ...], Array]:
    """The same where an axis of points comes last, for derivatives of a total order below ``order``."""
    n, found = len(axes), dict[tuple[int, ...], Array]()
    axis, count = axes[-1].integrals, len(pieces)
    for b in range(order):
        budget.check()
        moved = [np.moveaxis(np.take(pieces, k, axis=n - 1), 2 * n - 2, -1) @ axis[b, k].T for k in range(count)]
        inner = np.moveaxis(np.asarray(sum(moved)), -1, 2 * n - 2)
        if n == 1:
            found[b,] = inner
            continue
        for rest, part in _others(axes[:-1], _with_batch(inner, n), order - b, budget).items():
            found[(*rest, b)] = part.reshape(*part.shape[:-1], *inner.shape[-2:])
    return found


def _with_batch(array: Array, n: int) -> Array:
    """The last two axes as one."""
    return array.reshape(*array.shape[:-2], -1)


def _rounding(axes: list[AxisTable], pieces: Array) -> float:
    """Bound of the error of every D_a in all, in units of the dominant: that of the integrals, and of the sums."""
    gamma = (2 * sum(pieces.shape) + 16) * _UNIT  # at least twice the terms of the longest sums
    total = 0.0
    for a in itertools.product(range(ORDER), repeat=len(axes)):
        if sum(a) < ORDER:
            exact = math.prod(float(table.size[k]) for table, k in zip(axes, a))
            wrong = math.prod(float(table.size[k] + table.off[k]) for table, k in zip(axes, a)) - exact
            total += wrong * (1 + 1e-9) + gamma * (exact + wrong) + 1e-15 * exact
    return total


def _along(matrix: Array, array: Array, axis: int) -> Array:
    return np.moveaxis(np.tensordot(matrix, array, axes=([1], [axis])), 0, axis)
