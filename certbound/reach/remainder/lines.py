"""Linear functions around the dynamics over boxes: how kinks are bounded by planes, without cutting boxes at them.

Every value of the tape is followed as coefficients . d + rest over |d| <= e, with interval coefficients and rests. A
network lies between two parallel planes (`certbound.rigor.layers.relax_network`), any other function is followed by the
mean value theorem about the middle of its arguments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.problem.model import Node, Tape, enclosed, jacobian, relaxed
from certbound.rigor.intervals import Interval

_ZERO = Interval.point(0.0)


@dataclass(frozen=True, eq=False, slots=True)
class Line:
    """coefficients . d + rest, by coordinate of d."""

    coefficients: dict[int, Interval]
    rest: Interval

    def range(self, radii: Mapping[int, Interval]) -> Interval:
        """All its values."""
        total = self.rest
        for place, coefficient in self.coefficients.items():
            total = total + coefficient * radii[place]
        return total


def follow_lines(tape: Tape, slots: Sequence[Interval], radii: Mapping[int, Array]) -> list[Line]:
    """Lines around the outputs of a tape over boxes.

    ``slots`` hold the inputs at the centres of the boxes, ``radii`` the half-widths of the inputs that vary, by slot.
    Where something is not enclosed the rest is unbounded.

    Examples
    --------
    >>> tape = Tape(inputs=("a",), nodes=(Node("input", (0,)), Node("sq", (0,))), outputs=(1,), shape=(1,))
    >>> (line,) = follow_lines(tape, [Interval.point([1.0])], {0: np.array([0.5])})
    >>> [round(float(x.mid[0]), 9) for x in (line.coefficients[0], line.rest)]
    [2.0, 1.0]
    """
    spans = {slot: Interval(-radius, radius) for slot, radius in radii.items()}
    lines: list[Line] = []
    parts: dict[tuple[int, tuple[int, ...]], list[Line]] = {}
    for node in tape.nodes:
        if node.op == "input":
            slot = node.args[0]
            own = {slot: Interval.point(1.0)} if slot in spans else {}
            lines.append(Line(own, slots[slot]))
            continue
        args = [lines[arg] for arg in node.args]
        if not any(line.coefficients for line in args):
            lines.append(Line({}, enclosed(node, [line.rest for line in args])))
        elif node.part is not None and not node.part.by:
            key = id(node.part.network), node.args
            if key not in parts:
                parts[key] = _network(node, args, spans)
            lines.append(parts[key][node.part.output])
        elif node.op in ("add", "sub", "neg"):
            signs = (1.0, -1.0) if node.op == "sub" else (-1.0,) if node.op == "neg" else (1.0, 1.0)
            lines.append(_sum(args, [Interval.point(sign) for sign in signs], _ZERO))
        elif node.op == "mul" and not all(line.coefficients for line in args):
            factor, line = args if not args[0].coefficients else args[::-1]
            lines.append(_sum([line], [factor.rest], _ZERO))
        else:
            lines.append(_mean_value(node, args, spans))
    return [lines[output] for output in tape.outputs]


def _sum(lines: Sequence[Line], factors: Sequence[Interval], rest: Interval) -> Line:
    coefficients: dict[int, Interval] = {}
    for line, factor in zip(lines, factors):
        rest = rest + line.rest * factor
        for place, own in line.coefficients.items():
            term = own * factor
            coefficients[place] = coefficients[place] + term if place in coefficients else term
    return Line(coefficients, rest)


def _moved(line: Line, by: Array) -> Line:
    return Line(line.coefficients, line.rest - by)


def _network(node: Node, args: Sequence[Line], spans: Mapping[int, Interval]) -> list[Line]:
    """The outputs of a network: slopes . (u - c) + rest around its arguments u."""
    assert node.part is not None
    ranges = [line.range(spans) for line in args]
    middles, slopes, rests = relaxed(node.part.network, ranges)
    inner = [_moved(line, middle) for line, middle in zip(args, middles)]
    return [
        _sum(inner, [Interval.point(slopes[output, place]) for place in range(len(inner))], rests[output])
        for output in range(len(slopes))
    ]


@lru_cache(maxsize=64)
def _slopes_of(node: Node) -> Tape:
    count = len(node.args)
    inputs = tuple(f"x{place}" for place in range(count))
    nodes = (*(Node("input", (place,)) for place in range(count)), node._replace(args=tuple(range(count))))
    return jacobian(Tape(inputs=inputs, nodes=nodes, outputs=(count,), shape=(1,)))


def _mean_value(node: Node, args: Sequence[Line], spans: Mapping[int, Interval]) -> Line:
    """phi(p) + sum of slopes (u - p), the slopes between their middles and what is left of them over the range."""
    ranges = [line.range(spans) for line in args]
    size = np.broadcast_shapes(*(x.shape for x in ranges))
    slopes = enclose(_slopes_of(node._replace(args=tuple(range(len(args))))), ranges, undefined="infinite")
    slopes = slopes.broadcast_to((*size, 1, len(args)))
    points = [Interval.point(line.rest.mid) for line in args]
    rest = enclosed(node, points)
    inner, factors = [], []
    for place, (line, point, whole) in enumerate(zip(args, points, ranges)):
        own = slopes[..., 0, place]
        known = np.isfinite(own.lo) & np.isfinite(own.hi)
        middle = np.where(known, own.mid, 0.0)
        inner.append(_moved(line, point.mid))
        factors.append(Interval.point(middle))
        rest = rest + (own - middle) * (whole - point)
    return _sum(inner, factors, rest)
