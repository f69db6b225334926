"""Parts of networks on balls: ranges, derivatives, series and Taylor models, layer by layer with ball matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Protocol, cast

from flint import arb, arb_mat

from certbound.checker.expressions import series as ts
from certbound.checker.expressions import taylor as tm
from certbound.checker.expressions.activation_balls import ACTIVATIONS, Activation, Constants, kinked, line
from certbound.checker.expressions.arithmetic import Undecided, square
from certbound.checker.report import BALL, FUNCTION, PRODUCT, Budget, Unproved
from certbound.problem.model import Layer, Network, Part

_ZERO = arb(0)
Rows = list[list[arb]]
_Layers = list[tuple[arb_mat, arb_mat, list[arb], Activation, Constants]]
_SMALL, _LONG = 0.25, 1
"""A reach below which the second order is not worse than the first, and one beyond which it is not better."""
_MOST_CUBIC = 4
"""Coordinates up to which terms of third order are carried."""
_Triple = tuple[int, int, int]


class Builder(Protocol):
    """What derivatives are made with: ``graph.Graph``."""

    def part(self, part: Part, args: tuple[int, ...]) -> int: ...
    def add(self, a: int, b: int) -> int: ...
    def mul(self, a: int, b: int) -> int: ...
    def const(self, value: float) -> int: ...


@lru_cache(maxsize=16)
def _matrices(network: Network) -> _Layers:
    def read(layer: Layer) -> tuple[arb_mat, arb_mat, list[arb], Activation, Constants]:
        weights, size = (arb_mat([[arb(f(x)) for x in row] for row in layer.weights]) for f in (float, abs))
        return weights, size, [arb(x) for x in layer.bias], ACTIVATIONS[layer.activation], layer.constants

    return [read(layer) for layer in network.layers]


class _Last:
    """The last answers, for the very same arguments: all outputs of a network are asked one after the other."""

    def __init__(self) -> None:
        self.entries: list[tuple[Any, Sequence[Any], Any]] = []

    def of(self, key: Any, args: Sequence[Any], compute: Callable[[], Any]) -> Any:
        for known, held, answer in self.entries:
            if known == key and all(a is b for a, b in zip(held, args)):
                return answer
        answer = compute()
        self.entries = [(key, list(args), answer), *self.entries[:3]]
        return answer


_LAST = _Last()


def slope(graph: Builder, part: Part, args: tuple[int, ...], slopes: Sequence[int]) -> int:
    """The derivative of a part as a node, from those of its arguments."""
    if len(part.by) > 1:
        raise Unproved("the model has third derivatives of a network, which this proof does not treat")
    total = graph.const(0.0)
    for place, inner in enumerate(slopes):
        if inner != graph.const(0.0):
            total = graph.add(total, graph.mul(graph.part(part.derivative(place), args), inner))
    return total


def _count(network: Network, columns: int, budget: Budget, *, behind: bool = False) -> None:
    """Count the work of all layers for so many columns; ``behind``: and of errors on their way through the layers."""
    total, way = 0, 0
    for layer in network.layers:
        rows, taken = len(layer.bias), len(layer.weights[0])
        way += rows * taken
        total += rows * (taken * columns * PRODUCT + columns * 3 * BALL + 4 * FUNCTION)
        total += rows * way * (PRODUCT + BALL) if behind and not network.smooth else 0
    rows = len(network.layers[-1].bias)
    budget.balls(1, total + (rows * way * (PRODUCT + BALL) if behind else 0))


# ---- balls -----------------------------------------------------------------------------------------------------


def ball(part: Part, args: Sequence[arb], budget: Budget) -> arb:
    """The range of a part; a second derivative that may jump is `Undecided`."""
    if not all(x.is_finite() for x in args):
        return arb.nan()
    order = len(part.by)
    values, slopes, bends, edge = _LAST.of(
        (part.network, order), args, lambda: _ranges(part.network, args, order, budget)
    )
    if order == 0:
        result: arb = values[part.output]
        return result
    if order == 1:
        return slopes[part.output, part.by[0]]  # type: ignore[no-any-return]  # a ball matrix has no types
    if edge:
        raise Undecided
    return bends[part.by][part.output]  # type: ignore[no-any-return]  # as above


def _ranges(
    network: Network, args: Sequence[arb], order: int, budget: Budget
) -> tuple[list[arb], Any, dict[tuple[int, ...], Any], bool]:
    """Values, first derivatives, second derivatives by pairs, and whether a kink may lie in the box."""
    n = len(args)
    columns = 1 + n + (n * (n + 1) // 2 if order > 1 else 0)
    budget.fits(64 * 5 * (n * n + columns * max(len(layer.bias) for layer in network.layers)))  # with the last answers
    _count(network, columns, budget)
    centre, radius = [arb(x.mid()) for x in args], [arb(x.rad()) for x in args]
    values, slopes = list(args), arb_mat(n, n, [arb(int(i == j)) for i in range(n) for j in range(n)])
    pairs = [(i, j) for i in range(n) for j in range(i, n)] if order > 1 else []
    bends: dict[tuple[int, ...], list[arb]] = {pair: [_ZERO] * n for pair in pairs}
    edge = False
    for weights, _, bias, row, constants in _matrices(network):
        centre, slopes = _affine(weights, bias, centre), weights * slopes
        values = [_met(x, c, slopes, i, radius) for i, (x, c) in enumerate(
            zip(_affine(weights, bias, values), centre))]  # fmt: skip
        edge = edge or any(kinked(row, z, constants) for z in values)
        first = [row.slope(z, *constants) for z in values]
        if pairs:
            second = [row.bend(z, *constants) for z in values]
            for pair in pairs:
                moved = (weights * arb_mat([[x] for x in bends[pair]])).entries()
                bends[pair] = [
                    s * h + b * (square(slopes[i, pair[0]]) if pair[0] == pair[1] else
                                 slopes[i, pair[0]] * slopes[i, pair[1]])
                    for i, (s, h, b) in enumerate(zip(first, moved, second))
                ]  # fmt: skip
        slopes = arb_mat([[s * slopes[i, j] for j in range(n)] for i, s in enumerate(first)])
        centre = [row.value(c, *constants) for c in centre]
        values = [row.value(z, *constants) for z in values]
    values = [_met(x, c, slopes, i, radius) for i, (x, c) in enumerate(zip(values, centre))]
    return values, slopes, bends, edge


def _met(x: arb, centre: arb, slopes: arb_mat, i: int, radius: Sequence[arb]) -> arb:
    """The common part of a range and of the mean value form."""
    reach = sum((abs(slopes[i, j]) * r for j, r in enumerate(radius)), _ZERO)
    other = centre + arb(0, 1) * reach
    return x.intersection(other) if x.is_finite() and other.is_finite() else x


def _affine(weights: arb_mat, bias: Sequence[arb], x: Sequence[arb]) -> list[arb]:
    return [a + b for a, b in zip((weights * arb_mat([[value] for value in x])).entries(), bias)]


def series(part: Part, args: Sequence[ts.Series], budget: Budget) -> ts.Series:
    """Taylor coefficients of an output."""
    if part.by:
        raise Undecided
    _count(part.network, len(args[0]) ** 2, budget)
    rows: list[ts.Series] = [list(x) for x in args]
    for weights, _, bias, row, constants in _matrices(part.network):
        moved = (weights * arb_mat(rows)).tolist()
        rows = [row.series([line_[0] + b, *line_[1:]], *constants) for line_, b in zip(moved, bias)]
    return rows[part.output]


# ---- Taylor models -----------------------------------------------------------------------------------------------


def model(part: Part, args: Sequence[tm.Model], budget: Budget) -> tm.Model | None:
    """The model of an output over a box; None where it is not defined."""
    if part.by:
        whole = ball(part, [x.range() for x in args], budget)
        return tm.Model(arb(whole.mid()), {}, {}, arb(whole.rad()), {}) if whole.is_finite() else None
    if not all(x.range().is_finite() for x in args):
        return None
    key = part.network, tuple(map(_digits, args))
    found = _MODELS.get(key)
    if found is None:
        columns = _Columns(part.network, args, budget)
        found = columns.through_all()
        if (len(_MODELS) + 1) * len(found) * columns.count > _MOST_KEPT:
            _MODELS.clear()
        if len(found) * columns.count <= _MOST_KEPT:
            _MODELS[key] = found
    return found[part.output]


_MODELS: dict[Any, list[tm.Model]] = {}
"""Models by the very digits of their arguments: outputs of the dynamics that call one network ask the same."""
_MOST_KEPT = 500_000
"""Balls of these models."""


def _digits(x: tm.Model) -> tuple[Any, ...]:
    """All that a model says, as whole numbers."""
    parts: list[Any] = []
    for key, value in [(0, x.value), (0, x.error), *x.linear.items(), *x.squares.items()]:
        parts += [key, *value.mid().man_exp(), *value.rad().man_exp()]
    return tuple(parts)


class _Columns:
    """What is carried through the layers: one row a neuron, with columns for the value and the terms of a polynomial.

    Errors stay apart: a layer's own ones reach further layers through its linear coefficients (`errors_behind`), so
    that weights cancel. In networks with kinks that bounds every layer; in smooth ones, where errors are of fourth
    order, only the outputs, and the layers between take the sum of all sizes.
    """

    def __init__(self, network: Network, args: Sequence[tm.Model], budget: Budget) -> None:
        self.network, self.smooth = network, network.smooth
        found = sorted({a for x in args for a in x.linear} | {a for x in args for pair in x.squares for a in pair})
        self.linear = found
        held = {pair for x in args for pair in x.squares}
        pairs = [(a, b) for i, a in enumerate(found) for b in found[i:]]
        # pieces of straight lines make no squares of their own
        straight = all(layer.activation == "linear" or ACTIVATIONS[layer.activation].knots for layer in network.layers)
        self.squares = [pair for pair in pairs if pair in held] if straight else pairs
        self.partial = len(self.squares) < len(pairs)
        self.cubes = [
            (a, b, c) for i, a in enumerate(found) for k, b in enumerate(found[i:], i) for c in found[k:]
        ] if self.smooth and len(found) <= _MOST_CUBIC else []
        self.count = 1 + len(found) + len(self.squares) + len(self.cubes)
        budget.fits(64 * 3 * self.count * max(len(args), *(len(layer.bias) for layer in network.layers)))
        _count(network, 2 * self.count, budget, behind=True)
        place = {a: 1 + k for k, a in enumerate(found)}
        self.second, self.third = 1 + len(found), 1 + len(found) + len(self.squares)
        self.bends = [(place[a], place[b], 1 if a == b else 2) for a, b in self.squares]
        number = {triple: k for k, triple in enumerate(self.cubes, self.third)}
        self.turns = [
            (number[cast(_Triple, tuple(sorted((a, *pair))))], place[a], k)
            for a in found for k, pair in enumerate(self.squares)
        ] if self.cubes else []
        self.rows: Rows = [
            [x.value, *(x.linear.get(a, _ZERO) for a in found), *(x.squares.get(pair, _ZERO) for pair in self.squares),
             *[_ZERO] * len(self.cubes)] for x in args
        ]  # fmt: skip
        self.start = self.errors = [x.error for x in args]
        self.passed: list[tuple[arb_mat, list[arb], list[arb]]] = []  # weights, slopes and errors of every layer

    def errors_behind(self, rows: arb_mat, sizes: arb_mat) -> list[arb]:
        """All errors in ``rows`` (``sizes`` without signs) times the last layer: each by its way through the layers."""
        total = [_ZERO] * rows.nrows()
        errors = [self.start, *(own for *_, own in self.passed)]
        while True:
            total = [a + b for a, b in zip(total, (sizes * arb_mat([[x] for x in errors.pop()])).entries())]
            if all(error.is_zero() for below in errors for error in below):
                break
            weights, slopes, _ = self.passed[len(errors) - 1]
            rows = arb_mat([[x * s for x, s in zip(row, slopes)] for row in rows.tolist()]) * weights
            sizes = arb_mat(rows.nrows(), rows.ncols(), [abs(x) for x in rows.entries()])
        return [x.upper() for x in total]

    def through(self, weights: arb_mat, size: arb_mat, bias: Sequence[arb]) -> None:
        """W times everything (|W|, ``size``, times the errors), and the bias."""
        self.rows = (weights * arb_mat(self.rows)).tolist()
        for row, b in zip(self.rows, bias):
            row[0] += b
        if self.smooth:
            self.errors = [x.upper() for x in (size * arb_mat([[x] for x in self.errors])).entries()]
        else:
            self.errors = self.errors_behind(weights, size)

    def activated(self, weights: arb_mat, row: Activation, constants: Constants) -> None:
        """Everything behind the activation of the layer with these ``weights``."""
        made, slopes, fresh = [], [], []
        for own, error in zip(self.rows, self.errors):
            found, slope_, new = self._composed(own, error, row, constants)
            made.append(found)
            slopes.append(slope_)
            fresh.append(new)
        self.rows = made
        self.passed.append((weights, slopes, fresh))
        self.errors = [abs(s) * old + new for s, old, new in zip(slopes, self.errors, fresh)]

    def _composed(
        self, own: Sequence[arb], error: arb, row: Activation, constants: Constants
    ) -> tuple[list[arb], arb, arb]:
        """phi of one neuron: its columns, what its error is multiplied by, and the new one."""
        one, two, three = _size(own[1 : self.second]), _size(own[self.second : self.third]), _size(own[self.third :])
        reach = (one + two + three + error).upper()
        whole = own[0] + arb(0, 1) * reach
        if row.expansion is None:
            slope_, level = line(row, whole, constants)
            middle = arb(level.mid())
            if slope_.is_zero():
                return [middle, *[_ZERO] * (len(own) - 1)], _ZERO, arb(level.rad())
            found = list(own) if slope_ == 1 else [slope_ * x for x in own]
            found[0] += middle
            return found, slope_, arb(level.rad())
        value, first, half, third = row.expansion(own[0], whole)
        size = abs(half).upper()
        sixth = third / 6
        if self.cubes:
            # h = p1 + q with q = p2 + p3 + error: h^2 less p1^2 + 2 p1 p2, and h^3 less p1^3
            q = two + three + error
            left = size * (2 * one * (three + error) + q * q)
            left += abs(sixth) * q * (3 * one * (one + q) + q * q) + arb(sixth.rad()) * one * one * one
        else:
            left = size * (two * (2 * one + two) + error * (2 * (one + two) + error))
            left += abs(sixth) * reach * reach * reach
        if self.partial:  # squares without a column of their own
            left += size * one * one
        left = left.upper()
        if not (reach < _SMALL and left.is_finite()):
            slopes = row.slope(whole, *constants)
            plain = (arb(slopes.rad()) * reach).upper()  # to first order, by the mean value theorem
            level = row.value(whole, *constants)
            if level.rad() < plain and not left < level.rad():  # a constant
                return [arb(level.mid()), *[_ZERO] * (len(own) - 1)], _ZERO, arb(level.rad())
            if not left.is_finite() or plain < left or reach > _LONG:
                middle = arb(slopes.mid())
                return [value, *(middle * x for x in own[1:])], middle, plain
        return self._polynomial(own, (value, first, half, arb(sixth.mid()))), first, left

    def _polynomial(self, own: Sequence[arb], coefficients: tuple[arb, arb, arb, arb]) -> list[arb]:
        """value + first h + half h^2 + sixth h^3 of the polynomial h, up to its third order."""
        value, first, half, sixth = coefficients
        found = [value, *(first * x for x in own[1:])]
        squares = [own[a] * own[b] if factor == 1 else 2 * own[a] * own[b] for a, b, factor in self.bends]
        if self.turns:
            twice = 2 * half
            mixed = [twice * x + sixth * y for x, y in zip(own[self.second : self.third], squares)]
            for number, a, k in self.turns:
                found[number] += own[a] * mixed[k]
        for number, x in enumerate(squares, self.second):
            found[number] += half * x
        return found

    def through_all(self) -> list[tm.Model]:
        """All outputs of the network."""
        shares = [0.0] * len(self.linear)
        for number, (weights, size, bias, row, constants) in enumerate(_matrices(self.network)):
            self.through(weights, size, bias)
            if number == 0:
                shares = [sum(float(abs(own[1 + k]).mid()) for own in self.rows) for k in range(len(shares))]
            self.activated(weights, row, constants)
        return self.models(shares)

    def models(self, weights: Sequence[float]) -> list[tm.Model]:
        """The outputs as models; ``weights`` split their errors between the coordinates."""
        count = len(self.rows)
        unit = arb_mat([[arb(int(i == j)) for j in range(count)] for i in range(count)])
        behind = self.errors_behind(unit, unit)
        return [self._model(own, error, weights) for own, error in zip(self.rows, behind)]

    def _model(self, own: Sequence[arb], error: arb, weights: Sequence[float]) -> tm.Model:
        """One output; terms of third order join those of first, for |x| <= 1.

        x^3 is within 1/4 of 3x/4, and x^2 y within 1/2 of y/2.
        """
        linear = dict(zip(self.linear, own[1:]))
        for (a, b, c), x in zip(self.cubes, own[self.third :]):
            if a == b == c:
                linear[a] += 3 * x / 4
                error += abs(x) / 4
            elif a == b or b == c:
                linear[c if a == b else a] += x / 2
                error += abs(x) / 2
            else:
                error += abs(x)
        rest = error.upper()
        size, total = float(rest), sum(weights)
        blame = {a: size * w / total for a, w in zip(self.linear, weights)} if total > 0 else {}
        return tm.Model(
            own[0], {a: x for a, x in linear.items() if not x.is_zero()},
            {pair: x for pair, x in zip(self.squares, own[self.second :]) if not x.is_zero()}, rest, blame,
        )  # fmt: skip


def _size(terms: Sequence[arb]) -> arb:
    """A bound of a sum of terms times numbers in [-1, 1]."""
    return sum(map(abs, terms), _ZERO)
