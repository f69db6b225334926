"""Contraction and noise constants over boxes: J^T P + P J <= 2 c P, or J^T P J <= L^2 P, and g g^T <= sigma^2 P^-1.

The Jacobian is taken apart into J = J_0 + sum theta_m M_m, where the theta_m are the non-constant expressions that
occur in it; over a box each theta_m has a range. Both sets of matrices are convex in J, so that the vertices suffice.
A box on which that fails is halved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

from flint import arb, arb_mat

from certbound.checker.balls import cholesky, identity, is_positive_definite, matrix
from certbound.checker.expressions import Graph, Program, Undecided, is_partial
from certbound.checker.report import BALL, Budget, Unproved
from certbound.checker.statement import Model, Structure
from certbound.problem.model import JUMPS, Tape

Box = list[tuple[arb, arb]]

MOST_VERTICES = 4096
_MOST_BOXES = 20_000
_SLACK = arb(2) ** -30


class Contraction:
    """Bounds of the Jacobian in the norm of P, the ``metric``."""

    def __init__(self, model: Model, structure: Structure, metric: arb_mat, budget: Budget) -> None:
        self.model, self.metric, self.budget = model, metric, budget
        graph, n = structure.graph, model.dimension
        self.fixed = [[arb(0)] * n for _ in range(n)]
        forms: dict[int, list[list[arb]]] = {}
        for (i, j), node in structure.states.nodes.items():
            constant, parts = _affine(graph, node)
            self.fixed[i][j] = constant
            for atom, factor in parts.items():
                if atom not in forms:
                    budget.hold(2 * n * n)
                    budget.products(n, n)
                    forms[atom] = [[arb(0)] * n for _ in range(n)]
                forms[atom][i][j] = factor
        self.atoms = sorted(forms)
        self.forms = [matrix(forms[atom]) for atom in self.atoms]
        risky = [k for k in graph.reachable(structure.outputs) if _is_risky(graph.node(k).op)]
        self.program = Program(
            graph, self.atoms, risky, variables=len(model.dynamics.inputs), generalised=True, unbounded=True
        )
        self.program.prepare([])
        self.smooth = Smooth(graph, risky, len(model.dynamics.inputs), budget)
        self.relevant = 0
        for node in [*self.atoms, *risky]:
            self.relevant |= graph.masks[node]

    def prove(self, box: Box, bound: arb, what: str) -> None:
        """Prove that the rate (CT) or gain (DT) is at most ``bound`` over a box of all inputs of the dynamics."""
        if not _everywhere(box, lambda part: self._holds(part, bound), self.relevant, self.budget):
            raise Unproved(f"{what} {float(bound):.9g} was not shown to bound the Jacobian")

    def contradicts(self, point: Box, bound: arb) -> bool:
        """Whether the Jacobian at a point of all inputs exceeds ``bound``, but for rounding, where it exists."""
        try:
            self.program.run([low for low, _ in point])
        except Undecided:
            return False
        return not self._holds(point, bound + _SLACK * (1 + abs(bound)))

    def _holds(self, box: Box, bound: arb) -> bool:
        try:
            ranges = self.program.run([low.union(high) if low < high else low for low, high in box])
        except Undecided:
            return False
        n = self.model.dimension
        self.budget.products(2 * len(self.forms) + 2, n, n)
        base, wide = matrix(self.fixed), []
        for value, form in zip(ranges, self.forms):
            if value.is_exact():
                base = base + form * value
            else:
                wide.append((form * value.lower(), form * value.upper()))
            if 2 ** len(wide) > MOST_VERTICES:
                raise Unproved(f"the Jacobian has {len(wide)} independent parts or more, too many to try every vertex")
        self.budget.expect((n * n * n // 3 * BALL) << len(wide))
        for choice in itertools.product((0, 1), repeat=len(wide)):
            self.budget.products(n, n, 2 * n + len(wide) + 8)
            jacobian = base
            for place, pair in zip(choice, wide):
                jacobian = jacobian + pair[place]
            if not self._vertex(jacobian, bound):
                return False
        return True

    def _vertex(self, jacobian: arb_mat, bound: arb) -> bool:
        metric, turned = self.metric, self.metric * jacobian
        if self.model.continuous:
            return is_positive_definite(metric * (2 * bound) - turned - turned.transpose(), self.budget)
        return is_positive_definite(metric * (bound * bound) - jacobian.transpose() * turned, self.budget)


class Smooth:
    """Where nothing jumps and everything is defined: there alone a slope bounds how far two values are apart."""

    def __init__(self, graph: Graph, risky: Sequence[int], inputs: int, budget: Budget) -> None:
        self.program = Program(graph, [], risky, variables=inputs, generalised=True, unbounded=True)
        self.program.prepare([])
        self.budget, self.relevant = budget, 0
        for node in risky:
            self.relevant |= graph.masks[node]

    def prove(self, box: Box, what: str) -> None:
        """Prove it on a box of all inputs."""
        if not _everywhere(box, self._holds, self.relevant, self.budget):
            raise Unproved(
                f"{what} was not shown to be defined and without jumps wherever constants are stated; a domain may do"
            )

    def _holds(self, box: Box) -> bool:
        try:
            self.program.run([low.union(high) if low < high else low for low, high in box])
        except Undecided:
            return False
        return True


def _is_risky(op: str) -> bool:
    """Whether an operation or its derivative may be undefined, or jump."""
    return op in JUMPS or op == "hypot" or is_partial(op)


def _affine(graph: Graph, node: int) -> tuple[arb, dict[int, arb]]:
    """A node as constant + sum of factor * atom."""
    constant = arb(0)
    parts: dict[int, arb] = {}
    stack = [(node, arb(1))]
    count = 0
    while stack:
        graph.budget.balls(2)
        index, factor = stack.pop()
        op, args, *_ = graph.node(index)
        count += 1
        if not graph.masks[index]:
            constant += factor * _constant(graph, index)
        elif count > 2000:
            parts[index] = parts.get(index, arb(0)) + factor
        elif op == "add":
            stack += [(args[0], factor), (args[1], factor)]
        elif op == "sub":
            stack += [(args[0], factor), (args[1], -factor)]
        elif op == "neg":
            stack.append((args[0], -factor))
        elif op == "mul" and not graph.masks[args[0]]:
            stack.append((args[1], factor * _constant(graph, args[0])))
        elif op == "mul" and not graph.masks[args[1]]:
            stack.append((args[0], factor * _constant(graph, args[1])))
        elif op == "div" and not graph.masks[args[1]]:
            stack.append((args[0], factor / _constant(graph, args[1])))
        else:
            parts[index] = parts.get(index, arb(0)) + factor
    return constant, parts


def _constant(graph: Graph, index: int) -> arb:
    with graph.budget.passing():
        program = Program(graph, [index], variables=0)
        program.prepare([])
        try:
            return program.run([])[0]
        except Undecided as error:
            raise Unproved("a constant of the model is not defined") from error


def _everywhere(box: Box, holds: Callable[[Box], bool], relevant: int, budget: Budget) -> bool:
    """Whether something holds on a box, cut across the inputs in the mask ``relevant`` where need be.

    A part on which it fails although its middle point alone fails too, or which cannot be cut, settles that it is not
    proved.
    """
    stack = [box]
    for _ in range(_MOST_BOXES):
        if not stack:
            return True
        budget.box()
        current = stack.pop()
        if holds(current):
            continue
        if not holds([_point(low, high) for low, high in current]):
            return False
        parts = _halves(current, relevant)
        if parts is None:
            return False
        stack += parts
    return False


def _point(low: arb, high: arb) -> tuple[arb, arb]:
    """A point of a side, which may be unbounded."""
    if low.is_finite() and high.is_finite():
        middle = ((low + high) / 2).mid()
    else:
        middle = low if low.is_finite() else high if high.is_finite() else arb(0)
    return middle, middle


def _halves(box: Box, relevant: int) -> list[Box] | None:
    """A box cut across its widest bounded side (relative to its size); None where there is none."""
    best, widest = -1, arb(0)
    for place, (low, high) in enumerate(box):
        width = high - low
        if relevant >> place & 1 and width.is_finite() and width > 0:
            scaled = (width / (1 + abs(low + high))).mid()
            if scaled > widest:
                best, widest = place, scaled
    if best < 0:
        return None
    low, high = box[best]
    middle = ((low + high) / 2).mid()
    if not low < middle < high:
        return None
    return [[*box[:best], part, *box[best + 1 :]] for part in ((low, middle), (middle, high))]


class Spread:
    """Bounds of the noise in the norm of P: L^T g g^T L <= sigma^2 I with P = L L^T, tr(P g g^T) <= nu sigma^2."""

    def __init__(self, model: Model, metric: arb_mat, budget: Budget) -> None:
        self.model, self.metric, self.budget = model, metric, budget
        self.root = cholesky(metric, budget)
        self.program: Program | None = None
        self.smooth: Smooth | None = None
        self.relevant = 0
        diffusion = model.noise.diffusion
        if isinstance(diffusion, Tape):
            graph = Graph(budget)
            nodes = graph.include(diffusion, [graph.input(slot) for slot in range(len(diffusion.inputs))])
            outputs = [nodes[output] for output in diffusion.outputs]
            self.program = Program(graph, outputs, variables=len(diffusion.inputs))
            risky = [k for k in graph.reachable(outputs) if _is_risky(graph.node(k).op)]
            self.smooth = Smooth(graph, risky, len(diffusion.inputs), budget)
            self.program.prepare([])
            for node in outputs:
                self.relevant |= graph.masks[node]

    def prove(self, box: Box, sigma: arb, nu: arb) -> None:
        """Prove that the constants hold on a box of (t, states)."""
        if not _everywhere(box, lambda part: self._holds(part, sigma, nu), self.relevant, self.budget):
            raise Unproved(f"sigma = {float(sigma):.9g} and nu = {float(nu):.6g} were not shown to bound the noise")

    def contradicts(self, point: Box, sigma: arb, nu: arb) -> bool:
        """Whether noise that is constant exceeds the constants at all, or other noise does at a point (t, state)."""
        covariance = self._covariance(point)
        if covariance is None:
            return False
        return not self._holds(point, sigma if self.program is None else sigma * (1 + _SLACK), nu)

    def _holds(self, box: Box, sigma: arb, nu: arb) -> bool:
        n = self.model.dimension
        self.budget.products(3, n, n, n + 6)
        covariance = self._covariance(box)
        if covariance is None:
            return False
        if all(entry.is_zero() for entry in covariance.entries()):  # no noise exceeds nothing
            return True
        square = sigma * sigma
        rest = identity(n) * square - self.root.transpose() * covariance * self.root
        bounded = is_positive_definite(rest, self.budget)
        return bool(bounded and (self.metric * covariance).trace() <= nu * square)

    def _covariance(self, box: Box) -> arb_mat | None:
        if self.program is None:
            return self.model.noise.covariance()
        try:
            values = self.program.run([low.union(high) if low < high else low for low, high in box])
        except Undecided:
            return None
        n = self.model.dimension
        self.budget.products(len(values), n + 12)
        g = arb_mat(n, len(values) // n, values)
        product = g * g.transpose()
        rows = [[product[i, j] for j in range(n)] for i in range(n)]
        for i in range(n):  # a square is not negative
            entries: Sequence[arb] = [g[i, j] for j in range(g.ncols())]
            rows[i][i] = sum((arb(0).union(x.abs_upper() ** 2) if x.contains(0) else x * x for x in entries), arb(0))
        return matrix(rows)
