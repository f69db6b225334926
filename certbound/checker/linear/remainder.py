"""What the linearisation leaves over, bounded on balls by branch and bound.

On a piece with middle time t_m, nominal p, slope J(tau), gain E and reference disturbance d0 the remainder is

    beta(tau, s, d) = f(t_m + tau, p + s, d) - p' - J s - E (d - d0).

It is built as one expression over (tau, s, d) with the piece's data as parameters. On a box it is a quadratic
polynomial up to an error (Taylor models), and boxes are cut until the polynomials stay in the box of beta that the
certificate states. The boxes of s are taken in coordinates sigma = M s that the certificate names for every output
(rows of its polytope); what lies outside the polytope is dropped.

A model with kinks (abs, min, max) has no such polynomial there: value and generalised slopes over the box bound it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from certbound.checker.expressions import Cut, Expansion, Graph, Program, Quadratic, Undecided
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, Structure

_MOST_BOXES = 4000
_MOST_PARTS = 8
_ENOUGH = 0.1  # of the width of a box of the remainder: an error that may leave room for a proof

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
    """low <= row . s <= high for some rows over all states; ``frame`` numbers the rows used as coordinates.

    ``sides`` are the ranges of single states, where the rows bound them.
    """

    rows: Sequence[Sequence[arb]]
    low: Sequence[arb]
    high: Sequence[arb]
    frame: Sequence[int]
    sides: Mapping[int, Side]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Box:
    """Centre and radius in (tau, sigma, d)."""

    centre: list[arb]
    radius: list[arb]


def remainders(model: Model, structure: Structure, budget: Budget) -> list[OutputRemainder]:
    """The remainder of every output.

    Inputs of the expressions: tau, the states s, the disturbances d, and then the parameters: t_m; in continuous time
    four coefficients of p about the middle per state (by state), in discrete time p and the next p; the varying
    entries of A; those of K (continuous time); the varying entries of E; d0; the inputs of the plan.
    """
    n, q = model.dimension, len(model.disturbance)
    graph = Graph(budget)
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
    varying, moving = structure.states.varying, structure.disturbances.varying
    slopes = dict(zip(varying, fresh(len(varying))))
    if model.continuous:
        drifts = dict(zip(varying, fresh(len(varying))))
        slopes = {e: graph.add(a, graph.mul(tau, drifts[e])) for e, a in slopes.items()}
    gains = dict(zip(moving, fresh(len(moving))))
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
        budget.check()
        result.append(OutputRemainder(
            graph, graph.sub(values[i], velocities[i]), nodes[model.dynamics.outputs[i]], count=count,
            time=model.continuous, states=structure.states.active(i), disturbances=structure.disturbances.active(i),
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
    """The remainder of one output: its program over Taylor models, and the branch and bound."""

    def __init__(
        self, graph: Graph, node: int, value: int, *, count: int, time: bool, states: list[int],
        disturbances: list[int], dimension: int, budget: Budget,
    ) -> None:
        self.count, self.dimension, self.states, self.disturbances = count, dimension, states, disturbances
        self.time, self.budget = time, budget
        self.slots = [*([0] if time else []), *(1 + j for j in states), *(1 + dimension + j for j in disturbances)]
        self.expansion = Expansion(graph, node, value, variables=count)
        self.plain = Program(graph, [], [value], variables=count)
        self.values = Program(graph, [value], [value], variables=count)
        self.programs: list[Expansion | Program] = [self.expansion, self.plain]
        self.kinked: tuple[Program, Program] | None = None
        if any(graph.node(index).op in ("abs", "min", "max", "kink") for index in graph.reachable([node])):
            gradient = []
            for slot in self.slots:
                budget.check()
                gradient.append(graph.derivative(node, slot))
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
            size = len(box.centre)
            budget.balls(size * (8 + 4 * len(frame.cuts)) + (0 if frame.straight else 2 * len(frame.map) ** 2))
            if not frame.meets(box):
                continue
            form = self._form(frame, box)
            stays = None if form is None else form.stays(low, high, frame.cuts_at(box))
            if stays is False:
                return False
            if stays:
                continue
            smear = None if form is None else form.smear
            parts = _parts(box, smear, _ENOUGH * (high - low))
            if parts is None:
                return False
            stack.extend(parts)
        return not stack

    def is_decided(self, sides: Mapping[int, Side]) -> bool:
        """Whether the output is defined, and on one side of every jump, for all d and s within ``sides`` and at s = 0.

        States without a side are kept at s = 0.
        """
        try:
            self.plain.run(self._around(self.piece, sides))
        except Undecided:
            return False
        return True

    def width(self, piece: PieceData, sides: Mapping[int, Side]) -> arb:
        """How far values of the output may lie apart over such a piece; Unproved where it is not defined."""
        self.values.prepare(piece.values)
        try:
            (value,) = self.values.run(self._around(piece, sides))
        except Undecided as error:
            raise Unproved("the dynamics is not defined where its inputs jump") from error
        return (value.upper() - value.lower()).upper()

    def _around(self, piece: PieceData, sides: Mapping[int, Side]) -> list[arb]:
        """All of (tau, s, d), but that states without a side are 0."""
        inputs = [arb(0)] * self.count
        inputs[0] = arb(0, piece.half)
        for j, (low, high) in sides.items():
            inputs[1 + j] = low.union(high).union(arb(0))
        for j, (value, size) in enumerate(zip(piece.disturbance, piece.disturbance_radius)):
            inputs[1 + self.dimension + j] = value + arb(0, size)
        return inputs

    def _form(self, frame: _Frame, box: _Box) -> Quadratic | None:
        """The remainder as a polynomial in xi, the box being |xi| <= 1; None where undecided."""
        inputs: list[tuple[arb, dict[int, arb]]] = [(arb(0), {})] * self.count
        for j, value in enumerate(self.piece.disturbance):
            inputs[1 + self.dimension + j] = value, {}
        centre, rows = frame.unturned(box)
        for slot, value, row in zip(self.slots, centre, rows):
            inputs[slot] = value, row
        try:
            return self.expansion.run(inputs, len(self.slots))
        except Undecided:
            return self._kinked_form(frame, box) if self.kinked is not None else None

    def _kinked_form(self, frame: _Frame, box: _Box) -> Quadratic | None:
        """The same to first order, with generalised slopes over the box."""
        assert self.kinked is not None
        thin = [arb(0)] * self.count
        for j, value in enumerate(self.piece.disturbance):
            thin[1 + self.dimension + j] = value
        wide = list(thin)
        centre, rows = frame.unturned(box)
        for slot, value, row in zip(self.slots, centre, rows):
            size = sum((abs(x) for x in row.values()), arb(0))
            thin[slot], wide[slot] = value, value + arb(0, size)
        try:
            (value,) = self.kinked[0].run(thin)
            slopes = self.kinked[1].run(wide)
        except Undecided:
            return None
        count = len(slopes)
        turned = [arb(0)] * count
        for slope, row in zip(slopes, rows):
            for a, x in row.items():
                turned[a] += slope * x
        zero = [arb(0)] * count
        smear = [abs(x).upper() for x in turned]
        return Quadratic(
            value=value, gradient=zero, hessian=[zero] * count, radius=[arb(1)] * count,
            error=sum(smear, arb(0)).upper(), smear=smear,
        )


class _Frame:
    """The coordinates (tau, sigma, d) of one output on one piece: s = T sigma."""

    def __init__(self, output: OutputRemainder, polytope: Polytope) -> None:
        self.output, self.polytope = output, polytope
        states = output.states
        m = len(states)
        rows = len(polytope.rows)
        output.budget.products(m, m + rows, m + 20)
        output.budget.balls(rows * (len(polytope.rows[0]) if rows else 0), 100)
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
            cut for number in range(len(polytope.rows)) if number not in chosen and m > 1
            for cut in self._cut(number)
        ]

    def _cut(self, number: int) -> list[Cut]:
        """A row of the polytope as a cut of the output's own states: what other states add is anywhere in its range."""
        polytope, states = self.polytope, self.output.states
        row, low, high = polytope.rows[number], polytope.low[number], polytope.high[number]
        others = [j for j, value in enumerate(row) if j not in states and not value.is_zero()]
        if all(row[j].is_zero() for j in states) or not all(j in polytope.sides for j in others):
            return []
        rest = sum((row[j] * polytope.sides[j][0].union(polytope.sides[j][1]) for j in others), arb(0))
        return [Cut(self._form(row), (low - rest).lower(), (high - rest).upper())]

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
        return all(cut.meets(box.centre[self.start :], box.radius[self.start :]) for cut in self.cuts)

    def cuts_at(self, box: _Box) -> list[Cut]:
        """The cuts in the coordinates xi of the box."""
        result: list[Cut] = []
        size, start = len(box.centre), self.start
        for form, low, high in self.cuts:
            whole = [arb(0)] * size
            value = arb(0)
            for i, factor in enumerate(form, start):
                whole[i] = factor * box.radius[i]
                value += factor * box.centre[i]
            result.append(Cut(whole, low - value, high - value))
        return result

    def unturned(self, box: _Box) -> tuple[list[arb], list[dict[int, arb]]]:
        """(tau, s, d) over the box: the centre, and the coefficients of xi."""
        rows = [{} if size.is_zero() else {a: size} for a, size in enumerate(box.radius)]
        if self.straight:
            return box.centre, rows
        m, start = len(self.map), self.start
        centre = list(box.centre)
        for i, row in enumerate(self.map):
            centre[start + i] = sum((row[a] * box.centre[start + a] for a in range(m)), arb(0))
            scaled = {start + a: row[a] * box.radius[start + a] for a in range(m)}
            rows[start + i] = {a: x for a, x in scaled.items() if not x.is_zero()}
        return centre, rows


