"""Paths that end where they leave the domain: bounds around the truth, simulated alike, stated as what they are."""

import json
import math
from unittest.mock import patch

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.files.loading import loads
from certbound.safety.certificate import problem_data
from certbound.values.continuous.line import ladder
from certbound.values.discrete import bound_failure, bound_long_run

TEXT = """
time = "discrete"
horizon = 8
states = ["x"]

[dynamics]
x = "0.9*x + 0.05"

[noise]
law = "{law}"
{level}

[initial]
point = [0.2]

[[stay]]
halfspace = {{ normal = {{ x = 1 }}, bound = 0.6 }}

[domain]
box = {{ x = [-0.5, 1] }}
leaving = "ends"
"""
GAUSSIAN = TEXT.format(law="gaussian", level="std = 0.3")
UNIFORM = TEXT.format(law="uniform", level="halfwidth = 0.5")


def truth(problem, horizon=8):
    """P(in (0.6, 1] before outside [-0.5, 1]), by Gauss's rule on 400 nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    x, w = 0.05 + 0.55 * nodes, 0.55 * weights  # [-0.5, 0.6]

    def over(y, low, high):
        m = 0.9 * y + 0.05
        if problem.system.noise.uniform:
            return np.clip((np.minimum(high, m + 0.5) - np.maximum(low, m - 0.5)), 0, None)
        cdf = np.vectorize(lambda z: 0.5 * math.erfc(-z / math.sqrt(2)))
        return cdf((high - m) / 0.3) - cdf((low - m) / 0.3)

    def density(y):
        gap = x[None, :] - (0.9 * y + 0.05)[:, None]
        return np.where(np.abs(gap) <= 0.5, 1.0, 0.0) if problem.system.noise.uniform else (
            np.exp(-0.5 * (gap / 0.3) ** 2) / (0.3 * math.sqrt(2 * math.pi))
        )

    value = np.zeros(len(x))
    start = np.array([0.2])
    for step in range(horizon):
        last = step == horizon - 1
        y = start if last else x
        value = over(y, 0.6, 1.0) + (density(y) * w) @ value
    return float(value[0])


@pytest.mark.parametrize("text", [GAUSSIAN, UNIFORM], ids=["gaussian", "uniform"])
def test_who_leaves_the_domain_has_ended(text):
    problem = loads(text)
    found, exact = bound_failure(problem, seconds=0.3), truth(problem)
    slack = 0.0 if problem.system.noise.gaussian else 0.004  # Gauss's rule across jumps
    assert found.lower - slack <= exact <= found.upper + slack
    assert found.upper <= 1.1 * found.lower
    counts = cb.simulate_exits(problem, paths=40_000, rng=0, confidence=0.9999)
    assert counts.lower <= exact <= counts.upper
    assert list(counts.by_constraint) == ["x <= 0.6"]
    counted = bound_failure(problem.replace(leaving="unsafe"), seconds=0.3)
    assert counted.lower > found.upper


def test_it_needs_a_domain_and_one_of_two_words():
    problem = loads(GAUSSIAN)
    with pytest.raises(ValueError, match='`leaving` must be "unsafe" or "ends", got \'stops\''):
        problem.replace(leaving="stops")
    with pytest.raises(ValueError, match="give a domain"):
        problem.replace(domain=None)
    with pytest.raises(ValueError, match="`domain` must have a bound"):
        problem.replace(domain=cb.Box([-np.inf], [np.inf]))
    with pytest.raises(ValueError, match=r"domain\.leaving"):
        loads(GAUSSIAN.replace('"ends"', '"stops"'))
    with pytest.raises(InfeasibleError, match="bounds every state"):
        bound_failure(problem.replace(domain=cb.Box([-0.5], [np.inf])))
    with pytest.raises(InfeasibleError, match="count leaving the domain as failing"):
        bound_long_run(problem.replace(horizon=math.inf))
    with pytest.raises(InfeasibleError, match="count leaving the domain as an exit"):
        cb.bound_exit_times(problem)


def test_other_certificates_count_leaving_as_failing():
    problem = loads(GAUSSIAN).replace(domain=cb.Box([-9], [9]), safe=[cb.Inside(cb.HalfSpace([1], 8))], delta=0.01)
    text = cb.verify_safety(problem, method="linear").certificate_text(problem)
    assert check_data(parse(text)).valid
    forged = json.loads(text)
    forged["problem"]["leaving"] = "starts"
    with pytest.raises(CertificateError, match="leaving` must be"):
        check_data(forged)
    below = json.loads(text)
    below["claim"] |= {"log10_delta": 0.0.hex(), "log10_lower": (-1.0).hex()}
    with pytest.raises(CertificateError, match="must not be there where a path ends"):
        check_data(below)
    assert problem_data(problem)["leaving"] == "ends"


def test_value_functions_count_it_in_continuous_time_and_other_engines_say_nothing_from_below():
    system = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=0.5)
    problem = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.HalfSpace([1], 1))], horizon=1, domain=cb.Box([-0.5], [2]),
        leaving="ends", delta=1e-3,
    )  # fmt: skip
    with patch.object(ladder, "LADDER", ((1.5, 1e-2, 0.1), (2.5, 1e-3, 0.03))):
        verdict = cb.verify_safety(problem, method="values", time_limit=5)
    assert verdict.status == "UNSAFE"
    assert -3 < verdict.log10_lower < verdict.log10_delta
    assert cb.verify_safety(problem, method="linear").log10_lower is None
