"""A check ends within its limits on time and memory, whatever the file asks for, and never by a crash."""

from __future__ import annotations

import time
from typing import Any

import pytest
from flint import arb, arb_mat

from certbound.checker import check_data, parse
from certbound.checker.balls.matrices import is_positive_definite
from certbound.checker.expressions.expansion import Expansion
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.program import Program
from certbound.checker.expressions.quadratic import Quadratic
from certbound.checker.linear.events import sub_gaussian
from certbound.checker.report import Budget, Unproved
from certbound.errors import CertificateError
from certbound.safety.answers import exact
from tests.checker import lasting_forgeries  # noqa: F401  # they enter themselves into the table
from tests.checker.forgeries import text
from tests.checker.test_adversary import linear

Data = dict[str, Any]


def halving(n: int, steps: int, constraints: list[Data], proof: Data) -> Data:
    """A certificate about x+ = x/2 + w from 0."""
    nodes: list[list[Any]] = []
    outputs = []
    for i in range(n):
        nodes += [["input", 1 + i], ["const", exact(0.5)], ["mul", len(nodes), len(nodes) + 1]]
        outputs.append(len(nodes) - 1)
    return {
        "format": "certbound certificate", "version": 1, "proof": proof,
        "claim": {"log10_delta": exact(-1.0), "method": proof["engine"], "assumptions": []},
        "problem": {
            "name": "halving", "time": "discrete", "horizon": exact(float(steps)), "delta": exact(0.1),
            "states": [f"x{i}" for i in range(n)], "inputs": [], "disturbances": [], "plan": None,
            "dynamics": {"nodes": nodes, "outputs": outputs}, "disturbance_set": [], "domain": None,
            "noise": {"law": "gaussian", "level": "std", "values": exact([0.01]), "matrix": exact([[1.0]] * n)},
            "initial": {"kind": "box", "low": exact([0.0] * n), "high": exact([0.0] * n)},
            "constraints": constraints,
        },
    }  # fmt: skip


def box(n: int, low: Any, high: Any) -> Data:
    region = {"kind": "box", "low": low, "high": high, "center": None, "coordinates": None}
    return {"kind": "inside", "region": region, "during": None, "label": f"a box of {n}"}


def by_constants(n: int, steps: int, count: int) -> Data:
    proof = {
        "engine": "constants", "assumed": True, "metric": None, "region": "everywhere", "times": None,
        "middles": None, "rate": exact(0.6), "sigma": exact(0.1), "nu": exact(float(n)), "start_sigma": exact(0.0),
        "splits": exact([[0.0, 0.0]] * n), "rooms": exact([0.1] * (steps + 1)),
        "kummer": {"form": "kummer", "a": exact(1.0), "v0": exact(1.0)},
        "cells": [{
            "nominal": exact([[[0.0] * n]] * (steps + 1)), "eta": exact([1e-9] * steps),
            "radius": exact([1e-6] * (steps + 1)), "separations": [None] * count,
        }],
    }  # fmt: skip
    return halving(n, steps, [box(n, exact([-1.0] * n), exact([1.0] * n))] * count, proof)


def by_response(n: int, steps: int, constraints: list[Data]) -> Data:
    zeros = exact([0.0] * n)
    cell = {
        "nominal": [zeros] * (steps + 1), "slopes": [[]] * steps, "drifts": None, "gains": [[]] * steps,
        "remainder_low": [zeros] * steps, "remainder_high": [zeros] * steps, "rows": [[]] * steps,
        "levels": [[]] * steps, "window_levels": None, "frames": [None] * n, "separations": [None] * len(constraints),
    }  # fmt: skip
    return halving(n, steps, constraints, {
        "engine": "linear", "splits": exact([[0.0, 0.0]] * n), "pieces": steps, "varying": [], "moving": [],
        "units": [], "windows": None, "cells": [cell],
    })  # fmt: skip


def test_these_certificates_are_proved_where_they_are_small() -> None:
    assert check_data(by_constants(2, 3, 2)).log10_proved is not None
    assert check_data(by_response(2, 3, [box(2, exact([-1.0, -1.0]), exact([1.0, 1.0]))])).valid


@pytest.mark.parametrize("data", [by_constants(60, 2000, 20), by_constants(2, 20_000, 1)], ids=["rooms", "steps"])
def test_a_limit_on_time_holds_in_every_loop(data: Data) -> None:
    started = time.monotonic()
    report = check_data(data, seconds=0.3)
    assert "limit of 0.3 s" in report.reason
    assert time.monotonic() - started < 4.0  # to read it, and what is between two looks at the clock


def test_a_file_that_asks_for_gigabytes_is_refused_before_they_are_taken() -> None:
    report = check_data(by_response(100, 1000, []))
    assert not report.valid
    assert "more memory than its limit" in report.reason
    n = 400
    with pytest.raises(CertificateError, match="more memory"):
        check_data(by_response(n, 1, [box(n, [None] * n, [None] * n)] * 900))


