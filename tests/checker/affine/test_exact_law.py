"""Certificates of the exact law of linear models: what they prove, beside simulation and beside the prover's bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import certbound as cb
from certbound.checker.report import Unproved
from certbound.errors import CertificateError
from certbound.reach.affine import affine_answer, affine_failing
from certbound.safety.certificates import law_proof
from tests.checker.affine.models import OPEN, correlated, linear_problem, ornstein_uhlenbeck, oscillator, proved

STATIONARY = cb.GaussianStart([0.0, 0.0], [[0.1, 0.0], [0.0, 0.1]])
DRAWN = cb.GaussianStart([0.1, 0.0], [[0.05, 0.01], [0.01, 0.02]])
SINGULAR = cb.GaussianStart([0.0, 0.0], [[0.04, 0.04], [0.04, 0.04]])

CASES: dict[str, Callable[[], cb.Problem]] = {
    "oscillator": oscillator,
    "oscillator, its speed too": lambda: oscillator(bounds=[1.5, 1.5], initial=[0.3, 0.0]),
    "one state": ornstein_uhlenbeck,
    "one state, soon": lambda: ornstein_uhlenbeck(horizon=1.0),
    "one state, long": lambda: ornstein_uhlenbeck(horizon=100.0),
    "one state, a force": lambda: ornstein_uhlenbeck(drift=[0.1], initial=[0.3]),
    "correlated noise": correlated,
    "a box of starts": lambda: correlated(initial=cb.Box([-0.1, -0.2], [0.1, 0.3]), bounds=[1.5, 1.5]),
    "a stationary start": lambda: oscillator(initial=STATIONARY),
    "a normal start": lambda: oscillator(initial=DRAWN, bounds=[1.5, 1.5]),
    "a start on a line": lambda: correlated(initial=SINGULAR),
    "a stiff row": lambda: linear_problem([[-1, 1], [0, -1e4]], [[0], [30.0]], [0.012, OPEN], horizon=20.0),
    "an undriven state": lambda: linear_problem(
        [[-1, 0], [0, -0.5]], [[0.3], [0.0]], [1.2, 1.0], horizon=5.0, initial=[0.0, 0.5]
    ),
    "a drawn filter": lambda: linear_problem(
        [[-1, 1], [0, -0.5]], [[0.1, 0.0], [0.0, 0.5]], [1.5, OPEN], horizon=5.0,
        initial=cb.GaussianStart([0.0, 0.0], [[0.0, 0.0], [0.0, 0.25]]),
    ),
    "a drawn constant": lambda: linear_problem(
        [[-1, 1], [0, 0]], [[0.1], [0.0]], [1.5, OPEN], horizon=5.0,
        initial=cb.GaussianStart([0.0, 0.0], [[0.0, 0.0], [0.0, 0.25]]),
    ),
    "drawn and soon still": lambda: linear_problem(
        [[-1]], [[0.2]], [1.5], horizon=5.0, initial=cb.GaussianStart([0.0], [[0.125]])
    ),
    "disturbances": lambda: oscillator(gain=[[0.0], [0.05]], bounds=[1.8, OPEN]),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_proved_is_near_the_provers_bound_and_above_its_lower_one(name: str) -> None:
    problem = CASES[name]()
    answer = affine_answer(problem)
    assert answer is not None
    found = proved(problem)
    clumps = 1.3 if name == "a stiff row" else 1.0  # of crossings, which the prover alone tells apart
    assert found <= 1.3 * clumps * 10**answer.log10_delta
    assert 10**answer.log10_delta <= 1.02 * found  # the prover adopts what certificates state
    below = affine_failing(problem)
    if below is not None:
        assert found >= below.probability


def failing(a: Any, g: Any, bounds: Any, start: Any, *, horizon: float, paths: int, steps: int) -> tuple[float, float]:
    """The part of exactly simulated paths that leave the box at the steps, and its standard deviation."""
    n, h = len(a), horizon / steps
    whole = scipy.linalg.expm(np.block([[-a, g @ g.T], [np.zeros((n, n)), a.T]]) * h)
    forward = whole[n:, n:].T
    values, vectors = np.linalg.eigh(forward @ whole[:n, n:])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    generator = np.random.default_rng(7)
    x = generator.multivariate_normal(np.zeros(n), start, paths) if np.any(start) else np.zeros((paths, n))
    failed = np.any(np.abs(x) > bounds, axis=1)
    for _ in range(steps):
        x = x @ forward.T + generator.standard_normal((paths, n)) @ root.T
        failed |= np.any(np.abs(x) > bounds, axis=1)
    part = float(np.mean(failed))
    return part, np.sqrt(part * (1 - part) / paths)


@pytest.mark.parametrize(
    ("slope", "diffusion", "bounds", "start"),
    [
        ([[0, 1], [-1, -0.4]], [[0], [0.3]], [1.0, OPEN], None),
        ([[0, 1], [-1, -0.4]], [[0], [0.3]], [1.1, 1.1], np.diag([0.1, 0.02])),
        ([[-1, 0.5], [0, -2]], [[0.3, 0.1], [0.1, 0.4]], [0.7, 0.75], None),
        ([[-0.2, 3], [-3, -0.2]], [[0.2, 0.0], [0.0, 0.0]], [0.7, 0.7], None),
    ],
)
def test_no_simulation_fails_more_often_than_is_proved(slope: Any, diffusion: Any, bounds: Any, start: Any) -> None:
    a, g = np.array(slope, dtype=float), np.array(diffusion, dtype=float)
    initial = None if start is None else cb.GaussianStart([0.0, 0.0], start)
    problem = linear_problem(a, g, bounds, horizon=8.0, initial=initial, delta=0.5)
    drawn = np.zeros((2, 2)) if start is None else start
    part, deviation = failing(a, g, np.array(bounds), drawn, horizon=8.0, paths=20_000, steps=800)
    found = proved(problem)
    assert part > 0.003
    assert found >= part - 3 * deviation
    assert found <= 4 * part  # a path that turns crosses several limits one after the other


def test_wherever_pieces_are_cut_no_less_is_said_than_is_true() -> None:
    problem = correlated(bounds=[0.8, 0.8])
    below = affine_failing(problem)
    assert below is not None
    given = law_proof(problem)[0]
    generator = np.random.default_rng(5)
    for _ in range(12):
        levels, windows = [], []
        stack = [0]
        while stack:
            level = stack.pop()
            if level < 3 or (level < 9 and generator.random() < 0.5):
                stack += [level + 1, level + 1]
            else:
                levels.append(level)
                windows.append(int(generator.choice([1, 2, 30, 10**6])))
        limits = [{"grid": 0, "windows": windows} for _ in given["limits"]]
        try:
            found = proved(problem, {**given, "grids": [levels], "limits": limits})
        except Unproved:
            continue
        assert found >= below.probability


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"safe": [cb.Inside(cb.Ball([0, 0], 1.5))]}, "half-spaces"),
        ({"safe": [cb.Outside(cb.Ball([3, 3], 0.5))]}, "half-spaces"),
        ({"initial": [1.5, 0.0]}, "nothing is left"),
    ],
)
def test_what_is_no_half_space_or_touches_the_start_is_refused(change: dict[str, Any], reason: str) -> None:
    plan = law_proof(oscillator())[0]
    limits = [plan["limits"][0]] * (1 if "safe" in change else 2)
    with pytest.raises(Unproved, match=reason):
        proved(oscillator(**change), {**plan, "limits": limits})


def test_an_obstacle_that_is_a_half_space_is_kept_off() -> None:
    inside = oscillator(safe=[cb.Inside(cb.HalfSpace([1.0, 0.0], 1.5))])
    outside = oscillator(safe=[cb.Outside(cb.HalfSpace([-1.0, 0.0], -1.5))])
    plan = law_proof(inside)[0]
    assert proved(outside, plan) == proved(inside, plan)


def test_a_limit_counts_in_its_window_only() -> None:
    def during(window: tuple[float, float] | None) -> float:
        return proved(oscillator(safe=[cb.Inside(cb.Box([-1.5, -OPEN], [1.5, OPEN]), during=window)]))

    whole, late, moment = during(None), during((20.0, 30.0)), during((30.0, 30.0))
    assert moment < late < whole


def test_a_problem_without_such_a_law_has_no_such_certificate() -> None:
    system = cb.ContinuousSystem(lambda x: [-(x[0] ** 3)], states=1, diffusion=[[0.1]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], horizon=5.0, delta=0.1)
    with pytest.raises(CertificateError, match="linear model in continuous time"):
        law_proof(problem)
