"""The checker's networks hold every point of a box, and say the same function as the prover's."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.checker.expressions import Expansion, Graph, Program, Undecided, expand
from certbound.checker.expressions.activation_balls import ACTIVATIONS
from certbound.checker.report import Budget, Unproved
from certbound.problem.model import Part, compile_numpy, jacobian, trace
from certbound.problem.model.network_data import CONSTANTS, KINKED
from certbound.rigor.activations import ACTIVATIONS as PROVER
from tests.networks import CONSTANTS as CONSTANTS_OF
from tests.networks import random_layers, random_network

every_activation = pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
CENTRES = [(0.3, -0.2), (-1.0, 0.4)]


def included(activation: str, radius: float = 0.0) -> tuple[Graph, list[int], list[arb]]:
    network = random_network(activation).data
    graph = Graph()
    args = (graph.input(0), graph.input(1))
    outputs = [graph.part(Part(network, k), args) for k in range(2)]
    return graph, outputs, [arb(c, radius) for c in CENTRES[0]]


def test_the_tables_have_the_same_activations() -> None:
    assert ACTIVATIONS.keys() == PROVER.keys() == CONSTANTS.keys()
    assert {name for name, row in ACTIVATIONS.items() if row.knots} == KINKED
    assert {name for name, row in PROVER.items() if row.kinks} == KINKED
    assert {name: row.constants for name, row in PROVER.items()} == CONSTANTS


@every_activation
def test_ranges_and_derivatives_hold_points(activation: str) -> None:
    graph, outputs, box = included(activation, 0.3)
    policy = random_network(activation)
    tape = trace(lambda x: list(policy(x)), {"x": ["a", "b"]})
    slopes = compile_numpy(jacobian(tape))
    nodes = [*outputs, *(graph.derivative(node, slot) for node in outputs for slot in (0, 1))]
    program = Program(graph, nodes, variables=2, generalised=True)
    program.prepare([])
    found = program.run(box)
    for share in np.random.default_rng(0).uniform(-0.3, 0.3, (25, 2)):
        point = np.add(CENTRES[0], share)
        expected = [*compile_numpy(tape)(*point), *slopes(*point).reshape(-1)]
        for ball, value in zip(found, expected):
            assert (ball + arb(0, 1e-12)).contains(arb(float(value)))


@every_activation
@pytest.mark.parametrize("radius", [1e-3, 0.1, 1.5])
def test_taylor_models_hold_points(activation: str, radius: float) -> None:
    policy = random_network(activation)
    for centre in CENTRES:
        graph, outputs, _ = included(activation)
        node = graph.add(outputs[0], graph.mul(graph.input(0), outputs[1]))
        expansion = Expansion(graph, node, node, variables=2)
        expansion.prepare([])
        form = expansion.run([(arb(c), {k: arb(radius)}) for k, c in enumerate(centre)], 2)
        size = float(form.error)
        assert size < (1e-5 if radius == 1e-3 and activation not in KINKED else 40 * radius)
        for xi in np.random.default_rng(1).uniform(-1, 1, (25, 2)):
            a, b = np.add(centre, radius * xi)
            first, second = policy(a, b)
            gradient, hessian = (np.array([[float(x) for x in row] for row in rows]) for rows in
                                 ([form.gradient], form.hessian))  # fmt: skip
            value = float(form.value) + (gradient @ xi)[0] + xi @ hessian @ xi / 2
            assert abs(first + a * second - value) <= size + 1e-12


@pytest.mark.parametrize("seed", range(12))
def test_taylor_models_of_mixed_layers_hold_points(seed: int) -> None:
    """Kinked layers before and behind smooth ones, up to four of them, on up to six coordinates, of functions."""
    rng = np.random.default_rng(seed)
    n, kinds = int(rng.integers(1, 7)), sorted(ACTIVATIONS)
    rows = random_layers("tanh", seed, sizes=(n, *rng.integers(2, 7, size=rng.integers(1, 5)), 2))
    for row in rows[:-1]:
        row["activation"] = kinds[rng.integers(len(kinds))]
        row.update(CONSTANTS_OF.get(row["activation"], {}))
    policy, graph = cb.network(rows), Graph()
    inputs = [graph.input(slot) for slot in range(n)]
    turned = [graph.add(graph.mul(x, x), graph.apply("sin", inputs[slot - 1])) for slot, x in enumerate(inputs)]
    node = graph.part(Part(policy.data, 1), tuple(turned))
    expansion = Expansion(graph, node, node, variables=n)
    expansion.prepare([])
    centre, radius = rng.normal(size=n), 10 ** rng.uniform(-3, 0, size=n)
    form = expansion.run([(arb(c), {k: arb(r)}) for k, (c, r) in enumerate(zip(centre, radius))], n)
    gradient, hessian = np.array(form.gradient, dtype=float), np.array(form.hessian, dtype=float)
    for xi in [*np.sign(rng.uniform(-1, 1, (20, n))), *rng.uniform(-1, 1, (40, n))]:
        point = centre + radius * xi
        value = float(form.value) + gradient @ xi + xi @ hessian @ xi / 2
        assert abs(policy(point**2 + np.sin(np.roll(point, 1)))[1] - value) <= float(form.error) + 1e-11


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS.keys() - KINKED))
@pytest.mark.parametrize("place", [-1.7, -0.3, 0.4, 2.0])
def test_expansions_hold_third_derivatives_with_their_sign(activation: str, place: float) -> None:
    row, step = ACTIVATIONS[activation], 1e-4
    assert row.expansion is not None
    *_, third = row.expansion(arb(place), arb(place, 0.01))
    bends = [float(2 * row.expansion(arb(x), arb(x))[2]) for x in (place - step, place + step)]
    assert (third + arb(0, 1e-6)).contains(arb((bends[1] - bends[0]) / (2 * step)))


def test_second_derivatives_of_kinks_are_undecided_and_third_ones_are_refused() -> None:
    graph, outputs, box = included("relu", 1.0)
    second = graph.derivative(graph.derivative(outputs[0], 0), 1)
    program = Program(graph, [second], variables=2)
    program.prepare([])
    with pytest.raises(Undecided):
        program.run(box)
    with pytest.raises(Unproved, match="third derivatives"):
        graph.derivative(second, 0)


@every_activation
def test_series_in_time(activation: str) -> None:
    policy = random_network(activation)
    tape = trace(lambda x: list(policy(x)), {"x": ["a", "b"]})
    inputs = [[arb(0.31), arb(0.7), arb(0), arb(0)], [arb(-0.22), arb(0.4), arb(0), arb(0)]]
    step = 1e-3
    found = expand(tape, inputs, 3, Budget(60.0))
    value = [sum(float(c) * step**k for k, c in enumerate(series)) for series in found]
    np.testing.assert_allclose(value, policy(0.31 + 0.7 * step, -0.22 + 0.4 * step), atol=1e-8)
