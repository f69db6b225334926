"""Chord slopes: what is said of a step holds at all points of the box, and somewhere with hardly anything to spare."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.quadratic.setting import make_setting
from certbound.quadratic.steps import step_bounds
from certbound.quadratic.steps.secants import Secants, secants
from certbound.quadratic.steps.step_program import beyond


def of(f: Any, horizon: int = 5, disturbance: Any = None) -> cb.Problem:
    system = cb.DiscreteSystem(f, states=2, noise=cb.Gaussian(std=0.1), disturbance=disturbance)
    safe = [cb.Inside(cb.Box([-1.0, -1.5], [2.0, 1.5]))]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=horizon)


def spared(problem: cb.Problem, middle: Any, share: float = 1.0, points: int = 61) -> tuple[float, Secants]:
    """The least that a share of the terms leaves to spare of the first state's next value, at any time and d."""
    setting = make_setting(problem, np.array([-1.0, -1.5]), np.array([2.0, 1.5]))
    said = secants(problem, setting, np.array(middle))
    box = problem.system.disturbance
    axes = [np.arange(problem.horizon), *[np.linspace(-1, 1, points)] * 2]
    axes += [] if box is None else [np.array([a, 0.3 * a + 0.7 * b, b]) for a, b in zip(box.low, box.high)]
    t, first, second, *d = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(len(axes), -1)
    xi = np.stack([first, second], axis=1)
    x = setting.center + setting.width * xi
    y = (compile_numpy(problem.closed_loop)(t, *x.T, *d) - setting.center) / setting.width
    z, matrix, rows = np.hstack([xi, np.ones((len(xi), 1))]), said.matrix.mid, said.rows.mid
    most = np.zeros((len(z), len(rows)))
    for k, row in enumerate(rows):
        most[:, k] = np.abs(z @ row[:3]) + most[:, :k] @ np.abs(row[3 : 3 + k])
    room = share * most @ np.abs(matrix[:2, 3:]).T - np.abs(y - (z @ matrix[:, :3].T)[:, :2])
    return float(room[:, 0].min()), said


ONE = {
    "sin": lambda x: 0.7 * np.sin(2 * x[0]) + x[1], "exp": lambda x: np.exp(x[0]), "tanh": lambda x: np.tanh(3 * x[0]),
    "heater": lambda x: 0.35 * np.maximum(0, np.minimum(2, 1.3 - x[0])) + x[0], "square": lambda x: x[1] ** 2 - x[0],
    "quotient": lambda x: x[0] / (1.5 + x[0]), "kink": lambda x: np.abs(x[0] - 0.2) * x[0],
    "root": lambda x: np.sqrt(1.2 + x[0]), "of a sum": lambda x: np.cos(x[0] + x[1]),
    "decided": lambda x: np.where(x[0] > -3, x[0] ** 3, 9.0),
}  # fmt: skip


@pytest.mark.parametrize("middle", [(0.0, 0.0), (-0.85, 0.9), (0.6, -0.3)])
@pytest.mark.parametrize("name", list(ONE))
def test_functions_of_one_value_have_one_term_and_use_all_of_it(name: str, middle: Any) -> None:
    room, said = spared(of(lambda x: [ONE[name](x), 0.5 * x[1]]), middle)
    assert len(said.rows) == 1
    assert room > -1e-9
    less = spared(of(lambda x: [ONE[name](x), 0.5 * x[1]]), middle, 0.9, 241)[0]
    assert less < -1e-3 * np.abs(said.matrix.mid[0, 3])


SEVERAL = {
    "product": lambda x: x[0] * x[1], "cubic": lambda x: x[0] ** 2 * x[1] - x[1],
    "max": lambda x: np.maximum(x[0], x[1]), "quotient": lambda x: x[0] / (2 + x[1]),
    "angle": lambda x: np.arctan2(x[1], 3 + x[0]),
    "nested": lambda x: np.sin(x[0] * np.exp(x[1]) - np.abs(x[1])), "hypot": lambda x: np.hypot(1.5 + x[0], x[1]),
}  # fmt: skip


@pytest.mark.parametrize("middle", [(0.0, 0.0), (-0.85, 0.9)])
@pytest.mark.parametrize("name", list(SEVERAL))
def test_functions_of_several_values_lie_within_their_terms(name: str, middle: Any) -> None:
    room, said = spared(of(lambda x: [SEVERAL[name](x), 0.5 * x[1]]), middle)
    assert room > -1e-9
    assert len(said.rows) > 0


