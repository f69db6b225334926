"""The safety filter."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import certbound as cb
from certbound.constants import bound_constants
from certbound.rigor.intervals import Interval
from certbound.synthesis.controllers.held_steps import Link
from tests.synthesis.conftest import cart

CONSTANTS = cb.Constants(gain=1.0, sigma=0.002, dimension=2)


def integrator(**changes: Any) -> cb.Problem:
    """Two integrators among obstacles."""
    system = cb.linear_system(
        np.eye(2), 0.1 * np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), noise=cb.Gaussian(std=0.002)
    )
    safe = [cb.Outside(cb.Ball([1.0, 0.05], 0.4)), cb.Inside(cb.Box([-1, -1], [3, 1]))]
    return cb.Problem(system, **({"initial": [0.0, 0.0], "safe": safe, "horizon": 30, "delta": 1e-3} | changes))


@functools.cache
def _built() -> cb.SafetyFilter:
    return cb.SafetyFilter(integrator())


@pytest.fixture
def guard() -> cb.SafetyFilter:
    """A filter of the two integrators at its beginning, made once."""
    _built().reset()
    return _built()


def test_an_input_that_is_safe_passes_unchanged(guard: cb.SafetyFilter) -> None:
    report = guard.step([-0.1, 0.2])
    assert report.changed == 0
    np.testing.assert_array_equal(report.input, [-0.1, 0.2])


def test_driving_at_an_obstacle_is_bent_and_stays_guaranteed(guard: cb.SafetyFilter) -> None:
    reports = [guard.step([1.0, 0.0]) for _ in range(30)]
    assert max(report.changed for report in reports) > 0.1
    assert all(report.feasible and report.room >= -1e-9 for report in reports)
    assert guard.guaranteed
    assert guard.verify().status == "SAFE"


def test_inputs_from_measured_states_keep_the_noisy_system_safe(guard: cb.SafetyFilter) -> None:
    rng = np.random.default_rng(0)
    for _ in range(4):
        guard.reset()
        x = np.zeros(2)
        for _ in range(30):
            x = x + 0.1 * guard.step(np.array([2.0, 0.0]) - x).input + 0.002 * rng.standard_normal(2)
            assert np.linalg.norm(x - [1.0, 0.05]) > 0.4
        assert guard.guaranteed


def test_the_filtered_input_solves_the_quadratic_program() -> None:
    guard = cb.SafetyFilter(integrator(), decay=1.0)
    guard.state = np.array([0.55, 0.05])
    guard._link = Link(end=Interval.point(guard.state), radius=0.0)
    guard._room = np.array([0.05, 1.0, 1.0, 1.0, 1.0])  # of the obstacle, and of the box's sides
    wanted = np.array([1.0, 0.0])
    report = guard.step(wanted)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 401), np.linspace(-1, 1, 401)), axis=-1).reshape(-1, 2)
    following = np.array([0.55, 0.05]) + 0.1 * grid
    kept = np.linalg.norm(following - [1.0, 0.05], axis=1) - 0.4 >= guard._radii[0]
    best = np.min(np.linalg.norm(grid[kept] - wanted, axis=1))
    assert np.linalg.norm(report.input - wanted) == pytest.approx(best, abs=5e-3)


def test_a_steady_tube_leaves_an_input_to_a_system_that_can_stand_still() -> None:
    kept = []
    for steady in (True, False):
        guard = cb.SafetyFilter(integrator(safe=[cb.Outside(cb.Ball([1.0, 0.0], 0.4))]), steady=steady)
        for _ in range(30):
            guard.step([1.0, 0.0])
        kept.append(guard.state[0])
        assert guard.guaranteed
    assert kept[0] == pytest.approx(0.6 - guard._radii.max(), abs=0.01)


def test_a_step_without_a_point_is_reported_and_ends_the_guarantee() -> None:
    guard = cb.SafetyFilter(cart(), constants=CONSTANTS)
    reports = [guard.step([3.0]) for _ in range(20)]  # position lags behind speed: one step does not look far enough
    assert not all(report.feasible for report in reports)
    assert not guard.guaranteed


def test_stated_constants_guarantee_nothing() -> None:
    guard = cb.SafetyFilter(cart(), constants=CONSTANTS)
    assert not guard.guaranteed


def test_a_one_time_tube_guarantees_nothing() -> None:
    assert not cb.SafetyFilter(integrator(), method="markov").guaranteed


@pytest.mark.parametrize("decay", [0.0, 1.5, -1.0])
def test_a_decay_out_of_range_is_refused(decay: float) -> None:
    with pytest.raises(ValueError, match="`decay` must lie in"):
        cb.SafetyFilter(integrator(), decay=decay)


def test_other_refusals(guard: cb.SafetyFilter) -> None:
    with pytest.raises(ValueError, match="`desired` must hold 2 finite inputs"):
        guard.step([np.nan, 0.0])
    with pytest.raises(ValueError, match="`verify` needs all 30 steps"):
        guard.verify()
    start = cb.GaussianStart([0, 0], 0.01 * np.eye(2))
    with pytest.raises(ValueError, match="must start in a set"):
        cb.SafetyFilter(integrator(initial=start))
    pushed = cb.linear_system(
        np.eye(2), np.eye(2), E=np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), disturbance=cb.Box([-1, -1], [1, 1]),
        noise=cb.Gaussian(std=0.1),
    )  # fmt: skip
    with pytest.raises(ValueError, match="must have no disturbance"):
        cb.SafetyFilter(integrator().replace(system=pushed))
    with pytest.raises(ValueError, match="must have inputs"):
        cb.SafetyFilter(cb.load("ou"))


# ---- the promise in closed loop ----------------------------------------------------------------------------------


def wide(n: int) -> tuple[cb.SafetyFilter, np.ndarray]:
    """A start that is a box of n wide sides, and a metric whose longest corner of it has signs of its own."""
    along = np.ones(n)
    along[1] = -1.0
    along /= np.sqrt(n)
    system = cb.linear_system(
        np.eye(n), 0.1 * along[:, None], inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.001)
    )
    safe = [cb.Inside(cb.HalfSpace(along, 0.6))]
    start = cb.Box(np.full(n, -0.1), np.full(n, 0.1))
    problem = cb.Problem(system, initial=start, safe=safe, horizon=10, delta=1e-3)
    constants = bound_constants(problem, metric=0.05 * np.eye(n) + np.outer(along, along))
    tube = cb.tune_tube(constants, horizon=problem.horizon, delta=problem.delta)
    return cb.SafetyFilter(problem, tube=tube, decay=1.0), along


def exits_with_a_promise(n: int, runs: int) -> tuple[int, int]:
    """Runs that ended guaranteed, and those among them that left; from the corner that lies farthest ahead."""
    guard, along = wide(n)
    rng, promised, left = np.random.default_rng(0), 0, 0
    for _ in range(runs):
        guard.reset()
        x, out = 0.1 * np.sign(along), False
        for _ in range(10):
            x = x + 0.1 * along * guard.step([1.0]).input[0] + 0.001 * rng.standard_normal(n)
            out = out or bool(along @ x > 0.6)
        promised, left = promised + guard.guaranteed, left + (out and guard.guaranteed)
    assert along @ guard.state > 0.6 - 0.1 * np.sqrt(n) - 0.05  # the room is used
    return promised, left


@pytest.mark.parametrize("n", [14, 20])
def test_the_promise_holds_from_every_corner_of_a_box_with_many_wide_sides(n: int) -> None:
    assert exits_with_a_promise(n, 1) == (1, 0)


@pytest.mark.slow
@pytest.mark.parametrize("n", [14, 20])
def test_the_promise_holds_from_every_corner_in_many_runs(n: int) -> None:
    assert exits_with_a_promise(n, 40) == (40, 0)


def turning(speed: float, **options: Any) -> tuple[cb.SafetyFilter, np.ndarray, float]:
    """A rotation inside the unit disk, its filter, and its matrix; the noise's level."""
    matrix, noise = np.array([[0.0, speed], [-speed, 0.0]]), 5e-4
    system = cb.linear_system(matrix, np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), diffusion=noise * np.eye(2))
    problem = cb.Problem(system, initial=[0.8, 0.0], safe=[cb.Inside(cb.Ball([0, 0], 1.0))], horizon=4, delta=1e-3)
    return cb.SafetyFilter(problem, **options), matrix, noise


