"""Steps that are too long for a model are noticed: another scheme, more steps, or a warning that names enough."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

import certbound as cb
from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.paths import sample_paths
from certbound.simulation.estimates.preparation import prepare
from certbound.simulation.stepping import Scenario
from certbound.simulation.stiffness import jacobians, step_error, steps_needed
from certbound.simulation.transition import bridge_spread

SWING = np.array([[0.0, 1.0], [-38_900.0, -20.0]])


def swing(diffusion, pull=38_900.0):
    system = cb.ContinuousSystem(
        lambda x: [x[1], -pull * np.sin(x[0]) - 20.0 * x[1]], states=2, diffusion=diffusion
    )
    box = cb.Box([-0.2, -np.inf], [0.2, np.inf])
    return cb.Problem(system, initial=np.zeros(2), safe=[cb.Inside(box)], horizon=1.0, delta=1e-3)


def test_eulers_error_is_that_of_the_damping():
    real, imaginary = -10.0, np.sqrt(38_900.0 - 100.0)
    for step in (1e-3, 1e-4):
        right = abs(np.log(abs(1 + step * (real + 1j * imaginary))) / step - real) / (0.2 * 10.0)
        assert step_error(SWING[None], step, 1.0) == pytest.approx(right, rel=1e-9)
    assert step_error(SWING[None], 1e-3, 1.0) > 1.0 >= step_error(SWING[None], 1e-4, 1.0)
    assert steps_needed(SWING[None], 1000, 1.0) == 16_000


def test_a_stiff_model_with_constant_noise_takes_the_exponential_scheme_and_keeps_its_covariance():
    noise = np.array([[0.0], [1.0]])
    setting = prepare(swing(noise))
    model = setting.model
    assert (model.scheme, setting.steps) == ("exponential", 1000)
    move = model.exponential.move
    np.testing.assert_allclose(move, expm(SWING * 1e-3), rtol=1e-9, atol=1e-12)
    stationary = solve_continuous_lyapunov(SWING, -noise @ noise.T)
    after = move @ stationary @ move.T + model.noise @ model.noise.T
    np.testing.assert_allclose(after, stationary, rtol=1e-9, atol=1e-16)
    assert model.spread[0, 0] == 0.0
    assert setting.nominal().shape == (1001, 2)


def test_noise_that_depends_on_the_state_acts_in_the_middle_of_a_step_unless_its_mode_dies_out_within_one():
    setting = prepare(swing(lambda x: [[0.0], [1.0 + x[0] ** 2]]))
    assert (setting.model.scheme, setting.steps) == ("exponential", 1000)
    system = cb.ContinuousSystem(lambda x: [-3000.0 * x[0]], states=1, diffusion=lambda x: [[1.0 + x[0] ** 2]])
    fast = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], horizon=1.0)
    setting = prepare(fast)
    assert (setting.model.scheme, setting.steps) == ("exponential", 4000)
    with pytest.warns(UserWarning, match="500 steps are too coarse .* steps=4000 would do"):
        prepare(fast, 500)


def test_steps_that_are_given_are_kept_and_a_warning_names_enough():
    noise = np.array([[0.0], [1.0]])
    with pytest.warns(UserWarning, match=r"500 steps are too coarse .* steps=16000 would do"):
        assert prepare(swing(noise), 500, Scenario(scheme="euler")).steps == 500
    assert prepare(swing(noise), 16_000, Scenario(scheme="euler")).model.scheme == "euler"
    assert prepare(swing(noise), 500).model.scheme == "exponential"


def test_models_without_fast_modes_keep_eulers_scheme():
    assert prepare(swing(np.array([[0.0], [1.0]]), pull=9.81)).model.scheme == "euler"
    setting = prepare(cb.load("unicycle"))
    assert (setting.model.scheme, setting.steps) == ("euler", 1000)


def test_where_eulers_steps_add_a_little_energy_the_exponential_scheme_takes_as_many():
    """The pendulum, loud: .0052 (16,000 steps of Euler's scheme), for which 1000 of them count .0073."""
    problem = cb.load("pendulum", sigma=1.0)
    setting = prepare(problem)
    assert (setting.model.scheme, setting.steps) == ("exponential", 1000)
    assert {prepare(problem, steps).model.scheme for steps in (100, 1000, 20_000)} == {"exponential"}
    found = cb.simulate_exits(problem, paths=40_000, rng=1, halve=False)
    assert found.lower < 0.0052 < found.upper < 0.007


def light(spring, damping=0.02, limit=0.5, horizon=60.0, noise=0.03):
    """A swing of rate 1 with a spring force, started at rest."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -spring(x[0]) - 2.0 * damping * x[1]], states=2, diffusion=[[0.0], [noise]]
    )
    box = cb.Box([-limit, -np.inf], [limit, np.inf])
    return cb.Problem(system, initial=np.zeros(2), safe=[cb.Inside(box)], horizon=horizon, delta=1e-2)


def test_a_light_swing_keeps_its_energy_however_coarse_the_step():
    """Without damping and noise the exponential Euler scheme damps a soft spring, and Euler's drives it."""
    problem = light(lambda x: x - x**3, damping=0.0, limit=0.9, noise=0.0)
    for steps in (200, 600, 2000):
        path = sample_paths(problem, paths=1, steps=steps, scenario=Scenario(initial=[0.6, 0.0]))[0]
        energy = 0.5 * path[:, 1] ** 2 + 0.5 * path[:, 0] ** 2 - 0.25 * path[:, 0] ** 4
        swings = np.abs(energy / energy[0] - 1.0)
        assert np.max(swings[-steps // 5 :]) < 2.5 * np.max(swings[: steps // 5])  # it swings, and does not drift
        assert np.max(swings) < 1.2 * (60.0 / steps) ** 2


def test_finer_steps_of_a_light_swing_count_as_many_exits():
    problem = light(lambda x: x + 0.5 * x**3)
    found = [simulate_exits(problem, paths=8000, steps=steps, rng=steps, halve=False) for steps in (120, 400, 1500)]
    assert {result.scheme for result in found} == {"exponential"}
    assert max(result.lower for result in found) < min(result.upper for result in found)


def test_steps_end_on_slow_manifolds_of_fast_modes():
    """x' = -300 (x - cos y), y' = 1: x follows cos y; with a rest of the drift half a pair old it is .04 behind."""
    system = cb.ContinuousSystem(lambda x: [-300.0 * (x[0] - np.cos(x[1])), 1.0], states=2)
    problem = cb.Problem(
        system, initial=[1.0, 0.0], safe=[cb.Inside(cb.Box([-9, -9], [9, 9]))], horizon=2.0, delta=0.1
    )
    exact = (300.0**2 * np.cos(2.0) + 300.0 * np.sin(2.0)) / (300.0**2 + 1.0)
    errors = [abs(sample_paths(problem, paths=1, steps=steps)[0, -1, 0] - exact) for steps in (40, 80)]
    assert errors[1] < errors[0] < 1e-4


def test_bridges_of_modes_that_die_out_stay_near_their_ends():
    spread = bridge_spread(np.array([[-8.0, 0.0], [0.0, -1e-9]]), np.eye(2), 0.5)
    np.testing.assert_allclose(spread @ spread.T, 0.5 * np.diag([np.tanh(2.0) / 2.0, 1.0]), rtol=1e-6)


@pytest.mark.parametrize("step", [1e-6, 1e-3, 0.1])
def test_bridges_of_positions_are_smooth_and_those_of_what_follows_noise_at_once_are_not(step):
    assert not np.any(bridge_spread(np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [1.0]]), step)[0])
    fast = np.array([[-1e3 / step, 1e3 / step], [0.0, 0.0]])
    follows = bridge_spread(fast, np.array([[0.0], [1.0]]), step)
    np.testing.assert_allclose(follows @ follows.T, np.full((2, 2), step), rtol=0.02)


def test_where_the_drift_is_undefined_at_the_start_nothing_is_said_of_steps():
    system = cb.ContinuousSystem(lambda x: [np.sqrt(x[0] - 5.0)], states=1, diffusion=[[0.1]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0)
    assert prepare(problem).model.scheme == "euler"


def test_a_step_so_long_that_the_scheme_has_no_numbers_is_too_long():
    assert step_error(SWING[None] * -1.0, 1e300, 1e300, -SWING) == np.inf


def test_disturbances_act_along_the_path_that_is_looked_at():
    """Pushed by .05 to .15, x' = -x^3 + d settles at .46, where J is -.65; without it at 0, where J is 0."""
    system = cb.ContinuousSystem(
        lambda x, d: [-(x[0] ** 3) + d[0]], states=1, disturbance=cb.Box([0.05], [0.15]), diffusion=[[0.1]]
    )
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-9.0], [9.0]))], horizon=20.0, delta=0.1)
    setting = prepare(problem, 2000)
    looks = jacobians(setting.model, setting.steps, setting.start)
    assert looks[-2, 0, 0] == pytest.approx(-3.0 * 0.1 ** (2 / 3), rel=0.05)


def test_the_path_that_is_looked_at_ends_where_it_leaves():
    problem = light(lambda x: x - 2.0 * x**3, limit=0.9)
    setting = prepare(problem.replace(initial=[0.85, 0.3]))
    assert (setting.model.scheme, setting.steps) == ("exponential", 1000)
