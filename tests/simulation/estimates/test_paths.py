"""Simulated paths follow the model: drift, noise laws, disturbances, plans, in continuous and discrete time."""

import numpy as np
import pytest
from scipy.stats import kstest

import certbound as cb
from certbound.simulation.estimates.paths import sample_paths
from certbound.simulation.stepping import Scenario

EVERYWHERE = 1e6


def problem(system, start, horizon=1.0, **options):
    n = system.dimension
    safe = [cb.Inside(cb.Box([-EVERYWHERE] * n, [EVERYWHERE] * n))]
    return cb.Problem(system, initial=start, safe=safe, horizon=horizon, **options)


def decay(rate=0.5, sigma=1.0):
    return cb.ContinuousSystem(lambda x: -rate * x, states=1, diffusion=[[sigma]])


def test_without_noise_eulers_scheme_is_followed_exactly():
    system = cb.ContinuousSystem(lambda t, x: [x[1], -np.sin(x[0]) + np.cos(t)], states=2)
    paths = sample_paths(problem(system, [0.3, -0.1]), paths=2, rng=0, steps=100)
    x = np.array([0.3, -0.1])
    for k in range(100):
        np.testing.assert_allclose(paths[:, k], [x, x], rtol=1e-12)
        x = x + 0.01 * np.array([x[1], -np.sin(x[0]) + np.cos(0.01 * k)])
    assert paths.shape == (2, 101, 2)


@pytest.mark.parametrize("scheme", ["exact", "euler"])
def test_a_linear_system_has_the_moments_of_its_scheme(scheme):
    paths = sample_paths(problem(decay(), [2.0]), paths=40_000, rng=1, steps=4, scenario=Scenario(scheme=scheme))[
        :, -1, 0
    ]
    factor, shock = (np.exp(-0.125), 1 - np.exp(-0.25)) if scheme == "exact" else (0.875, 0.25)
    mean = 2.0 * factor**4
    variance = shock * (1 - factor**8) / (1 - factor**2)
    assert abs(paths.mean() - mean) < 5 * np.sqrt(variance / 40_000)
    assert abs(paths.var() / variance - 1) < 5 * np.sqrt(2 / 40_000)


def test_a_jump_beside_a_linear_part_is_no_linear_system():
    def pulled(x):
        return [-0.5 * np.sign(x[0]) - x[0]]

    system = cb.ContinuousSystem(pulled, states=1, diffusion=[[1e-9]])
    paths = sample_paths(cb.Problem(system, initial=[0.2], safe=[], horizon=0.25), paths=1, rng=0)
    assert paths[0, -1, 0] == pytest.approx(0.7 * np.exp(-0.25) - 0.5, abs=1e-3)


def test_twelve_coupled_states_have_the_covariance_of_the_scheme():
    gain = np.zeros((12, 2))
    gain[0, 0], gain[5, 1], gain[5, 0] = 1.0, 0.5, 0.3

    def cascade(x):
        return [-x[0], *[x[i - 1] - x[i] for i in range(1, 12)]]

    system = cb.ContinuousSystem(cascade, states=12, diffusion=gain)
    scenario = Scenario(scheme="euler")
    end = sample_paths(problem(system, np.ones(12), 9.0), paths=20_000, rng=3, steps=36, points=1, scenario=scenario)
    flow = np.eye(12) + 0.25 * (np.eye(12, k=-1) - np.eye(12))
    mean, covariance = np.ones(12), np.zeros((12, 12))
    for _ in range(36):
        mean, covariance = flow @ mean, flow @ covariance @ flow.T + 0.25 * gain @ gain.T
    scale = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(end[:, -1].mean(axis=0) - mean) < 5 * scale / np.sqrt(20_000))
    error = (np.cov(end[:, -1].T) - covariance) / np.outer(scale, scale)
    assert np.max(np.abs(error)) < 5 * np.sqrt(2 / 20_000)


LAWS = {
    "gaussian": (cb.Gaussian(covariance=[[2.0, 0.7], [0.7, 1.0]]), None),
    "uniform": (cb.Uniform(halfwidth=[1.5, 0.3]), (1.5, 0.3)),
    "rademacher": (cb.Rademacher(scale=[1.0, 0.2]), (1.0, 0.2)),
    "bounded": (cb.Bounded(halfwidth=[1.0, 0.5]), (1.0, 0.5)),
}


@pytest.mark.parametrize("name", sorted(LAWS))
def test_discrete_time_noise_follows_its_law(name):
    law, bound = LAWS[name]
    gain = np.array([[1.0, 0.5], [0.0, 2.0]])
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=law, noise_matrix=gain)
    paths = sample_paths(problem(system, [1.0, -1.0], horizon=3), paths=30_000, rng=4)
    noise = (paths[:, 3] - 0.5 * paths[:, 2]) @ np.linalg.inv(gain).T
    reference = law.resolve(2).sample(np.random.default_rng(5), 30_000)
    for i in range(2):
        if bound is not None:
            assert np.max(np.abs(noise[:, i])) <= bound[i] * (1 + 1e-9)
        assert kstest(np.round(noise[:, i], 9), np.round(reference[:, i], 9)).pvalue > 1e-3
    tolerance = 5 * np.sqrt(2 / 30_000) * np.cov(reference.T).max()
    np.testing.assert_allclose(np.cov(noise.T), np.cov(reference.T), atol=2 * tolerance)


