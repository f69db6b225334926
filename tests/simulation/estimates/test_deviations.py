"""The largest deviation from the noise-free path: exact laws, metrics, directions, profiles, curves over time."""

import numpy as np
import pytest
from scipy.special import ndtri

import certbound as cb
from certbound.simulation.estimates.deviations import Measure, sup_deviation
from certbound.simulation.stepping import Scenario
from experiments.first_passage import exit_radius

OU = {"rate": -0.5, "sigma": 0.1**0.5, "horizon": 5.0}


def ou(n=1, start=None, horizon=5.0):
    system = cb.ContinuousSystem(lambda x: -0.5 * x, states=n, diffusion=0.1**0.5 * np.eye(n))
    initial = np.zeros(n) if start is None else start
    return cb.Problem(system, initial=initial, safe=[], domain=cb.Box([-99] * n, [99] * n), horizon=horizon)


@pytest.mark.parametrize("scheme", ["exact", "euler"])
def test_quantiles_are_the_exact_ones_in_one_dimension(scheme):
    found = sup_deviation(ou(), paths=25_000, rng=1, steps=250, scenario=Scenario(scheme=scheme))
    for delta in (0.1, 0.01, 0.001):
        value, lower, upper = found.quantile(1 - delta, confidence=0.9999)
        exact = exit_radius(delta, **OU)
        assert lower * 0.997 < exact < upper * 1.003
        assert lower < value < upper
    probability, lower, upper = found.exceedance(exit_radius(0.01, **OU))
    assert lower < 0.01 < upper
    assert lower < probability < upper


def test_without_the_bridge_the_supremum_is_too_small():
    found = sup_deviation(ou(), paths=50_000, rng=1, steps=100, scenario=Scenario(bridge=False))
    assert found.quantile(0.9).upper < 0.98 * exit_radius(0.1, **OU)


def test_quantiles_are_the_exact_ones_in_three_dimensions():
    found = sup_deviation(ou(3), paths=30_000, rng=2, steps=250)
    for delta in (0.1, 0.01):
        exact = exit_radius(delta, **OU, dimension=3)
        quantile = found.quantile(1 - delta, confidence=0.9999)
        assert quantile.lower * 0.997 < exact < quantile.upper * 1.003


def test_the_start_does_not_matter_for_a_linear_system():
    fixed = sup_deviation(ou(), paths=20_000, rng=3, steps=100)
    spread = sup_deviation(ou(start=cb.Box([-5.0], [5.0])), paths=20_000, rng=3, steps=100)
    for level in (0.5, 0.99):
        assert spread.quantile(level).lower < fixed.quantile(level).value < spread.quantile(level).upper


def test_a_metric_coordinates_and_directions_measure_what_they_say():
    def quantile(row=0, **measure):
        return sup_deviation(ou(2), paths=20_000, rng=4, steps=100, measure=Measure(**measure)).quantile(0.9, row=row)

    plain = quantile()
    assert quantile(metric=4.0 * np.eye(2)).value == pytest.approx(2 * plain.value, rel=1e-3)
    flat = quantile(coordinates=[1])
    assert flat.lower < exit_radius(0.1, **OU) < flat.upper
    one_sided = quantile(directions=[[0.0, 1.0], [0.0, -2.0]])
    assert one_sided.lower < exit_radius(0.2, **OU) * 1.02
    assert one_sided.value < flat.value < plain.value
    assert quantile(row=1, directions=[[0.0, 1.0], [0.0, -2.0]]).value == pytest.approx(2 * one_sided.value, rel=0.03)


def test_a_profile_tells_how_much_a_tube_must_be_scaled():
    exact = exit_radius(0.1, **OU)
    flat = sup_deviation(ou(), paths=20_000, rng=5, steps=100, measure=Measure(profile=lambda t: 0.0 * t + exact))
    plain = sup_deviation(ou(), paths=20_000, rng=5, steps=100)
    assert flat.quantile(0.9).value == pytest.approx(plain.quantile(0.9).value / exact, rel=1e-2)
    growing = np.sqrt(np.linspace(0.0, 5.0, 101))
    scaled = sup_deviation(ou(), paths=20_000, rng=5, steps=100, measure=Measure(profile=growing))
    paths = cb.sample_paths(ou(), paths=20_000, rng=5, steps=100)[:, 1:, 0]
    bare = np.quantile(np.max(np.abs(paths) / growing[1:], axis=1), 0.9)
    assert bare < scaled.quantile(0.9).value < 1.3 * bare


