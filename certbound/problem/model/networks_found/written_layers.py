"""Networks that a model writes out, found again in its scalar tape.

``W2 @ np.tanh(W1 @ z + b1) + b2`` is thousands of products on a tape, and one chain of layers. ``with_layers`` reads
every value as a sum of units with coefficients that are floats, exactly: a unit is an activation of such a sum, and
units of one kind over the same units before them make a layer. A sum of units that the model uses otherwise is an
output of a network. The new tape is the same function over the reals, however the layers were written: a sum is
rewritten only where every coefficient is a float, and what is rounded there becomes a layer without an activation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from certbound.problem.model.graph import Graph
from certbound.problem.model.network_data import MOST_LAYERS, Layer, Network, Part
from certbound.problem.model.networks_found.written_activations import Read, activation_of
from certbound.problem.model.tape import Tape

LEAST_WEIGHTS = 200
"""Products of a network below which it stays written out: all methods know single operations, some no networks.

With 192 products in one layer the linear response takes .55 s for 1.2 s of processor time, constants 7.1 s for 5.2 s.
"""
LEAST_DENSITY = 0.25
"""Share of a network's weights that are not 0, below which it stays written out: a chain of springs is no network."""
_ANY = -1  # the layer of constants, which go with every layer


@dataclass(slots=True)
class Sum:
    """``constant`` plus coefficients times units (by their nodes) of one layer; 0 is that of all other values."""

    layer: int
    terms: dict[int, float]
    constant: float = 0.0


def with_layers(tape: Tape) -> Tape:
    """The tape with its written-out networks as parts of ``Network`` objects; the same tape where it has none."""
    if len(tape.nodes) < LEAST_WEIGHTS:
        return tape
    return _Found(tape).tape_found()


@dataclass(slots=True)
class _Outputs:
    """Sums over one layer that become the outputs of one network."""

    layer: int
    roots: list[int]
    inputs: tuple[int, ...] = ()
    network: Network | None = None


@dataclass(slots=True)
class _Kind:
    """A layer: the one before it, its activation, and its units' sums over that one."""

    before: int
    activation: str
    constants: tuple[float, ...]
    depth: int = 0
    units: dict[int, Sum] = field(default_factory=dict)


