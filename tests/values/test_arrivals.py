"""Targets in continuous time, one state: both bounds against closed forms and simulation, and what is refused."""

from unittest.mock import patch

import numpy as np
import pytest

import certbound as cb
from certbound.values.continuous import bound_exits, straight
from certbound.values.continuous.line import arrivals, ladder
from certbound.values.continuous.line.arrivals import complement


def flow(start=(0.8,), *, drift=-1.0, sigma=0.3, horizon=3.0, target=(-0.2, 0.2), safe=(-1.5, 1.0), **more):
    system = cb.ContinuousSystem(lambda x: drift * x, states=["x"], diffusion=[[sigma]])
    wall = cb.Inside(cb.Box([safe[0]], [safe[1]]))
    reach = cb.Box([target[0]], [target[1]])
    return cb.Problem(system, initial=start, safe=[wall], reach=reach, horizon=horizon, delta=0.1, **more)


def bounds(problem):
    answer = cb.verify_safety(problem, method="values").answers["values"]
    lower = 0.0 if answer.log10_lower is None else 10**answer.log10_lower
    return lower, 10**answer.log10_delta, answer


def hitting(x, low, high, horizon):
    """P(a Brownian motion from x is at `high` before `low`, and before the horizon), by its eigenfunctions."""
    width, y, k = high - low, x - low, np.arange(1, 2000)
    series = np.sin(k * np.pi * y / width) * np.exp(-((k * np.pi / width) ** 2) * horizon / 2)
    return y / width + 2 / np.pi * np.sum((-1.0) ** k / k * series)


@pytest.mark.usefixtures("frugal")
def test_brownian_motion_between_a_wall_and_a_target(monkeypatch):
    monkeypatch.setattr(arrivals, "_RUNGS", 1)
    # with no drift the noise-free path misses: the engine is asked itself
    from certbound.safety.engines import values_engine

    system = cb.ContinuousSystem(lambda x: 0 * x, states=["x"], diffusion=[[1.0]])
    walls = [cb.Inside(cb.Box([-1.0], [4.0]))]
    problem = cb.Problem(system, initial=[0.3], safe=walls, reach=cb.Box([1.0], [2.0]), horizon=0.8)
    answer = values_engine(problem)
    truth = 1 - hitting(0.3, -1.0, 1.0, 0.8)
    lower, upper = 10**answer.log10_lower, 10**answer.log10_delta
    assert lower < truth < upper < 1.02 * lower


@pytest.mark.usefixtures("frugal")
def test_bounds_hold_a_simulation_and_are_close(monkeypatch):
    monkeypatch.setattr(arrivals, "_RUNGS", 1)
    lower, upper, _ = bounds(flow(horizon=1.5))
    counted = cb.simulate_exits(flow(horizon=1.5), paths=30_000, rng=1, steps=1000, halve=False)
    assert lower < counted.upper
    assert counted.lower < upper < 1.1 * lower


@pytest.mark.slow
def test_the_worst_start_is_the_farthest_one_on_either_side():
    far = bounds(flow())[:2]
    assert bounds(flow(cb.Box([0.5], [0.8])))[:2] == far
    mirrored = flow((-0.8,), safe=(-1.0, 1.5))
    assert bounds(mirrored)[:2] == pytest.approx(far, rel=1e-3)


@pytest.mark.usefixtures("frugal")
def test_where_nothing_limits_the_other_side_a_path_may_come_back(monkeypatch):
    monkeypatch.setattr(arrivals, "_RUNGS", 1)
    lower, upper, answer = bounds(flow(safe=(-1.5, np.inf)))
    assert lower == 0.0
    assert answer.log10_lower is None
    assert upper < 0.02


def test_one_minus_a_bound_is_rounded_outward():
    assert np.exp(complement(np.log(0.25), up=False)) <= 0.75 <= np.exp(complement(np.log(0.25), up=True))
    assert complement(-np.inf, up=True) == 0.0
    assert complement(0.0, up=False) == -np.inf


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reach": cb.Reach(cb.Box([-0.2], [0.2]), during=(1, 3))}, "counts from the beginning"),
        ({"reach": cb.Box([-0.2], [0.9])}, "starts on one side of the target"),
        ({"initial": cb.GaussianStart([0.8], [[0.001]])}, "need a set of starts"),
        ({"safe": [cb.Inside(cb.Box([-0.1], [1.0]))], "reach": cb.Box([-0.2], [-0.1])}, "beyond the target's face"),
        ({"safe": [cb.Inside(cb.Box([-1.0], [1.0]), during=(0, 2))]}, "without time"),
        (
            {"system": cb.ContinuousSystem(lambda x, d: d - x, states=["x"], diffusion=[[0.3]],
                                           disturbance=cb.Box([-0.1], [0.1]))},
            "targets under disturbances",
        ),
    ],
)  # fmt: skip
def test_what_is_not_served_says_so(changes, message):
    from certbound.safety.engines import values_engine

    answer = values_engine(flow().replace(**changes))
    assert not answer.applicable
    assert message in answer.reason


@pytest.mark.parametrize("end", [0.5, 3.0])
def test_a_path_that_leaves_its_domain_does_not_fail(end: float) -> None:
    """Brownian motion: failing below, before ending above; by both limits where the domain ends beyond them."""
    system = cb.ContinuousSystem(lambda x: 0 * x, states=1, diffusion=1.0)
    problem = cb.Problem(
        system, initial=[0.1], safe=[cb.Inside(cb.Box([-0.5], [2.0]))], horizon=4.0, domain=cb.Box([-4], [end]),
        leaving="ends",
    )  # fmt: skip
    with patch.object(ladder, "LADDER", ((2.0, 5e-3, 0.1),)):
        found = bound_exits(problem, seconds=0.1)
    truth = hitting(-0.1, -0.5, 0.5, 4.0) if end < 2 else hitting(0.1, -0.5, 2.0, 4.0) + hitting(-0.1, -2.0, 0.5, 4.0)
    assert found.lower is not None
    assert 0.8 * truth <= 10**found.lower <= truth <= 10**found.upper <= 1.2 * truth


def test_where_the_domain_counts_as_a_limit_there_is_no_lower_bound() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.5 * np.eye(2))
    safe, domain = [cb.Inside(cb.Box([-1, -1], [1, 1]))], cb.Box([-2, -2], [0.9, 2])
    problem = cb.Problem(system, initial=[0, 0], safe=safe, horizon=1.0, domain=domain, leaving="ends")
    with patch.object(straight, "bound_plane", lambda *_, **__: (-1.0, -2.0, "", ((), ()))):
        assert bound_exits(problem).lower is None
        assert bound_exits(problem.replace(leaving="unsafe")).lower is not None
