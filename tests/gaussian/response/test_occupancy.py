"""Boxes as large as the noise, against simulation and the half-space that keeps them off."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

import certbound as cb
from certbound.gaussian.response.occupancy import log_occupancy
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun

Array = NDArray[np.float64]

MATRIX = np.array([[0.9, 0.2], [-0.2, 0.8]])


def problem(box: cb.Box, *, during: tuple[float, float] | None = None, spread: float = 0.2) -> cb.Problem:
    system = cb.linear_system(MATRIX, noise=cb.Gaussian(std=0.7))
    start = cb.Box([1.0 - spread, -spread], [1.0 + spread, spread])
    return cb.Problem(system, initial=start, safe=[cb.Outside(box, during=during)], horizon=8, delta=1e-6)


def simulated(asked: cb.Problem, paths: int) -> float:
    """The worst corner of the initial set."""
    box, found = asked.safe[0].region, []
    states = list(range(2)) if box.coordinates is None else list(box.coordinates)
    first, last = (0, 8) if asked.safe[0].during is None else asked.safe[0].during
    for corner in ((0.8, -0.2), (0.8, 0.2), (1.2, -0.2), (1.2, 0.2)):
        rng = np.random.default_rng(0)
        x, hit = np.tile(corner, (paths, 1)), np.zeros(paths, dtype=bool)
        for t in range(9):
            if t:
                x = x @ MATRIX.T + 0.7 * rng.standard_normal((paths, 2))
            if first <= t <= last:
                hit |= np.all((x[:, states] >= box.low) & (x[:, states] <= box.high), axis=1)
        found.append(float(hit.mean()))
    return max(found)


@pytest.mark.parametrize(
    ("box", "during"),
    [
        (cb.Box([2.0, 2.0], [2.8, 2.7]), None),
        (cb.Box([2.0, 2.0], [2.8, 2.7]), (3, 5)),
        (cb.Box([3.0], [3.5], coordinates=(0,)), None),
        (cb.Box([-np.inf, 3.0], [0.0, 3.6]), None),
    ],
)
def test_small_boxes_are_entered_about_as_often_as_simulated(box: cb.Box, during: tuple[float, float] | None) -> None:
    asked = problem(box, during=during)
    found = 10 ** cb.verify_safety(asked, method="linear").log10_delta
    paths = 200_000
    truth = simulated(asked, paths)
    assert truth - 3 * np.sqrt(truth / paths) <= found <= 2.0 * truth


def test_it_says_nothing_of_other_constraints() -> None:
    engine = Linearisation.of(problem(cb.Box([2.0, 2.0], [2.8, 2.7])))
    run = LinearRun(engine)
    y, r = run.supports[0].y_nodes, np.zeros((9, 2))
    inside = cb.Inside(cb.Box([-9.0, -9.0], [9.0, 9.0]))
    round_one = cb.Outside(cb.Ball([2.0, 2.0], 0.5))
    moving = cb.Outside(cb.Box([2.0, 2.0], [3.0, 3.0], center=lambda t: [0.1 * t, 0.0]))

    def log(constraint: cb.Inside, remainder: Array = r, disturbed: bool = False) -> float:
        return log_occupancy(
            constraint, engine.response, 0, nominal=engine.nodes[0], moved=y, remainder=remainder, disturbed=disturbed
        )

    for constraint in (inside, round_one, moving):
        assert log(constraint) == 0.0
    box = cb.Outside(cb.Box([2.0, 2.0], [2.8, 2.7]))
    assert log(box) < log(box, r + 0.1) < 0
    assert log(box) < log(box, disturbed=True) < 0
    assert log(box, np.full((9, 2), np.inf)) == 0.0


def test_a_disturbance_that_has_seen_the_noise_is_covered() -> None:
    # d pulls the state towards the box's middle at the last step, knowing all noise
    system = cb.DiscreteSystem(
        lambda x, d: [0.5 * x[0] + d[0]], states=1, noise=cb.Gaussian(std=1.0), disturbance=cb.Box([-0.5], [0.5])
    )
    box = cb.Box([2.0], [2.4])
    asked = cb.Problem(system, initial=[0.0], safe=[cb.Outside(box, during=(1, 1))], horizon=1, delta=1e-6)
    found = 10 ** cb.verify_safety(asked, method="linear").log10_delta
    truth = float(norm.cdf(2.9) - norm.cdf(1.5))  # some d in [-.5, .5] brings w into the box
    assert truth <= found <= 1.001 * truth
