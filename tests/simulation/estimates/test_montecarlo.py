"""Counting exits: the same answer on any executor, honest limits, and clear refusals."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import certbound as cb
from certbound.problem.noise import Law
from certbound.simulation.blocks import BLOCK
from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.stepping import Scenario
from experiments.first_passage import exit_probability


def ou(radius=0.8, **options):
    system = cb.ContinuousSystem(lambda x: -0.5 * x, states=1, diffusion=[[0.1**0.5]])
    safe = [cb.Inside(cb.Ball([0.0], radius))]
    return cb.Problem(system, **({"initial": [0.0], "safe": safe, "horizon": 5.0} | options))


def test_the_probability_is_the_exact_one():
    result = simulate_exits(ou(), paths=100_000, rng=1, steps=200)
    expected = exit_probability(0.8, rate=-0.5, sigma=0.1**0.5, horizon=5.0)
    assert result.lower < expected < result.upper
    assert result.upper - result.lower < 0.01
    assert result.scheme == "exact"


def test_every_number_of_the_result_fits_the_others():
    result = simulate_exits(ou(), paths=5000, rng=np.random.default_rng(1), steps=100)
    assert result.exits == sum(result.by_constraint.values()) == result.exits_by_time.sum()
    assert result.probability == result.exits / result.paths
    assert result.exits_by_time.shape == (1, 101)
    assert len(result.times) == 101
    assert result.times[[0, -1]].tolist() == [0.0, 5.0]
    assert result.lower < result.probability < result.upper
    assert result.refutes(0.5 * result.lower)
    assert not result.refutes(result.probability)
    assert result.path_steps_per_second > 0


def test_the_same_seed_gives_the_same_counts_on_any_executor():
    subject, counts = ou(), []
    for width in (None, 1, 3):
        rng = np.random.default_rng(7)
        if width is None:
            counts.append(simulate_exits(subject, paths=10_000, rng=rng, steps=50))
        else:
            with ThreadPoolExecutor(width) as pool:
                counts.append(simulate_exits(subject, paths=10_000, rng=rng, steps=50, executor=pool))
    assert all(np.array_equal(count.exits_by_time, counts[0].exits_by_time) for count in counts)
    other = simulate_exits(subject, paths=10_000, rng=np.random.default_rng(8), steps=50)
    assert not np.array_equal(other.exits_by_time, counts[0].exits_by_time)


def test_a_generator_moves_on_so_that_the_next_run_differs():
    rng = np.random.default_rng(7)
    first, second = (simulate_exits(ou(), paths=5000, rng=rng, steps=50) for _ in range(2))
    assert not np.array_equal(first.exits_by_time, second.exits_by_time)


def test_more_paths_keep_the_first_ones():
    few = simulate_exits(ou(), paths=2 * BLOCK, rng=3, steps=50)
    many = simulate_exits(ou(), paths=2 * BLOCK + 100, rng=3, steps=50)
    assert np.all(many.exits_by_time >= few.exits_by_time)


def test_a_random_start_outside_the_safe_set_is_an_exit_at_time_zero():
    subject = ou(0.8, initial=cb.GaussianStart([0.0], [[0.16]]))
    result = simulate_exits(subject, paths=20_000, rng=4, steps=50)
    share = result.exits_by_time[0, 0] / 20_000
    assert share == pytest.approx(0.0455, abs=0.0075)


def test_a_worse_problem_is_found_worse():
    def probability(radius, scenario=None, **options):
        return simulate_exits(ou(radius, **options), paths=20_000, rng=5, steps=100, scenario=scenario).probability

    assert probability(0.9) < probability(0.8) < probability(0.7)
    assert probability(0.8, horizon=2.0) < probability(0.8)
    assert probability(0.8) < probability(0.8, initial=cb.Box([-0.5], [0.5]))
    assert probability(0.8) < probability(0.8, initial=cb.Box([-0.5], [0.5]), scenario=Scenario(initial=[0.5]))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"paths": 0}, ValueError, "`paths` must be a positive whole number, got 0"),
        ({"paths": -5}, ValueError, "`paths` must be a positive whole number, got -5"),
        ({"paths": 1.5}, ValueError, "`paths` must be a positive whole number, got 1.5"),
        ({"paths": float("nan")}, ValueError, "`paths` must be a positive whole number, got nan"),
        ({"paths": "many"}, TypeError, "`paths` must be a positive whole number, got 'many'"),
        ({"paths": True}, TypeError, "`paths` must be a positive whole number, got True"),
        ({"paths": 1e15}, ValueError, r"`paths` must be at most 1e\+12, got 1e\+15"),
        ({"steps": 0}, ValueError, "`steps` must be a positive whole number, got 0"),
        ({"steps": 10**12}, ValueError, r"`steps` must be at most \d+ for this problem"),
        ({"confidence": 1.0}, ValueError, "`confidence` must lie in"),
        ({"rng": "seed"}, TypeError, "`rng` must be a numpy.random.Generator"),
        ({"executor": 4}, TypeError, "`executor` must be a concurrent.futures.Executor or a dask Client"),
    ],
)
def test_malformed_arguments_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        simulate_exits(ou(), **({"paths": 10, "rng": 0} | options))


def test_a_float_that_is_a_whole_number_will_do_for_paths():
    assert simulate_exits(ou(), paths=1e2, rng=0, steps=10).paths == 100


def test_noise_without_a_law_is_refused():
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.SubGaussian(proxy_std=0.1))
    subject = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], 1.0))], horizon=3)
    with pytest.raises(ValueError, match="cannot be simulated; give a law"):
        simulate_exits(subject, paths=10, rng=0)


def test_other_steps_than_the_horizon_are_refused_in_discrete_time():
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.Gaussian(std=0.1))
    subject = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], 1.0))], horizon=3)
    with pytest.raises(ValueError, match="`steps` must be 3, the horizon"):
        simulate_exits(subject, paths=10, rng=0, steps=30)


def test_a_model_that_returns_nan_is_reported_with_state_time_and_path():
    system = cb.ContinuousSystem(lambda x: [np.sqrt(1.0 - x[0]), 0.0], states=2, diffusion=[[0.0], [0.1]])
    subject = cb.Problem(system, initial=[0.5, 0.0], safe=[], domain=cb.Box([-9, -9], [9, 9]), horizon=5.0)
    with pytest.raises(ValueError, match=r"not finite in the step after time 1.4 on path 0, from state \(0.99"):
        simulate_exits(subject, paths=3000, rng=0, steps=100)


def test_the_first_bad_path_is_reported_whichever_thread_meets_one_first():
    system = cb.DiscreteSystem(lambda x: np.log(x), states=1, noise=cb.Gaussian(std=1.0))
    subject = cb.Problem(system, initial=cb.Box([2.5], [2.6]), safe=[], domain=cb.Box([-np.inf], [np.inf]), horizon=2)
    with ThreadPoolExecutor(4) as pool:
        messages = set()
        for _ in range(10):
            with pytest.raises(ValueError, match="not finite") as caught:
                simulate_exits(subject, paths=20_000, rng=3, executor=pool)
            messages.add(str(caught.value))
    assert len(messages) == 1


def test_an_explosion_inside_the_safe_set_is_reported():
    system = cb.ContinuousSystem(lambda x: x**5, states=1, diffusion=[[0.1]])
    subject = cb.Problem(system, initial=[1.0], safe=[], domain=cb.Box([-np.inf], [np.inf]), horizon=5.0)
    with pytest.raises(ValueError, match=r"not finite .* use more steps, or set `domain`"):
        simulate_exits(subject, paths=10, rng=0, steps=100)


@pytest.mark.slow
def test_the_bundled_problems_are_as_safe_as_certified():
    for name, paths in (("ou", 1_000_000), ("unicycle", 200_000), ("chain", 1_000_000), ("chain_rest", 1_000_000)):
        subject = cb.load(name)
        assert not simulate_exits(subject, paths=paths, rng=1, confidence=1 - 2e-6).refutes(subject.delta)


class Triangular(cb.Uniform):
    """Draws from the triangular law on [-h, h], which the simulator does not know."""

    def sample(self, rng, size):
        return super().sample(rng, size) * rng.uniform(size=1)


class SmallNormal(cb.Gaussian):
    """A class made from a law that the simulator does know."""


class Own(Law):
    """A law of one's own from the base class."""

    def resolve(self, dimension):
        return self

    @property
    def proxy(self):
        return np.eye(1)

    @property
    def bound(self):
        return np.ones(1)

    def sample(self, rng, size):
        return rng.triangular(-1.0, 0.0, 1.0, (size, 1))


@pytest.mark.parametrize("law", [Triangular(halfwidth=1.0), SmallNormal(std=0.1), Own()])
def test_a_law_of_an_unknown_class_is_refused_not_taken_for_another(law):
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=law)
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.9], [1.9]))], horizon=5)
    message = f"one of cb.Gaussian.* to be simulated, got the class {type(law).__name__}.*state what it keeps by"
    with pytest.raises(TypeError, match=message):
        simulate_exits(problem, paths=100, rng=1)
    with pytest.raises(TypeError, match="to be written"):
        problem.to_dict()


def test_a_step_beyond_where_the_noise_vanishes_as_a_root_goes_on():
    """The slope of sqrt(max(x, 0)) is no number below 0, where there is no noise."""
    system = cb.ContinuousSystem(
        lambda x: 0.1 - x, states=1, diffusion=lambda x: [[np.sqrt(np.maximum(x[0], 0.0))]]
    )
    problem = cb.Problem(system, initial=[0.5], safe=[cb.Inside(cb.Box([-2], [3]))], horizon=1.0)
    found = cb.simulate_exits(problem, paths=500, steps=200, rng=np.random.default_rng(0))
    assert (found.exits, found.scheme) == (0, "milstein")