def test_an_expression_of_many_products_is_refused_before_it_fills_the_memory() -> None:
    n = 20
    for balls, fits in ((30_000, True), (10_000, False)):
        graph = Graph(Budget(60, balls=balls))
        node = graph.sum(graph.input(i) for i in range(n))
        for _ in range(30):
            node = graph.apply("sin", node)
        expansion = Expansion(graph, node, node, variables=n)
        expansion.prepare([])
        inputs = [(arb(0), {i: arb(0.01)}) for i in range(n)]
        if fits:
            for _ in range(5):  # what one box takes is given back before the next
                assert expansion.run(inputs, n).value == 0
        else:
            with pytest.raises(Unproved, match="memory"):
                expansion.run(inputs, n)


def test_what_is_held_in_passing_is_given_back() -> None:
    budget = Budget(60, balls=10)
    with budget.passing():
        budget.hold(9)
    budget.hold(10)
    with pytest.raises(Unproved, match="memory"):
        budget.hold(1)


def test_programs_and_matrices_keep_the_time() -> None:
    late = Budget(-1.0)
    with pytest.raises(Unproved, match="limit"):
        is_positive_definite(arb_mat(1, 1, [1]), late)
    graph = Graph(late)
    with pytest.raises(Unproved, match="limit"):
        Program(graph, [graph.const(1.0)], variables=0)


def test_a_box_without_sides_is_undecided_and_no_crash() -> None:
    """An output that depends on no state, and a box of its remainder as thin as rounding."""
    point = Quadratic(value=arb(0, 1e-9), gradient=[], hessian=[], radius=[], error=arb(0), smear=[])
    assert point.stays(arb(0), arb(0), []) is None
    data = linear()
    tape = data["problem"]["dynamics"]
    n = len(tape["nodes"])
    tape["nodes"] += [["const", exact(1.0)], ["sin", n], ["sub", n + 1, n + 1], ["add", tape["outputs"][0], n + 2]]
    tape["outputs"] = [n + 3]
    cell = data["proof"]["cells"][0]
    cell["remainder_low"] = cell["remainder_high"] = exact([[0.0]] * 4)
    assert "was not shown to stay in its box" in check_data(data).reason


@pytest.mark.parametrize(("op", "value"), [("log", -1.0), ("sqrt", -1.0), ("asin", 2.0), ("div", 0.0)])
def test_a_derivative_that_is_not_defined_is_a_refusal(op: str, value: float) -> None:
    data = linear()
    tape = data["problem"]["dynamics"]
    n = len(tape["nodes"])
    tape["nodes"] += [["input", 1], ["const", exact(value)]]
    tape["nodes"] += [["div", n, n + 1]] if op == "div" else [[op, n + 1], ["mul", n, n + 2]]
    tape["nodes"].append(["add", tape["outputs"][0], len(tape["nodes"]) - 1])
    tape["outputs"] = [len(tape["nodes"]) - 1]
    assert "is not defined" in check_data(data).reason


def test_a_variance_that_is_negative_or_no_number_is_refused_where_it_is_read() -> None:
    for variance in (arb(-1), arb.nan()):
        with pytest.raises(Unproved, match="a variance is negative"):
            sub_gaussian([[arb(1)]], [arb(1)], [arb_mat(1, 1, [variance])], Budget(10))
    assert sub_gaussian([[arb(1)]], [arb.nan()], [arb_mat(1, 1, [arb(0)])], Budget(10)) >= 1


def grown(op: str, first: list[Any], count: int, *more: list[Any]) -> Data:
    """A tape that does the same to its own last value again and again."""
    nodes: list[list[Any]] = [first]
    for place in range(count):
        nodes.append([op, place, *{"mul": [place], "pow": [exact(20.0)]}.get(op, [])])
    return {"nodes": [*nodes, *more], "outputs": [len(nodes) + len(more) - 1]}


@pytest.mark.parametrize(
    "tape",
    [grown("sq", ["input", 1], 30), grown("pow", ["const", exact(1.1)], 8), grown("sq", ["const", exact(3.0)], 40)],
)
def test_polynomials_of_any_degree_and_length_end_soon(tape: Data) -> None:
    data, started = parse(text("drift")), time.process_time()
    data["problem"]["dynamics"] = tape
    assert "too high a degree" in check_data(data).reason
    assert time.process_time() - started < 1


def test_fractions_of_any_length_end_soon_where_the_clock_decides() -> None:
    data, started = parse(text("switched")), time.process_time()
    nodes, outputs = data["problem"]["dynamics"]["nodes"], data["problem"]["dynamics"]["outputs"]
    for op, size, count in (("mul", 1.1, 40), ("mul", 3.0, 40), ("mul", 1e308, 1)):
        first = len(nodes)
        nodes += [["const", exact(size)], *[[op, first + k, first + k] for k in range(count)]]
        nodes += [["floor", len(nodes) - 1], ["add", outputs[0], len(nodes)]]
        outputs[0] = len(nodes) - 1
    with pytest.raises(CertificateError, match="rounding decides"):
        check_data(data)
    assert time.process_time() - started < 2


def test_no_pieces_of_time_where_it_has_no_end() -> None:
    data = parse(text("lasting"))
    data["proof"]["jumps"] = 2
    with pytest.raises(CertificateError, match="endless"):
        check_data(data)
