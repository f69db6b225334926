"""Jumps that time alone decides, by the exact floats of their constants: prover, simulator and checker say the same."""

from __future__ import annotations

import json
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError
from certbound.problem.files.loading import loads
from certbound.safety.certificate import certificate_text, problem_data

Data = dict[str, Any]

TEXT = """
time = "continuous"
horizon = HORIZON
delta = 1e-3
states = ["x"]
[parameters]
start = 0.1
delay = 0.2
stop = 0.3
[dynamics]
x = "FIELD"
[noise]
diffusion = [[0.1]]
[initial]
point = [0]
[[stay]]
box = { x = [-1, 1] }
"""
DELAYED = "where(t - start < delay + t - stop, 50, 0)"
ADDED = "where(0.3 < ((t + 0.1) - t) + 0.2, 50, 0)"


def given(field: str, horizon: str = "2") -> cb.Problem:
    return loads(TEXT.replace("FIELD", field).replace("HORIZON", horizon))


def stated(problem: cb.Problem) -> Data:
    return json.loads(json.dumps(problem_data(problem)))  # type: ignore[no-any-return]


def certified(problem: cb.Problem, method: str = "linear") -> Data:
    return parse(certificate_text(problem, cb.verify_safety(problem, method=method)))


def raw(*nodes: list[Any]) -> Data:
    """Dynamics whose last node is the derivative."""
    kept = [[op, *(x.hex() if isinstance(x, float) else x for x in rest)] for op, *rest in nodes]
    return {"nodes": kept, "outputs": [len(kept) - 1]}


@pytest.mark.parametrize("jump", ["where(t < 1, 0.2, -0.2)", "0"])
@pytest.mark.parametrize("field", [DELAYED, ADDED])
def test_a_comparison_that_rounding_flips_is_refused_with_the_cure(field: str, jump: str) -> None:
    with pytest.raises(ValueError, match=r"rounding decides, got .*Compare with one number"):
        given(f"-x + {jump} + {field}")


def test_a_function_with_such_a_comparison_is_refused_too() -> None:
    system = cb.ContinuousSystem(
        lambda t, x: -x + np.where(t - 0.1 < 0.2 + t - 0.3, 50, 0), states=["x"], diffusion=0.1
    )
    with pytest.raises(ValueError, match="rounding decides"):
        cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2)


def test_the_checker_refuses_them_by_itself() -> None:
    data = certified(given("-x + where(t < 1, 0.2, -0.2)"))
    data["problem"]["dynamics"] = raw(
        ["input", 0], ["const", 0.1], ["sub", 0, 1], ["const", 0.2], ["add", 3, 0], ["const", 0.3], ["sub", 4, 5],
        ["lt", 2, 6], ["const", 50.0], ["if_else_zero", 7, 8], ["input", 1], ["sub", 9, 10],
    )
    with pytest.raises(CertificateError, match="rounding decides"):
        check_data(data)


def test_constants_are_compared_as_floats() -> None:
    """0.1 + 0.2 is more than 0.3, in exact arithmetic on floats and in rounded one: everything leaves."""
    problem = given("-x + where(0.1 + 0.2 > 0.3, 50, 0)")
    assert cb.verify_safety(problem, method="linear").status != "SAFE"
    assert cb.simulate_exits(problem, paths=200, rng=1, halve=False).exits == 200
    data = certified(given("-x"))
    data["problem"] = stated(problem)
    report = check_data(data, stated(problem))
    assert not report.valid
    for count in (1, 2):
        jumping = deepcopy(data)
        jumping["proof"]["jumps"] = count
        assert not check_data(jumping, stated(problem)).valid


def test_nodes_that_no_output_needs_are_refused() -> None:
    problem = given("-x + where(0.1 + 0.2 > 0.3, 50, 0)")
    data = certified(given("-x"))
    data["problem"] = stated(problem)
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes += [["input", 0], ["const", (1.0).hex()], ["lt", len(nodes), len(nodes) + 1]]
    data["proof"]["jumps"] = 2
    with pytest.raises(CertificateError, match="no output needs it"):
        check_data(data, stated(problem))


@pytest.mark.parametrize(
    ("field", "horizon"),
    [
        ("-x + where(t < 0.3, 0.2, -0.2)", "1"), ("-x + 0.1*(t < 1/3)", "1"), ("min(0.1*t, 0.3) - x", "6"),
        ("-x + where(t < 0.1, 0.2, where(t < 0.7, 0, 0.1))", "0.9"), ("where(t < 0.3, -x, -2*x) + 0.1", "0.6"),
        ("-x + where(t < 0.3, 0.2, 0)", "0.3"), ("-x + where(t < 3*0.1, 0.2, 0)", "0.3"),
    ],
)
@pytest.mark.parametrize("method", ["linear", "kummer"])
def test_jumps_at_times_that_are_no_ends_of_equal_pieces_are_proved(field: str, horizon: str, method: str) -> None:
    problem = given(field, horizon)
    data = certified(problem, method)
    report = check_data(data, stated(problem))
    assert report.valid, report.reason


@pytest.mark.parametrize("method", ["linear", "kummer"])
def test_what_a_jump_does_between_two_floats_is_paid_for(method: str) -> None:
    """From 0.3 to 0.1 + 0.2 it is 2.8e-17 s, in which a push of 1e17 moves x by 2.8, and one of 10 by nothing."""
    harmless, push = (f"-x + where(t < 0.3, 0.2, where(t < 0.1 + 0.2, {size}, 0))" for size in ("10", "1e17"))
    good, bad = given(harmless, "1"), given(push, "1")
    assert cb.verify_safety(bad, method=method).status != "SAFE"
    data = certified(good, method)
    assert check_data(data, stated(good)).valid
    data["problem"] = stated(bad)
    assert not check_data(data, stated(bad)).valid


@pytest.mark.parametrize("method", ["linear", "kummer"])
@pytest.mark.parametrize("other", ["0.30001", "0.3 + 1e-12", "0.31"])
def test_a_jump_at_another_time_is_another_function(method: str, other: str) -> None:
    data = certified(given("-x + where(t < 0.3, 0.2, -0.2)", "1"), method)
    moved = given(f"-x + where(t < {other}, 0.2, -0.2)", "1")
    data["problem"] = stated(moved)
    assert not check_data(data, stated(moved)).valid
