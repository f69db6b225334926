"""The drift and the diffusion of a model to second order over cells of a working box, in xi and in balls."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from certbound.checker.balls import matrix
from certbound.checker.expressions import Graph, Program, Undecided
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model
from certbound.problem.model import JUMPS, Tape

Pair = tuple[int, int]
_MOST_PARTS = 64
_MOST_CUTS = 8
_KINKED = {"bent", "jumping", "abs", "min", "max", "hypot", "atan2", "fmod", "copysign"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Local:
    """f on a cell: A(s, d) z about the middle, and a remainder.

    ``base`` is the linear part, ``along[a]`` what a step along the held coordinate a adds to it, ``pushed[b]`` what the
    disturbance b at its upper end adds (minus that at its lower end), and what is missing of f_i is at most
    sum_b rest[i][b] |eta_b|, eta_b the coordinate b of the cell scaled to [-1, 1] about ``middle`` by half widths
    ``size``, and the last one equal to 1.
    """

    base: arb_mat
    along: dict[int, arb_mat]
    pushed: list[arb_mat]
    rest: list[list[arb]]
    middle: list[arb]
    size: list[arb]


class Flow:
    """f and g of a model at rest, with the derivatives that they have."""

    def __init__(self, model: Model, budget: Budget) -> None:
        self.model, self.budget, self.n = model, budget, model.dimension
        self.graph = Graph(budget)
        slots = [self.graph.input(slot) for slot in range(len(model.dynamics.inputs))]
        nodes = self.graph.include(model.dynamics, slots)
        self.outputs = [nodes[output] for output in model.dynamics.outputs]
        given = model.noise.diffusion
        if isinstance(given, Tape):
            nodes = self.graph.include(given, slots[: self.n + 1])
            self.noise, self.columns = [nodes[output] for output in given.outputs], given.shape[1]
        else:
            self.noise, self.columns = [self.graph.const(float(x)) for x in given.entries()], given.ncols()
        self._refuse()
        self.q = self.n + len(model.disturbance)
        self.slopes = [[self._by(node, a) for a in range(self.q)] for node in self.outputs]
        self.gains = [[self._by(node, a) for a in range(self.n)] for node in self.noise]
        if any(not self._is_zero(self._by(node, b)) for row in self.gains for node in row for b in range(self.n)):
            raise Unproved("this proof needs a diffusion that is affine in the states")
        self.bends = {
            (i, a, b): node
            for i, row in enumerate(self.slopes) for a in range(self.q) for b in range(a, self.q)
            if not self._is_zero(node := self._by(row[a], b))
        }  # fmt: skip

    def _by(self, node: int, place: int) -> int:
        """The derivative by a state or a disturbance, time being input 0."""
        return self.graph.derivative(node, 1 + place)

    def _is_zero(self, node: int) -> bool:
        return self.graph.is_const(node, 0.0)

    def _refuse(self) -> None:
        reached = self.graph.reachable([*self.outputs, *self.noise])
        for index in reached:
            op, args, *_ = self.graph.node(index)
            if op in JUMPS or op in _KINKED:
                raise Unproved(f"the model has an operation ({op}) that this proof does not treat")
            if op == "input" and args[0] == 0:
                raise Unproved("this proof does not treat a model that changes with time")

    # ---- what holds everywhere -------------------------------------------------------------------------------

    def held(self, places: Sequence[int]) -> None:
        """Refuse coordinates that leave a second-order term, or a state that g depends on, without one that is held."""
        for _, a, b in self.bends:
            if b < self.n and a not in places and b not in places:
                raise Unproved("the coordinates that are held do not meet every second-order term")
        for row in self.gains:
            if any(not self._is_zero(node) and a not in places for a, node in enumerate(row)):
                raise Unproved("the coordinates that are held are not all that the diffusion depends on")

    def gain(self, center: Sequence[arb], width: Sequence[arb]) -> list[arb_mat]:
        """G_c with column c of g, in units of xi, equal to G_c z."""
        origin = [arb(0), *center, *(arb(a) for a, _ in self.model.disturbance)]
        found = []
        values = self._run([*self.noise, *(node for row in self.gains for node in row)], origin)
        count = len(self.noise)
        for c in range(self.columns):
            rows = []
            for i in range(self.n):
                entry = i * self.columns + c
                slope = values[count + entry * self.n : count + (entry + 1) * self.n]
                rows.append([x * w / width[i] for x, w in zip(slope, width)] + [values[entry] / width[i]])
            found.append(matrix([*rows, [arb(0)] * (self.n + 1)]))
        return found

    def rate(self, row: Sequence[arb], center: Sequence[arb], width: Sequence[arb]) -> list[arb] | None:
        """d(row . z)/dt over z, where it is affine and free of noise and disturbances; None elsewhere."""
        states = [i for i in range(self.n) if not row[i].is_zero()]
        for i in states:
            if any(not self._is_zero(self.noise[i * self.columns + c]) for c in range(self.columns)):
                return None
            if any(self._is_bent(i, a) for a in range(self.q)):
                return None
            if any(not self._is_zero(self.slopes[i][a]) for a in range(self.n, self.q)):
                return None
        point = [arb(0), *center, *(arb(a) for a, _ in self.model.disturbance)]
        nodes = [node for i in states for node in (self.outputs[i], *self.slopes[i][: self.n])]
        values, total = self._run(nodes, point), [arb(0)] * (self.n + 1)
        for k, i in enumerate(states):
            at, *slope = values[k * (self.n + 1) : (k + 1) * (self.n + 1)]
            parts = [*(x * w for x, w in zip(slope, width)), at]
            total = [a + row[i] * b / width[i] for a, b in zip(total, parts)]
        return total

    def _is_bent(self, i: int, a: int) -> bool:
        return any((i, *sorted((a, b))) in self.bends for b in range(self.q))

    # ---- cells -----------------------------------------------------------------------------------------------

    def over(self, low: Sequence[arb], high: Sequence[arb], held: Sequence[int], center: Sequence[arb],
             width: Sequence[arb]) -> Local:  # fmt: skip
        """f over a cell [low, high] of xi and all disturbances, by Taylor's formula about the middle."""
        n, q = self.n, self.q
        middle = [((a + b) / 2).mid() for a, b in zip(low, high)]
        size = [arb.max(b - m, m - a).upper() for a, b, m in zip(low, high, middle)]
        ranges = [(arb(a), arb(b)) for a, b in self.model.disturbance]
        still = [((a + b) / 2).mid() for a, b in ranges]
        size += [arb.max(b - m, m - a).upper() for (a, b), m in zip(ranges, still)]
        scale = [*width, *([arb(1)] * (q - n))]
        here = [arb(0), *(c + w * m for c, w, m in zip(center, width, middle)), *still]
        all_ = [arb(0), *(c + w * a.union(b) for c, w, a, b in zip(center, width, low, high)),
                *(a.union(b) for a, b in ranges)]  # fmt: skip
        asked = [*self.outputs, *(node for row in self.slopes for node in row)]
        self._run([*asked, *self.noise], all_)  # all of it is defined
        values = self._run(asked, here)
        bends = dict(zip(self.bends, self._ranges(all_)))
        base = [[arb(0)] * (n + 1) for _ in range(n + 1)]
        along = {a: [[arb(0)] * (n + 1) for _ in range(n + 1)] for a in held}
        pushed = [[[arb(0)] * (n + 1) for _ in range(n + 1)] for _ in range(q - n)]
        rest = [[arb(0)] * (n + 1) for _ in range(n)]
        for i in range(n):
            slope = [x * s / width[i] for x, s in zip(values[n + i * q : n + (i + 1) * q], scale)]
            _affine(base[i], values[i] / width[i], slope[:n], middle)
            for b in range(q - n):
                pushed[b][i][-1] += slope[n + b] * size[n + b]
        for (i, a, b), bend in bends.items():
            factor = bend * scale[a] * scale[b] / width[i] * (1 if a != b else arb(0.5))
            known, missing = factor.mid(), arb(factor.rad()).upper()
            if a >= n:
                known, missing = arb(0), abs(factor).upper()
            owner, other = (a, b) if a in along else (b, a)
            rest[i][other if b < n else min(a, n)] += missing * size[a] * size[b]
            if b < n:
                along[owner][i][other] += known
                along[owner][i][-1] -= known * middle[other]
            elif a < n:
                pushed[b - n][i][a] += known * size[b]
                pushed[b - n][i][-1] -= known * middle[a] * size[b]
        return Local(base=matrix(base), along={a: matrix(rows) for a, rows in along.items()},
                     pushed=[matrix(rows) for rows in pushed], rest=[[x.upper() for x in row] for row in rest],
                     middle=middle, size=size[:n])  # fmt: skip

    def _ranges(self, box: Sequence[arb]) -> list[arb]:
        """The second derivatives over a box, in parts: balls say more of small ones."""
        nodes = list(self.bends.values())
        used = [self.graph.node(index) for index in self.graph.reachable(nodes)]
        places = sorted({args[0] for op, args, *_ in used if op == "input"})
        cuts = _MOST_CUTS
        while cuts > 1 and cuts ** len(places) > _MOST_PARTS:
            cuts -= 1
        found: list[arb] = []
        for part in itertools.product(range(cuts), repeat=len(places)):
            self.budget.check()
            inputs = list(box)
            for place, k in zip(places, part):
                low, high = box[place].lower(), box[place].upper()
                inputs[place] = (low + (high - low) * k / cuts).union(low + (high - low) * (k + 1) / cuts)
            values = self._run(nodes, inputs)
            found = [a.union(b) for a, b in zip(found, values)] if found else values
        return found

    def _run(self, nodes: list[int], inputs: Sequence[arb]) -> list[arb]:
        if not nodes:
            return []
        program = Program(self.graph, nodes, variables=len(inputs))
        program.prepare([])
        try:
            found = program.run(list(inputs))
        except Undecided as error:
            raise Unproved("the model was not shown to be defined in the working box") from error
        if not all(x.is_finite() for x in found):
            raise Unproved("the model was not shown to be defined in the working box")
        return found


def _affine(row: list[arb], at: arb, slope: Sequence[arb], middle: Sequence[arb]) -> None:
    """at + slope . (xi - middle) as a row over z."""
    for a, x in enumerate(slope):
        row[a] += x
        row[-1] -= x * middle[a]
    row[-1] += at
