"""A problem checks everything it is given, and offers the closed loop that all engines read."""

import pickle

import numpy as np
import pytest

from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tracing import trace
from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets.constraints import GaussianStart, Inside, Outside
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope
from certbound.problem.systems import ContinuousSystem, DiscreteSystem

SQUARE = Inside(Box([-1, -1], [1, 1]))


def continuous(**options):
    return ContinuousSystem(lambda x: -x, states=["a", "b"], diffusion=0.1 * np.eye(2), **options)


def driven(kind=DiscreteSystem, **options):
    return kind(lambda t, x, u: [x[1] + t, u[0] - x[0]], states=["a", "b"], inputs=Box([-2], [2]), **options)


def problem(system=None, **changes):
    options = {"initial": [0, 0], "safe": [SQUARE], "horizon": 5} | changes
    return Problem(continuous() if system is None else system, **options)


def test_a_point_is_stored_as_a_degenerate_box():
    start = problem(initial=[0.1, 0.2])
    assert isinstance(start.initial, Box)
    assert start.fixed_start
    np.testing.assert_array_equal(start.initial.low, start.initial.high)
    assert not problem(initial=Box([0, 0], [0.1, 0])).fixed_start


def test_defaults_and_labels():
    base = problem()
    assert (base.delta, base.name, base.plan, base.cost, base.domain) == (1e-3, "problem", None, None, None)
    assert base.safe[0].label == "-1 <= a <= 1, -1 <= b <= 1"
    assert dict(base.parameters) == {}
    assert base.horizon == 5.0


def test_without_inputs_the_closed_loop_is_the_dynamics():
    base = problem()
    assert base.closed_loop is base.system.dynamics


def test_a_feedback_law_is_put_into_the_dynamics():
    closed = problem(driven(), plan=lambda t, x: [t * x[0] - x[1]]).closed_loop
    assert closed.inputs == ("t", "a", "b")
    np.testing.assert_allclose(compile_numpy(closed)(3.0, 5.0, 7.0), [7 + 3, (3 * 5 - 7) - 5])
    tape = trace(lambda t, x: [t * x[0] - x[1]], {"t": ["t"], "x": ["a", "b"]})
    np.testing.assert_allclose(compile_numpy(problem(driven(), plan=tape).closed_loop)(3.0, 5.0, 7.0), [10, 3])


def test_a_feedback_law_leaves_the_disturbance_in_place():
    system = ContinuousSystem(
        lambda x, u, d: [u[0] + d[0]], states=["x"], inputs=Box([-1], [1]), disturbance=Box([-1], [1])
    )
    base = problem(system, initial=[0], safe=[], plan=lambda x: [-x[0]])
    assert base.closed_loop.inputs == ("t", "x", "d")
    np.testing.assert_allclose(compile_numpy(base.closed_loop)(0, 2, 3), [1])


def test_an_array_plan_keeps_the_inputs_and_is_cut_to_the_horizon():
    rows = np.arange(7.0) / 7
    base = problem(driven(), plan=rows)
    assert base.closed_loop.inputs == ("t", "a", "b", "u")
    np.testing.assert_array_equal(base.input_sequence, rows[:5, None])
    assert problem(driven(), plan=lambda x: [x[0]]).input_sequence is None


def test_a_continuous_array_plan_may_have_any_number_of_pieces():
    base = problem(driven(ContinuousSystem), plan=[[0.0], [1.0], [0.5]])
    assert base.input_sequence.shape == (3, 1)
    with pytest.raises(ValueError, match="`horizon` must not change alone when the plan is an array"):
        base.replace(horizon=3)
    assert base.replace(horizon=3, plan=[[0.0]]).horizon == 3


def test_inputs_without_a_plan_are_allowed_until_the_closed_loop_is_asked_for():
    base = problem(driven())
    with pytest.raises(ValueError, match=r"the system has inputs \(u\) and no plan; give `plan=`"):
        base.closed_loop  # noqa: B018


def test_the_domain_is_one_more_constraint():
    base = problem(domain=Box([-5, -5], [5, np.inf]))
    assert [constraint.label for constraint in base.constraints][1:] == ["the model's domain"]
    assert len(base.safe) == 1


