"""A step of a model over a box as a linear map and terms in proportion to what they multiply.

Every operation g of the model, with arguments a and their values a0 in the middle of the box, is
    g(a) = g(a0) + sum_i s_i (a_i - a0_i),
one argument after the other moved, s_i the mean of the i-th slope between a0_i and a_i. Such means vary less than
slopes do: of what saturates, over the sides of the box, a part of the slope in the middle is left. With the middle m_i
of the range of s_i and its radius r_i, s_i (a_i - a0_i) = m_i (a_i - a0_i) + p, |p| <= r_i |a_i - a0_i|. So over
z = (xi, 1), x = center + width xi, and the list of all p,

    (the next xi, 1) = L (z, p)   with   |p_k| <= |C_k (z, p)|, where C_k reads earlier p alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import JUMPS, Node, Tape, jacobian
from certbound.problem.problem import Problem
from certbound.quadratic.setting import Setting
from certbound.rigor.intervals import Interval, concatenate, stack

MOST_TERMS = 40
_LONGEST = 600  # operations, which recursion goes through
_PARTS = 64  # of each side of the middle
_SMALL = 1e-11  # of a slope: what varies less is left to the enclosure of L


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Secants:
    """L, shape (n + 1, n + 1 + k), and C, shape (k, n + 1 + k): see the module."""

    matrix: Interval
    rows: Interval


def secants(problem: Problem, setting: Setting, middle: Array) -> Secants:
    """What a step does on the working box, about the point ``middle`` of it (in xi), for every disturbance and time.

    Raises
    ------
    EnclosureError
        The model is undefined somewhere in the box, or jumps.
    InfeasibleError
        More than ``MOST_TERMS`` terms, a slope that is not bounded, or a network.
    """
    tape, n = problem.closed_loop, setting.dimension
    if len(tape.nodes) > _LONGEST:
        raise InfeasibleError(f"the model has {len(tape.nodes)} operations, more than the {_LONGEST} that are served.")
    last, disturbed = float(problem.horizon) - 1, problem.system.disturbance
    ends = [(0.0, last)] + ([] if disturbed is None else list(zip(disturbed.low.tolist(), disturbed.high.tolist())))
    signals = Interval(*(np.array(side, dtype=float) for side in zip(*ends)))
    at = Interval.point(setting.center) + Interval.point(setting.width) * Interval.point(middle)
    whole = concatenate([signals[:1], setting.over(-np.ones(n), np.ones(n)), signals[1:]])
    about = concatenate([Interval.point(signals.mid[:1]), at, Interval.point(signals.mid[1:])])
    every = replace(tape, outputs=tuple(range(len(tape.nodes))), shape=(len(tape.nodes),))
    both = stack([whole, about])
    ranges = enclose(every, [both[:, k] for k in range(len(whole))])
    if not np.all(np.isfinite(ranges.mag)):
        raise InfeasibleError("the model overflows in the box that is looked at.")
    found = _Forms(tape, setting, whole, ranges)
    for index, node in enumerate(tape.nodes):
        found.add(index, node)
    matrix = [(found.form(k) - found.constant(Interval.point(c))) / Interval.point(w)
              for k, c, w in zip(tape.outputs, setting.center.tolist(), setting.width.tolist())]  # fmt: skip
    count = n + 1 + len(found.rows)
    rows = stack(found.rows) if found.rows else Interval.point(np.zeros((0, n + 1 + MOST_TERMS)))
    whole_matrix = stack([*matrix, found.constant(Interval.point(1.0))])
    return Secants(matrix=whole_matrix[:, :count], rows=rows[:, :count])


class _Forms:
    """Every node as a linear form over (z, p), and what bounds the p."""

    def __init__(self, tape: Tape, setting: Setting, whole: Interval, ranges: Interval) -> None:
        self.tape, self.n, self.setting, self.whole = tape, setting.dimension, setting, whole
        self.wide, self.about = ranges[0], ranges[1]
        self.nodes: list[Node] = []
        self.bases: list[int] = []  # the node that a node is a function of; -1: of none
        self.known: dict[int, Interval] = {}
        self.rows: list[Interval] = []

    def constant(self, value: Interval) -> Interval:
        """The form of a constant."""
        lo, hi = np.zeros((2, self.n + 1 + MOST_TERMS))
        lo[self.n], hi[self.n] = value.lo, value.hi
        return Interval(lo, hi)

    def add(self, index: int, node: Node) -> None:
        """Take the next node: what is a function of one earlier node, its base, waits until it is asked for."""
        if node.part is not None:
            raise InfeasibleError("quadratic value bounds in discrete time do not serve networks.")
        wide = self.wide[index]
        bases = {self.bases[arg] for arg in node.args if self.bases[arg] >= 0} if node.op != "input" else {index}
        exact = wide.lo == wide.hi
        if node.op in JUMPS - {"if_else_zero"} and not exact:  # `enclose` has decided it
            raise InfeasibleError("the model jumps somewhere in the box that is looked at.")
        self.bases.append(-1 if exact or not bases else bases.pop() if len(bases) == 1 else index)
        self.nodes.append(Node("const", value=float(wide.lo)) if exact else node)
        if self.bases[index] < 0:
            self.known[index] = self.constant(wide)
        elif self.bases[index] == index:
            self.known[index] = self._based(index, node)

    def form(self, index: int) -> Interval:
        """The form of a node."""
        if index not in self.known:
            self.known[index] = self._bent(index, [self.bases[index]], self._between(index, self.bases[index]))
        return self.known[index]

    def _based(self, index: int, node: Node) -> Interval:
        if node.op == "input":
            return self._input(node.args[0])
        if node.op in ("add", "sub"):
            first, second = (self.form(arg) for arg in node.args)
            return first + second if node.op == "add" else first - second
        args = list(dict.fromkeys(arg for arg in node.args if self.bases[arg] >= 0))
        return self._bent(index, args, self._between(index, *args))

    def _between(self, index: int, *start: int) -> Tape:
        """The function that leads from some nodes to another."""
        nodes, places = [Node("input", (k,)) for k in range(len(start))], {base: k for k, base in enumerate(start)}
        live = {index}
        for other in range(index, -1, -1):
            if other in live:
                live.update(arg for arg in self.nodes[other].args if arg not in places)
        for other in sorted(live):
            node = self.nodes[other]
            nodes.append(node._replace(args=tuple(places[arg] for arg in node.args)))
            places[other] = len(nodes) - 1
        names = tuple(f"a{k}" for k in range(len(start)))
        return Tape(inputs=names, nodes=tuple(nodes), outputs=(len(nodes) - 1,), shape=(1,))

    def _input(self, slot: int) -> Interval:
        if 1 <= slot <= self.n:
            form = np.zeros(self.n + 1 + MOST_TERMS)
            form[slot - 1], form[self.n] = self.setting.width[slot - 1], self.setting.center[slot - 1]
            return Interval.point(form)
        whole = self.whole[slot]
        middle = Interval.point(whole.mid)
        return self.constant(middle) + self._term(self.constant(Interval.point((whole - middle).mag)), 1.0)

    def _term(self, row: Interval, factor: float) -> Interval:
        """factor p' with |p'| <= |row|, p' a power of two times a new p of size 1, whatever units the model has."""
        if len(self.rows) == MOST_TERMS:
            raise InfeasibleError(f"the model has more than {MOST_TERMS} terms that are not linear.")
        scale = Interval.point(np.ldexp(1.0, int(np.clip(np.frexp(row.mag.sum())[1], -900, 900))))
        form = np.zeros(self.n + 1 + MOST_TERMS)
        form[self.n + 1 + len(self.rows)] = (Interval.point(factor) * scale).hi
        self.rows.append(row / scale)
        return Interval.point(form)

    def _bent(self, index: int, args: list[int], function: Tape) -> Interval:
        """A function of other nodes by the means of its slopes."""
        try:
            means = _means(function, self.wide[args], self.about[args])
        except EnclosureError as error:
            what = f"the slope of `{self.tape.describe(index)}` is not bounded in the box that is looked at."
            raise InfeasibleError(what) from error
        total = self.constant(self.about[index])
        for arg, slope in ((arg, means[k]) for k, arg in enumerate(args)):
            moved = self.form(arg) - self.constant(self.about[arg])
            if slope.rad <= _SMALL * slope.mag:
                total = total + slope * moved
                continue
            total = total + Interval.point(slope.mid) * moved
            total = total + self._term(moved, float((slope - Interval.point(slope.mid)).mag))
        return total


