"""The files of the literature's problems: each is listed, read, and moves as published."""

import math

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from experiments.literature import ENDS, FOLDER, LITERATURE, path_of

# time, horizon, delta, a state and where it goes (its drift in continuous time), worked out by hand
EXPECTED = {
    "halfdisc_sde": ("continuous", 5, 0.302, [1.0, -0.5], [-0.5, -1.0]),
    "halfdisc_sde_disc": ("continuous", 5, 0.557, [1.0, -0.5], [-0.5, -1.0]),
    "halfdisc_steps": ("discrete", 10, 6.5e-4, [1.0, 0.5], [0.1, -1.15]),
    "halfdisc_steps_disc": ("discrete", 10, 0.402, [1.0, 0.5], [0.1, -1.15]),
    "santoyo": ("continuous", 2, 0.05, [1.0, 2.0], [2.0, -3.5]),
    "neural_barrier": ("discrete", 10, 1e-3, [1.5, 1.0], [1.6, 0.8625]),
    "population": ("discrete", 10, 1e-2, [1.0, 2.0], [0.8, 1.9]),
    "polynomial_4d": ("discrete", 10, 1e-3, [1.0, 1.0, 0.0, 0.0], [1.2, 1.2, 0.0, -0.2]),
    "gbm_target": ("continuous", math.inf, 0.1, [50.0, -50.0], [-125.0, 25.0]),
    "linear_sys": ("discrete", math.inf, 1e-6, [0.5, 0.4], [0.158, -0.04]),
    "two_link": ("discrete", 200, 0.2, [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),
    "walk": ("discrete", math.inf, 1e-4, [2.0], [1.5]),
    "patrol_impact": ("discrete", math.inf, 0.1, [0.0, 6.5], [2.0, 6.5]),
    "patrol_julia": ("discrete", math.inf, 0.1, [1.0, 6.0], [6.0, 6.0]),
    "delivery_impact": ("discrete", math.inf, 0.1, [5.5, 0.0], [3.55, 1.4]),
    "delivery_julia": ("discrete", math.inf, 0.1, [5.5, 0.0], [-3.0, -3.5]),
    "delivery_syscore": ("discrete", math.inf, 0.1, [5.5, 0.0], [3.95, 1.0]),
    "van_der_pol_arch": ("discrete", math.inf, 0.1, [3.0, 1.0], [3.1, -0.1]),
    "van_der_pol_impact": ("discrete", math.inf, 0.1, [3.0, 1.0], [3.1, 1.1]),
    "vehicle_impact": ("discrete", math.inf, 0.5, [1.0, 2.0, 0.0], [0.9, 2.0, 0.0]),
    "vehicle_julia": ("discrete", math.inf, 0.5, [1.0, 2.0, 0.0], [-1.0, 0.0, 0.0]),
    "collision": ("discrete", math.inf, 1e-6, [0.0, 1.2], [0.0, 1.2]),  # at the first centre: pushed up from y = 1
    "pendulum_rasm": ("discrete", math.inf, 1e-6, [0.0, 5.0], [0.05 * (0.63 - 0.672), 0.63 - 0.672]),
    "triple_integrator": ("discrete", 100, 0.05, [0.0, 0.0, 1.0], [-0.07, 0.045 - 0.09, 0.8]),
    "lucid_linear": ("discrete", 15, 1e-3, [0.5], [0.25]),
    "lucid_barrier2": ("discrete", 5, 1e-3, [0.0, 2.0], [0.2, 2.0]),
    "lucid_barrier3": ("discrete", 5, 1e-3, [1.5, 1.0], [1.6, 0.8625]),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_the_file_is_the_published_problem(name):
    time, horizon, delta, x, expected = EXPECTED[name]
    problem = cb.load(path_of(name))
    assert (problem.name, problem.system.time, problem.horizon, problem.delta) == (name, time, horizon, delta)
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(0, *x), expected, rtol=1e-9, atol=1e-12)


def test_every_file_is_listed_and_tested():
    names = {path.stem for path in FOLDER.iterdir()}
    assert names == set(EXPECTED) == set(LITERATURE)
    assert set(ENDS) == {name for name, row in EXPECTED.items() if math.isinf(row[1])}


@pytest.mark.parametrize(("name", "centre", "radius", "side"), [
    ("halfdisc_sde", [-0.5, -0.75], 0.5, [0, -1]), ("halfdisc_steps", [0.8, 0.2], 0.4, [1, 1]),
])  # fmt: skip
def test_the_polygon_holds_the_half_disc_and_little_more(name, centre, radius, side):
    problem = cb.load(FOLDER / f"{name}.toml")
    region = problem.safe[0].region
    points = np.asarray(centre) + radius * np.random.default_rng(0).uniform(-1.2, 1.2, (20_000, 2))
    away = points - centre
    half = (np.hypot(*away.T) <= radius) & (away @ side >= 0)
    inside = region.contains(points)
    assert np.all(inside[half])
    assert np.mean(inside[~half]) < 0.01
    assert problem.ending


def test_a_tool_that_is_installed_is_asked_and_its_last_line_shown(tmp_path, monkeypatch):
    from experiments.peers import PEERS, lucid_answers, peer_rows

    tool = tmp_path / "pylucid"
    tool.write_text("#!/bin/sh\necho reading\necho P = 0.9 of $(basename $1)\n", encoding="utf-8")
    tool.chmod(0o755)
    answer = lucid_answers(str(tool), [FOLDER / "lucid_linear.yaml"])
    assert answer.startswith("lucid_linear: P = 0.9 of lucid_linear.yaml (")
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    rows = {name: said for name, _, _, said in peer_rows()}
    assert set(rows) == set(PEERS)
    assert rows["LUCID"] == "not installed"
    assert rows["PRoTECT"] == "not asked: pip does not bring it"