def test_weights_may_be_diagonals_or_matrices():
    base = problem(driven(), cost=([1.0, 2.0], [[3.0]]))
    np.testing.assert_array_equal(base.cost[0], np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(base.cost[1], [[3.0]])


def test_replace_checks_again_and_keeps_the_rest():
    base = problem(name="mine", parameters={"k": 1.0}, domain=Box([-9, -9], [9, 9]))
    other = base.replace(delta=0.5)
    assert (other.delta, other.name, other.horizon, dict(other.parameters)) == (0.5, "mine", 5.0, {"k": 1.0})
    assert other.system is base.system
    assert other.domain is base.domain
    with pytest.raises(ValueError, match="`delta` must lie in"):
        base.replace(delta=2)
    with pytest.raises(TypeError, match="`horzon` is no argument of Problem; did you mean 'horizon'"):
        base.replace(horzon=2)


def test_twelve_states():
    system = ContinuousSystem(lambda x: -x, states=12, diffusion=np.eye(12))
    base = Problem(system, initial=Ball(np.zeros(12), 0.1), safe=[Inside(Ball(np.zeros(12), 1))], horizon=1)
    assert base.closed_loop.shape == (12,)
    with pytest.raises(ValueError, match="a part of it violates"):
        base.replace(initial=Box([-0.3] * 12, [0.3] * 12))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"delta": 0}, r"`delta` must lie in \(0, 1\), got 0"),
        ({"delta": 1}, r"`delta` must lie in \(0, 1\), got 1"),
        ({"delta": np.nan}, "`delta` must not contain nan"),
        ({"horizon": 0}, "`horizon` must be positive, got 0"),
        ({"horizon": -1}, "`horizon` must be positive, got -1"),
        ({"horizon": np.nan}, "`horizon` must not contain nan"),
        ({"horizon": 1e300}, r"`horizon` must lie between 1e-50 and 1e\+50, or be infinite, got 1e\+300"),
        ({"horizon": 1e-300}, r"got 1e-300; choose another unit of time"),
        ({"horizon": 10**400}, r"`horizon` must hold numbers of at most 1.8e308 in size"),
        ({"initial": [0, 0, 0]}, "`initial` must have 2 entries, got 3"),
        ({"initial": [0, np.nan]}, "`initial` must not contain nan"),
        ({"initial": Box([0, 0, 0], [1, 1, 1])}, r"`initial` must have dimension 2 \(the states\), got 3"),
        ({"initial": Box([0, -np.inf], [0, 0])}, "`initial` must be bounded"),
        ({"initial": Ball([0, 0], 1, coordinates=(0, 1))}, "`initial` must be a fixed set over all states"),
        ({"initial": Ball(lambda t: [t, 0], 1)}, "`initial` must be a fixed set"),
        ({"initial": GaussianStart([0], [[1]])}, "`initial` must have dimension 2"),
        ({"safe": [Inside(Box([-1], [1]))]}, r"`safe\[0\]` must have dimension 2 \(the states\), got 1"),
        ({"safe": [Outside(Ball([9], 1, coordinates=(2,)))]}, r"`safe\[0\]` must use state indices below 2"),
        ({"safe": [Inside(SQUARE.region, during=(0, 6))]}, r"`safe\[0\]` must have `during` within \[0, 5\]"),
        ({"domain": Box([-1], [1])}, "`domain` must have dimension 2"),
        ({"plan": [[0.0]] * 5}, "`plan` must be omitted for a system without inputs"),
        ({"cost": ([1, 1], [1])}, "`cost` must be omitted for a system without inputs"),
    ],
)
def test_numbers_and_sizes_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        problem(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 2.5}, "`horizon` must be a whole number of steps"),
        ({"safe": [Inside(SQUARE.region, during=(0, 1.5))]}, "must have whole steps in `during`"),
        ({"plan": [[0.0]] * 4}, "`plan` must have 5 rows, one a step, got 4"),
        ({"plan": [[0.0, 1.0]] * 5}, r"`plan` must be a finite array \(steps, 1\), got shape \(5, 2\)"),
        ({"plan": [[np.nan]] * 5}, "`plan` must be a finite array"),
        ({"plan": [[0.0]] * 3 + [[3.0]] * 2}, r"got u = 3 in row 3, outside \[-2, 2\]"),
        ({"plan": lambda x: [x[0], x[1]]}, r"`plan` must return 1 values \(u\) from t and x, got shape \(2,\)"),
        ({"cost": [1, 2, 3]}, r"`cost` must be the pair \(Q, R\)"),
        ({"cost": ([1, -1], [1])}, "`Q` must be positive semidefinite"),
        ({"cost": ([1, 1], [0])}, "`R` must be positive definite"),
        ({"cost": ([1, 1, 1], [1])}, "`Q` must have 2 entries"),
        ({"cost": ([[1, 2], [0, 1]], [1])}, "`Q` must be symmetric"),
    ],
)
def test_discrete_plans_and_costs_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        problem(driven(noise=Gaussian(std=0.1)), **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"safe": 3}, "`safe` must be a list of cb.Inside and cb.Outside"),
        ({"safe": [Box([-1, -1], [1, 1])]}, r"`safe\[0\]` must be cb.Inside or cb.Outside"),
        ({"initial": HalfSpace([1, 0], 1)}, "`initial` must be a point, Box"),
        ({"initial": "origin"}, "`initial` must be a point, Box"),
        ({"domain": Ball([0, 0], 1)}, "`domain` must be a fixed Box"),
        ({"name": 3}, "`name` must be text"),
        ({"delta": True}, "`delta` must be a number"),
        ({"delta": "x"}, "`delta` must hold numbers"),
    ],
)
def test_kinds_are_checked(changes, message):
    with pytest.raises(TypeError, match=message):
        problem(**changes)