def _means(tape: Tape, whole: Interval, about: Interval) -> Interval:
    """Ranges of the means of the slopes of one function of a few arguments, moved one after the other."""
    slopes, count = jacobian(tape), len(whole)
    found = []
    for j in range(count):
        fixed = [whole[k] if k < j else about[k] for k in range(count)]
        ways = [_running(slopes, fixed, j, about[j], end) for end in (whole.lo[j], whole.hi[j]) if end != about.mid[j]]
        ways = ways or [enclose(slopes, fixed).reshape(-1)[j]]  # an argument that is a point
        found.append(Interval(min(float(one.lo) for one in ways), max(float(one.hi) for one in ways)))
    return stack(found)


def _running(slopes: Tape, fixed: Sequence[Interval], j: int, begin: Interval, end: float) -> Interval:
    """The range of the means of the j-th slope along its argument from ``begin`` to anywhere before ``end``.

    Of bounds that are constant between cuts such a mean is monotone between two cuts.
    """
    way = 1.0 if end > begin.mid else -1.0
    cuts = np.linspace(float(begin.mid), float(end), _PARTS + 1)
    cuts[-1] = end
    first = Interval(min(begin.lo, cuts[1]), max(begin.hi, cuts[1])).reshape(1)
    rest = Interval(np.minimum(cuts[1:-1], cuts[2:]), np.maximum(cuts[1:-1], cuts[2:]))
    inputs = [concatenate([first, rest]) if k == j else one for k, one in enumerate(fixed)]
    found = enclose(slopes, inputs).reshape(_PARTS, -1)[:, j]
    marks = concatenate([begin.reshape(1), Interval.point(cuts[1:])])
    lengths, total = ((marks[1:] - one) * Interval.point(way) for one in (marks[:-1], marks[:1]))
    if not np.all(total.lo > 0):
        return Interval(found.lo.min(), found.hi.max())
    sums: Interval = Interval.point(0.0)
    low, high = [float(found.lo[0])], [float(found.hi[0])]
    for k in range(_PARTS):
        sums = sums + found[k] * lengths[k]
        mean = sums / total[k]
        low.append(float(mean.lo))
        high.append(float(mean.hi))
    return Interval(min(low), max(high))
