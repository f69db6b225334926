"""Laws of one state with exponential tails, or given by tables, against quadrature and simulation."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.values.discrete.failures import bound_failure
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.shocks import shocks_of
from certbound.values.discrete.uniform_noise import LineTables
from certbound.values.grids import Grid
from tests.values.discrete.helpers import random_function

LAWS = {
    "laplace": cb.Laplace(scale=0.3),
    "table": cb.Histogram(edges=[-4, -0.5, 0.5, 1], probabilities=[0.2, 0.2, 0.6], scale=0.4),
}


def density(name: str, w: np.ndarray) -> np.ndarray:
    if name == "laplace":
        return np.exp(-np.abs(w) / 0.3) / 0.6
    ends, shares = 0.4 * np.array([-4, -0.5, 0.5, 1]), np.array([0.2, 0.2, 0.6])
    place = np.clip(np.searchsorted(ends, w, side="right") - 1, 0, 2)
    return np.where((w >= ends[0]) & (w < ends[-1]), shares[place] / np.diff(ends)[place], 0.0)


def brute(value: ValueFunction, name: str, m: np.ndarray) -> np.ndarray:
    w = np.linspace(-8, 8, 80_001)
    middle = (w[1:] + w[:-1]) / 2
    weight = density(name, middle) * np.diff(w)
    return np.array([value.values((place + middle)[:, None]) @ weight for place in m])


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("fixed", [0.0, 0.3])
def test_the_table_and_the_slopes_enclose_the_mean(name: str, fixed: float) -> None:
    grid = Grid(axes=(np.array([-1.0, -0.7, -0.55, -0.1, 0.0, 0.3, 0.42, 1.0]),))
    value = random_function(np.random.default_rng(3), grid, fixed=fixed)
    law = LAWS[name].resolve(1)
    tables = LineTables(grid, shocks_of(law, np.array([[-1.0 if name == "laplace" else 1.0]])), np.array([-1.4]),
                        np.array([1.2]), fineness=12.0)  # fmt: skip
    field = tables.field(value)
    mesh = np.random.default_rng(1).choice(field.mesh.count[0] - 1, 6, replace=False)
    points = field.mesh.points(0)
    assert field.error < 1e-8
    assert np.all(np.abs(field.table[mesh] - brute(value, name, points[mesh])) < 3e-4)  # of the quadrature
    (low, high), step = field.slopes[0], float(field.mesh.step[0])
    mean = (brute(value, name, points[mesh + 1]) - brute(value, name, points[mesh])) / step
    assert np.all(low[mesh] <= mean + 2e-2)
    assert np.all(mean <= high[mesh] + 2e-2)
    rise = np.diff(field.table) / step  # means of slopes, which the ranges hold
    assert np.all(low <= rise + 1e-9)
    assert np.all(rise <= high + 1e-9)
    assert np.median(high - low) < 0.9 * np.ptp(rise)


@pytest.mark.parametrize(
    ("noise", "drift", "start"),
    [(cb.Laplace(scale=0.7), 0.3, 4.0), (LAWS["table"], 0.05, 1.0)], ids=LAWS,
)  # fmt: skip
def test_ruin_is_bounded_closely_from_both_sides_though_nothing_bounds_the_capital(
    noise: cb.Laplace, drift: float, start: float
) -> None:
    system = cb.DiscreteSystem(lambda x: x + drift, states=1, noise=noise)
    problem = cb.Problem(system, initial=[start], safe=[cb.Inside(cb.HalfSpace([-1.0], 0.0))], horizon=20)
    found = bound_failure(problem, seconds=1.0)
    assert 0.9 * found.upper < found.lower < found.upper
    rng = np.random.default_rng(0)
    x, safe = np.full(60_000, start), np.ones(60_000, dtype=bool)
    for _ in range(20):
        x = x + drift + noise.resolve(1).sample(rng, len(x))[:, 0]
        safe &= x >= 0
    share = 1 - safe.mean()
    slack = 4 * np.sqrt(share / len(x))
    assert found.lower - slack <= share <= found.upper + slack


def test_interest_beyond_two_limits_counts_on_both_sides() -> None:
    """Both ends are limits: nothing is cut."""
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=1, noise=cb.Laplace(scale=0.2))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    found = bound_failure(problem, seconds=0.5)
    assert found.lower <= np.exp(-5) <= found.upper < 1.01 * found.lower
