"""Jumps that time alone decides are piece boundaries: found exactly, and the function stays the same beside them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import scipy.stats

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError
from certbound.problem.files.loading import loads
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.model import between_jumps, compile_numpy
from certbound.safety.certificate import certificate_text, problem_data

TEXT = """
time = "continuous"
horizon = HORIZON
delta = 1e-3
states = ["x"]
[dynamics]
x = "FIELD"
[noise]
diffusion = [[0.1]]
[initial]
point = [0]
[[stay]]
box = { x = [-1, 1] }
"""


def given(field: str, horizon: str = "10") -> cb.Problem:
    return loads(TEXT.replace("FIELD", field).replace("HORIZON", horizon))


@pytest.mark.parametrize(
    ("field", "horizon", "pieces"),
    [
        ("-x + where(t < 5, 0.2, -0.2)", "10", 2),
        ("-x + 0.2*sign(t - 3)", "10", 10),
        ("-x + 0.1*(0.3 <= t)", "1", 10),
        ("-x + 0.1*floor(t/2)", "6", 3),
        ("-x + 0.1*(t < 1/3)", "10", 30),
        ("-x + 0.1*(t - 2*floor(t/2) < 1)", "8", 8),
        ("-x + 0.2*sign(3*(4 - t) - 6)", "10", 5),
        ("where(t < 1 or (t > 2 and not t == 3), -x, -2*x)", "4", 4),
        ("-x + 0.1*where(t < 5, sin(t), where(t < 20, t, 7))", "10", 2),
        ("-x + where(t < 10, 0.2, -0.2)", "10", 1),
        ("-x + min(0.1*t, 0.3)", "6", 2),
        ("-x + min(0.1*t, 0.3)", "3", 1),
        ("-x + 0.1*max(0, min(1, (t - 2)/3)) + 0.05*abs(t - 4)", "10", 10),
        ("-x + 0.1*max(-floor(t/5), sin(t), t/10)", "10", 2),
        ("-x + where(t > 0, 0.2, -0.2)", "10", 1),
        ("-x + 0.1*floor(t/5 + 0.5)*where(t < 10, 1, 0)", "10", 4),
    ],
)
def test_a_jump_at_a_known_time_lies_between_two_pieces(field, horizon, pieces):
    problem = given(field, horizon)
    cut = in_pieces(problem)
    assert len(cut.plan) == pieces
    before, after = compile_numpy(problem.closed_loop), compile_numpy(cut.closed_loop)
    rng = np.random.default_rng(0)
    for t in rng.uniform(0, float(horizon), 40):
        row = cut.plan[int(t / float(horizon) * pieces)]
        assert after(t, 0.3, *row) == pytest.approx(before(t, 0.3), abs=0)


def test_a_jump_that_misses_the_end_of_its_piece_is_told() -> None:
    """0.3 and 0.1 + 0.2 as floats: two jumps about the end of the third tenth, and what holds in between."""
    cut = in_pieces(given("-x + where(t < 0.3, 0.2, where(t < 0.1 + 0.2, 7, 0.1))", "1"))
    change = cut.changes[3]
    assert (change.first, change.last) == (Fraction(0.3), Fraction(0.1) + Fraction(0.2))
    before, after = cut.plan[2], cut.plan[3]
    assert (np.array(change.low) <= np.minimum(before, after)).all()
    values = compile_numpy(cut.closed_loop)
    between = [values(0.3, 0.0, *row)[0] for row in itertools.product(*zip(change.low, change.high))]
    assert max(between) >= 7
    assert values(0.2, 0.0, *before) == 0.2
    assert values(0.4, 0.0, *after) == 0.1
    exact = in_pieces(given("-x + where(t < 0.5, 0.2, 0)", "1"))
    assert [(one.first, one.last) for one in exact.changes] == [(k, k) for k in (0, Fraction(1, 2), 1)]


def test_jumps_that_no_float_names_do_not_part_the_noise() -> None:
    system = cb.ContinuousSystem(lambda t, x: np.where(3 * t < 1, x, 2 * x), states=1, diffusion=1.0)
    assert between_jumps(system.dynamics, 1, 1.0) == [(1.0, system.dynamics)]


def test_in_discrete_time_every_step_is_decided_or_refused() -> None:
    """0.1*t <= 0.9 is false of the ninth step on floats, and true after rounding."""

    def walk(test: Callable[[Any], Any]) -> cb.Problem:
        system = cb.DiscreteSystem(lambda t, x: [0.5 * x[0] + np.where(test(t), 5.0, 0.0)], states=["x"])
        return cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=10)

    with pytest.raises(ValueError, match=r"rounding decides, got .* at a step"):
        walk(lambda t: 0.1 * t <= 0.9)
    assert walk(lambda t: 0.1 * t <= 0.85).horizon == 10


@pytest.mark.parametrize(
    "field",
    [
        "-x + 0.1*min(t, x)", "-x + 0.1*abs(t - 0.12345)", "-x + 0.1*abs(sin(t))",
        "-x + 0.1*sign(x)", "-x + 0.2*sign(sin(t))", "-x + 0.1*(t < x)", "-x + 0.1*(t < 20)", "-x + 0.1*(t < 0.12345)",
        "-x",
    ],
)
def test_what_no_equal_pieces_end_at_is_left_as_it_is(field):
    problem = given(field)
    assert in_pieces(problem) is problem


def test_an_array_plan_and_discrete_time_are_left_as_they_are():
    system = cb.ContinuousSystem(
        lambda t, x, u: [-x[0] + u[0] + np.where(t < 1, 0.1, 0.0)], states=["x"], inputs=cb.Box([-1], [1]),
        diffusion=0.1,
    )
    safe = [cb.Inside(cb.Box([-1], [1]))]
    planned = cb.Problem(system, initial=[0], safe=safe, horizon=2, plan=[[0.1], [0.2], [0.0]])
    assert in_pieces(planned) is planned
    steps = cb.DiscreteSystem(lambda t, x: [0.5 * x[0] + np.where(t < 1, 0.1, 0.0)], states=["x"])
    walk = cb.Problem(steps, initial=[0], safe=safe, horizon=2)
    assert in_pieces(walk) is walk


def test_the_linear_response_is_near_the_truth_beside_a_jump_and_certificates_say_so():
    """The normal law of an Ornstein-Uhlenbeck process just before its push turns."""
    problem = given("where(t < 2, -x + 0.5, -2*x - 0.1)", "4").replace(safe=[cb.Inside(cb.HalfSpace([1.0], 0.75))])
    verdict = cb.verify_safety(problem, method="linear")
    mean, std = 0.5 * (1 - np.exp(-2)), np.sqrt(0.005 * (1 - np.exp(-4)))
    alone = float(scipy.stats.norm.logsf((0.75 - mean) / std)) / np.log(10)
    assert alone < verdict.log10_delta < alone + 1
    data = parse(certificate_text(problem, verdict))
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    for wrong, why in ((3, "no jump"), (5, "no jump"), (1, "no jump")):
        data["proof"]["jumps"] = wrong
        assert why in check_data(data).reason
    for wrong in (0, 2000, True):
        data["proof"]["jumps"] = wrong
        with pytest.raises(CertificateError, match="jumps"):
            check_data(data)


@pytest.mark.parametrize("field", ["where(t < 2, 0.1, 7) - x", "min(0.5*t, 0.3) - abs(t - 0.6) - x"])
def test_a_jump_at_the_very_end_is_none_and_bends_have_certificates(field):
    problem = given(field, "2").replace(safe=[cb.Inside(cb.Box([-2], [1]))])
    verdict = cb.verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    data = parse(certificate_text(problem, verdict))
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    if "min" in field:
        data["proof"]["jumps"] = 3
        assert not check_data(data).valid


def test_reach_tubes_and_noise_free_violations_see_the_jump():
    late = given("-x + where(t < 5, 0.2, 1.5)")
    assert cb.verify_safety(late).status == "UNSAFE_NOMINAL"
    tube = cb.bound_reach(given("-x + where(t < 5, 0.2, -0.2)"), noise=False)
    assert tube.end == 10
