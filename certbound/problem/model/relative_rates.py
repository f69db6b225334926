"""A model in the logarithms of some of its states, over the reals: what a state divides is divided, as far as it goes.

With x_i = exp(y_i), dx_i = f_i dt + sum_k g_ik dW_k becomes dy_i = (f_i/x_i - 1/2 sum_k (g_ik/x_i)^2) dt
+ sum_k (g_ik/x_i) dW_k (Ito, x_i > 0). Interval arithmetic would not see that (c x_i)/x_i is c.
"""

from __future__ import annotations

from collections.abc import Sequence

from certbound.problem.model.graph import Graph
from certbound.problem.model.tape import Tape


class _Quotients:
    """What values of a graph are once one of its inputs has divided them."""

    def __init__(self, graph: Graph, x: int) -> None:
        self.graph, self.x = graph, x
        self._factors: dict[int, int | None] = {x: graph.const(1.0)}
        self._found: dict[int, int] = {}

    def factor(self, node: int) -> int | None:
        """node / x without a division; None where x is no factor of it."""
        if node not in self._factors:
            self._factors[node] = self._factor(node)
        return self._factors[node]

    def _factor(self, node: int) -> int | None:
        graph, (op, args, value, _) = self.graph, self.graph.nodes[node]
        if op == "const" and value == 0:
            return node
        if op == "mul":
            for a, b in (args, args[::-1]):
                found = self.factor(a)
                if found is not None:
                    return graph.apply("mul", found, b)
        elif op in ("div", "neg"):
            found = self.factor(args[0])
            return None if found is None else graph.apply(op, found, *args[1:])
        elif op in ("add", "sub"):
            found, other = self.factor(args[0]), self.factor(args[1])
            return None if found is None or other is None else graph.apply(op, found, other)
        elif op == "sq":
            found = self.factor(args[0])
            return None if found is None else graph.apply("mul", found, args[0])
        elif op == "pow" and args[0] == self.x and value > 1:
            return graph.pow(self.x, value - 1) if value - 1 == int(value) - 1 else None
        return None

    def of(self, node: int) -> int:
        """node / x: of a sum term by term."""
        if node not in self._found:
            self._found[node] = self._of(node)
        return self._found[node]

    def _of(self, node: int) -> int:
        graph, (op, args, *_) = self.graph, self.graph.nodes[node]
        found = self.factor(node)
        if found is not None:
            return found
        if op in ("add", "sub"):
            return graph.apply(op, self.of(args[0]), self.of(args[1]))
        if op == "neg":
            return graph.apply("neg", self.of(args[0]))
        for a, b in (args, args[::-1]) if op == "mul" else ():
            if graph.number(a) is not None:
                return graph.apply("mul", a, self.of(b))
        return graph.apply("div", node, self.x)


def proportional(diffusion: Tape) -> tuple[int, ...]:
    """The states whose noise, some of it, has the state itself as a factor; ``diffusion`` (n, m) over (t, states)."""
    graph = Graph(diffusion.inputs)
    values = diffusion.evaluate(graph.arithmetic(), [graph.input(slot) for slot in range(len(diffusion.inputs))])
    n, m = diffusion.shape
    found = []
    for i in range(n):
        quotients, row = _Quotients(graph, graph.input(i + 1)), values[i * m : (i + 1) * m]
        if all(quotients.factor(entry) is not None for entry in row) and any(graph.number(entry) != 0 for entry in row):
            found.append(i)
    return tuple(found)


def in_logarithms(dynamics: Tape, diffusion: Tape, places: Sequence[int]) -> tuple[Tape, Tape]:
    """Dynamics (t, states, ...) and diffusion (t, states) in log x_i for i in ``places``, over the same inputs."""
    graph, (n, m) = Graph(dynamics.inputs), diffusion.shape
    given = [graph.input(slot) for slot in range(len(dynamics.inputs))]
    rates = dynamics.evaluate(graph.arithmetic(), given)
    gains = diffusion.evaluate(graph.arithmetic(), given[: n + 1])
    for i in places:
        quotients = _Quotients(graph, given[i + 1])
        gains[i * m : (i + 1) * m] = own = [quotients.of(entry) for entry in gains[i * m : (i + 1) * m]]
        total = graph.const(0.0)
        for entry in own:
            total = graph.apply("add", total, graph.apply("sq", entry))
        rates[i] = graph.apply("sub", quotients.of(rates[i]), graph.apply("mul", graph.const(0.5), total))
    return _exponentials(graph.tape(rates, (n,)), places), _exponentials(graph.tape(gains, (n, m)), places, n + 1)


def _exponentials(tape: Tape, places: Sequence[int], count: int | None = None) -> Tape:
    """The tape with exp(x_i) for x_i, over the first ``count`` inputs."""
    graph = Graph(tape.inputs[:count])
    given = [graph.input(slot) for slot in range(len(graph.inputs))]
    given += [graph.const(0.0)] * (len(tape.inputs) - len(given))  # the noise knows no signals
    for i in places:
        given[i + 1] = graph.apply("exp", given[i + 1])
    return graph.tape(tape.evaluate(graph.arithmetic(), given), tape.shape)
