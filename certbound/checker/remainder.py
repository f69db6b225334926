"""What the linearisation leaves over, bounded on balls by branch and bound.

On a piece with middle time t_m, nominal p, slope J(tau), gain E and reference disturbance d0 the remainder is

    beta(tau, s, d) = f(t_m + tau, p + s, d) - p' - J s - E (d - d0).

It is built as one expression over (tau, s, d) with the piece's data as parameters, and differentiated twice. On a box
around (0, c, d_c) it lies in beta + grad . delta + delta^T H delta / 2, the value and gradient at the centre and the
Hessian H over the whole box. The boxes of s are taken in coordinates sigma = M s that the certificate names for every
output (rows of its polytope), in which the Hessian is nearly diagonal; boxes outside the polytope are dropped.

A model with kinks (abs, min, max) has no Hessian there: value and generalised slopes over the box bound it instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from certbound.checker.arithmetic import Undecided
from certbound.checker.graph import Graph
from certbound.checker.model import Model
from certbound.checker.program import Program
from certbound.checker.report import Budget, Unproved
from certbound.checker.structure import Structure
from certbound.problem.tape import JUMPS

__all__ = ["OutputRemainder", "PieceData", "Polytope", "remainders"]

_MOST_BOXES = 4000
_RISKY = JUMPS | {"kink", "atan2"}

Side = tuple[arb, arb]


@dataclass(frozen=True, eq=False, kw_only=True)
class PieceData:
    """Parameters of one piece, in the order in which `remainders` numbers them (see there)."""

    values: list[arb]
    half: arb
    disturbance: list[arb]
    disturbance_radius: list[arb]


@dataclass(frozen=True, eq=False, kw_only=True)
class Polytope:
    """low <= row . s <= high for some rows over all states; ``frame`` numbers the rows used as coordinates."""

    rows: Sequence[Sequence[arb]]
    low: Sequence[arb]
    high: Sequence[arb]
    frame: Sequence[int]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Box:
    """Centre and radius in (tau, sigma, d)."""

    centre: list[arb]
    radius: list[arb]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Found:
    """Value at a box's centre, bounds over the box, and how much each coordinate contributes to their distance."""

    value: arb
    low: arb
    high: arb
    smear: list[arb]


def remainders(model: Model, structure: Structure, budget: Budget) -> list[OutputRemainder]:
    """The remainder of every output.

    Inputs of the expressions: tau, the states s, the disturbances d, and then the parameters: t_m; in continuous time
    four coefficients of p about the middle per state (by state), in discrete time p and the next p; the varying
    entries of A; those of K (continuous time); the varying entries of E; d0; the inputs of the plan.
    """
    n, q = model.dimension, len(model.disturbance)
    graph = Graph()
    tau = graph.input(0)
    s = [graph.input(1 + j) for j in range(n)]
    d = [graph.input(1 + n + j) for j in range(q)]
    count = 1 + n + q
    taken = count

    def fresh(number: int) -> list[int]:
        nonlocal taken
        taken += number
        return [graph.input(slot) for slot in range(taken - number, taken)]

    (middle,) = fresh(1)
    if model.continuous:
        curves = [fresh(4) for _ in range(n)]
        states = [_polynomial(graph, curve, tau) for curve in curves]
        velocities = [_polynomial(graph, _rate(graph, curve), tau) for curve in curves]
    else:
        states, velocities = fresh(n), fresh(n)
    slopes = dict(zip(structure.varying, fresh(len(structure.varying))))
    if model.continuous:
        drifts = dict(zip(structure.varying, fresh(len(structure.varying))))
        slopes = {e: graph.add(a, graph.mul(tau, drifts[e])) for e, a in slopes.items()}
    gains = dict(zip(structure.moving, fresh(len(structure.moving))))
    centre = fresh(q)
    inputs = fresh(0 if model.plan is None else len(model.plan[0]))
    time = graph.add(middle, tau) if model.continuous else middle
    slots = [time, *(graph.apply("add", p, x) for p, x in zip(states, s)), *inputs, *d]
    nodes = graph.include(model.dynamics, slots)
    values = [nodes[output] for output in model.dynamics.outputs]
    offsets = [graph.sub(x, y) for x, y in zip(d, centre)]
    # constant entries of the Jacobians are the model's own: beta does not depend on those variables through them, so
    # that these are kept at s = 0, d = d0 and need no term
    for (i, j), a in slopes.items():
        values[i] = graph.sub(values[i], graph.mul(a, s[j]))
    for (i, j), e in gains.items():
        values[i] = graph.sub(values[i], graph.mul(e, offsets[j]))
    result = []
    for i in range(n):
        result.append(OutputRemainder(
            graph, graph.sub(values[i], velocities[i]), nodes[model.dynamics.outputs[i]], count=count,
            time=model.continuous, states=structure.active_states(i), disturbances=structure.active_disturbances(i),
            dimension=n, budget=budget,
        ))
    return result


