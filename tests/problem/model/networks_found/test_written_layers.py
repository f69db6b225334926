"""Networks that models write out are found again, exactly, however they are written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from certbound.problem.model import Graph, Layer, Network, Part, Tape, compile_numpy, trace
from certbound.problem.model.networks_found import with_layers, written_layers

RNG = np.random.default_rng(0)
W1, W2, W3 = RNG.normal(size=(16, 2)), RNG.normal(size=(16, 16)) / 4, RNG.normal(size=(1, 16)) / 4
B1, B2, B3 = RNG.normal(size=16), RNG.normal(size=16) / 4, RNG.normal(size=1)
POINTS = np.random.default_rng(1).normal(size=(2, 40)) * 2

ACTIVATIONS: dict[str, list[Callable[[Any], Any]]] = {
    "tanh": [np.tanh],
    "sin": [np.sin],
    "relu": [
        lambda v: np.maximum(0, v), lambda v: np.maximum(v, 0.0), lambda v: np.where(v > 0, v, 0),
        lambda v: v * (v > 0), lambda v: np.where(v < 0, 0, v), lambda v: np.where(v >= 0, v, 0.0),
        lambda v: np.clip(v, 0, None),
        lambda v: np.array([np.maximum(entry, 0) for entry in v]), lambda v: np.where(~(v > 0), 0, v),
    ],
    "sigmoid": [
        lambda v: 1 / (1 + np.exp(-v)), lambda v: 1.0 / (np.exp(-v) + 1), lambda v: np.exp(v) / (1 + np.exp(v)),
        lambda v: np.reciprocal(1 + np.exp(-v)),
    ],
    "leaky_relu": [
        lambda v: np.maximum(v, 0.1 * v), lambda v: np.where(v > 0, v, 0.1 * v), lambda v: np.where(v <= 0, v * 0.1, v),
    ],
    "clip": [lambda v: np.clip(v, -0.5, 0.7), lambda v: np.minimum(0.7, np.maximum(-0.5, v))],
    "softplus": [lambda v: np.log(1 + np.exp(v)), lambda v: np.logaddexp(0, v), lambda v: np.log1p(np.exp(v))],
    "elu": [lambda v: np.where(v > 0, v, np.exp(v) - 1), lambda v: np.where(v < 0, np.expm1(v), v)],
}  # fmt: skip
WRITINGS: dict[str, Callable[[Any, Callable[[Any], Any]], Any]] = {
    "@": lambda z, f: W3 @ f(W2 @ f(W1 @ z + B1) + B2) + B3,
    "bias first": lambda z, f: B3 + W3 @ f(B2 + W2 @ f(B1 + W1 @ z)),
    "minus a bias": lambda z, f: W3 @ f(W2 @ f(W1 @ z - (-B1)) - (-B2)) - (-B3),
    "rows": lambda z, f: f(f(z @ W1.T + B1) @ W2.T + B2) @ W3.T + B3,
    "np.dot": lambda z, f: np.dot(W3, f(np.dot(W2, f(np.dot(W1, z) + B1)) + B2)) + B3,
    ".dot": lambda z, f: f(f(z.dot(W1.T) + B1).dot(W2.T) + B2).dot(W3.T) + B3,
    "np.array": lambda z, f: W3 @ f(W2 @ f(W1 @ np.array([z[0], z[1]]) + B1) + B2) + B3,
    "np.stack": lambda z, f: W3 @ f(W2 @ f(W1 @ np.stack([z[0], z[1]]) + B1) + B2) + B3,
    "np.concatenate": lambda z, f: W3 @ f(W2 @ f(W1 @ np.concatenate([z[:1], z[1:]]) + B1) + B2) + B3,
    "einsum": lambda z, f: W3 @ f(np.einsum("ij,j->i", W2, f(W1 @ z + B1)) + B2) + B3,
    "columns": lambda z, f: (W3 @ f(W2 @ f(W1 @ z.reshape(2, 1) + B1[:, None]) + B2[:, None]) + B3[:, None])[:, 0],
    "sums": lambda z, f: np.array([np.sum(W3[0] * f((W2 * f((W1 * z).sum(axis=1) + B1)).sum(axis=1) + B2)) + B3[0]]),
    "loops": lambda z, f: _loops(z, f),
}


def _loops(z: Any, f: Callable[[Any], Any]) -> Any:
    first = f(np.array([sum(w * x for w, x in zip(row, z)) + b for row, b in zip(W1, B1)]))
    second = f(np.array([b + sum(w * x for w, x in zip(row, first)) for row, b in zip(W2, B2)]))
    return np.array([sum(w * x for w, x in zip(W3[0], second)) + B3[0]])


def networks_of(tape: Tape) -> list[Network]:
    return list(dict.fromkeys(node.part.network for node in tape.nodes if node.part is not None))


def values(tape: Tape) -> Any:
    return compile_numpy(tape)(*POINTS)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_an_activation_however_it_is_written_makes_the_layers_of_its_network(activation: str) -> None:
    for f in ACTIVATIONS[activation]:
        tape = trace(lambda x, f=f: WRITINGS["@"](x, f), {"x": ["a", "b"]})
        (network,) = networks_of(tape)
        assert [node.op for node in tape.nodes[:2]] == ["input", "input"]
        assert len(tape.nodes) == 3
        assert [layer.activation for layer in network.layers] == [activation, activation, "linear"]
        for layer, weights, bias in zip(network.layers, (W1, W2, W3), (B1, B2, B3)):
            np.testing.assert_array_equal(np.array(layer.weights), weights)
            np.testing.assert_array_equal(np.array(layer.bias), bias)
        expected = [WRITINGS["@"](point, f) for point in POINTS.T]
        np.testing.assert_allclose(values(tape), expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("writing", WRITINGS)
def test_a_product_however_it_is_written_is_a_layer(writing: str) -> None:
    for f in (np.tanh, lambda v: np.maximum(0, v)):
        tape = trace(lambda x, f=f: WRITINGS[writing](x, f), {"x": ["a", "b"]})
        (network,) = networks_of(tape)
        assert len(tape.nodes) == 3
        assert [np.array(layer.weights).tolist() for layer in network.layers] == [W1.tolist(), W2.tolist(), W3.tolist()]
        assert [list(layer.bias) for layer in network.layers] == [B1.tolist(), B2.tolist(), B3.tolist()]


def test_what_stands_around_a_network_stays_as_it_is() -> None:
    def model(x: Any) -> Any:
        u = np.clip(0.3 * WRITINGS["@"](np.array([np.sin(x[0]), x[1] / 0.7]), np.tanh), -1, 1)
        return [x[0] + 0.1 * x[1], x[1] * u[0]]

    tape = trace(model, {"x": ["a", "b"]})
    (network,) = networks_of(tape)
    assert [len(layer.bias) for layer in network.layers] == [16, 16, 1]
    assert network.inputs == 2
    counted = Counter(node.op for node in tape.nodes)
    assert counted["sin"] == counted["div"] == counted["max"] == counted["min"] == counted["network"] == 1
    plain = [[float(value) for value in model(point)] for point in POINTS.T]
    np.testing.assert_allclose(values(tape), plain, rtol=1e-12, atol=1e-13)


def test_two_networks_are_two_and_one_with_two_outputs_is_one() -> None:
    def model(x: Any) -> Any:
        one = WRITINGS["@"](x, np.tanh)[0]
        hidden = np.maximum(0, W2 @ np.maximum(0, W1 @ x[::-1] + B1))
        return [one + W3[0] @ hidden, one - 2 * (W3[0, ::-1] @ hidden)]

    tape = trace(model, {"x": ["a", "b"]})
    assert [(n.inputs, n.outputs) for n in networks_of(tape)] == [(2, 1), (2, 2)]
    np.testing.assert_allclose(values(tape), [[float(v) for v in model(p)] for p in POINTS.T], rtol=1e-12, atol=1e-12)


def test_sums_of_outputs_do_not_join_networks() -> None:
    def model(x: Any) -> Any:
        nets = [WRITINGS["@"](part, np.tanh)[0] for part in (x, x[::-1], 2 * x, x - 1, x**2, np.exp(x))]
        return [sum(nets) / 6 - 0.3, nets[0] - nets[1] + 2]

    tape = trace(model, {"x": ["a", "b"]})
    found = networks_of(tape)
    assert len(found) == 6
    assert all(len(layer.bias) <= 16 for network in found for layer in network.layers)
    np.testing.assert_allclose(values(tape), [[float(v) for v in model(p)] for p in POINTS.T], rtol=1e-12, atol=1e-12)


def test_a_rounded_scale_between_layers_is_a_layer_of_its_own() -> None:
    tape = trace(lambda x: W3 @ np.tanh(0.1 * (W2 @ np.tanh(0.3 * (W1 @ x) + B1)) + B2 + 0.7), {"x": ["a", "b"]})
    (network,) = networks_of(tape)
    assert network.inputs == 2
    assert len(tape.nodes) == 3
    assert {layer.activation for layer in network.layers} == {"tanh", "linear"}
    expected = [W3 @ np.tanh(0.1 * (W2 @ np.tanh(0.3 * (W1 @ p) + B1)) + B2 + 0.7) for p in POINTS.T]
    np.testing.assert_allclose(values(tape), expected, rtol=1e-12, atol=1e-13)


def test_connections_that_skip_a_layer_leave_shorter_networks() -> None:
    def model(x: Any) -> Any:
        first = np.tanh(W1 @ x + B1)
        return x + W3[0] @ np.tanh(W2 @ first + W1 @ x) + first[0] * first[1]

    tape = trace(model, {"x": ["a", "b"]})
    assert networks_of(tape)
    assert len(tape.nodes) < 700
    np.testing.assert_allclose(values(tape), [model(point) for point in POINTS.T], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("function", [
    lambda x: W3 @ np.tanh(W1 @ x + B1),  # small
    lambda x: x + np.diff(np.tanh(np.diff(np.concatenate([[0.0], x, np.zeros(1)])))),  # sparse
    lambda x: np.tanh(RNG.normal(size=(len(x), len(x))) @ x),  # no layer behind the activation
    lambda x: RNG.normal(size=(9, 9)) @ (RNG.normal(size=(9, len(x))) @ x),  # no activation
], ids=["small", "sparse", "one layer", "linear"])  # fmt: skip
def test_what_is_no_network_keeps_its_operations(function: Callable[[Any], Any]) -> None:
    states = ["a", "b"] if function(np.zeros(2)).shape == (1,) else [f"x{k}" for k in range(60)]
    assert not networks_of(trace(function, {"x": states}))


def _fractions(tape: Tape, inputs: list[Fraction]) -> list[Fraction]:
    """The tape's values, exactly."""
    zero = Fraction(0)
    table: dict[str, Callable[..., Any]] = {
        "const": Fraction, "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "neg": lambda a: -a,
        "mul": lambda a, b: a * b, "div": lambda a, b: a / b if b else zero, "max": max, "min": min,
        "sq": lambda a: a * a,
        "lt": lambda a, b: Fraction(a < b), "le": lambda a, b: Fraction(a <= b), "not": lambda a: Fraction(a == 0),
        "if_else_zero": lambda c, a: a if c else zero,
    }  # fmt: skip
    phi: dict[str, Callable[..., Fraction]] = {
        "linear": lambda v: v, "relu": lambda v: max(v, zero),
        "clip": lambda v, a, b: min(max(v, Fraction(a)), Fraction(b)),
        "leaky_relu": lambda v, s: v if v > 0 else Fraction(s) * v,
    }  # fmt: skip

    def part(*given: Any) -> Fraction:
        *row, which = given
        for layer in which.network.layers:
            sums = [sum((Fraction(w) * v for w, v in zip(line, row)), Fraction(b))
                    for line, b in zip(layer.weights, layer.bias)]  # fmt: skip
            row = [phi[layer.activation](value, *layer.constants) for value in sums]
        return row[which.output]

    return tape.evaluate(table | dict.fromkeys(("network", "bent"), part), inputs)


