"""Exits are seen where they happen: closed forms for Brownian motion, also with very few steps."""

import numpy as np
import pytest
from scipy.special import ndtr

import certbound as cb
from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.splitting import simulate_rare_exits
from certbound.simulation.gap_tests import barriers_of
from certbound.simulation.stepping import Scenario
from experiments.first_passage import exit_probability

PATHS = 100_000


def brownian(n=1, drift=0.0, gain=None):
    shift = np.broadcast_to(drift, (n,)).astype(float)
    return cb.ContinuousSystem(lambda x: 0.0 * x + shift, states=n, diffusion=np.eye(n) if gain is None else gain)


def exits(system, safe, *, start=None, steps=16, horizon=1.0, rng=1, scenario=None, **options):
    start = np.zeros(system.dimension) if start is None else start
    subject = cb.Problem(system, initial=start, safe=safe, horizon=horizon, **options)
    return simulate_exits(subject, paths=PATHS, rng=rng, steps=steps, scenario=scenario, halve=False)


def agrees(result, probability, bias=0.0):
    spread = 5 * np.sqrt(probability / PATHS) + bias * probability
    return abs(result.probability - probability) < spread


def above(level):
    """P(max of a Brownian path on [0, 1] exceeds the level): the reflection principle."""
    return 2 * ndtr(-level)


def test_a_half_space_needs_no_small_steps():
    safe = [cb.Inside(cb.HalfSpace([2.0], 2.6))]
    assert agrees(exits(brownian(), safe, steps=3), above(1.3))


def test_without_the_bridge_exits_between_steps_are_missed():
    safe = [cb.Inside(cb.HalfSpace([1.0], 1.3))]
    bare = exits(brownian(), safe, steps=3, scenario=Scenario(bridge=False))
    assert bare.probability < 0.75 * above(1.3)


def test_outside_a_half_space_is_inside_the_other():
    safe = [cb.Outside(cb.HalfSpace([-1.0], -1.3))]
    assert agrees(exits(brownian(), safe, steps=3), above(1.3))


@pytest.mark.parametrize("scheme", ["auto", pytest.param("euler", marks=pytest.mark.slow)])
def test_an_interval_has_the_exact_exit_probability(scheme):
    expected = exit_probability(1.2, rate=-1e-12, sigma=1.0, horizon=1.0)
    regions = [cb.Ball([0.0], 1.2), cb.Box([-1.2], [1.2]), cb.Ellipsoid([0.0], [[1.44]])]
    results = [exits(brownian(), [cb.Inside(region)], scenario=Scenario(scheme=scheme)) for region in regions]
    assert agrees(results[0], expected)
    assert len({result.exits for result in results}) == 1


@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_ball_has_the_exact_exit_probability_up_to_the_step(n):
    expected = exit_probability(2.0, rate=-1e-12, sigma=1.0, dimension=n, horizon=1.0)
    result = exits(brownian(n), [cb.Inside(cb.Ball([0.0] * n, 2.0))], steps=100)
    assert agrees(result, expected, bias=0.01)
    bare = exits(brownian(n), [cb.Inside(cb.Ball([0.0] * n, 2.0))], steps=100, scenario=Scenario(bridge=False))
    assert bare.probability < 0.93 * expected


def test_an_ellipsoid_is_a_ball_of_scaled_noise():
    shape = np.array([[4.0, 1.0], [1.0, 2.0]])
    root = np.linalg.cholesky(shape)
    ball = exits(brownian(2), [cb.Inside(cb.Ball([0.0, 0.0], 2.0))], steps=50)
    stretched = exits(brownian(2, gain=root), [cb.Inside(cb.Ellipsoid([0.0, 0.0], 4.0 * shape))], steps=50)
    assert ball.exits == pytest.approx(stretched.exits, abs=3)


def test_a_ball_to_avoid_is_hit_with_the_probability_of_three_dimensional_brownian_motion():
    expected = 0.5 / 1.5 * above(1.0)
    result = exits(brownian(3), [cb.Outside(cb.Ball([0.0] * 3, 0.5))], start=[1.5, 0.0, 0.0], steps=400)
    assert agrees(result, expected, bias=0.01)


def test_a_wide_box_to_avoid_is_a_half_space():
    wide = exits(brownian(2), [cb.Outside(cb.Box([1.3, -50.0], [80.0, 50.0]))], steps=4)
    assert agrees(wide, above(1.3))


@pytest.mark.slow
def test_a_corner_is_touched_across_both_faces_only():
    corner = exits(brownian(2), [cb.Outside(cb.Box([0.5, 0.5], [80.0, 80.0]))], steps=200)
    fine = exits(brownian(2), [cb.Outside(cb.Box([0.5, 0.5], [80.0, 80.0]))], steps=1600)
    assert corner.probability == pytest.approx(fine.probability, rel=0.04)