def test_milsteins_scheme_is_chosen_where_it_is_exact_and_has_its_second_moment():
    system = cb.ContinuousSystem(lambda x: 0.1 * x, states=2, diffusion=lambda x: [[0.8 * x[0], 0], [0, 0.3]])
    subject = problem(system, [1.0, 0.0])
    moments = {}
    for scheme in ("milstein", "euler"):
        end = sample_paths(subject, paths=200_000, rng=6, steps=1, scenario=Scenario(scheme=scheme))[:, -1]
        moments[scheme] = np.mean((end[:, 0] - 1.1) ** 2)
        assert abs(end[:, 1].var() / 0.09 - 1) < 5 * np.sqrt(2 / 200_000)
    assert moments["euler"] == pytest.approx(0.64, rel=0.02)
    assert moments["milstein"] == pytest.approx(0.64 + 0.5 * 0.64**2, rel=0.03)


def test_milsteins_scheme_is_refused_for_other_diffusions():
    crossed = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=lambda x: [[x[1], 0], [0, 1.0]])
    with pytest.raises(ValueError, match="depends on the state in another way"):
        sample_paths(problem(crossed, [1.0, 1.0]), paths=1, rng=0, scenario=Scenario(scheme="milstein"))
    with pytest.raises(ValueError, match="'milstein' needs a state-dependent diffusion"):
        sample_paths(problem(decay(), [1.0]), paths=1, rng=0, scenario=Scenario(scheme="milstein"))
    nonlinear = cb.ContinuousSystem(lambda x: -(x**3), states=1, diffusion=[[1.0]])
    with pytest.raises(ValueError, match="'exact' needs a linear system with constant coefficients"):
        sample_paths(problem(nonlinear, [1.0]), paths=1, rng=0, scenario=Scenario(scheme="exact"))


def still(high=1.0):
    """The state integrates its disturbance: after a second it is the mean of d."""
    return cb.ContinuousSystem(lambda x, d: [d[0], d[1]], states=2, disturbance=cb.Box([-1.0, 0.0], [high, 0.5]))


def test_a_constant_disturbance_is_uniform_in_its_box():
    end = sample_paths(problem(still(), [0.0, 0.0]), paths=5000, rng=7, steps=10)
    rates = np.diff(end, axis=1) * 10
    assert np.max(np.ptp(rates, axis=1)) < 1e-9
    assert kstest(rates[:, 0, 0], "uniform", (-1, 2)).pvalue > 1e-3
    assert kstest(rates[:, 0, 1], "uniform", (0, 0.5)).pvalue > 1e-3


def test_a_switching_disturbance_jumps_between_vertices_at_random_times():
    paths = sample_paths(
        problem(still(), [0.0, 0.0]), paths=300, rng=8, steps=100, scenario=Scenario(disturbance="switching")
    )
    rates = np.round(np.diff(paths, axis=1) * 100, 6)
    assert {tuple(rate) for rate in rates.reshape(-1, 2)} == {(-1, 0), (1, 0), (-1, 0.5), (1, 0.5)}
    jumps = np.any(np.diff(rates, axis=1) != 0, axis=2).sum(axis=1)
    assert abs(jumps.mean() - 0.75 * 100 / 10.5) < 0.5


def test_given_disturbances_are_followed():
    signal = np.array([[1.0, 0.5], [-1.0, 0.0]])
    paths = sample_paths(problem(still(), [0.0, 0.0]), paths=1, rng=0, steps=10, scenario=Scenario(disturbance=signal))
    np.testing.assert_allclose(np.diff(paths[0], axis=0) * 10, np.repeat(signal, 5, axis=0), atol=1e-12)


def test_an_adversarial_disturbance_sees_the_state_and_is_cut_off_at_its_box():
    system = cb.ContinuousSystem(lambda x, d: d, states=1, disturbance=cb.Box([-1.0], [1.0]), diffusion=[[0.1]])
    scenario = Scenario(disturbance=lambda t, x: [5.0 * np.sign(x[0])])
    end = sample_paths(problem(system, [0.1]), paths=200, rng=9, steps=50, scenario=scenario)[:, -1, 0]
    assert np.all(np.abs(np.abs(end) - 1.0) < 0.6)
    assert abs(np.mean(np.abs(end)) - 1.1) < 0.1