def test_curves_over_time_are_the_marginal_and_the_running_laws():
    found = sup_deviation(ou(), paths=50_000, rng=6, steps=100, points=5)
    np.testing.assert_allclose(found.times, [1, 2, 3, 4, 5])
    marginal = found.quantile_curve(0.95, confidence=0.9999)
    spread = np.sqrt(0.1 * (1 - np.exp(-found.times)))
    exact = ndtri(0.975) * spread
    assert np.all((marginal[:, 1] < exact) & (exact < marginal[:, 2]))
    running = found.quantile_curve(0.95, running=True)
    assert np.all(np.diff(running[:, 0]) > 0)
    assert running[-1, 0] == pytest.approx(found.quantile(0.95).value, rel=0.01)
    assert np.all(running[:, 0] > marginal[:, 0])


def test_discrete_time_takes_the_largest_step():
    system = cb.DiscreteSystem(lambda x: 0.0 * x, states=1, noise=cb.Gaussian(std=2.0))
    subject = cb.Problem(system, initial=[7.0], safe=[], domain=cb.Box([-99.0], [99.0]), horizon=4)
    found = sup_deviation(subject, paths=50_000, rng=7)
    exact = 2.0 * ndtri((1 + 0.9**0.25) / 2)
    quantile = found.quantile(0.9, confidence=0.9999)
    assert quantile.lower < exact < quantile.upper


def test_the_associated_path_shares_the_disturbance():
    system = cb.ContinuousSystem(
        lambda x, d: -0.5 * x + d, states=1, disturbance=cb.Box([-9.0], [9.0]), diffusion=[[0.1**0.5]]
    )
    subject = cb.Problem(system, initial=[0.0], safe=[], domain=cb.Box([-99.0], [99.0]), horizon=5.0)
    exact = exit_radius(0.1, **OU)
    for disturbance in ("constant", "switching"):
        scenario = Scenario(disturbance=disturbance, scheme="euler")
        quantile = sup_deviation(subject, paths=20_000, rng=8, steps=200, scenario=scenario).quantile(0.9)
        assert quantile.lower < exact < quantile.upper


def test_a_quantile_beyond_the_sample_has_no_upper_limit():
    found = sup_deviation(ou(), paths=100, rng=9, steps=20)
    quantile = found.quantile(0.9999)
    assert quantile.upper == np.inf
    assert 0 < quantile.lower <= quantile.value
    with pytest.raises(ValueError, match=r"`level` must lie in \(0, 1\), got 1.0"):
        found.quantile(1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"measure": Measure(metric=[[1.0]])}, "`metric` must have shape"),
        ({"measure": Measure(metric=-np.eye(2))}, "`metric` must be positive definite"),
        ({"measure": Measure(coordinates=[2])}, "`coordinates` must be distinct state indices below 2"),
        ({"measure": Measure(directions=[[1.0]])}, "`directions` must be finite rows of 2 numbers"),
        ({"measure": Measure(profile=0.0)}, "`profile` must be positive and finite after time 0"),
        ({"points": 50, "steps": 20}, "`points` must be at most the number of steps, 20"),
        ({"points": 1e6, "steps": 1e6}, r"`points` must be at most \d+, got 1000000"),
    ],
)
def test_malformed_measures_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        sup_deviation(ou(2), **({"paths": 10, "rng": 0, "steps": 20} | options))


def test_two_ways_of_measuring_are_refused():
    with pytest.raises(ValueError, match="at most one of `metric`, `coordinates`, `directions`"):
        Measure(metric=np.eye(2), coordinates=[0])


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [2.0, 5.0])
def test_three_million_paths_reach_the_exact_quantiles_of_figure_seven(horizon):
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.1**0.5]])
    subject = cb.Problem(system, initial=[0.0], safe=[], domain=cb.Box([-99.0], [99.0]), horizon=horizon)
    found = sup_deviation(subject, paths=3_000_000, rng=70, steps=round(1000 * horizon))
    for delta in (1e-1, 1e-2, 1e-3, 1e-4):
        value, lower, upper = found.quantile(1 - delta, confidence=0.6827)
        exact = exit_radius(delta, rate=-1.0, sigma=0.1**0.5, horizon=horizon)
        assert abs(value - exact) < max(0.003 * exact, 3 * 0.5 * (upper - lower))