def _drawn(rng: np.random.Generator) -> Tape:
    """A random tape in which sums, activations, copies and products meet in any order."""
    graph = Graph(["a", "b", "c"])
    known = [graph.input(k) for k in range(3)]
    for _ in range(60):
        a, b = (int(known[-1 - min(int(rng.exponential(6)), len(known) - 1)]) for _ in range(2))
        number = graph.const(float(rng.choice([0.0, 1.0, 0.5, -2.0, 0.1, 0.3, 3.0])))
        choice = int(rng.integers(12))
        if choice < 4:
            new = graph.apply(("add", "sub")[choice % 2], a, b)
        elif choice < 7:
            new = graph.apply("mul", number, a)
        elif choice == 7:
            new = graph.apply("add", a, number)
        elif choice == 8:
            new = graph.apply("max", a, graph.const(0.0))
        elif choice == 9:
            condition = graph.apply(("lt", "le")[int(rng.integers(2))], graph.const(0.0), a)
            slope = graph.apply("mul", graph.const(0.1), a)
            other = graph.apply("if_else_zero", graph.apply("not", condition), slope)
            new = graph.apply("add", graph.apply("if_else_zero", condition, a), other)
        elif choice == 10:
            new = graph.apply("min", graph.apply("max", a, graph.const(-0.5)), graph.const(1.0))
        else:
            new = graph.apply(("div", "mul", "max")[int(rng.integers(3))], a, b)
        known.append(new)
    return graph.tape([known[-1], known[-2], known[int(rng.integers(len(known)))]], (3,))