def outwards(guard: cb.SafetyFilter, matrix: np.ndarray, noise: float, runs: int) -> tuple[int, int, float]:
    """Runs that ended guaranteed, those among them that left between or at samples, and the largest radius."""
    fine = 20
    step = guard.planner.grid.step
    short = expm(matrix * step / fine)
    held = np.linalg.solve(matrix, short - np.eye(2))
    rng, promised, left, largest = np.random.default_rng(0), 0, 0, 0.0
    for _ in range(runs):
        guard.reset()
        x, out = np.array([0.8, 0.0]), False
        for _ in range(guard.planner.grid.steps):
            ahead = expm(matrix * step / 2) @ x
            u = guard.step(0.7 * ahead / np.linalg.norm(ahead)).input
            for _ in range(fine):
                x = short @ x + held @ u + noise * np.sqrt(step / fine) * rng.standard_normal(2)
                largest = max(largest, float(np.linalg.norm(x)))
                out = out or float(np.linalg.norm(x)) > 1
        promised, left = promised + guard.guaranteed, left + (out and guard.guaranteed)
    return promised, left, largest


def test_a_fast_rotation_stays_inside_although_the_plain_integrator_loses_it() -> None:
    promised, left, largest = outwards(*turning(12.0, steps=40), runs=1)
    assert (promised, left) == (1, 0)
    assert largest > 0.99  # the controller gets there


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "steps"), [(12.0, 100), (12.0, 40), (10.0, 40), (1.0, 40)])
def test_rotations_keep_the_promise_in_many_runs(speed: float, steps: int) -> None:
    promised, left, largest = outwards(*turning(speed, steps=steps), runs=4)
    assert (promised, left) == (4, 0)
    assert largest > 0.99


