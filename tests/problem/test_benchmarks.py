"""The benchmark files state the published problems."""

from pathlib import Path

import numpy as np
import pytest

from certbound.problem.files.loading import load
from certbound.problem.model.evaluation import compile_numpy

FOLDER = Path(__file__).parents[2] / "experiments" / "benchmarks"

EXPECTED = {
    "two_tanks": ("discrete", 5, 1e-6, [2.0, 1.0], [2.25, 0.8]),
    "room_3d": ("discrete", 3, 1e-6, [17.0, 18.0, 17.5], [16.751, 17.6335, 17.2155]),
    "van_der_pol_dt": ("discrete", 5, 1e-3, [5.0, 5.0], [5.5, -7.5]),
    "contraction_14d": ("discrete", 1, 1e-2, [1.0] * 14, [0.8] * 14),
    "oscillator_cubic": ("continuous", 5, 1e-3, [1.0, 2.0], [2.0, -3.5]),
    "room_1d": ("continuous", 5, 1e-6, [19.7], [-0.23364677918]),
    "ou_radius": ("continuous", 2, 1e-3, [3.0], [-3.0]),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_the_file_is_the_published_problem(name):
    time, horizon, delta, x, expected = EXPECTED[name]
    problem = load(FOLDER / f"{name}.toml")
    assert (problem.name, problem.system.time, problem.horizon, problem.delta) == (name, time, horizon, delta)
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(0, *x), expected, rtol=1e-9)


def test_every_file_is_tested():
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(EXPECTED)


def test_noise_levels_are_the_published_ones():
    levels = {
        "two_tanks": 1e-4 * np.eye(2),
        "room_3d": 1e-4 * np.eye(3),
        "van_der_pol_dt": 0.02**2 / 3 * np.eye(2),
        "contraction_14d": 0.04 * np.eye(14),
    }
    for name, proxy in levels.items():
        np.testing.assert_allclose(load(FOLDER / f"{name}.toml").system.noise.proxy, proxy, rtol=1e-12)
    diffusions = {"oscillator_cubic": [[0], [0.5]], "room_1d": [[0.1]], "ou_radius": [[0.1**0.5]]}
    for name, diffusion in diffusions.items():
        np.testing.assert_allclose(load(FOLDER / f"{name}.toml").system.diffusion, diffusion, rtol=1e-15)
