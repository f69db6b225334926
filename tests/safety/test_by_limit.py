"""Which limit is met first, and when: bounds of parts of the probability of failing, and of the exit time's density."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

import certbound as cb
from certbound.cli.app import run
from certbound.safety.answers import bound_limits, limits_of

TWO = """
name = "two limits"
time = "continuous"
horizon = 5
delta = 0.3
states = ["v"]
[dynamics]
v = "0.2 - 0.5*v"
[noise]
diffusion = [[0.4]]
[initial]
point = [0]
[[stay]]
box = { v = [-1.5, 1.6] }
"""


@pytest.fixture(scope="module")
def walk():
    system = cb.DiscreteSystem(lambda x: 0.9 * x + 0.1, states=["x"], noise=cb.Gaussian(std=0.4))
    problem = cb.Problem(system, initial=[0.2], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=6)
    return problem, cb.bound_exit_times(problem, by_limit=True)


def test_limits_are_the_faces_of_what_to_stay_in_and_other_sets_as_a_whole():
    rock = cb.Outside(cb.Ball([3, 0], 1))
    safe = [cb.Inside(cb.Box([-1, -2], [1, np.inf])), cb.Inside(cb.Ball([0, 0], 5)), rock]
    system = cb.ContinuousSystem(lambda x: -x, states=["a", "b"], diffusion=0.1 * np.eye(2))
    problem = cb.Problem(system, initial=[0, 0], safe=safe, horizon=1, domain=cb.Box([-9, -9], [9, np.inf]))
    names = limits_of(problem)
    assert sorted(names) == [(-1, 0), (-1, 1), (-1, 2), (0, 0), (0, 1), (0, 2), (1, 0), (2, 0)]
    assert {names[0, k] for k in range(3)} == {"a <= 1", "a >= -1", "b >= -2"}
    ends = cb.Problem(system, initial=[0, 0], safe=safe, horizon=1, domain=problem.domain, leaving="ends")
    assert (-1, 0) not in limits_of(ends)


def test_what_is_proved_of_one_limit_says_something_of_the_others():
    names = {(0, 0): "a", (0, 1): "b", (1, 0): "c"}
    a, b, c = bound_limits(names, -1.0, math.log10(0.05), uppers=[{(0, 1): -2.0, (1, 0): -2.0}, {(1, 0): -3.0}])
    assert (a.log10_upper, b.log10_upper, c.log10_upper) == (-1, -2, -3)
    assert 10**a.log10_lower == pytest.approx(0.05 - 0.01 - 0.001)
    assert 10**a.log10_lower < 0.05 - 0.01 - 0.001
    assert b.log10_lower is None  # a alone may explain what is proved from below
    (alone,) = bound_limits({(0, 0): "a"}, -1.0, -2.0)
    assert (alone.log10_upper, round(alone.log10_lower, 9)) == (-1, -2)
    nothing = bound_limits(names, 0.0, None)
    assert {(one.log10_upper, one.log10_lower) for one in nothing} == {(None, None)}


def test_a_verdict_by_the_linear_response_tells_the_sides_apart(tmp_path, capsys):
    (tmp_path / "two.toml").write_text(TWO)
    assert run(["verify", str(tmp_path / "two.toml"), "--method", "linear", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    shares = {one["constraint"]: one["log10_upper"] for one in found["by_limit"]}
    assert set(shares) == {"v <= 1.6", "v >= -1.5"}
    assert shares["v <= 1.6"] <= found["log10_delta"]
    assert shares["v >= -1.5"] < shares["v <= 1.6"] - 1.5
    assert sum(10**share for share in shares.values()) >= 10 ** found["log10_delta"] * (1 - 1e-9)
    problem = cb.load(tmp_path / "two.toml")
    paths = cb.sample_paths(problem, paths=20_000, rng=np.random.default_rng(0))[:, :, 0]
    up, down = (paths > 1.6).any(axis=1), (paths < -1.5).any(axis=1)
    assert up.mean() < 10 ** shares["v <= 1.6"]
    assert down.mean() < 10 ** shares["v >= -1.5"] + 3e-4  # six standard errors of nothing seen


def test_a_target_leaves_the_bound_of_failing_and_nothing_from_below():
    system = cb.DiscreteSystem(lambda x: 0.7 * x, states=["x"], noise=cb.Gaussian(std=0.1))
    target = cb.Reach(cb.Box([-0.2], [0.2]))
    problem = cb.Problem(system, initial=[0.8], safe=[cb.Inside(cb.Box([-1], [1]))], reach=target, horizon=8)
    verdict = cb.verify_safety(problem)
    assert verdict.log10_lower is not None
    assert [(one.log10_upper, one.log10_lower) for one in verdict.by_limit] == [(verdict.log10_delta, None)] * 2


def test_exit_times_tell_which_of_two_limits_is_met_first(walk):
    problem, found = walk
    paths = cb.sample_paths(problem, paths=200_000, rng=np.random.default_rng(0))[:, :, 0]
    out = np.abs(paths) > 1
    first = paths[np.arange(len(paths)), out.argmax(axis=1)] * out.any(axis=1)
    bounds = {one.constraint: (10**one.log10_lower, 10**one.log10_upper) for one in found.by_limit}
    for name, seen in (("x <= 1", np.mean(first > 1)), ("x >= -1", np.mean(first < -1))):
        low, high = bounds[name]
        error = 5 * np.sqrt(seen / len(paths))
        assert low - error < seen < high + error
        assert high < 1.25 * low
    assert sum(high for _, high in bounds.values()) >= found.upper[-1] * (1 - 1e-9)


def test_the_density_of_exit_times_holds_what_paths_show(walk):
    problem, found = walk
    paths = cb.sample_paths(problem, paths=200_000, rng=np.random.default_rng(1))[:, :, 0]
    out = np.abs(paths) > 1
    steps = np.where(out.any(axis=1), out.argmax(axis=1), -1)
    seen = np.array([np.mean(steps == step) for step in range(1, 7)])
    density = found.density
    assert density.times.tolist() == [0, 1, 2, 3, 4, 5, 6]
    error = 5 * np.sqrt(seen / len(paths)) + 1e-6
    assert np.all(density.lower - error < seen)
    assert np.all(seen < density.upper + error)
    assert np.all(density.upper[1:] < 1.1 * density.lower[1:])
    assert found.to_dict()["density"].keys() == {"times", "lower", "upper"}


def test_a_disturbance_leaves_no_density_from_below():
    system = cb.DiscreteSystem(
        lambda x, d: 0.9 * x + d, states=["x"], noise=cb.Gaussian(std=0.4), disturbance=cb.Box([0], [0.3])
    )
    problem = cb.Problem(system, initial=[0.2], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3)
    found = cb.bound_exit_times(problem)
    assert np.all(found.density.lower == 0)
    assert found.density.upper[-1] >= found.upper[-1] * (1 - 1e-9)
    assert found.by_limit == ()