def _polynomial(graph: Graph, coefficients: list[int], x: int) -> int:
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = graph.add(coefficient, graph.mul(x, value))
    return value


def _rate(graph: Graph, c: list[int]) -> list[int]:
    return [c[1], graph.mul(graph.const(2.0), c[2]), graph.mul(graph.const(3.0), c[3])]


class OutputRemainder:
    """The remainder of one output: programs for value, gradient and Hessian, and the branch and bound."""

    def __init__(
        self, graph: Graph, node: int, value: int, *, count: int, time: bool, states: list[int],
        disturbances: list[int], dimension: int, budget: Budget,
    ) -> None:
        self.count, self.dimension, self.states, self.disturbances = count, dimension, states, disturbances
        self.time = time
        self.slots = [*([0] if time else []), *(1 + j for j in states), *(1 + dimension + j for j in disturbances)]
        gradient = [graph.derivative(node, slot) for slot in self.slots]
        pairs = [(a, b) for a in range(len(gradient)) for b in range(a, len(gradient))]
        second = {}
        for a, b in pairs:
            budget.check()
            second[a, b] = graph.derivative(gradient[a], self.slots[b])
        self.pairs = [pair for pair, index in second.items() if not graph.is_const(index, 0.0)]
        hessian = [second[pair] for pair in self.pairs]
        risky = {index for index in graph.reachable([*gradient, *hessian]) if graph.node(index).op in _RISKY}
        self.thin = Program(graph, [node, *gradient], [value], variables=count)
        self.wide = Program(graph, hessian, risky | {value}, variables=count)
        self.plain = Program(graph, [], [value], variables=count)
        self.programs = [self.thin, self.wide, self.plain]
        self.kinked: tuple[Program, Program] | None = None
        if any(graph.node(index).op == "kink" for index in graph.reachable(gradient)):
            self.kinked = (
                Program(graph, [node], [value], variables=count),
                Program(graph, gradient, [value], variables=count, generalised=True),
            )
            self.programs += self.kinked

    def prepare(self, piece: PieceData) -> None:
        """Take the parameters of a piece."""
        self.piece = piece
        for program in self.programs:
            program.prepare(piece.values)

    def prove(self, polytope: Polytope, low: arb, high: arb, budget: Budget) -> bool:
        """Whether beta lies in [low, high] over the polytope, all d and the whole piece."""
        frame = _Frame(self, polytope)
        stack = [frame.whole()]
        for _ in range(_MOST_BOXES):
            if not stack:
                return True
            budget.box()
            box = stack.pop()
            if not frame.meets(box):
                continue
            found = self._bound(frame, box)
            if found is not None:
                if found.low >= low and found.high <= high:
                    continue
                if (found.value > high or found.value < low) and frame.holds_centre(box):
                    return False
            parts = _halves(box, None if found is None else found.smear)
            if parts is None:
                return False
            stack.extend(parts)
        return not stack

    def is_decided(self, sides: Mapping[int, Side]) -> bool:
        """Whether the output is defined, and on one side of every jump, for all d and s within ``sides`` and at s = 0.

        States without a side are kept at s = 0.
        """
        inputs = [arb(0)] * self.count
        inputs[0] = arb(0, self.piece.half)
        for j, (low, high) in sides.items():
            inputs[1 + j] = low.union(high).union(arb(0))
        for j, (value, size) in enumerate(zip(self.piece.disturbance, self.piece.disturbance_radius)):
            inputs[1 + self.dimension + j] = value + arb(0, size)
        try:
            self.plain.run(inputs)
        except Undecided:
            return False
        return True

    def _inputs(self, frame: _Frame, box: _Box) -> tuple[list[arb], list[arb]]:
        """The centre and the whole box as inputs of the programs."""
        thin = [arb(0)] * self.count
        for j, value in enumerate(self.piece.disturbance):
            thin[1 + self.dimension + j] = value
        wide = list(thin)
        centre, reach = frame.unturned(box)
        for slot, value, size in zip(self.slots, centre, reach):
            thin[slot], wide[slot] = value, value + arb(0, size)
        return thin, wide

    def _bound(self, frame: _Frame, box: _Box) -> _Found | None:
        """Bounds on a box; None where undecided."""
        thin, wide = self._inputs(frame, box)
        try:
            value, *gradient = self.thin.run(thin)
            second = self.wide.run(wide)
        except Undecided:
            return self._kinked_bound(frame, box, thin, wide)
        size = len(self.slots)
        hessian = [[arb(0)] * size for _ in range(size)]
        for (a, b), entry in zip(self.pairs, second):
            hessian[a][b] = hessian[b][a] = entry
        gradient = frame.turned(gradient)
        if not frame.straight:
            hessian = [frame.turned(row) for row in hessian]
            hessian = [list(row) for row in zip(*[frame.turned(list(column)) for column in zip(*hessian)])]
        radius = box.radius
        low = high = spread = arb(0)
        smear = []
        for a in range(size):
            share = abs(gradient[a])
            spread += share * radius[a]
            for b in range(size):
                if b != a:
                    cross = abs(hessian[a][b]) * radius[b]
                    share += cross
                    if b > a:
                        spread += cross * radius[a]
            square, own = radius[a] * radius[a] / 2, hessian[a][a]
            high += arb.max(own.upper(), arb(0)) * square
            low += arb.min(own.lower(), arb(0)) * square
            smear.append(((share + abs(own) * radius[a]) * radius[a]).upper())
        return _Found(
            value=value, low=(value - spread + low).lower(), high=(value + spread + high).upper(), smear=smear
        )

    def _kinked_bound(self, frame: _Frame, box: _Box, thin: list[arb], wide: list[arb]) -> _Found | None:
        """The same to first order, with generalised slopes over the box."""
        if self.kinked is None:
            return None
        try:
            (value,) = self.kinked[0].run(thin)
            slopes = self.kinked[1].run(wide)
        except Undecided:
            return None
        smear = [(abs(g) * r).upper() for g, r in zip(frame.turned(slopes), box.radius)]
        spread = sum(smear, arb(0))
        return _Found(value=value, low=(value - spread).lower(), high=(value + spread).upper(), smear=smear)