def test_the_system_must_be_one():
    with pytest.raises(TypeError, match="`system` must be a ContinuousSystem or DiscreteSystem"):
        Problem(lambda x: -x, initial=[0], safe=[], horizon=1)


BOX = Box([0.5, -0.1], [0.7, 0.1])


@pytest.mark.parametrize(
    ("start", "constraint", "fault"),
    [
        ([2, 0], SQUARE, r"its centre \(2, 0\)"),
        (Box([1.1, 0], [1.5, 0.1]), SQUARE, "its centre"),
        (Box([0.5, 0], [1.1, 0]), SQUARE, "a part of it"),
        (Ball([0.5, 0], 0.6), SQUARE, "a part of it"),
        (Ellipsoid([0.5, 0], np.diag([0.36, 0.01])), SQUARE, "a part of it"),
        (BOX, Inside(HalfSpace([1, 0], 0.65)), "a part of it"),
        (BOX, Inside(Ball([0, 0], 0.65)), "a part of it"),
        (BOX, Inside(Ball([0], 0.65, coordinates=(0,))), "a part of it"),
        (Ball([0.5, 0], 0.2), Inside(Ball([0, 0], 0.65)), "a part of it"),
        (BOX, Inside(Polytope([[1, 1], [-1, 0]], [0.75, 1])), "a part of it"),
        (BOX, Outside(Ball([0.6, 0.5], 0.45)), "a part of it"),
        (Ball([0.5, 0], 0.2), Outside(Ball([1, 0], 0.35)), "a part of it"),
        (BOX, Outside(Ball([0.6, 0.0], 0.1)), "its centre"),
        (BOX, Outside(HalfSpace([-1, 0], -0.65)), "a part of it"),
        (BOX, Outside(Box([0.65, -9], [9, 9])), "a part of it"),
        (BOX, Outside(Ellipsoid([0.6, 0], np.eye(2))), "its centre"),
        (GaussianStart([2, 0], np.zeros((2, 2))), SQUARE, "the mean"),
    ],
)
def test_a_start_outside_the_safe_set_is_refused(start, constraint, fault):
    with pytest.raises(ValueError, match=f"`initial` must satisfy every constraint.* {fault}.* violates '"):
        problem(initial=start, safe=[constraint])


def test_a_random_start_may_have_its_mean_where_paths_fail():
    """How often it starts there is a part of the probability that is asked for."""
    assert problem(initial=GaussianStart([2, 0], np.eye(2)), safe=[SQUARE]).initial.random


def test_a_centre_that_is_undefined_at_the_start_is_refused_by_name():
    gone = Ball(lambda t: [1 / t, 0.5], 0.1)
    with pytest.raises(ValueError, match=r"centres that are defined .* 'gone' is \[inf, 0\.5\] at time 0"):
        problem(safe=[Outside(gone, label="gone")])
    problem(safe=[Outside(gone, label="gone", during=(0.5, 1.0))])


@pytest.mark.parametrize(
    ("start", "constraint"),
    [
        ([1, 0], SQUARE),
        (BOX, Inside(HalfSpace([1, 0], 0.7))),
        (BOX, Outside(Ball([1.0, 0.0], 0.3))),
        (BOX, Outside(HalfSpace([-1, 0], -0.7))),
        (BOX, Outside(Box([0.7, -9], [9, 9]))),
        (Ball([0, 0], 1), SQUARE),
        (GaussianStart([0, 0], np.eye(2)), SQUARE),
        ([2, 0], Inside(SQUARE.region, during=(1, 5))),
        ([2, 0], Inside(Box([-1, -1], [1, 1], center=lambda t: [2, 0]))),
        ([0, 0], Inside(Box([-np.inf] * 2, [np.inf] * 2))),
    ],
)
def test_a_start_that_touches_or_comes_before_a_window_is_accepted(start, constraint):
    assert problem(initial=start, safe=[constraint]).horizon == 5


