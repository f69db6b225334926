"""``bound_reach``: one door to every engine."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EngineError, InfeasibleError
from certbound.problem.library import MODELS
from certbound.reach.contraction.local import local_constants, local_contraction_tube, local_tube, radius_over_pieces
from certbound.reach.linear.run import LinearRun


def spiral(half=0.05, sigma=0.05, horizon=2.0) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: [-0.5 * x[0] + x[1], -x[0] - 0.5 * x[1] + 0.1 * np.sin(x[0])], states=2, diffusion=sigma * np.eye(2)
    )
    start = np.array([0.5, 0.0])
    safe = [cb.Inside(cb.Box([-9, -9], [9, 9]))]
    return cb.Problem(system, initial=cb.Box(start - half, start + half), safe=safe, horizon=horizon)


@pytest.mark.parametrize("method", ["linear", "contraction"])
def test_noise_free_paths_lie_in_the_reach_tube(method):
    problem = spiral()
    reach = cb.bound_reach(problem, noise=False, method=method)
    assert reach.end == problem.horizon
    assert not reach.noise
    paths = cb.sample_paths(
        problem.replace(system=cb.ContinuousSystem(problem.system.dynamics, states=2)),
        paths=20,
        rng=np.random.default_rng(0),
    )
    times = np.linspace(0, problem.horizon, paths.shape[1])
    for k in range(0, len(times), 50):
        for path in paths:
            assert reach.contains(float(times[k]), path[k], tolerance=5e-3)


@pytest.mark.parametrize("method", ["linear", "contraction"])
def test_noise_widens_the_tube_and_carries_its_probability(method):
    problem = spiral()
    calm = cb.bound_reach(problem, noise=False, method=method)
    noisy = cb.bound_reach(problem, noise=True, method=method)
    assert noisy.noise
    assert noisy.log10_delta <= np.log10(problem.delta) + 1e-9
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    for t in (0.5, 1.0, 2.0):
        assert np.all(noisy.extent(directions, t) > calm.extent(directions, t))


def test_a_tube_asks_no_probability_of_breaking_the_constraints(monkeypatch):
    """Each of them asks for rows of its own, and for as much time as the tube itself."""
    asked = []
    monkeypatch.setattr(LinearRun, "_cell", lambda *given: asked.append(given))
    problem = spiral().replace(safe=[cb.Inside(cb.Ball([0.0, 0.0], 9.0)), cb.Outside(cb.Ball([4.0, 4.0], 0.5))])
    tube = cb.bound_reach(problem, method="linear")
    assert tube.log10_delta <= np.log10(problem.delta) + 1e-9
    assert not asked


def test_auto_takes_an_engine_that_reaches_the_horizon():
    reach = cb.bound_reach(spiral(), noise=False)
    assert reach.end == 2.0


def test_cells_are_passed_on():
    assert cb.bound_reach(spiral(), noise=False, cells=2, method="contraction").curve.cells == 4


def test_local_rates_serve_where_no_global_ones_exist():
    system = cb.ContinuousSystem(lambda x: [-x[0] + 0.3 * x[0] ** 2], states=1, diffusion=0.02)
    problem = cb.Problem(system, initial=cb.Box([0.4], [0.5]), safe=[], horizon=2.0)
    with pytest.raises(InfeasibleError):
        cb.bound_constants(problem)
    reach = cb.bound_reach(problem, noise=False, method="contraction")
    assert "local" in reach.method
    assert reach.end == 2.0
    noisy = cb.bound_reach(problem, method="contraction")
    assert noisy.noise
    assert 0.02 < float(noisy.radius.max()) < 0.2


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="`method` must be one of auto, linear, contraction"):
        cb.bound_reach(spiral(), method="magic")


def test_a_local_tube_confirms_its_own_guess():
    problem = MODELS["unicycle"](disturbance=0.0, x0_halfwidth=0.0).replace(horizon=0.5)
    reach = local_contraction_tube(problem)
    tube, radius = local_tube(problem, reach, delta=1e-3, method="kummer")
    again = local_constants(problem, reach, radius)
    assert np.all(np.asarray(again.rate) <= np.asarray(tube.constants.rate) + 1e-9)
    assert np.all(radius_over_pieces(tube, reach.curve) <= radius + 1e-15)
    wider = local_constants(problem, reach, 3 * radius)
    assert np.max(np.asarray(wider.rate) - np.asarray(again.rate)) > 0


def test_one_time_bounds_must_not_be_combined_with_local_constants():
    problem = MODELS["unicycle"](disturbance=0.0, x0_halfwidth=0.0).replace(horizon=0.5)
    reach = local_contraction_tube(problem)
    with pytest.raises(ValueError, match="trajectory level"):
        local_tube(problem, reach, delta=1e-3, method="markov")


def test_a_local_tube_that_cannot_close_says_so():
    problem = MODELS["unicycle"](disturbance=0.0, x0_halfwidth=0.0, sigma=1.0).replace(horizon=1.0)
    reach = local_contraction_tube(problem)
    with pytest.raises(InfeasibleError, match="no local tube at delta"):
        local_tube(problem, reach, delta=1e-3, method="kummer")


def test_fewer_pieces_keep_the_largest_values_and_the_proof():
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + 0.3 * x[0] ** 2], states=1, diffusion=lambda x: [[0.02 + 0.01 * x[0]]]
    )
    problem = cb.Problem(system, initial=cb.Box([0.4], [0.5]), safe=[], horizon=2.0)
    reach = local_contraction_tube(problem)
    fine = local_constants(problem, reach, 0.1, segments=10_000)
    coarse = local_constants(problem, reach, 0.1, segments=7)
    assert fine.certified
    assert coarse.certified
    assert len(coarse.times) == 8
    assert len(fine.times) == reach.curve.pieces + 1
    piece = np.searchsorted(coarse.times, fine.times[:-1], side="right") - 1
    for name in ("rate", "sigma"):
        assert np.all(getattr(coarse, name)[piece] >= getattr(fine, name))
        assert np.max(getattr(coarse, name)) == np.max(getattr(fine, name))
    altered = cb.Constants(
        rate=coarse.rate - 1e-9, sigma=coarse.sigma, dimension=1, times=coarse.times, proof=coarse.proof
    )
    assert not altered.certified


@pytest.mark.parametrize("continuous", [True, False])
def test_the_contraction_tube_holds_the_spread_of_a_random_start(continuous):
    start = cb.GaussianStart([1.0, 0.0], covariance=[[0.04, 0.0], [0.0, 0.01]])
    law = {"states": 2, "diffusion": 1e-3 * np.eye(2)} if continuous else {"states": 2, "noise": cb.Gaussian(std=1e-3)}
    kind = cb.ContinuousSystem if continuous else cb.DiscreteSystem
    system = kind(lambda x: [-0.5 * x[0] if continuous else 0.5 * x[0], 0.2 * np.sin(x[1])], **law)
    problem = cb.Problem(system, initial=start, safe=[], horizon=2, delta=0.05)
    reach = cb.bound_reach(problem, method="contraction")
    points = start.mean + np.random.default_rng(0).standard_normal((2000, 2)) * [0.2, 0.1]
    outside = np.any((points < reach.hull.lo[0]) | (points > reach.hull.hi[0]), axis=1)
    assert outside.mean() < problem.delta
    assert cb.bound_reach(problem, noise=False, method="contraction").hull.hi[0, 0] == pytest.approx(1.0)


def test_local_constants_make_no_tube_of_a_random_start():
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0] + 0.1 * x[0] ** 3], states=["x"], noise=cb.Gaussian(std=1e-3))
    start = cb.GaussianStart([0.1], covariance=[[0.01]])
    problem = cb.Problem(system, initial=start, safe=[], horizon=3)
    with pytest.raises(InfeasibleError, match="`initial` is a GaussianStart"):
        cb.bound_reach(problem, method="contraction")


@pytest.mark.parametrize("continuous", [True, False])
def test_constants_of_the_domain_prove_a_tube_while_it_is_in_the_domain(continuous):
    law = {"diffusion": 1e-3} if continuous else {"noise": cb.Gaussian(std=1e-3)}
    kind = cb.ContinuousSystem if continuous else cb.DiscreteSystem
    system = kind(lambda x: [x[0] + x[0] ** 3], states=1, **law)
    start, domain = cb.Box([0.5], [0.7]), cb.Box([-1], [1])
    problem = cb.Problem(system, initial=start, safe=[], horizon=0.5 if continuous else 3, domain=domain)
    for noise in (False, True):
        reach = cb.bound_reach(problem, noise=noise, method="contraction")
        assert 0 < reach.end < problem.horizon
        assert np.all(reach.hull.hi[: None if continuous else -1] <= 1.0)
        wide = cb.bound_reach(problem.replace(domain=cb.Box([-1e3], [1e3])), noise=noise, method="linear")
        assert wide.end == problem.horizon
    tiny = problem.replace(domain=cb.Box([0.5 - 1e-6], [0.7 + 1e-6]))
    if continuous:
        with pytest.raises(EngineError, match="leaves the model's domain on its first piece"):
            cb.bound_reach(tiny, method="contraction")