class _Frame:
    """The coordinates (tau, sigma, d) of one output on one piece: s = T sigma."""

    def __init__(self, output: OutputRemainder, polytope: Polytope) -> None:
        self.output, self.polytope = output, polytope
        states = output.states
        m = len(states)
        self.start = 1 if output.time else 0
        chosen = list(polytope.frame)
        if len(chosen) != m or any(not _lives_in(polytope.rows[row], states) for row in chosen):
            raise Unproved("the frame of an output must be as many rows as it has active states, over those states")
        square = [[polytope.rows[row][j] for j in states] for row in chosen]
        self.straight = all(square[i][j] == (1 if i == j else 0) for i in range(m) for j in range(m))
        self.map: list[list[arb]] = square
        if not self.straight:
            try:
                self.map = arb_mat(square).inv().tolist()
            except ZeroDivisionError as error:
                raise Unproved("the frame of an output is not regular") from error
        self.cuts = [
            (self._form(row), low, high)
            for number, (row, low, high) in enumerate(zip(polytope.rows, polytope.low, polytope.high))
            if number not in chosen and m > 1 and _lives_in(row, states)
        ]

    def _form(self, row: Sequence[arb]) -> list[arb]:
        """A row over the states as a form over sigma."""
        values = [row[j] for j in self.output.states]
        if self.straight:
            return values
        m = len(values)
        return [sum((values[i] * self.map[i][a] for i in range(m)), arb(0)) for a in range(m)]

    def whole(self) -> _Box:
        """The box of the polytope."""
        piece, output = self.output.piece, self.output
        centre = [arb(0)] if output.time else []
        radius = [piece.half] if output.time else []
        for row in self.polytope.frame:
            low, high = self.polytope.low[row], self.polytope.high[row]
            centre.append((low + high) / 2)
            radius.append((high - low) / 2)
        for j in output.disturbances:
            centre.append(piece.disturbance[j])
            radius.append(piece.disturbance_radius[j])
        return _Box(centre=centre, radius=radius)

    def meets(self, box: _Box) -> bool:
        """False only where the box has no point in the polytope."""
        for form, low, high in self.cuts:
            value = reach = arb(0)
            for place, factor in enumerate(form):
                value += factor * box.centre[self.start + place]
                reach += abs(factor) * box.radius[self.start + place]
            if value - reach > high or value + reach < low:
                return False
        return True

    def holds_centre(self, box: _Box) -> bool:
        """Whether the box's centre surely lies in the polytope."""
        for form, low, high in self.cuts:
            value = sum((factor * box.centre[self.start + place] for place, factor in enumerate(form)), arb(0))
            if not (value >= low and value <= high):
                return False
        return True

    def unturned(self, box: _Box) -> tuple[list[arb], list[arb]]:
        """Centre and reach of the box in (tau, s, d)."""
        if self.straight:
            return box.centre, box.radius
        m, start = len(self.map), self.start
        centre, reach = list(box.centre), list(box.radius)
        for i, row in enumerate(self.map):
            centre[start + i] = sum((row[a] * box.centre[start + a] for a in range(m)), arb(0))
            reach[start + i] = sum((abs(row[a]) * box.radius[start + a] for a in range(m)), arb(0))
        return centre, reach

    def turned(self, gradient: list[arb]) -> list[arb]:
        """A form over (tau, s, d) as one over (tau, sigma, d)."""
        if self.straight:
            return gradient
        m, start = len(self.map), self.start
        result = list(gradient)
        for a in range(m):
            result[start + a] = sum((gradient[start + i] * self.map[i][a] for i in range(m)), arb(0))
        return result


def _lives_in(row: Sequence[arb], states: list[int]) -> bool:
    return all(value.is_zero() or j in states for j, value in enumerate(row))


def _halves(box: _Box, smear: list[arb] | None) -> list[_Box] | None:
    """The box cut in two where that helps most; None for a point."""
    sizes = box.radius if smear is None else smear
    best = -1
    for place, size in enumerate(sizes):
        if box.radius[place] > 0 and (best < 0 or size > sizes[best]):
            best = place
    if best < 0:
        return None
    half = box.radius[best] / 2
    parts = []
    for sign in (-1, 1):
        centre, radius = list(box.centre), list(box.radius)
        centre[best], radius[best] = centre[best] + sign * half, half
        parts.append(_Box(centre=centre, radius=radius))
    return parts
