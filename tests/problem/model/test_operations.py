"""Every column of the prover's table says the same function, for every operation that a tape may hold."""

from __future__ import annotations

import itertools

import casadi
import numpy as np
import pytest

from certbound.problem.adapters.casadi import from_casadi, to_casadi
from certbound.problem.files.formulas import formulas
from certbound.problem.files.parser import parse
from certbound.problem.model import Graph, Node, Tape, compile_numpy, edged, jacobian
from certbound.problem.model.operations import OPERATIONS, enclosed, operands, undefined_where
from certbound.problem.model.tape import ARITY, JUMPS
from certbound.reach.nominal.series import expand
from certbound.rigor.intervals import Interval
from tests.simulation.test_tape_text import run

EXPONENT = 2.5
TAME = [(0.3, 0.7), (0.8, 0.4), (0.45, 0.55)]
"""Points at which everything is defined and nothing jumps."""

every_operation = pytest.mark.parametrize("op", sorted(OPERATIONS))


def node_of(op: str) -> Node:
    return Node(op, tuple(range(ARITY[op])), EXPONENT if op == "pow" else 0.0)


def tape_of(op: str) -> Tape:
    nodes = (Node("input", (0,)), Node("input", (1,)), node_of(op))
    return Tape(inputs=("a", "b"), nodes=nodes, outputs=(2,), shape=(1,))


def boxes(op: str, count: int = 400) -> list[Interval]:
    """Random intervals, many of them across 0, across +-1, or points."""
    rng = np.random.default_rng(len(op))
    middle, edge = rng.normal(size=(2, count)), rng.choice([-1.0, 0.0, 1.0], (2, count))
    middle = np.where(rng.random((2, count)) < 0.3, edge, middle)
    radius = np.abs(rng.normal(size=(2, count))) * 10.0 ** rng.uniform(-12, 0, (2, count))
    radius[rng.random((2, count)) < 0.2] = 0.0
    return [Interval(m - r, m + r) for m, r in zip(middle, radius)][: ARITY[op]]


def points(args: list[Interval]) -> list[list[np.ndarray]]:
    """Ends and inner points of boxes, in every combination."""
    shares = (0.0, 0.37, 0.5, 1.0)
    choices = [[np.clip(x.lo + share * (x.hi - x.lo), x.lo, x.hi) for share in shares] for x in args]
    return [list(choice) for choice in itertools.product(*choices)]


def values(op: str, args: list[np.ndarray]) -> np.ndarray:
    with np.errstate(all="ignore"):
        return np.asarray(OPERATIONS[op].numpy(*operands(node_of(op), args)), dtype=float)


def test_the_table_has_every_operation_of_a_tape_and_says_which_jump() -> None:
    assert set(OPERATIONS) == ARITY.keys() - {"const", "input"}
    assert {op for op, row in OPERATIONS.items() if row.jump} == JUMPS | {"atan2"}
    for op, row in OPERATIONS.items():
        assert len(row.slopes) == (0 if op in JUMPS | {"kink"} else ARITY[op]), op


@every_operation
def test_the_range_holds_the_values_and_what_is_undefined_is_said(op: str) -> None:
    args = boxes(op)
    found, undefined = enclosed(node_of(op), args), undefined_where(node_of(op), args)
    everywhere = np.ones(args[0].shape, dtype=bool) if undefined is None else ~undefined
    assert everywhere.sum() > 50
    for point in points(args):
        value = values(op, point)
        assert np.all(np.isfinite(value[everywhere]))
        assert np.all(found.contains(value)[everywhere])


@every_operation
def test_what_is_decided_does_not_jump_and_has_no_kink(op: str) -> None:
    """Beside its jumps an operation is continuous, beside its kinks its slope is."""
    row, args = OPERATIONS[op], [x.hull(x + 1e-9) for x in boxes(op)]
    undefined = undefined_where(node_of(op), args)
    decided = np.ones(args[0].shape, dtype=bool) if undefined is None else ~undefined
    if row.jump is not None:
        decided = ~row.jump(enclosed(node_of(op), args), *args)
    elif op == "kink":  # which is all of [-1, 1] at 0
        decided = ~row.kink(*args)
    tape, size = tape_of(op), sum(np.max(np.abs([x.lo, x.hi]), axis=0) for x in args)
    ends = [[x.lo for x in args], [x.lo + 1e-9 for x in args]]
    first, second = (values(op, end) for end in ends)
    tame = decided & (size < 5)
    slopes = [compile_numpy(jacobian(tape))(*end, *[0.0] * (2 - len(args)))[:, 0] for end in ends]
    steep = 1 + np.sum(np.abs(slopes[0]) + np.abs(slopes[1]), axis=1)
    assert np.all((np.abs(first - second) <= 1e-8 * steep)[tame & np.isfinite(steep)])
    if row.kink is None:
        assert not edged(jacobian(tape)) or op in JUMPS
    else:
        assert edged(tape)
        smooth = tame & ~row.kink(*args)
        assert 50 < smooth.sum() < len(smooth)
        np.testing.assert_array_equal(slopes[0][smooth], slopes[1][smooth])


