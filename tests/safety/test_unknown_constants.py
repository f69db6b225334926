"""Unknown constants: bounds hold for every value, nothing is said from below, and files keep them apart."""

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.files.loading import load, loads, save
from certbound.simulation.stepping import Scenario

TEXT = """
time = "discrete"
horizon = 8
delta = 0.2
states = ["x"]
[uncertain]
gain = [0.7, 0.9]
[disturbances]
push = [-0.01, 0.01]
[dynamics]
x = "gain*x + push"
[noise]
law = "gaussian"
std = 0.25
[initial]
point = [0.3]
[[stay]]
box = { x = [-1, 1] }
"""


def test_the_bound_holds_for_every_value_and_nothing_is_said_from_below():
    problem = loads(TEXT)
    assert problem.unknown == ("gain",)
    verdict = cb.verify_safety(problem, method="values")
    varying = cb.verify_safety(problem.replace(unknown=()), method="values")
    assert verdict.log10_delta == varying.log10_delta
    assert varying.log10_lower is not None
    assert verdict.log10_lower is None
    assert all(answer.log10_lower is None for answer in verdict.answers.values())
    for gain in (0.7, 0.8, 0.9):
        fixed = cb.simulate_exits(problem, paths=50_000, rng=1, scenario=Scenario(disturbance=[0.0, gain]), halve=False)
        assert fixed.lower < 10**verdict.log10_delta
    assert verdict.safe_starts().charts.lower == ()


def test_what_is_unsafe_for_changing_disturbances_is_unknown_for_constants():
    problem = loads(TEXT.replace("delta = 0.2", "delta = 0.001"))
    assert cb.verify_safety(problem.replace(unknown=()), method="values").status == "UNSAFE"
    assert cb.verify_safety(problem, method="values").status == "UNKNOWN"
    far = loads(TEXT.replace("[0.7, 0.9]", "[0.7, 1.4]"))
    assert cb.verify_safety(far).status == "UNSAFE_NOMINAL"


def test_files_keep_constants_apart_from_disturbances(tmp_path):
    problem = loads(TEXT)
    for again in (problem, problem.replace(name="traced")):
        save(again, tmp_path / "walk.toml")
        text = (tmp_path / "walk.toml").read_text()
        assert "[uncertain]\ngain = [0.7, 0.9]" in text
        loaded = load(tmp_path / "walk.toml")
        assert (loaded.unknown, loaded.system.disturbance_names) == (("gain",), ("push", "gain"))


def test_simulation_keeps_a_constant():
    problem = loads(TEXT)
    assert cb.simulate_exits(problem, paths=1000, rng=0, halve=False).paths == 1000
    for moving in ("switching", lambda t, x: [0.0, 0.8], np.full((4, 2), 0.0)):
        with pytest.raises(ValueError, match="gain is an unknown constant"):
            cb.simulate_exits(problem, paths=10, rng=0, scenario=Scenario(disturbance=moving))


def test_bad_constants_are_refused():
    with pytest.raises(ValueError, match=r"gain.*must be \[low, high\]|`low` must not exceed `high`|low"):
        loads(TEXT.replace("[0.7, 0.9]", "[0.9, 0.7]"))
    with pytest.raises(ValueError, match="gain"):
        loads(TEXT.replace("[disturbances]", "[disturbances]\ngain = [0, 1]"))
    with pytest.raises(ValueError, match=r"`unknown` must name disturbances of the system, got 'gian'"):
        loads(TEXT).replace(unknown=["gian"])
    with pytest.raises(TypeError, match="`unknown` must be a list of names of disturbances, got 3"):
        loads(TEXT).replace(unknown=3)
    with pytest.raises(InfeasibleError, match="no bounds for unknown constants"):
        cb.bound_exit_times(loads(TEXT))