def test_between_the_samples_the_constraint_holds_too() -> None:
    matrix = np.array([[0.0, np.pi], [-np.pi, 0.0]])  # from one side to the other and back in two seconds
    weak = cb.Box([-1e-3, -1e-3], [1e-3, 1e-3])
    system = cb.linear_system(matrix, np.eye(2), inputs=weak, diffusion=1e-4 * np.eye(2))
    safe = [cb.Inside(cb.Box([-2, -2], [2, 0.5]))]
    problem = cb.Problem(system, initial=[-0.8, 0.0], safe=safe, horizon=2, delta=1e-3)
    guard = cb.SafetyFilter(problem, steps=2)  # at the samples the second state is 0; in between it reaches 0.8
    reports = [guard.step([0.0, 0.0]) for _ in range(2)]
    assert not all(report.feasible for report in reports)
    assert not guard.guaranteed
    assert "is not proved to keep" in guard.reason


def test_what_is_not_guaranteed_says_why() -> None:
    assert "stated, not proved" in cb.SafetyFilter(cart(), constants=CONSTANTS).reason
    assert "no whole trajectory" in cb.SafetyFilter(integrator(), method="markov").reason
    guard = cb.SafetyFilter(integrator(horizon=2))
    for _ in range(2):
        guard.step([0.0, 0.0])
    assert (guard.guaranteed, guard.reason) == (True, "")
    assert not guard.step([0.0, 0.0]).feasible
    assert guard.reason == "the horizon is over"


def test_a_start_that_is_not_proved_to_keep_the_constraints_is_not_guaranteed() -> None:
    start = cb.Ellipsoid([0.0, 0.0], [[0.25, 0.24], [0.24, 0.25]])
    kept = cb.SafetyFilter(integrator(initial=start, safe=[cb.Inside(cb.Box([-2, -2], [2, 2]))]))
    inside = cb.Inside(cb.Ellipsoid([0.0, 0.0], [[0.2, 0.0], [0.0, 0.2]]))
    lost = cb.SafetyFilter(integrator(initial=start, safe=[inside]))
    assert kept.guaranteed
    assert "initial set is not proved" in lost.reason


