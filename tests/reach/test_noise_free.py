"""Noise-free reach tubes of the bundled problems: everything sampled lies inside, and they are not much wider."""

from __future__ import annotations

import pytest

import certbound as cb
from certbound.problem.library import MODELS
from experiments.reach_tubes import compare


@pytest.mark.parametrize("name", sorted(MODELS))
def test_the_linear_response_reaches_every_bundled_horizon_without_noise(name: str) -> None:
    problem = cb.load(name)
    reach = cb.bound_reach(problem, noise=False, method="linear")
    assert reach.end == problem.horizon
    assert not reach.noise
    assert compare(problem, reach, 1000, steps=100).outside == 0


def test_the_tube_is_not_much_wider_than_the_sampled_hull_and_a_narrower_one_is_caught() -> None:
    problem = cb.load("pendulum").replace(horizon=2.0)
    reach = cb.bound_reach(problem, noise=False)
    found = compare(problem, reach, 1500)
    assert found.outside == 0
    assert 1.0 <= found.mean_ratio < 1.1
    assert reach.box is not None
    narrow = reach.altered(box=0.9 * reach.box)
    assert compare(problem, narrow, 500).outside > 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "cells", "most"), [("pendulum", None, 1.1), ("unicycle", 2, 1.5)])
def test_a_hundred_thousand_trajectories_lie_inside(name: str, cells: int | None, most: float) -> None:
    problem = cb.load(name)
    found = compare(problem, cb.bound_reach(problem, noise=False, cells=cells), 100_000)
    assert found.outside == 0
    assert found.mean_ratio <= most
