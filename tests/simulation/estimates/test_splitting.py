"""Importance splitting: unbiased, with an honest standard error, down to very small probabilities."""

import numpy as np
import pytest

import certbound as cb
from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.splitting import simulate_rare_exits
from certbound.simulation.stepping import Scenario
from experiments.first_passage import exit_probability, exit_radius

OU = {"rate": -0.5, "sigma": 0.1**0.5, "horizon": 5.0}


def ou(radius, start=None):
    system = cb.ContinuousSystem(lambda x: -0.5 * x, states=1, diffusion=[[0.1**0.5]])
    initial = [0.0] if start is None else start
    return cb.Problem(system, initial=initial, safe=[cb.Inside(cb.Ball([0.0], radius))], horizon=5.0)


@pytest.mark.parametrize("radius", [0.8, 1.9])
def test_the_estimate_is_the_exact_probability(radius):
    found = simulate_rare_exits(ou(radius), paths=10_000, particles=250, rng=1, steps=200)
    exact = exit_probability(radius, **OU)
    assert abs(found.probability - exact) < 4 * found.standard_error
    assert found.standard_error < 0.1 * exact
    assert found.lower < exact < found.upper
    assert found.replicas == 40
    assert found.path_steps > found.paths * found.steps * 0.5


def test_the_standard_error_is_the_scatter_between_seeds():
    runs = [simulate_rare_exits(ou(1.5), paths=1000, particles=50, rng=seed, steps=30) for seed in range(20)]
    scatter = np.std([run.probability for run in runs], ddof=1)
    stated = np.sqrt(np.mean([run.standard_error**2 for run in runs]))
    assert 0.5 < stated / scatter < 1.6


@pytest.mark.slow
def test_plain_simulation_agrees_where_it_can():
    box = cb.Box([-0.9, -0.8], [1.0, 1.1])
    system = cb.ContinuousSystem(
        lambda x, d: [x[1], -np.sin(x[0]) - x[1] + d[0]],
        states=2,
        disturbance=cb.Box([-0.2], [0.2]),
        diffusion=[[0.1, 0.0], [0.0, 0.3]],
    )
    subject = cb.Problem(
        system,
        initial=cb.Box([-0.1, -0.1], [0.1, 0.1]),
        safe=[
            cb.Inside(box),
            cb.Outside(cb.Ball([0.9, 0.9], 0.3)),
            cb.Outside(cb.Box([-0.9, 0.5], [-0.5, 0.9])),
            cb.Inside(cb.HalfSpace([1.0, 0.0], 0.5), during=(2.0, 2.0)),
            cb.Outside(cb.Ball(lambda t: [-0.8 + 0.1 * t, 0.2], 0.2)),
        ],
        horizon=2.0,
    )
    plain = simulate_exits(subject, paths=200_000, rng=2, steps=100)
    found = simulate_rare_exits(subject, paths=40_000, rng=3, steps=100)
    error = np.hypot(found.standard_error, (plain.upper - plain.lower) / 5.15)
    assert 0.001 < plain.probability < 0.3
    assert abs(found.probability - plain.probability) < 4 * error


def test_discrete_time_and_a_random_start_are_split_too():
    system = cb.DiscreteSystem(lambda x: 0.8 * x, states=1, noise=cb.Uniform(halfwidth=0.5))
    start = cb.GaussianStart([0.0], [[0.2]])
    subject = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Ball([0.0], 1.3))], horizon=6)
    plain = simulate_exits(subject, paths=400_000, rng=4)
    found = simulate_rare_exits(subject, paths=40_000, rng=5)
    error = np.hypot(found.standard_error, (plain.upper - plain.lower) / 5.15)
    assert abs(found.probability - plain.probability) < 4 * error


def test_the_same_seed_gives_the_same_estimate_on_any_number_of_threads():
    from concurrent.futures import ThreadPoolExecutor

    options = {"paths": 2000, "particles": 50, "rng": 6, "steps": 50}
    with ThreadPoolExecutor(1) as pool:
        alone = simulate_rare_exits(ou(1.5), **options, executor=pool)
    assert alone.probability == simulate_rare_exits(ou(1.5), **options).probability


def test_an_impossible_exit_gets_a_limit_from_the_first_generation():
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.Uniform(halfwidth=0.1))
    start = cb.Box([-0.1], [0.1])  # the kernel is that of the test above
    subject = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Ball([0.0], 1.0))], horizon=5)
    found = simulate_rare_exits(subject, paths=1000, particles=50, rng=7)
    assert (found.probability, found.lower, found.standard_error, found.exits) == (0.0, 0.0, 0.0, 0)
    assert found.upper == pytest.approx(1 - 0.005 ** (1 / 1000))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"paths": 0}, "`paths` must be a positive whole number"),
        ({"particles": 5}, "`particles` must be at least 20, got 5"),
        ({"particles": 10**7}, r"`particles` must be at most \d+ with 50 steps of 1 states"),
        ({"confidence": 2}, "`confidence` must lie in"),
    ],
)
def test_malformed_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        simulate_rare_exits(ou(1.0), **({"paths": 100, "rng": 0, "steps": 50} | options))


def test_a_switching_disturbance_is_refused():
    system = cb.ContinuousSystem(lambda x, d: -x + d, states=1, disturbance=cb.Box([-0.1], [0.1]), diffusion=[[0.1]])
    subject = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], 1.0))], horizon=1.0)
    with pytest.raises(ValueError, match="`disturbance` must not be 'switching' for rare exits"):
        simulate_rare_exits(subject, rng=0, scenario=Scenario(disturbance="switching"))


@pytest.mark.slow
@pytest.mark.parametrize("probability", [1e-4, 1e-6, 1e-8])
def test_twenty_seeds_come_within_a_tenth_of_the_exact_probability(probability):
    subject = ou(exit_radius(probability, **OU))
    runs = [simulate_rare_exits(subject, paths=5000, rng=seed).probability for seed in range(20)]
    assert np.mean(runs) == pytest.approx(probability, rel=0.1)
