"""Noise in one of three coordinates: every majorant against sampling, and bounds against simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.values.semilagrangian import bound_exits_by_steps, serves
from certbound.values.semilagrangian.carried import bound_carried_exits
from certbound.values.semilagrangian.carried.carried_exits import bound_by_kicks
from certbound.values.semilagrangian.carried.carried_grid import Fineness, axes_of, layout_of
from certbound.values.semilagrangian.carried.carried_problem import Voyage, voyage_of
from certbound.values.semilagrangian.carried.carried_step import Layout, back, terminal

COARSE = Fineness(count=8, cells=10, edge=2.0, cell=0.8, omega=4.5)


def course(x):
    """A vehicle of speed 1 that steers towards the line y = 0."""
    return [np.cos(x[2]), np.sin(x[2]), -1.0 * x[2] - 0.5 * x[1]]


def vehicle(horizon: float = 0.5, s: float = 0.8, f=course, safe=None, start=(0.0, 0.3, 0.5)) -> cb.Problem:
    safe = safe or [cb.Inside(cb.Box([-1, -0.8], [1.5, 0.8], coordinates=[0, 1]))]
    system = cb.ContinuousSystem(f, states=3, diffusion=[[0.0], [0.0], [s]])
    return cb.Problem(system, initial=list(start), safe=safe, horizon=horizon)


@pytest.fixture(scope="module")
def ready() -> tuple[Voyage, Layout]:
    voyage = voyage_of(vehicle())
    return voyage, layout_of(voyage, COARSE)


def paths(voyage: Voyage, x: np.ndarray, step: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """States (3, paths) after one step and half a step more without noise, by small steps of Heun's method."""
    drift, parts = compile_numpy(voyage.tape), 40
    z, d = np.tile(x[:, None], (1, count)), step / parts
    for k in range(parts + parts // 2):
        noise = voyage.noise * math.sqrt(d) * rng.standard_normal(count) if k < parts else np.zeros(count)
        kick = np.stack([0 * noise, 0 * noise, noise])
        f = np.broadcast_to(drift(0.0, *z), (count, 3)).T
        ahead = z + d * f + kick
        z = z + d / 2 * (f + np.broadcast_to(drift(0.0, *ahead), (count, 3)).T) + kick
    return z


def test_one_step_back_is_above_the_mean_of_any_function_however_wrong(ready) -> None:
    voyage, layout = ready
    rng = np.random.default_rng(3)
    value = terminal(layout)
    value = np.maximum(value, rng.uniform(0, 1, value.shape))  # nothing like a probability: ragged everywhere
    found, _ = back(layout, value)
    look, seen = (
        RegularGridInterpolator(layout.axes, part, bounds_error=False, fill_value=2.0) for part in (value, found)
    )
    drift, h = compile_numpy(voyage.tape), voyage.horizon / COARSE.count
    live = np.argwhere(layout.level == 0)
    for cell in live[rng.choice(len(live), 8, replace=False)]:
        y = np.array([axis[k] + rng.uniform(0.1, 0.9) * (axis[k + 1] - axis[k]) for axis, k in zip(layout.axes, cell)])
        x = y.copy()
        for _ in range(40):  # half a step back
            x -= h / 80 * np.broadcast_to(drift(0.0, *x), 3)
        ends = look(paths(voyage, x, h, 2000, rng).T)
        mean, error = np.minimum(ends, 1.0).mean(), ends.std() / math.sqrt(2000)
        assert float(seen(y)[0]) >= mean - 4 * error


def test_smooth_functions_lose_little_in_a_step() -> None:
    voyage = voyage_of(vehicle())
    fine = layout_of(voyage, Fineness(count=20, cells=24, edge=2.0, cell=0.5, omega=4.5))
    value = np.maximum(terminal(fine), 0.3)  # a constant is its own mean
    found, _ = back(fine, value)
    inner = found[len(found) // 2, found.shape[1] // 2, found.shape[2] // 2]
    assert 0.3 <= inner < 0.301


def test_a_higher_function_gives_a_higher_bound_and_levels_are_kept(ready) -> None:
    _, layout = ready
    value = terminal(layout)
    found, _ = back(layout, value)
    nodes = np.maximum.reduce([layout.level[1:, 1:, 1:], layout.level[:-1, :-1, :-1]])
    assert np.all(found[1:-1, 1:-1, 1:-1] >= nodes)
    assert np.all(found >= 0)


def simulated(problem: cb.Problem, voyage: Voyage, count: int, rng: np.random.Generator) -> float:
    drift, parts = compile_numpy(voyage.tape), 300
    x = np.array([np.full(count, ends[0]) for ends in voyage.starts])
    d, failed = voyage.horizon / parts, np.zeros(count, dtype=bool)
    for _ in range(parts):
        noise = voyage.noise * math.sqrt(d) * rng.standard_normal(count)
        x = x + d * np.broadcast_to(drift(0.0, x[0], x[1], x[2] + noise / 2), (count, 3)).T
        x[2] += noise
        failed |= ~np.all([c.satisfied(x.T) for c in problem.constraints], axis=0)
    return float(failed.mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    "safe",
    [
        None,
        [cb.Inside(cb.Ball([0, 0], 0.8, coordinates=[0, 1]))],
        [cb.Inside(cb.Box([-1, -1], [2, 1], coordinates=[0, 1])),
         cb.Outside(cb.Ball([0.2, 0.7], 0.2, coordinates=[0, 1]))],
        [cb.Inside(cb.Box([-1, -1, -1.2], [2, 1, 1.4]))],
    ],
)  # fmt: skip
def test_bounds_are_above_what_simulation_counts(safe) -> None:
    problem = vehicle(0.5, f=lambda x: [np.cos(x[2]), np.sin(x[2]), -0.2 * x[2]], safe=safe, start=(0.0, 0.35, 1.1))
    voyage = voyage_of(problem)
    share = simulated(problem, voyage, 8000, np.random.default_rng(1))
    error = math.sqrt(share * (1 - share) / 8000)
    bound = bound_by_kicks(voyage, Fineness(count=10, cells=16, edge=1.5, cell=0.6, omega=4.2))
    assert share > 0.01
    assert bound >= share - 4 * error


def test_who_surely_leaves_counts_1(ready) -> None:
    voyage, _ = ready
    leaving = voyage_of(vehicle(start=(1.45, 0.0, 0.0)))
    assert voyage.stays
    assert bound_by_kicks(leaving, COARSE) >= 1 - 1e-9


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (vehicle(safe=[cb.Inside(cb.Ball([0, 0, 0], 1.0))]), "joins the noisy state"),
        (vehicle(safe=[cb.Inside(cb.Box([-1, -1], [1, 1], coordinates=[0, 1]), during=(0, 0.2))]), "windows"),
    ],
)
def test_what_is_not_served_is_said(problem, words) -> None:
    with pytest.raises(InfeasibleError, match=words):
        bound_carried_exits(problem)