def test_a_step_across_a_thin_wall_is_an_exit():
    wall = cb.Polytope([[1.0, 0.0], [-1.0, 0.0]], [1.001, -1.0])
    result = exits(brownian(2), [cb.Outside(wall)], steps=4)
    assert agrees(result, above(1.0))


def test_faces_of_a_polytope_are_counted_together():
    polytope = cb.Polytope([[1.0, 1.0], [-1.0, 0.0]], [1.8, 50.0])
    assert agrees(exits(brownian(2), [cb.Inside(polytope)], steps=4), above(1.8 / np.sqrt(2)))


def test_a_moving_set_is_a_fixed_one_in_its_own_frame():
    moving = exits(brownian(2), [cb.Inside(cb.Ball(lambda t: [1.0 * t, -0.5 * t], 1.8))], steps=50)
    fixed = exits(brownian(2, drift=[-1.0, 0.5]), [cb.Inside(cb.Ball([0.0, 0.0], 1.8))], steps=50)
    assert moving.exits == pytest.approx(fixed.exits, abs=3)


@pytest.mark.slow
def test_a_moving_box_is_a_half_space_in_its_own_frame():
    box = exits(brownian(), [cb.Inside(cb.Box([-50.0], [1.0], center=lambda t: [t]))], steps=20)
    half = exits(brownian(drift=-1.0), [cb.Inside(cb.HalfSpace([1.0], 1.0))], steps=20)
    assert box.exits == pytest.approx(half.exits, abs=3)


def test_a_terminal_constraint_holds_at_the_end_only():
    safe = [cb.Inside(cb.Ball([0.0], 1.0), during=(1.0, 1.0))]
    assert agrees(exits(brownian(), safe), 2 * ndtr(-1.0))


def test_a_window_counts_what_happens_inside_it():
    safe = [cb.Inside(cb.HalfSpace([1.0], 1.0), during=(0.5, 1.0))]
    start = np.linspace(-6.0, 6.0, 20_001)
    beyond = np.where(start > 1.0, 1.0, 2 * ndtr(-(1.0 - start) / np.sqrt(0.5)))
    expected = np.trapezoid(beyond * np.exp(-(start**2)), start) / np.sqrt(np.pi)
    assert agrees(exits(brownian(), safe, steps=8), expected)


def test_a_window_between_two_grid_times_is_watched_at_the_nearest():
    subject = cb.Problem(
        brownian(),
        initial=[0.0],
        safe=[cb.Inside(cb.Ball([0.0], 1.0), during=(0.52, 0.53))],
        horizon=1.0,
    )
    (barrier,) = barriers_of(subject, np.linspace(0.0, 1.0, 11))
    assert (barrier.first, barrier.last) == (5, 5)


def test_leaving_the_domain_counts_even_where_nothing_is_unsafe():
    result = exits(brownian(), [], domain=cb.Box([-np.inf], [1.3]), steps=4)
    assert agrees(result, above(1.3))
    assert list(result.by_constraint) == ["the model's domain"]


def test_a_set_in_some_coordinates_ignores_the_others():
    system = brownian(3, gain=np.diag([1.0, 9.0, 1.0]))
    result = exits(system, [cb.Inside(cb.Ball([0.0, 0.0], 2.0, coordinates=(0, 2)))], steps=50)
    expected = exit_probability(2.0, rate=-1e-12, sigma=1.0, dimension=2, horizon=1.0)
    assert agrees(result, expected, bias=0.02)


def test_a_state_dependent_diffusion_bridges_with_the_state_at_the_step():
    system = cb.ContinuousSystem(lambda x: 0.02 * x, states=1, diffusion=lambda x: [[0.2 * x[0]]])
    result = exits(system, [cb.Inside(cb.HalfSpace([1.0], 1.3))], start=[1.0], steps=200)
    level, drift, sigma = np.log(1.3), 0.02 - 0.02, 0.2
    expected = ndtr((drift - level) / sigma) + ndtr((-drift - level) / sigma)
    assert agrees(result, expected, bias=0.02)


@pytest.mark.slow
def test_a_state_dependent_diffusion_bridges_to_round_sets_too():
    level, drift, sigma = np.log(1.3), 0.0, 0.2
    expected = ndtr((drift - level) / sigma) + ndtr((-drift - level) / sigma)
    round_set = [cb.Inside(cb.Ball([0.0, 0.0], 1.3))]
    plane = cb.ContinuousSystem(
        lambda x: [0.02 * x[0], 0.0], states=2, diffusion=lambda x: [[0.2 * x[0], 0.0], [0.0, 1e-9]]
    )
    assert agrees(exits(plane, round_set, start=[1.0, 0.0], steps=200), expected, bias=0.02)


def test_a_direction_without_noise_is_not_bridged():
    system = cb.ContinuousSystem(lambda x: [x[1], 0.0], states=2, diffusion=[[0.0], [1.0]])
    result = exits(system, [cb.Inside(cb.HalfSpace([1.0, 0.0], 0.8))], steps=100)
    bare = exits(system, [cb.Inside(cb.HalfSpace([1.0, 0.0], 0.8))], steps=100, scenario=Scenario(bridge=False))
    assert result.exits == bare.exits


