"""Parts of networks on balls: ranges, derivatives, series and Taylor models, layer by layer with ball matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Protocol

from flint import arb, arb_mat

from certbound.checker.expressions import series as ts
from certbound.checker.expressions import taylor as tm
from certbound.checker.expressions.activation_balls import ACTIVATIONS, Activation, Constants, kinked, line
from certbound.checker.expressions.arithmetic import Undecided, square
from certbound.checker.report import Unproved
from certbound.problem.model import Layer, Network, Part

_ZERO = arb(0)
Rows = list[list[arb]]
_Layers = list[tuple[arb_mat, arb_mat, list[arb], Activation, Constants]]
_SMALL = 0.25
"""A reach below which the second order is not worse than the first."""


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


# ---- balls -----------------------------------------------------------------------------------------------------


def ball(part: Part, args: Sequence[arb]) -> arb:
    """The range of a part; a second derivative that may jump is `Undecided`."""
    if not all(x.is_finite() for x in args):
        return arb.nan()
    order = len(part.by)
    values, slopes, bends, edge = _LAST.of((part.network, order), args, lambda: _ranges(part.network, args, order))
    if order == 0:
        result: arb = values[part.output]
        return result
    if order == 1:
        return slopes[part.output, part.by[0]]  # type: ignore[no-any-return]  # a ball matrix has no types
    if edge:
        raise Undecided
    return bends[part.by][part.output]  # type: ignore[no-any-return]  # as above


def _ranges(
    network: Network, args: Sequence[arb], order: int
) -> tuple[list[arb], Any, dict[tuple[int, ...], Any], bool]:
    """Values, first derivatives, second derivatives by pairs, and whether a kink may lie in the box."""
    n = len(args)
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


def series(part: Part, args: Sequence[ts.Series]) -> ts.Series:
    """Taylor coefficients of an output."""
    if part.by:
        raise Undecided
    rows: list[ts.Series] = [list(x) for x in args]
    for weights, _, bias, row, constants in _matrices(part.network):
        moved = (weights * arb_mat(rows)).tolist()
        rows = [row.series([line_[0] + b, *line_[1:]], *constants) for line_, b in zip(moved, bias)]
    return rows[part.output]


# ---- Taylor models -----------------------------------------------------------------------------------------------


def model(part: Part, args: Sequence[tm.Model]) -> tm.Model | None:
    """The model of an output over a box; None where it is not defined."""
    if part.by:
        whole = ball(part, [x.range() for x in args])
        return tm.Model(arb(whole.mid()), {}, {}, arb(whole.rad()), {}) if whole.is_finite() else None
    if not all(x.range().is_finite() for x in args):
        return None
    key = part.network, tuple(map(_digits, args))
    found = _MODELS.get(key)
    if found is None:
        if len(_MODELS) >= _MOST_MODELS:
            _MODELS.clear()
        found = _MODELS[key] = _models(part.network, args)
    return found[part.output]


_MODELS: dict[Any, list[tm.Model]] = {}
"""Models by the very digits of their arguments: outputs of the dynamics that call one network ask the same."""
_MOST_MODELS = 300


def _digits(x: tm.Model) -> tuple[Any, ...]:
    """All that a model says, as whole numbers."""
    parts: list[Any] = []
    for key, value in [(0, x.value), (0, x.error), *x.linear.items(), *x.squares.items()]:
        parts += [key, *value.mid().man_exp(), *value.rad().man_exp()]
    return tuple(parts)


class _Columns:
    """What is carried through the layers: one row a neuron, with columns for the value, terms and symbols of errors.

    In networks with kinks every error keeps a symbol of its own, so that errors cancel behind the next layer as the
    weights say; in smooth ones, where errors are of third order, one bound a neuron stands for all.
    """

    def __init__(self, network: Network, args: Sequence[tm.Model]) -> None:
        self.apart = not network.smooth
        self.linear = sorted({a for x in args for a in x.linear})
        self.squares = sorted({pair for x in args for pair in x.squares} | {
            (a, b) for i, a in enumerate(self.linear) for b in self.linear[i:]})  # fmt: skip
        place = {a: 1 + k for k, a in enumerate(self.linear)}
        self.bends = [
            (number, place[a], place[b]) for number, (a, b) in enumerate(self.squares, 1 + len(self.linear))
            if a in place and b in place
        ]  # fmt: skip
        self.rows: Rows = [
            [x.value, *(x.linear.get(a, _ZERO) for a in self.linear),
             *(x.squares.get(pair, _ZERO) for pair in self.squares)] for x in args
        ]  # fmt: skip
        self.errors = [x.error for x in args]
        self.symbols = 0
        if self.apart:
            self.spread([_ZERO] * len(args), self.errors)

    def spread(self, old: Sequence[arb], errors: Sequence[arb]) -> None:
        """Errors as symbols of their own."""
        new = [i for i, error in enumerate(errors) if not error.is_zero()]
        for i, row in enumerate(self.rows):
            row += [errors[i] if i == j else _ZERO for j in new]
        self.symbols += len(new)
        self.errors = list(old)

    def through(self, weights: arb_mat, size: arb_mat, bias: Sequence[arb]) -> None:
        """W times everything (|W|, ``size``, times the errors), and the bias."""
        if not self.apart:
            self.errors = (size * arb_mat([[x] for x in self.errors])).entries()
        self.rows = (weights * arb_mat(self.rows)).tolist()
        for row, b in zip(self.rows, bias):
            row[0] += b
        if not self.apart:
            return
        self.errors = [_ZERO] * len(self.rows)

    def norms(self, row: Sequence[arb], error: arb) -> tuple[arb, arb, arb]:
        """Bounds of the linear and the quadratic part and of all errors."""
        first, second = 1 + len(self.linear), 1 + len(self.linear) + len(self.squares)
        one, two, rest = (
            sum((abs(x) for x in part), _ZERO).upper() for part in (row[1:first], row[first:second], row[second:])
        )
        return one, two, (rest + error).upper()

    def activated(self, row: Activation, constants: Constants) -> None:
        """Everything behind an activation."""
        made, errors, fresh = [], [], []
        for own, error in zip(self.rows, self.errors):
            found, old, new = self._composed(own, error, row, constants)
            made.append(found)
            errors.append(old)
            fresh.append(new)
        self.rows = made
        if self.apart:
            self.spread(errors, fresh)
        else:
            self.errors = [a + b for a, b in zip(errors, fresh)]

    def _composed(
        self, own: Sequence[arb], error: arb, row: Activation, constants: Constants
    ) -> tuple[list[arb], arb, arb]:
        """phi of one neuron: its columns, what was its error, and the new one."""
        one, two, rest = self.norms(own, error)
        reach = one + two + rest
        whole = own[0] + arb(0, 1) * reach
        if row.expansion is None:
            slope_, level = line(row, whole, constants)
            middle = arb(level.mid())
            return [slope_ * own[0] + middle, *(slope_ * x for x in own[1:])], abs(slope_) * error, arb(level.rad())
        value, first, half, third = row.expansion(own[0], whole)
        cross = two * (2 * one + two) + rest * (2 * (one + two) + rest)
        cubic = abs(half) * cross + abs(third) * reach * reach * reach / 6
        if not (reach < _SMALL and cubic.is_finite()):
            slopes = row.slope(whole, *constants)
            plain = (arb(slopes.rad()) * reach).upper()  # to first order, by the mean value theorem
            level = row.value(whole, *constants)
            if level.rad() < plain and not cubic < level.rad():  # a constant
                return [arb(level.mid()), *[_ZERO] * (len(own) - 1)], _ZERO, arb(level.rad())
            if not cubic.is_finite() or plain < cubic or reach > 1:
                middle = arb(slopes.mid())
                return [value, *(middle * x for x in own[1:])], abs(middle) * error, plain
        found = [value, *(first * x for x in own[1:])]
        for number, a, b in self.bends:
            found[number] += half * own[a] * own[b] * (1 if a == b else 2)
        return found, abs(first) * error, cubic.upper()

    def models(self, weights: Sequence[float]) -> list[tm.Model]:
        """The outputs as models; ``weights`` split their errors between the coordinates."""
        result = []
        for own, error in zip(self.rows, self.errors):
            _, _, rest = self.norms(own, error)
            linear = {a: x for a, x in zip(self.linear, own[1:]) if not x.is_zero()}
            quadratic = own[1 + len(self.linear) :]
            squares = {pair: x for pair, x in zip(self.squares, quadratic) if not x.is_zero()}
            size, total = float(rest), sum(weights)
            blame = {a: size * w / total for a, w in zip(self.linear, weights)} if total > 0 else {}
            result.append(tm.Model(own[0], linear, squares, rest, blame))
        return result


def _models(network: Network, args: Sequence[tm.Model]) -> list[tm.Model]:
    columns = _Columns(network, args)
    shares = [0.0] * len(columns.linear)
    for number, (weights, size, bias, row, constants) in enumerate(_matrices(network)):
        columns.through(weights, size, bias)
        if number == 0:
            shares = [sum(float(abs(own[1 + k]).mid()) for own in columns.rows) for k in range(len(shares))]
        columns.activated(row, constants)
    return columns.models(shares)
