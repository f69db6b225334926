"""CROWN in plain floats, one box at a time: what widths of enclosures are measured by."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from certbound.arrays import Array
from certbound.rigor.planes import Weights

Line = tuple[float, float]


def crown(network: Sequence[Weights], low: Array, high: Array) -> tuple[Array, Array]:
    """The range of a network over a box, every hidden layer's by planes too."""
    lines: list[list[tuple[Line, Line]]] = []
    ends = low, high
    for number, layer in enumerate(network):
        ends = _layer_range(network, lines, number, low, high)
        if number < len(network) - 1:
            lines.append([_LINES[layer.row.numpy(-1.0) == 0](a, b) for a, b in zip(*ends)])
    return ends


def _layer_range(
    network: Sequence[Weights], lines: list[list[tuple[Line, Line]]], number: int, low: Array, high: Array
) -> tuple[Array, Array]:
    found = []
    for sign in (-1.0, 1.0):
        rows, total = sign * network[number].weights, sign * network[number].bias
        for below in range(number - 1, -1, -1):
            (ls, lt), (us, ut) = (np.array(lines[below])[:, side].T for side in (0, 1))
            total = total + np.where(rows > 0, rows * ut, rows * lt).sum(axis=1)
            rows = np.where(rows > 0, rows * us, rows * ls)
            total, rows = total + rows @ network[below].bias, rows @ network[below].weights
        found.append(sign * (total + np.where(rows > 0, rows * high, rows * low).sum(axis=1)))
    return found[0], found[1]


def _relu(a: float, b: float) -> tuple[Line, Line]:
    if a >= 0 or b <= 0:
        return ((1.0, 0.0),) * 2 if a >= 0 else ((0.0, 0.0),) * 2
    slope = b / (b - a)
    return (float(b >= -a), 0.0), (slope, -slope * a)


def _tanh(a: float, b: float) -> tuple[Line, Line]:
    chord = (np.tanh(b) - np.tanh(a)) / (b - a)
    through = chord, np.tanh(a) - chord * a
    middle = _tangent((a + b) / 2)
    if a >= 0:
        return through, middle
    if b <= 0:
        return middle, through
    slope, offset = _from(-b, -a) or (through[0], -through[1])
    return (slope, -offset), _from(a, b) or through


def _tangent(d: float) -> Line:
    slope = 1 - np.tanh(d) ** 2
    return slope, np.tanh(d) - slope * d


def _from(a: float, b: float) -> Line | None:
    """The tangent through tanh's point at a < 0, if it touches in (0, b): by bisection."""
    excess: Callable[[float], float] = lambda d: np.tanh(a) - sum(np.multiply(_tangent(d), (a, 1.0)))  # noqa: E731
    if excess(b) > 0:
        return None
    low, high = 0.0, b
    for _ in range(60):
        d = (low + high) / 2
        low, high = (d, high) if excess(d) > 0 else (low, d)
    return _tangent(high)


_LINES = {True: _relu, False: _tanh}