@every_operation
def test_kernels_compute_the_values(op: str) -> None:
    for point in [*TAME, (0.3, -1.2), (-1.2, 0.3), (0.5, 0.5), (0.0, 2.0)]:
        expected = compile_numpy(tape_of(op))(*point)
        if np.isfinite(expected):
            np.testing.assert_allclose(run(tape_of(op), *point), expected, rtol=1e-14, atol=0)


@every_operation
def test_the_derivative_is_that_of_the_values(op: str) -> None:
    tape = tape_of(op)
    for point in TAME:
        step = 1e-6 * np.eye(2)
        expected = [(compile_numpy(tape)(*(point + d)) - compile_numpy(tape)(*(point - d)))[0] / 2e-6 for d in step]
        np.testing.assert_allclose(compile_numpy(jacobian(tape))(*point)[0], expected, rtol=1e-7, atol=1e-8)


@every_operation
def test_series_begin_with_the_derivatives_along_a_line(op: str) -> None:
    """x = a + 0.7 s, y = b - 0.4 s: coefficients 0 to 3 against derivatives of derivatives, and none is wide."""
    first = tape_of(op)
    second, third = jacobian(jacobian(first)), jacobian(jacobian(jacobian(first)))
    direction = np.array([0.7, -0.4]) * ([0, 1] if op == "if_else_zero" else 1)
    for a, b in TAME if op != "if_else_zero" else [(0.0, 0.7), (1.0, 0.4)]:  # a condition is 0 or 1
        thin = [[Interval.point(np.array([p])), Interval.point(d)] for p, d in zip((a, b), direction)]
        expected = [
            float(compile_numpy(first)(a, b)[0]),
            float(compile_numpy(jacobian(first))(a, b).reshape(2) @ direction),
            float(direction @ compile_numpy(second)(a, b).reshape(2, 2) @ direction) / 2,
            float(compile_numpy(third)(a, b).reshape(8) @ np.kron(np.kron(direction, direction), direction)) / 6,
        ]
        for coefficient, value in zip(expand(first, thin, 3)[0], expected):
            assert coefficient.width < 1e-12 * (1 + abs(value))
            np.testing.assert_allclose(coefficient.mid, value, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("op", sorted(op for op, row in OPERATIONS.items() if row.at_zero is not None))
def test_what_is_folded_at_zero_is_the_value_there(op: str) -> None:
    zero = OPERATIONS[op].interval(Interval.point(0.0))
    assert float(OPERATIONS[op].numpy(0.0)) == OPERATIONS[op].at_zero
    assert zero.contains(OPERATIONS[op].at_zero)
    graph = Graph(["a"])
    assert graph.number(graph.apply(op, graph.const(0.0))) == OPERATIONS[op].at_zero


@every_operation
def test_files_read_and_write_what_they_may_call(op: str) -> None:
    graph = Graph(["a", "b"])
    names = {"a": graph.input(0), "b": graph.input(1)}
    text = f"{op}({', '.join('ab'[: ARITY[op]])})"
    if op == "not":  # a word, and no function
        assert formulas(graph.tape([parse(text, graph, names, "dynamics.a")], (1,)), iter("c")) == ({}, ["not a"])
        return
    if not OPERATIONS[op].in_files:
        with pytest.raises(ValueError, match=r"unknown function|expected a value"):
            parse(text, graph, names, "dynamics.a")
        return
    tape = graph.tape([parse(text, graph, names, "dynamics.a")], (1,))
    assert tape.nodes[-1].op == op
    assert formulas(tape, iter("c")) == ({}, [text])


@every_operation
def test_casadi_computes_the_same_and_gives_it_back(op: str) -> None:
    tape, symbols = tape_of(op), casadi.SX.sym("x", 2)
    expression = to_casadi(tape, [symbols])
    for point in [*TAME, (-0.5, 0.25), (0.0, 0.5)]:
        expected = compile_numpy(tape)(*point)[0]
        if np.isfinite(expected):
            found = float(casadi.Function("f", [symbols], [expression])(point))
            np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)
    if op != "kink":  # which CasADi only knows as a sign
        assert from_casadi(expression, [symbols], ["a", "b"], (1,)).nodes[-1].op == op
