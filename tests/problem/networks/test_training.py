"""The policies of the experiments are trained by the seed, imitate their law, and come with a problem."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import certbound as cb
from experiments.networks.training import TASKS, train, write


@pytest.mark.parametrize("task", sorted(TASKS))
def test_a_policy_imitates_its_law_and_the_seed_says_which(task: str) -> None:
    options = {"width": 8, "activation": "tanh", "steps": 800}
    rows, again = train(TASKS[task], **options), train(TASKS[task], **options)
    np.testing.assert_array_equal(rows[1]["weights"], again[1]["weights"])
    points = np.random.default_rng(1).uniform(TASKS[task].low, TASKS[task].high, (200, len(TASKS[task].low)))
    wanted = TASKS[task].law(points)
    assert np.mean((cb.network(rows)(points) - wanted) ** 2) < 0.05 * np.var(wanted)


def test_a_policy_is_written_with_its_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.networks.training.train", lambda task, **options: train(task, steps=1, **options))
    problem = cb.load(write(tmp_path, "pendulum", width=4, activation="relu"))
    assert problem.horizon == 100
    assert len(problem.closed_loop.nodes) < 30


def test_a_policy_that_is_held_is_clipped_by_its_last_layer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("experiments.networks.training.train", lambda task, **options: train(task, steps=1, **options))
    for task, hold, limit in (("lane", 0.05, 0.5), ("cart-pole", 0.05, 10.0)):
        path = write(tmp_path, task, width=4, activation="tanh")
        assert cb.load(path).hold == hold
        far = np.full((1, len(TASKS[task].low)), 1e4)
        assert abs(cb.network(path.with_suffix(".npz"))(far)[0, 0]) <= limit
