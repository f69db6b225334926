"""The corners of a cell contain the dynamics at every point of it."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.quadratic.corners import Cells, Dynamics, curved_axes
from certbound.quadratic.form_matrices import splitting
from certbound.quadratic.setting import make_setting

LOW, HIGH = np.array([-0.5, 0.2, -1.0]), np.array([1.5, 1.4, 0.5])


def bent(t: float, x: Array, d: Array) -> list[object]:
    """Products, a sine, an exponential, time, and a disturbance beside a state."""
    return [x[1] * x[2] - x[0] + d[0], np.sin(x[0]) * x[1] + 0.3 * d[0] * x[2], np.exp(0.4 * x[2]) - t * x[0]]


def shaken(x: Array) -> list[list[object]]:
    """Constant, affine, bilinear and curved entries."""
    return [[0.3, 0.1 * x[1]], [0.2 * x[0] * x[1], 0.0], [0.1 * np.cos(x[2]), 0.2]]


def affine(x: Array) -> list[list[object]]:
    return [[0.3, 0.1 * x[1]], [0.0, 0.2 - 0.1 * x[0]], [0.1, 0.2]]


def problem_of(diffusion: object) -> cb.Problem:
    system = cb.ContinuousSystem(bent, states=3, disturbance=cb.Box([-0.2], [0.3]), diffusion=diffusion)
    return cb.Problem(system, initial=[0.5, 0.8, -0.2], safe=[cb.Inside(cb.Box(LOW, HIGH))], horizon=1.0)


def cells_of(problem: cb.Problem) -> Cells:
    dynamics = Dynamics(problem, make_setting(problem, LOW, HIGH))
    assert dynamics.autonomous is False
    low = np.array([[-1.0, -1.0, -1.0], [0.0, -1.0, -0.5]])
    high = np.array([[0.0, 1.0, 1.0], [1.0, 0.5, 0.25]])
    return dynamics.over(low, high, 0.25, 0.5)


@pytest.mark.parametrize("diffusion", [shaken, affine, 0.2 * np.eye(3)])
def test_drift_and_diffusion_lie_among_the_corners(diffusion: object) -> None:
    problem = problem_of(diffusion)
    cells, rng = cells_of(problem), np.random.default_rng(0)
    width, center = (HIGH - LOW) / 2, (HIGH + LOW) / 2
    drift, system = compile_numpy(problem.closed_loop), problem.system
    noise = compile_numpy(system.diffusion) if callable(diffusion) else lambda t, *x: 0.2 * np.eye(3)
    for c in range(2):
        for _ in range(300):
            xi = rng.uniform(cells.low[c], cells.high[c])
            x, t, d, p = center + width * xi, rng.uniform(0.25, 0.5), rng.uniform(-0.2, 0.3), rng.standard_normal(3)
            z, q = np.append(xi, 1.0), np.append(p, 0.0)
            f, g = drift(t, *x, d) / width, noise(t, *x) / width[:, None]
            along = np.array([q @ corner @ z for corner in cells.drift.mid[:, c]])
            square = np.array([np.sum((q @ columns) ** 2) for columns in cells.spread.mid[:, c]])
            allowed = along + square / 2 + cells.toll.hi[c] + z @ cells.bend.hi[c] @ z + 1e-9
            assert p @ f + np.sum((g.T @ p) ** 2) / 2 <= allowed.max()
            assert cells.square.contains(np.array([g @ g.T] * 2))[c].all()
            if cells.affine is not None:
                assert np.allclose(cells.affine.mid @ z, np.vstack([g, np.zeros(g.shape[1])]).T)


def test_curved_noise_lies_below_its_columns() -> None:
    """With a linear drift nothing else is in the columns: along every direction they must bear the noise."""
    system = cb.ContinuousSystem(lambda x: -x, states=3, diffusion=lambda x: [[0.1], [0.2 * x[0] * x[1]],
                                                                              [(x[2] + 0.25) ** 2]])  # fmt: skip
    problem = cb.Problem(system, initial=[0.5, 0.8, -0.2], safe=[cb.Inside(cb.Box(LOW, HIGH))], horizon=1.0)
    setting = make_setting(problem, LOW, HIGH)
    cells = Dynamics(problem, setting).over(-np.ones((1, 3)), np.ones((1, 3)), 0.0, 1.0)
    noise, rng = compile_numpy(system.diffusion), np.random.default_rng(2)
    for p in [*np.eye(3), *rng.standard_normal((20, 3))]:
        xi = rng.uniform(-1, 1, (500, 3))
        g = noise(0.0, *setting.over(xi, xi).mid.T)[:, :, 0] / setting.width
        square = [np.sum((p @ columns[:3]) ** 2) for columns in cells.spread.mid[:, 0]]
        assert np.max((g @ p) ** 2) <= max(square) + 1e-12


def test_remainders_that_vanish_with_a_coordinate_cost_nothing_where_it_does() -> None:
    """y sin(x): on a cell about x = y = 0 all of the remainder vanishes there, and it is paid away from it."""
    system = cb.ContinuousSystem(lambda x: [-x[0], x[1] * (np.sin(x[0]) - 1), -x[2]], states=3, diffusion=np.eye(3))
    problem = cb.Problem(system, initial=[0, 0, 0], safe=[cb.Inside(cb.Box([-1] * 3, [1] * 3))], horizon=1.0)
    dynamics = Dynamics(problem, make_setting(problem, -np.ones(3), np.ones(3)))
    cells = dynamics.over(np.array([[-0.5, -1.0, -1.0]]), np.array([[0.5, 1.0, 1.0]]), 0.0, 1.0)
    assert curved_axes(problem) == {0, 1}
    assert cells.toll.hi[0] == 0
    assert abs(cells.bend.hi[0, -1, -1]) < 1e-12
    z = np.array([0.5, 1.0, 0.0, 1.0])
    assert z @ cells.bend.mid[0] @ z > 0.01
    assert cells.spread.shape[-1] == 4  # a column for the remainder of the second state


def test_a_splitting_is_zero_where_its_coordinates_are_the_states() -> None:
    rng, held = np.random.default_rng(1), (0, 2)
    basis = splitting(3, held)
    for _ in range(20):
        z = np.append(rng.standard_normal(3), 1.0)
        values = np.einsum("a,baij,i,j->b", z[list(held)], basis, z, z)
        assert np.abs(values).max() < 1e-12
    assert np.linalg.matrix_rank(basis.reshape(len(basis), -1)) == len(basis)


def test_kinks_and_too_many_corners_are_refused() -> None:
    kinked = cb.ContinuousSystem(lambda x: [-abs(x[0]), -x[1]], states=2, diffusion=np.eye(2))
    problem = cb.Problem(kinked, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1.0)
    low, high = -np.ones(2), np.ones(2)
    with pytest.raises(InfeasibleError, match="kinks or jumps"):
        Dynamics(problem, make_setting(problem, low, high))
    many = cb.ContinuousSystem(lambda x: [-(x[i] ** 2) for i in range(10)], states=10, diffusion=np.eye(10))
    problem = cb.Problem(many, initial=np.zeros(10), safe=[cb.Inside(cb.Box([-1] * 10, [1] * 10))], horizon=1.0)
    dynamics = Dynamics(problem, make_setting(problem, -np.ones(10), np.ones(10)))
    with pytest.raises(InfeasibleError, match="1024 extreme cases"):
        dynamics.over(-np.ones((1, 10)), np.ones((1, 10)), 0.0, 1.0)
