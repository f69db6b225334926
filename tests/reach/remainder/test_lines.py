"""Lines around the dynamics hold every point of a box."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import compile_numpy, trace
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.remainder.lines import follow_lines
from certbound.reach.remainder.samples import sampled_range
from certbound.rigor.intervals import Interval
from tests.networks import random_network

RELU, TANH = random_network("relu"), random_network("tanh", 1)
MODELS: dict[str, Any] = {
    "a policy in a plant": lambda x: [x[0] + 0.1 * np.sin(x[1]), 0.9 * x[1] + 0.3 * RELU(x)[0] - 0.5],
    "a policy of functions": lambda x: [np.exp(0.3 * x[0]) * TANH(np.sin(x[0]), x[0] * x[1])[1], -x[0] * x[1]],
    "a clipped policy": lambda x: [np.clip(2 * TANH(x)[0], -0.5, 0.5), np.maximum(RELU(x)[1], x[0] ** 2)],
    "a policy of a policy": lambda x: [TANH(RELU(x))[0] / (2 + x[0] ** 2), 3.0],
}


@pytest.mark.parametrize("name", sorted(MODELS))
def test_no_point_is_outside_the_lines(name: str) -> None:
    tape = trace(MODELS[name], {"x": ["a", "b"]})
    rng, evaluate = np.random.default_rng(5), compile_numpy(tape)
    centre, radius = rng.normal(size=(2, 100)), 10 ** rng.uniform(-6, 0, (2, 100))
    found = follow_lines(tape, [Interval.point(c) for c in centre], dict(enumerate(radius)))
    for number in range(60):
        share = rng.uniform(-1, 1, (2, 100))
        d = (np.sign(share) if number < 10 else share) * radius
        values = evaluate(*(centre + d))
        for output, line in enumerate(found):
            total = line.rest
            for slot, coefficient in line.coefficients.items():
                total = total + coefficient * d[slot]
            room = 1e-12 * (1 + np.abs(values[:, output]))
            assert np.all((total.lo - room <= values[:, output]) & (values[:, output] <= total.hi + room))


def test_what_is_undefined_is_unbounded() -> None:
    tape = trace(lambda x: [np.log(x[0])], {"x": ["a"]})
    (line,) = follow_lines(tape, [Interval.point([1.0, 1.0])], {0: np.array([0.5, 2.0])})
    assert np.isfinite(line.rest.lo[0])
    assert np.isinf(line.rest.lo[1])


def test_kinks_of_one_coordinate_are_cut_where_the_slope_of_another_changes_most() -> None:
    """A staircase of 17 kinks in v beside one kink in x: cutting x alone stalled at a sixth of the range too much."""
    places = np.linspace(-0.4, 0.4, 17)
    policy = cb.network([
        {"weights": np.array([[1.0, 0.0], *[[0.0, 1.0]] * 17]), "bias": [-0.2, *-places], "activation": "relu"},
        {"weights": np.array([[1.0, 3.0, *np.tile([-6.0, 6.0], 8)]])},
    ])  # fmt: skip
    system = cb.DiscreteSystem(
        lambda x: [0.5 * x[0] + 0.1 * x[1], 0.4 * x[1] + policy(x)[0]], states=2, noise=cb.Gaussian(std=0.01)
    )
    engine = Linearisation(cb.Problem(system, initial=[0.1, 0.1], safe=[], horizon=1), pieces=1)
    half, rows = np.full((1, 2), 0.5), np.zeros((1, 0, 2))
    low, high = sampled_range(engine.model, engine.frame, -half, half, rows)
    room = 0.05 * (high - low) + 1e-12
    found = engine.model.bound(engine.frame, -half, half, rows, 1, (low - room, high + room))
    assert (found[0] >= low - room).all()
    assert (found[1] <= high + room).all()
