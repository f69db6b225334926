"""Reach sets from samples: their guarantee, their marks, their refusals."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

import certbound as cb
from certbound.reach.nominal.flow import Flow
from certbound.reach.sampled.boxes import (
    SampledTube,
    draw,
    estimate_reach,
    noise_free_states,
    scenario_count,
    time_grid,
)
from certbound.reach.sampled.classifier import LearnedTube

Array = NDArray[np.float64]


def spring(disturbed: bool = False) -> cb.Problem:
    if disturbed:
        system = cb.ContinuousSystem(
            lambda x, d: [x[1], -x[0] - 0.5 * x[1] + d[0]],
            states=2,
            disturbance=cb.Box([-0.1], [0.1]),
            diffusion=0.05 * np.eye(2),
        )
    else:
        system = cb.linear_system([[0, 1], [-1, -0.5]], diffusion=0.05 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=cb.Box([0.4, -0.1], [0.6, 0.1]), safe=safe, horizon=2.0)


def fresh(problem: cb.Problem, grid: Array, count: int, seed: int) -> list[tuple[float, Array]]:
    flow = Flow(problem)
    starts, disturbances = draw(flow, np.random.default_rng(seed), count)
    return [(t, x.copy()) for _, t, x in noise_free_states(flow, grid, starts, disturbances) if t in set(grid)]


@pytest.mark.parametrize(("faces", "epsilon", "confidence"), [(1, 0.01, 0.99), (40, 0.05, 0.999), (300, 0.1, 0.5)])
def test_the_number_of_samples_is_the_least_that_the_binomial_tail_allows(
    faces: int, epsilon: float, confidence: float
) -> None:
    count = scenario_count(faces, epsilon, confidence)
    assert binom.cdf(faces - 1, count, epsilon) <= 1 - confidence
    assert binom.cdf(faces - 1, count - 1, epsilon) > 1 - confidence


@pytest.mark.parametrize("noise", [False, True])
def test_few_fresh_trajectories_leave_the_sampled_tube(noise: bool) -> None:
    problem = spring(disturbed=True)
    tube = cb.bound_reach(problem, noise=noise, method="sampled", epsilon=0.05, pieces=10, rng=1)
    assert isinstance(tube, SampledTube)
    grid = time_grid(Flow(problem), 10)
    if noise:
        paths = cb.sample_paths(problem, paths=2000, rng=np.random.default_rng(2), steps=200, points=10)
        states = list(zip(grid, np.moveaxis(paths, 1, 0)))
    else:
        states = fresh(problem, grid, 2000, 2)
    left = np.zeros(2000, dtype=bool)
    for t, x in states:
        piece = tube.pieces[tube.curve.piece_of(float(t))]
        left |= ((x < piece.low) | (x > piece.high)).any(axis=1)
    # the mean share outside is faces / (N + 1) at most, well below epsilon
    assert left.mean() <= 0.05
    assert tube.noise == noise


def test_the_guarantee_is_kept_as_often_as_it_says() -> None:
    """One state, uniform: the mass outside [min, max] of N is known exactly for every draw."""
    system = cb.ContinuousSystem(lambda x: -0 * x, states=1)
    safe = [cb.Inside(cb.Box([-1], [1]))]
    problem = cb.Problem(system, initial=cb.Box([0], [1]), safe=safe, horizon=1.0)
    rng = np.random.default_rng(3)
    outside = []
    for _ in range(60):
        hull = estimate_reach(problem, epsilon=0.2, confidence=0.8, pieces=1, rng=rng).hull
        outside.append(1 - (hull.hi[0, 0] - hull.lo[0, 0]))
    broken = np.mean(np.array(outside) > 0.2)
    assert 0.1 < broken < 0.3  # 1 - confidence: the bound is tight for boxes, neither kept always nor too rarely


def test_a_sampled_tube_says_that_it_proves_nothing_and_answers_like_a_reach_tube() -> None:
    problem = spring()
    tube = cb.bound_reach(problem, noise=False, method="sampled", epsilon=0.1, confidence=0.9, rng=0)
    proved = cb.bound_reach(problem, noise=False)
    assert proved.certified
    assert not tube.certified
    assert "statistical, not certified" in tube.summary()
    assert tube.to_dict()["certified"] is False
    assert tube.contains(0.0, [0.5, 0.0])
    assert not tube.contains(1.0, [0.9, 0.9])
    directions = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.all(tube.extent(directions, 1.0) > 0)
    assert tube.distance_to(problem.safe[0]) == pytest.approx(proved.distance_to(problem.safe[0]), abs=0.1)
    # samples lie inside what is proved, piece by piece of the finer grid
    for piece in proved.pieces:
        box = tube.pieces[tube.curve.piece_of(piece.start)]
        assert np.all(box.high >= piece.low)
        assert np.all(box.low <= piece.high)


def test_sampled_boxes_lie_inside_the_certified_tube() -> None:
    problem = spring(disturbed=True)
    proved = cb.bound_reach(problem, noise=False)
    tube = cb.bound_reach(problem, noise=False, method="sampled", epsilon=0.1, pieces=20, rng=0)
    for piece in tube.pieces:
        inside = [p for p in proved.pieces if p.end >= piece.start and p.start <= piece.end]
        assert np.all(piece.low >= np.min([p.low for p in inside], axis=0) - 1e-6)
        assert np.all(piece.high <= np.max([p.high for p in inside], axis=0) + 1e-6)


def test_discrete_time_has_a_box_for_every_step() -> None:
    system = cb.linear_system([[0.5]], noise=cb.Gaussian(std=0.1))
    safe = [cb.Inside(cb.Box([-2], [2]))]
    problem = cb.Problem(system, initial=cb.Box([0.8], [1.0]), safe=safe, horizon=3)
    tube = cb.bound_reach(problem, noise=False, method="sampled", epsilon=0.1, rng=0)
    assert [p.start for p in tube.pieces] == [0, 1, 2, 3]
    assert tube.contains(3, [0.9 / 8])
    noisy = cb.bound_reach(problem, method="sampled", epsilon=0.1, rng=0)
    assert noisy.pieces[3].high[0] > tube.pieces[3].high[0]


def test_the_classifier_knows_a_slanted_set_better_than_its_box() -> None:
    pytest.importorskip("sklearn")
    problem = cb.load("pendulum", sigma=0.0).replace(horizon=1.0)
    tube = cb.bound_reach(problem, noise=False, method="learned", epsilon=0.05, pieces=2, points=120, rng=0)
    assert isinstance(tube, LearnedTube)
    assert not tube.certified
    grid = time_grid(Flow(problem), 2)
    states = dict(fresh(problem, grid, 500, 7))[1.0]
    kept = np.mean([tube.contains(1.0, x) for x in states])
    assert kept >= 0.95
    box = tube.pieces[-1]
    anywhere = np.random.default_rng(8).uniform(box.low, box.high, (500, 2))
    accepted = np.mean([tube.contains(1.0, x) for x in anywhere])
    assert accepted < 0.5
    assert 1.0 in tube.to_dict()["classified"]


def test_without_scikit_learn_the_cure_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.gaussian_process", None)
    with pytest.raises(ValueError, match=r"pip install 'certbound\[learn\]'"):
        cb.bound_reach(spring(), noise=False, method="learned")


@pytest.mark.parametrize(
    ("method", "changes", "message"),
    [
        ("sampled", {"epsilon": 0.0}, r"`epsilon` must lie in \(0, 1\), got 0"),
        ("sampled", {"confidence": 1.0}, r"`confidence` must lie in \(0, 1\), got 1"),
        ("sampled", {"epsilon": 1e-9}, "`epsilon` must be larger"),
        ("sampled", {"pieces": 0}, "`pieces` must be a positive integer, got 0"),
        ("sampled", {"cells": 2}, "`cells` must be left out"),
        ("sampled", {"points": 99}, "`points` must be one of"),
        ("learned", {"points": 3}, "`points` must be a whole number, at least 40, got 3"),
        ("learned", {"noise": True}, "`noise` must be False"),
        ("linear", {"epsilon": 0.1}, "`epsilon` must be left out for the method 'linear'"),
        ("magic", {}, "`method` must be one of auto, linear, contraction, sampled, learned, got 'magic'"),
    ],
)
def test_bad_arguments_are_named(method: str, changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cb.bound_reach(spring(), **{"noise": False, "method": method, **changes})  # type: ignore[arg-type]


def test_sets_that_cannot_be_sampled_or_hit_are_refused() -> None:
    system = cb.linear_system([[0.5]], noise=cb.Gaussian(std=0.1))
    safe = [cb.Inside(cb.Box([-2], [2]))]
    steps = cb.Problem(system, initial=[0.5], safe=safe, horizon=3)
    with pytest.raises(ValueError, match="`pieces` must be left out in discrete time"):
        cb.bound_reach(steps, noise=False, method="sampled", pieces=4)
    with pytest.raises(ValueError, match="continuous time"):
        cb.bound_reach(steps, noise=False, method="learned")
    with pytest.raises(ValueError, match="`initial` must have an interior"):
        cb.bound_reach(spring().replace(initial=cb.Box([0.4, 0.0], [0.6, 0.0])), noise=False, method="learned")
    runaway = cb.ContinuousSystem(lambda x: x**2, states=1)
    lost = cb.Problem(runaway, initial=cb.Box([0.9], [1.0]), safe=[cb.Inside(cb.Box([-9], [9]))], horizon=2.0)
    with pytest.raises(ValueError, match="`horizon` must end before a noise-free trajectory is lost"):
        cb.bound_reach(lost, noise=False, method="sampled", epsilon=0.2)