def test_times_and_disturbances_up_to_their_ends() -> None:
    """t runs from 0 to 4; nothing is to spare where both it and d are at an end."""
    pushed = of(lambda t, x, d: [x[0] + 0.1 * t + d[0], x[1] * d[1]], disturbance=cb.Box([-1, 0], [2, 1]))
    room, _ = spared(pushed, (0, 0))
    assert abs(room) < 1e-9


def test_what_a_product_leaves_depends_on_both_sides() -> None:
    """x y with middles 0: x moves first, with slope 0; then y, whose slope is all of x."""
    _, said = spared(of(lambda x: [x[0] * x[1], x[1]]), (-1 / 3, 0.0))
    assert np.isclose(np.abs(said.matrix.mid[0, 3]) * np.abs(said.rows.mid[0, 1]), 1.5 * 1.5 / 1.5, rtol=1e-6)


def test_every_way_out_is_a_wall_and_inside_is_not_beyond() -> None:
    """A step may lead out of a side and a ball at once, or into an obstacle: some form says so wherever it leads."""
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=0.1))
    safe = [
        cb.Inside(cb.Box([-1, -np.inf], [1, np.inf])), cb.Inside(cb.Ball([0.1, 0], 1.05)),
        cb.Inside(cb.HalfSpace([1, 2], 1.4)), cb.Outside(cb.Box([0.3, -0.8], [0.6, -0.4])),
        cb.Outside(cb.Ball([-0.6, 0.2], 0.15)), cb.Outside(cb.HalfSpace([-1, 1], -1.3)),
    ]  # fmt: skip
    problem = cb.Problem(system, initial=[0, 0], safe=safe, horizon=3)
    setting = next(step_bounds._settings(problem))
    xi = np.random.default_rng(0).uniform(-3, 3, (20_000, 2))
    x = setting.center + setting.width * xi
    left = np.any([~constraint.satisfied(x) for constraint in safe], axis=0) | np.any(np.abs(xi) > 1, axis=1)
    z = np.hstack([xi, np.ones((len(xi), 1))])
    shown = [np.all(np.einsum("pi,kij,pj->kp", z, beyond(w).mid, z) >= 0, axis=0) for w in setting.walls]
    assert np.array_equal(left, np.any(shown, axis=0))
    assert 500 < left.sum() < 20_000 - 500


def test_starts_are_all_corners_of_the_hull() -> None:
    system = cb.DiscreteSystem(lambda x: [0.5 * v for v in x], states=3, noise=cb.Gaussian(std=0.1))
    start, safe = cb.Box([-0.2, 0.1, 0.3], [0.4, 0.1, 0.5]), [cb.Inside(cb.Box([-1] * 3, [1] * 3))]
    problem = cb.Problem(system, initial=start, safe=safe, horizon=7)
    given = step_bounds._steps(problem, next(step_bounds._settings(problem)))
    corners = {tuple(row) for row in np.round(given.corners.mid, 12).tolist()}
    assert corners == {(a, 0.1, b, 1.0) for a, b in itertools.product((-0.2, 0.4), (0.3, 0.5))}
    assert given.horizon == 7


@pytest.mark.parametrize("law", [
    cb.Gaussian(covariance=[[0.04, 0.02], [0.02, 0.03]]), cb.Uniform(halfwidth=[0.35, 0.3]),
    cb.Bounded(halfwidth=[0.1, 0.2], independent=False), cb.SubGaussian(proxy_std=0.2),
])  # fmt: skip
def test_columns_of_the_noise_have_its_proxy(law: Any) -> None:
    gain, width = np.array([[1.0, 0.5], [-0.3, 0.7]]), np.array([1.0, 2.0])
    system = cb.DiscreteSystem(lambda x: [0.5 * v for v in x], states=2, noise=law, noise_matrix=gain)
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box(-width, width))], horizon=3)
    columns = step_bounds._columns(problem, next(step_bounds._settings(problem)))[:2] * width[:, None]
    wanted = gain @ system.noise.proxy @ gain.T
    assert np.linalg.eigvalsh(columns @ columns.T - wanted).min() >= -1e-17
    assert np.allclose(columns @ columns.T, wanted, rtol=1e-8)