@pytest.mark.parametrize(
    ("disturbance", "message"),
    [
        ("adversarial", "must be 'constant', 'switching', an array or a function"),
        ([2.0, 0.0], "must lie in the system's disturbance box"),
        ([0.0], "must hold 2 finite values a row"),
        (lambda t, x: [x[0]], "must return 2 values"),
    ],
)
def test_malformed_disturbances_are_refused(disturbance, message):
    with pytest.raises(ValueError, match=message):
        sample_paths(problem(still(), [0.0, 0.0]), paths=1, rng=0, scenario=Scenario(disturbance=disturbance))


def test_a_disturbance_for_a_system_without_one_is_refused():
    with pytest.raises(ValueError, match="must be left out: this system has none"):
        sample_paths(problem(decay(), [0.0]), paths=1, rng=0, scenario=Scenario(disturbance=[0.1]))


def test_plans_as_arrays_and_as_feedback_are_followed():
    box = cb.Box([-9.0], [9.0])
    system = cb.DiscreteSystem(lambda x, u: x + u, states=1, inputs=box)
    rows = np.arange(5.0)[:, None]
    given = sample_paths(problem(system, [0.0], horizon=5, plan=rows), paths=1, rng=0)
    np.testing.assert_allclose(given[0, :, 0], [0, 0, 1, 3, 6, 10])
    fed_back = sample_paths(problem(system, [8.0], horizon=3, plan=lambda x: -0.5 * x), paths=1, rng=0)
    np.testing.assert_allclose(fed_back[0, :, 0], [8, 4, 2, 1])
    driven = cb.ContinuousSystem(lambda x, u: u, states=1, inputs=box)
    held = sample_paths(problem(driven, [0.0], plan=[[1.0], [-2.0]]), paths=1, rng=0, steps=4)
    np.testing.assert_allclose(held[0, :, 0], [0, 0.25, 0.5, 0.0, -0.5], atol=1e-12)


def test_a_system_with_inputs_and_no_plan_is_refused():
    system = cb.DiscreteSystem(lambda x, u: x + u, states=1, inputs=cb.Box([-9.0], [9.0]))
    with pytest.raises(ValueError, match="give `plan=`"):
        sample_paths(problem(system, [0.0], horizon=5), paths=1, rng=0)


def test_starts_are_uniform_in_the_initial_set_or_as_given():
    subject = problem(decay(sigma=0.1), cb.Box([-1.0], [3.0]))
    start = sample_paths(subject, paths=4000, rng=10, steps=1)[:, 0, 0]
    assert kstest(start, "uniform", (-1, 4)).pvalue > 1e-3
    fixed = sample_paths(subject, paths=3, rng=10, steps=1, scenario=Scenario(initial=[2.5]))
    assert np.all(fixed[:, 0, 0] == 2.5)
    with pytest.raises(ValueError, match="`initial` must hold 1 finite numbers"):
        sample_paths(subject, paths=3, rng=10, scenario=Scenario(initial=[np.nan]))


def test_the_deviation_is_the_difference_to_the_path_without_noise():
    system = cb.ContinuousSystem(
        lambda x, d: -np.sin(x) + d, states=1, disturbance=cb.Box([-1.0], [1.0]), diffusion=[[0.3]]
    )
    subject = problem(system, cb.Box([0.0], [1.0]))
    euler = Scenario(scheme="euler")
    states = sample_paths(subject, paths=50, rng=11, steps=40, scenario=euler)
    deviations = sample_paths(subject, paths=50, rng=11, steps=40, deviation=True, scenario=euler)
    nominal = (states - deviations)[..., 0]
    rates = np.diff(nominal, axis=1) * 40 + np.sin(nominal[:, :-1])  # the constant disturbance of each path
    assert np.max(np.ptp(rates, axis=1)) < 1e-9
    assert np.ptp(rates[:, 0]) > 1.0
    assert np.all(deviations[:, 0] == 0.0)


def test_fewer_points_are_a_subset_of_the_same_paths():
    subject = problem(decay(), [1.0])
    every = sample_paths(subject, paths=1500, rng=12, steps=20)
    some = sample_paths(subject, paths=1500, rng=12, steps=20, points=5)
    np.testing.assert_array_equal(every[:, ::4], some)
    with pytest.raises(ValueError, match="`points` must divide the number of steps, 20, got 3"):
        sample_paths(subject, paths=1, rng=0, steps=20, points=3)


def test_paths_that_do_not_fit_into_memory_are_refused_with_what_fits():
    with pytest.raises(ValueError, match="`paths` must be at most 67041 with 1001 stored times of 1 states"):
        sample_paths(problem(decay(), [1.0]), paths=10**6, rng=0)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"scheme": "heun"}, ValueError, "`scheme` must be auto, exact, milstein or euler"),
        ({"disturbance": "random"}, ValueError, "`disturbance` must be"),
    ],
)
def test_malformed_scenarios_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        Scenario(**options)


def test_a_scenario_of_another_type_is_refused():
    with pytest.raises(TypeError, match="`scenario` must be a"):
        sample_paths(problem(decay(), [1.0]), paths=1, rng=0, scenario={"scheme": "euler"})