def test_discrete_time_counts_steps_only():
    system = cb.DiscreteSystem(lambda x: 0.0 * x, states=1, noise=cb.Gaussian(std=1.0))
    subject = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.HalfSpace([1.0], 1.0), during=(2, 3))], horizon=4)
    result = simulate_exits(subject, paths=PATHS, rng=1, halve=False)
    assert agrees(result, 1 - ndtr(1.0) ** 2)
    by_step = result.exits_by_time[0]
    assert by_step[[0, 1, 4]].tolist() == [0, 0, 0]
    assert agrees_count(by_step[2], 1 - ndtr(1.0))


def agrees_count(count, probability):
    return abs(count / PATHS - probability) < 5 * np.sqrt(probability / PATHS)


@pytest.mark.parametrize("region", [cb.Box([1.0], [2.0]), cb.Ball([1.5], 0.5), cb.HalfSpace([-1.0], -1.0)])
def test_edges_belong_to_sets_in_simulation_as_anywhere(region):
    walk = cb.DiscreteSystem(lambda x: 1.0 * x, states=["x"], noise=cb.Rademacher(scale=1.0))
    stay = [cb.Inside(cb.Box([-1.0], [1.0]))]
    assert exits(walk, stay, steps=None, horizon=1).exits == 0
    avoid = exits(walk, [cb.Outside(region)], steps=None, horizon=1)
    missed = exits(walk, stay, steps=None, horizon=1, reach=region)
    assert avoid.probability == pytest.approx(0.5, abs=0.02)
    assert missed.probability == pytest.approx(0.5, abs=0.02)


def test_the_edge_of_a_disc_belongs_to_it():
    turn = cb.DiscreteSystem(lambda x: [x[0], x[1]], states=2, noise=cb.Rademacher(scale=[1.0, 0.0]))
    avoid = exits(turn, [cb.Outside(cb.Ball([2.0, 0.0], 1.0))], steps=None, horizon=1)
    assert avoid.probability == pytest.approx(0.5, abs=0.02)


def test_a_path_that_passes_an_obstacle_without_width_between_two_steps_has_failed():
    """p' = 1 from 0 passes {p = .3} between two steps, and does not come to {p = 1.5}."""
    system = cb.ContinuousSystem(lambda x: [1 + 0 * x[0], -x[1]], states=2, diffusion=np.array([[0.0], [0.1]]))
    for region, share in ((cb.Box([0.3], [0.3], coordinates=[0]), 1.0), (cb.Box([1.5], [1.5], coordinates=[0]), 0.0)):
        subject = cb.Problem(system, initial=[0.0, 0.0], safe=[cb.Outside(region)], horizon=1.0)
        assert simulate_exits(subject, paths=100, rng=1, steps=4, halve=False).probability == share


@pytest.mark.parametrize(("limit", "leaves"), [(0.999, True), (1.001, False)])
@pytest.mark.parametrize("shape", ["box", "ball", "half-space"])
def test_a_position_is_seen_where_it_turns_between_two_steps(limit, leaves, shape):
    """x = sin t at steps of .3: the highest is .9975 (t = 1.5), and the parabola through three ends at 1.0000."""
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=2, diffusion=[[0.0], [1e-9]])
    safe = {
        "box": cb.Inside(cb.Box([-2.0, -np.inf], [limit, np.inf])),
        "ball": cb.Inside(cb.Ball([0.0], limit, coordinates=[0])),
        "half-space": cb.Outside(cb.HalfSpace([-1.0, 0.0], -limit)),
    }[shape]
    subject = cb.Problem(system, initial=[0.0, 1.0], safe=[safe], horizon=3.0)
    found = simulate_exits(subject, paths=4, rng=1, steps=10, halve=False)
    assert found.exits == (4 if leaves else 0)
    rare = simulate_rare_exits(subject, paths=200, particles=20, rng=1, steps=10)
    assert rare.probability == pytest.approx(1.0 if leaves else 0.0)
    bare = simulate_exits(subject, paths=4, rng=1, steps=10, scenario=Scenario(bridge=False), halve=False)
    assert bare.exits == 0


def test_a_position_is_not_looked_for_outside_of_a_window():
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=2, diffusion=[[0.0], [1e-9]])
    box = cb.Box([-2.0, -np.inf], [0.999, np.inf])
    for during, exits in (((0.0, 1.5), 0), ((1.8, 3.0), 0), ((1.2, 1.8), 4)):
        subject = cb.Problem(system, initial=[0.0, 1.0], safe=[cb.Inside(box, during=during)], horizon=3.0)
        assert simulate_exits(subject, paths=4, rng=1, steps=10, halve=False).exits == exits