@pytest.mark.parametrize("rates", [(0.0, 0.0), (0.0, 1.0), (1e-250, 0.0)])
def test_states_that_stand_still_have_a_grid(rates) -> None:
    voyage = voyage_of(vehicle(f=lambda x: [rates[0] * x[1], rates[1] * x[2], -x[2]]))
    assert all(10 < len(axis) < 1000 for axis in axes_of(voyage, COARSE, 0.1))


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (vehicle(s=1e-170, safe=[cb.Inside(cb.Box([-1, -1, -1], [1, 1, 1]))]), "the noise of a step is less than"),
        (vehicle(s=1e-3, safe=[cb.Inside(cb.Box([-1, -1, -1], [1, 1, 1]))]), "the coarsest grid asks for"),
        (vehicle(f=lambda x: [np.log(x[0]), x[2], -x[2]], start=(-0.9, 0.0, 0.0),
                 safe=[cb.Inside(cb.Box([-1, -1, -1], [-0.8, 1, 1]))]), "undefined all over"),
    ],
)  # fmt: skip
def test_grids_that_cannot_be_made_are_refused(problem, words) -> None:
    with pytest.raises(InfeasibleError, match=words):
        bound_carried_exits(problem)


def test_two_noisy_states_of_three_are_another_engine_s() -> None:
    system = cb.ContinuousSystem(course, states=3, diffusion=np.diag([0.0, 0.1, 0.1]))
    problem = vehicle().replace(system=system)
    assert serves(vehicle())
    assert not serves(problem)


@pytest.mark.slow
def test_the_door_takes_three_states() -> None:
    found = bound_exits_by_steps(vehicle(), seconds=1.0)
    assert found.upper <= 0
    assert found.lower is None
    assert "steps" in found.words