class _Found:
    """The sums of a tape's nodes, bottom-up, and the networks that its outputs need, top-down."""

    def __init__(self, tape: Tape) -> None:
        self.tape, self.nodes = tape, tape.nodes
        self.layers = [_Kind(_ANY, "", ())]
        self.known: dict[tuple[int, str, tuple[float, ...]], int] = {}
        self.leads: dict[tuple[int, int], bool] = {}
        self.uses = Counter(arg for node in self.nodes if node.op != "input" for arg in node.args)
        self.uses.update(tape.outputs)
        self.sums: list[Sum | None] = []
        for index in range(len(self.nodes)):
            self.sums.append(self._sum(index))

    # the sums

    def _sum(self, index: int) -> Sum:
        node = self.nodes[index]
        if node.op == "const":
            return Sum(_ANY, {}, node.value)
        found = None if node.op in ("input", "pow") or node.part is not None else activation_of(self.nodes, index)
        if found is not None:
            unit = self._unit(index, found)
            if unit is not None:
                return unit
        if node.op in ("add", "sub"):
            return self._added(index, node.args[0], node.args[1], -1.0 if node.op == "sub" else 1.0)
        if node.op == "neg":
            return self._scaled(index, node.args[0], -1.0)
        if node.op in ("mul", "div"):
            return self._product(index)
        return _single(index)

    def _unit(self, index: int, found: Read) -> Sum | None:
        """A node as a unit of the layer that its argument stands before."""
        argument = self.sums[found.argument]
        if argument is None or argument.layer == _ANY:
            return None
        factor = -1.0 if found.negated else 1.0
        before = Sum(argument.layer, {u: factor * c for u, c in argument.terms.items()}, factor * argument.constant)
        self.uses[found.argument] += 1  # the sum is kept
        layer = self._layer(argument.layer, found.activation, found.constants)
        if layer is None:
            return None
        self.layers[layer].units[index] = before
        return Sum(layer, {index: 1.0})

    def _layer(self, before: int, activation: str, constants: tuple[float, ...] = ()) -> int | None:
        """The layer of a kind behind another one; None where a network has no room for it."""
        key, depth = (before, activation, constants), self.layers[before].depth + 1
        if depth >= MOST_LAYERS:
            return None
        if key not in self.known:
            self.known[key] = len(self.layers)
            self.layers.append(_Kind(*key, depth))
        return self.known[key]

    def _product(self, index: int) -> Sum:
        node = self.nodes[index]
        left, right = (self.sums[arg] for arg in node.args)
        if node.op == "mul" and left is not None and left.layer == _ANY:
            return self._scaled(index, node.args[1], left.constant)
        if right is None or right.layer != _ANY or right.constant == 0:
            return _single(index)
        if node.op == "mul":
            return self._scaled(index, node.args[0], right.constant)
        if Fraction(1.0 / right.constant) * Fraction(right.constant) == 1:
            return self._scaled(index, node.args[0], 1.0 / right.constant)
        return _single(index)

    def _scaled(self, index: int, arg: int, factor: float) -> Sum:
        one = self.sums[arg]
        if one is None:
            return _single(index)
        shifted = one.layer == 0 and len(one.terms) == 1 and one.constant != 0  # an input x - m
        if shifted or not _exactly((factor, c) for c in (*one.terms.values(), one.constant)):
            one = self._fresh(arg)
        terms = {unit: factor * c for unit, c in one.terms.items()}
        return Sum(one.layer, terms, factor * one.constant)

    def _added(self, index: int, first: int, second: int, sign: float) -> Sum:
        a, b = self.sums[first], self.sums[second]
        if a is None or b is None:
            return _single(index)
        a, b = self._same_layer(a, b)
        if not _adds(a, b, sign):
            a, b = self._same_layer(self._fresh(first), self._fresh(second))
            if not _adds(a, b, sign):
                return _single(index)
        own = a.layer != _ANY and len(b.terms) == 1 and a is self.sums[first] and self.uses[first] == 1
        if own:  # nothing else asks for the terms of a running sum
            self.sums[first] = None
        terms = a.terms if own else dict(a.terms)
        for unit, c in b.terms.items():
            terms[unit] = terms.get(unit, 0.0) + sign * c
        return Sum(b.layer if a.layer == _ANY else a.layer, terms, a.constant + sign * b.constant)

    def _fresh(self, arg: int) -> Sum:
        """A node as one unit: a value of its own, or one of a layer without activation."""
        one = self.sums[arg]
        if one is None or one.layer == _ANY:
            return one or _single(arg)
        if one.layer == 0 and len(one.terms) < 2:
            return _single(arg)
        self.uses[arg] += 1
        layer = self._layer(one.layer, "linear")
        if layer is None:
            return _single(arg)
        self.layers[layer].units[arg] = one
        return Sum(layer, {arg: 1.0})

    def _same_layer(self, a: Sum, b: Sum) -> tuple[Sum, Sum]:
        """Two sums over one layer: through layers without activation, or else over all values."""
        if a.layer == b.layer or _ANY in (a.layer, b.layer):
            return a, b
        for one, other, turned in ((a, b, False), (b, a, True)):
            lifted = self._lifted(one, other.layer)
            if lifted is not None:
                return (other, lifted) if turned else (lifted, other)
        return Sum(0, a.terms, a.constant), Sum(0, b.terms, b.constant)

    def _lifted(self, one: Sum, layer: int) -> Sum | None:
        """The same sum over a layer that has more layers without activation before it; None where it is another."""
        if not self._leads(one.layer, layer):
            return None
        kind = self.layers[layer]
        if one.layer == layer or one.layer == _ANY:
            return one
        same = self._leads(self.layers[one.layer].before, kind.before) and self._alike(one.layer, layer)
        for unit in one.terms:
            if unit not in kind.units:
                inner = self.layers[one.layer].units[unit] if same else Sum(one.layer, {unit: 1.0})
                lifted = self._lifted(inner, kind.before)
                assert lifted is not None
                kind.units[unit] = lifted
        return Sum(layer, one.terms, one.constant)

    def _leads(self, low: int, high: int) -> bool:
        """Whether a layer is another one but for layers without activation."""
        if low == high or high <= 0:
            return low == high
        if (low, high) not in self.leads:
            before = self.layers[high].before
            same = low > 0 and self._alike(low, high) and self._leads(self.layers[low].before, before)
            self.leads[low, high] = same or (self.layers[high].activation == "linear" and self._leads(low, before))
        return self.leads[low, high]

    def _alike(self, low: int, high: int) -> bool:
        one, other = self.layers[low], self.layers[high]
        return (one.activation, one.constants) == (other.activation, other.constants)

    # the networks

    def tape_found(self) -> Tape:
        """The tape with the networks that are worth it."""
        plain: set[int] = set()  # sums that stay as they are
        while True:
            live, roots = self._reached(plain)
            groups = [group for layer in roots.values() for group in self._groups(layer)]
            refused = [root for group in groups if not self._built(group) for root in group.roots]
            if not refused:
                return self._rewritten(live, groups) if groups else self.tape
            plain.update(refused)

    def _reached(self, plain: set[int]) -> tuple[list[int], dict[int, list[int]]]:
        """The nodes that the new tape has, in order, and by layer the sums that are outputs of networks."""
        seen: set[int] = set()
        roots: dict[int, list[int]] = {}
        stack = list(self.tape.outputs)
        while stack:
            index = stack.pop()
            if index in seen:
                continue
            seen.add(index)
            one = self.sums[index]
            if index not in plain and one is not None and _wide(one) and not self._apart(index):
                roots.setdefault(one.layer, []).append(index)
                stack += self._layers_below(one.layer, one.terms)[0]
            elif self.nodes[index].op != "input":
                stack += self.nodes[index].args
        return sorted(seen), roots

    def _apart(self, index: int) -> bool:
        """Whether a sum adds outputs of networks that have no unit in common."""
        node = self.nodes[index]
        inner = [arg for arg in node.args if self.nodes[arg].op != "const"]
        if node.op not in ("add", "sub", "mul", "div", "neg") or any(self.sums[arg] is None for arg in inner):
            return False
        if len(inner) < 2:
            return self._apart(inner[0])
        a, b = (self._of(arg) for arg in inner)
        if a.layer != b.layer or not (_wide(a) and _wide(b)):
            return False
        below = zip(self._layers_below(a.layer, a.terms)[1:], self._layers_below(b.layer, b.terms)[1:])
        return not any(set(one) & set(other) for one, other in below)

    def _layers_below(self, layer: int, units: Iterable[int]) -> list[list[int]]:
        """The units that a layer's units need, layer by layer from the values that go into the first one."""
        found = [sorted(units)]
        while layer:
            kind = self.layers[layer]
            found.append(sorted({below for unit in found[-1] for below in kind.units[unit].terms}))
            layer = kind.before
        return found[::-1]

    def _groups(self, roots: Sequence[int]) -> list[_Outputs]:
        """Sums over a layer that share units: outputs of one network, or of several where one needs another."""
        first: dict[int, int] = {}
        leader: dict[int, int] = {root: root for root in roots}

        def lead(root: int) -> int:
            while leader[root] != root:
                leader[root] = root = leader[leader[root]]
            return root

        for root in roots:
            for unit in self._of(root).terms:
                leader[lead(root)] = lead(first.setdefault(unit, root))
        groups: dict[int, list[int]] = {}
        for root in sorted(roots):
            groups.setdefault(lead(root), []).append(root)
        return [found for group in groups.values() for found in self._ordered(group)]

    def _ordered(self, roots: list[int]) -> Iterator[_Outputs]:
        layer = self._of(roots[0]).layer
        units = {unit for root in roots for unit in self._of(root).terms}
        inputs = tuple(self._layers_below(layer, units)[0])
        if len(roots) == 1 or max(inputs, default=0) < roots[0]:
            yield _Outputs(layer, roots, inputs)
            return
        for root in roots:  # what goes into one may depend on another
            yield from self._ordered([root])

    def _of(self, root: int) -> Sum:
        one = self.sums[root]
        assert one is not None
        return one

    def _built(self, group: _Outputs) -> bool:
        """Whether a network is made of a group of sums."""
        units = {unit for root in group.roots for unit in self._of(root).terms}
        below = self._layers_below(group.layer, units)
        kinds = []
        layer = group.layer
        while layer:
            kinds.append(self.layers[layer])
            layer = self.layers[layer].before
        rows = [[kind.units[unit] for unit in row] for kind, row in zip(reversed(kinds), below[1:])]
        rows.append([self._of(root) for root in group.roots])
        named = [(kind.activation, kind.constants) for kind in reversed(kinds)] + [("linear", ())]
        mixing = [number for number, row in enumerate(rows) if any(len(one.terms) > 1 for one in row)]
        weights = sum(len(one.terms) for number in mixing for one in rows[number])
        whole = sum(len(rows[number]) * len(below[number]) for number in mixing)
        bends = any(name != "linear" for name, _ in named)
        if not bends or weights < LEAST_WEIGHTS or weights < LEAST_DENSITY * whole:
            return False
        try:
            made = [
                Layer(tuple(_row(one, places) for one in row), tuple(one.constant for one in row), *name)
                for row, places, name in zip(rows, below, named)
            ]
            group.network = Network(layers=tuple(made))
        except ValueError:  # too large, or too large numbers
            return False
        return True

    def _rewritten(self, live: Sequence[int], groups: Sequence[_Outputs]) -> Tape:
        """The nodes again, less the sums that are parts of networks now."""
        graph = Graph(self.tape.inputs)
        table = graph.arithmetic()
        parts = {root: (group, place) for group in groups for place, root in enumerate(group.roots)}
        new: dict[int, int] = {}
        for index in live:
            node = self.nodes[index]
            if index in parts:
                group, place = parts[index]
                assert group.network is not None
                new[index] = graph.part(Part(group.network, place), tuple(new[arg] for arg in group.inputs))
            elif node.op == "input":
                new[index] = graph.input(node.args[0])
            elif node.op == "const":
                new[index] = graph.const(node.value)
            else:
                more = (node.part,) if node.part is not None else (node.value,) if node.op == "pow" else ()
                new[index] = table[node.op](*(new[arg] for arg in node.args), *more)
        return graph.tape([new[output] for output in self.tape.outputs], self.tape.shape)


def _row(one: Sum, places: Sequence[int]) -> tuple[float, ...]:
    return tuple(one.terms.get(unit, 0.0) for unit in places)


def _wide(one: Sum) -> bool:
    return one.layer > 0 and len(one.terms) > 1


def _single(index: int) -> Sum:
    return Sum(0, {index: 1.0})


def _exactly(pairs: Iterable[tuple[float, float]]) -> bool:
    """Whether all products are floats."""
    return all(
        abs(a) == 1 or abs(b) == 1 or a == 0 or b == 0 or Fraction(a * b) == Fraction(a) * Fraction(b)
        for a, b in pairs
    )


def _adds(a: Sum, b: Sum, sign: float) -> bool:
    """Whether the coefficients of a + sign b are floats."""
    pairs = [(a.terms[unit], sign * c) for unit, c in b.terms.items() if unit in a.terms]
    pairs.append((a.constant, sign * b.constant))
    return all(x == 0 or y == 0 or Fraction(x + y) == Fraction(x) + Fraction(y) for x, y in pairs)