def _lives_in(row: Sequence[arb], states: list[int]) -> bool:
    return all(value.is_zero() or j in states for j, value in enumerate(row))


def _parts(box: _Box, smear: list[arb] | None, enough: arb) -> list[_Box] | None:
    """The box cut where that helps most, into two or, should the error be large, more; None for a point."""
    parts = _halves(box, _largest(smear) if smear else None)
    if parts is None or not smear:
        return parts
    sizes = [float(x) for x in smear]
    goal = float(enough)
    while len(parts) < _MOST_PARTS:
        best = _largest(sizes)
        sizes = [x / 4 if a == best else x / 2 for a, x in enumerate(sizes)]
        if not sum(sizes) > goal:
            break
        finer = [_halves(part, _largest(sizes)) or [part] for part in parts]
        parts = [half for pair in finer for half in pair]
    return parts


def _largest(sizes: Sequence[arb] | Sequence[float]) -> int:
    return max(range(len(sizes)), key=lambda a: float(sizes[a]))


def _halves(box: _Box, place: int | None) -> list[_Box] | None:
    """The box cut in two along a coordinate (the widest one, if none is named or it has no width); None for a point."""
    if not box.radius:
        return None
    if place is None or not box.radius[place] > 0:
        place = _largest(box.radius)
        if not box.radius[place] > 0:
            return None
    half = box.radius[place] / 2
    found = []
    for sign in (-1, 1):
        centre, radius = list(box.centre), list(box.radius)
        centre[place], radius[place] = centre[place] + sign * half, half
        found.append(_Box(centre=centre, radius=radius))
    return found