def test_a_step_into_where_the_model_is_undefined_is_not_feasible_nor_any_after_it() -> None:
    system = cb.DiscreteSystem(
        lambda x, u: [x[0] + 0.1 * u[0] + 0.01 * np.sqrt(1 + u[0])], states=1, inputs=cb.Box([-2], [2]),
        noise=cb.Gaussian(std=1e-3),
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-5], [5]))], horizon=5, delta=1e-3)
    guard = cb.SafetyFilter(problem, constants=cb.Constants(gain=1.0, sigma=1e-3, dimension=1))
    assert guard.step([0.5]).feasible
    assert not guard.step([-2.0]).feasible
    assert guard._link is None
    guard.state = np.zeros(1)
    assert not guard.step([0.5]).feasible


# ---- a tube of another problem -----------------------------------------------------------------------------------


def tube_of(problem: cb.Problem, **changes: Any) -> Any:
    options = {"horizon": problem.horizon, "delta": problem.delta} | changes
    return cb.tune_tube(bound_constants(problem), **options)


def noisy(std: float, **changes: Any) -> cb.Problem:
    system = cb.linear_system(np.eye(2), np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), noise=cb.Gaussian(std=std))
    return integrator(**changes).replace(system=system)


def test_a_tube_that_promises_more_than_the_problem_asks_serves() -> None:
    for tube in (tube_of(integrator()), tube_of(integrator(), horizon=40, delta=1e-4)):
        assert cb.SafetyFilter(integrator(), tube=tube).guaranteed


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: tube_of(integrator(), delta=0.2), "`tube` must have delta <= 0.001, got 0.2"),
        (lambda: tube_of(integrator(), horizon=5), "`tube` must cover the horizon 30, got one up to 5"),
        (lambda: tube_of(noisy(0.0005)), "`tube` must hold for this problem on its whole domain, got gain 1"),
        (
            lambda: cb.tune_tube(cb.Constants(gain=1.0, sigma=0.1, dimension=3), horizon=30, delta=1e-3),
            "`tube` must have dimension 2, got 3",
        ),
        (
            lambda: cb.tune_tube(cb.Constants(rate=0.0, sigma=0.1, dimension=2), horizon=30, delta=1e-3),
            r"`tube` must have a gain \(discrete time\), got a rate",
        ),
    ],
)
def test_a_tube_of_another_problem_is_refused(build: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cb.SafetyFilter(integrator(), tube=build())


def test_certified_constants_of_another_problem_are_refused_by_filters_plans_and_controllers() -> None:
    quiet = bound_constants(noisy(0.0005))
    with pytest.raises(ValueError, match="`constants` must hold for this problem"):
        cb.SafetyFilter(integrator(), constants=quiet)
    with pytest.raises(ValueError, match="`constants` must hold for this problem"):
        cb.synthesize_plan(integrator(), method="kummer", constants=quiet)
    with pytest.raises(ValueError, match="`tube` must hold for this problem"):
        cb.synthesize_plan(integrator(), tube=tube_of(noisy(0.0005)))
    free = [cb.Inside(cb.Box([-1, -1], [3, 1]))]
    plan = cb.synthesize_plan(noisy(0.0005, safe=free, horizon=4), method="kummer")
    with pytest.raises(ValueError, match="`plan` must hold for this problem"):
        cb.PredictiveController(noisy(0.05, safe=free, horizon=4), horizon=2, plan=plan)


def test_constants_that_hold_on_a_small_domain_only_are_refused() -> None:
    system = cb.ContinuousSystem(
        lambda x, u: [-x[0] + x[0] ** 3 + u[0]], states=1, inputs=cb.Box([-1], [1]), diffusion=0.01
    )
    problem = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.Box([-2], [2]))], domain=cb.Box([-2], [2]), horizon=1, delta=1e-3
    )
    near = bound_constants(problem, domain=cb.Box([-0.1], [0.1]))
    with pytest.raises(ValueError, match="`constants` must hold for this problem on its whole domain"):
        cb.SafetyFilter(problem, constants=near)
    assert cb.SafetyFilter(problem, constants=bound_constants(problem), steps=4).guaranteed