def test_random_tapes_stay_the_same_function_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(written_layers, "LEAST_WEIGHTS", 2)
    monkeypatch.setattr(written_layers, "LEAST_DENSITY", 0.0)
    found = 0
    for seed in range(500):
        rng = np.random.default_rng(seed)
        tape = _drawn(rng)
        other = with_layers(tape)
        found += other is not tape
        for point in rng.normal(size=(3, 3)) * 2:
            exact = [Fraction(float(x)) for x in point]
            assert _fractions(tape, exact) == _fractions(other, exact), seed
    assert found > 40


def test_outputs_that_need_each_other_are_networks_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(written_layers, "LEAST_WEIGHTS", 2)

    def model(x: Any) -> Any:
        one, two, three = np.tanh(x[0] + x[1]), np.tanh(x[0] - 2 * x[1]), np.tanh(x[1])
        first = one + two
        y = first * first
        return [first, two + 3 * np.tanh(y - x[0]) + three]

    tape = trace(model, {"x": ["a", "b"]})
    np.testing.assert_allclose(values(tape), [[float(v) for v in model(p)] for p in POINTS.T], rtol=1e-12, atol=1e-13)
    assert len(networks_of(tape)) == 2


def test_a_part_of_a_network_that_was_called_stays_one() -> None:
    graph = Graph(["a"])
    rows = [[float(k)] for k in range(1, 4)]
    network = Network(layers=tuple(Layer(tuple(map(tuple, rows)), (0.0,) * 3, "tanh") for _ in range(1)))
    tape = graph.tape([graph.part(Part(network, 0), (graph.input(0),))], (1,))
    assert with_layers(tape) is tape