EDGES = [
    ([0.1, 0.1], [0.1001, 0.1], Inside(Polytope([[0.7, -0.1], [1.0, 0.0]], [0.7 * 0.1 - 0.1 * 0.1, 9.0]))),
    ([0.3, 0.4], [0.3, 0.4001], Inside(Ball([0, 0], 0.5))),
    ([0.3, 0.4], [0.3, 0.3999], Outside(Ball([0.3, 0], 0.4))),
    (Ball([0.3, 0.1], 0.3), Ball([0.3001, 0.1], 0.3), Inside(HalfSpace([1.0, 0.0], 0.6))),
]


@pytest.mark.parametrize(("start", "beyond", "wall"), EDGES)
@pytest.mark.parametrize("unit", [1e-9, 0.3, 1e8])
def test_units_decide_nothing_for_a_start_on_an_edge(start, beyond, wall, unit):
    constraint = type(wall)(_in_units(wall.region, unit))
    assert problem(initial=_in_units(start, unit), safe=[constraint]).safe
    with pytest.raises(ValueError, match="`initial` must satisfy"):
        problem(initial=_in_units(beyond, unit), safe=[constraint])


def _in_units(region, unit):
    """A set of states as it reads in other units of length."""
    if isinstance(region, Ball):
        return Ball(unit * region.center, unit * region.radius)
    if isinstance(region, HalfSpace):
        return HalfSpace(region.normal, unit * region.bound)
    return Polytope(region.A, unit * region.b) if isinstance(region, Polytope) else unit * np.array(region)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_a_plan_outside_its_bounds_is_refused_in_all_units(unit):
    system = ContinuousSystem(lambda x, u: u - x, states=1, inputs=Box([-unit], [unit]), diffusion=[[0.1 * unit]])
    wall = Inside(Box([-9 * unit], [9 * unit]))
    with pytest.raises(ValueError, match="`plan` must stay in the input bounds"):
        Problem(system, initial=[0.0], safe=[wall], horizon=1, plan=[[unit], [1.5 * unit]])
    rounded = Problem(system, initial=[0.0], safe=[wall], horizon=1, plan=[[unit], [(1 + 1e-12) * unit]])
    assert rounded.plan.max() == unit


def test_a_start_outside_the_domain_is_refused():
    with pytest.raises(ValueError, match="violates 'the model's domain'"):
        problem(safe=[], initial=[9, 9], domain=Box([-5, -5], [5, 5]))


def test_moving_obstacles_are_met_at_time_0():
    rock = Outside(Ball(lambda t: [2 - t, 0.0], 1.0))
    assert problem(safe=[rock]).safe[0].region.moving
    with pytest.raises(ValueError, match="violates"):
        problem(safe=[rock], initial=[2.0, 0.0])


def test_a_problem_travels_to_another_process():
    base = problem(
        driven(noise=Gaussian(std=0.1)),
        plan=lambda t, x: [t - x[0]],
        safe=[SQUARE, Outside(Ball(lambda t: [9 - t, 0.0], 1.0))],
        parameters={"k": 1.0},
    )
    copy = pickle.loads(pickle.dumps(base))
    assert dict(copy.parameters) == {"k": 1.0}
    assert [constraint.label for constraint in copy.safe] == [constraint.label for constraint in base.safe]
    np.testing.assert_array_equal(copy.safe[1].region.center_at(2.0), [7.0, 0.0])
    np.testing.assert_array_equal(copy.system.noise.proxy, base.system.noise.proxy)
    point = (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(compile_numpy(copy.closed_loop)(*point), compile_numpy(base.closed_loop)(*point))


def test_classes_made_from_sets_or_constraints_are_refused_since_they_may_mean_something_else():
    class Ring(Ball):
        def contains(self, x, t=0.0):
            return super().contains(x, t) & (np.linalg.norm(self.local(x), axis=-1) > 0.5)

    class Mostly(Inside):
        pass

    with pytest.raises(TypeError, match=r"`region` must be a Box, Ball.* itself"):
        Inside(Ring([0, 0], 1))
    with pytest.raises(TypeError, match=r"`safe\[0\]` must be cb.Inside or cb.Outside itself"):
        problem(safe=[Mostly(Ball([0, 0], 1))])
    with pytest.raises(TypeError, match="`initial` must be a point, Box"):
        problem(initial=Ring([0, 0], 0.9))
