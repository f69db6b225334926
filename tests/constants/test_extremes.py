"""Metrics at the ends of what is legal: very unlike units, deviations that overflow, maps without slope."""

import numpy as np
import pytest

import certbound as cb
from certbound.constants.programs.centers import lyapunov_metric, starting_metric


def coupled(units, *, time=1.0, during=None, domain=None):
    """Oscillators that pull at each other, each state in a unit of its own."""
    s = np.asarray(units, dtype=float)
    n = len(s)

    def f(x):
        y = x / s
        return [s[i] / time * sum(np.sin(y[j] - y[i]) for j in range(n)) for i in range(n)]

    system = cb.ContinuousSystem(f, states=n, diffusion=(0.05 * s / np.sqrt(time))[:, None])
    inside = cb.Box(-0.5 * s, 0.5 * s)
    return cb.Problem(
        system, initial=np.zeros(n), safe=[cb.Inside(inside, during=during)], horizon=time, domain=domain, delta=1e-2
    )


@pytest.mark.parametrize("units", [(1.24e4, 8.42e-7, 2.23e6), (1e-8, 1e8), (1e8, 1.0, 1e-8, 1e4)])
def test_metrics_of_states_in_very_unlike_units_are_found_without_a_warning(units):
    problem = coupled(units, domain=cb.Box(-0.6 * np.array(units), 0.6 * np.array(units)))
    constants = cb.bound_metrics(problem)
    assert [one.certified for one in constants] == [True, True]


def test_a_tube_that_overflows_is_no_reason_to_prefer_its_metric():
    rate = np.array([[0.0, 2580.0], [-2.58e-3, -0.2]]) / 0.0055
    system = cb.linear_system(rate, diffusion=np.array([[0.0], [1e-5]]) / np.sqrt(0.0055))
    stay = cb.Inside(cb.Box([-np.inf, -6e-4], [0.6, 6e-4]), during=(0.002, 0.004))
    problem = cb.Problem(system, initial=[0.5, 0.0], safe=[stay], horizon=0.00715, delta=1e-2)
    (found,) = cb.bound_metrics(problem)
    assert cb.tune_tube(found, horizon=0.00715, delta=1e-2).radius(0.00715) < np.inf


def test_a_lyapunov_equation_without_a_usable_solution_is_passed_over():
    unlike = np.array([[-1e-12, 1e14], [0.0, -1e-12]])
    with pytest.raises(np.linalg.LinAlgError):
        lyapunov_metric(unlike, 0.1, continuous=True)
    np.linalg.cholesky(starting_metric([unlike], continuous=True))


def test_a_metric_for_the_last_step_alone_is_found():
    stay = [cb.Inside(cb.Box([-2.5, -2.5], [2.5, 2.5]), during=(26, 26))]
    system = cb.DiscreteSystem(lambda x: 0.999999999 * x, states=2, noise=cb.Gaussian(std=0.1))
    (found,) = cb.bound_metrics(cb.Problem(system, initial=[0.0, 0.0], safe=stay, horizon=26))
    assert found.certified


@pytest.mark.parametrize("slope", [0.0, 1e-200, 1e-13])
def test_a_constant_map_has_a_metric_for_each_constraint(slope):
    stay = [cb.Inside(cb.Box([-1, -3], [2, 3])), cb.Inside(cb.Ball([0, 0], 4.0), during=(1, 2))]
    system = cb.DiscreteSystem(
        lambda x: [0.5 + slope * x[0], -0.2 + slope * x[1]], states=2, noise=cb.Gaussian(std=0.1)
    )
    found = cb.bound_metrics(cb.Problem(system, initial=[0.5, -0.2], safe=stay, horizon=4))
    assert [constants.gain < 1e-9 for constants in found] == [True, True]


def test_noise_that_depends_on_large_numbers_is_sampled_where_the_domain_lies():
    system = cb.ContinuousSystem(lambda x: [-x[0]], states=1, diffusion=lambda t, x: [[1e-4 * x[0]]])
    stay, domain = cb.Inside(cb.HalfSpace([-1.0], -7e3)), cb.Box([2e3], [4e4])
    found, _ = cb.bound_metrics(cb.Problem(system, initial=[9e3], safe=[stay], horizon=0.1, domain=domain))
    assert found.certified
