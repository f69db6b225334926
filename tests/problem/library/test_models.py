"""The bundled problems are what the documentation says they are."""

import math

import numpy as np
import pytest

from certbound.problem.files.loading import load
from certbound.problem.library import DEFAULTS, MODELS
from certbound.problem.model.evaluation import compile_numpy


@pytest.mark.parametrize("name", MODELS)
def test_every_model_builds_with_its_defaults(name):
    problem = MODELS[name]()
    assert problem.name == name
    assert dict(problem.parameters) == dict(DEFAULTS[name])
    assert problem.closed_loop.shape == (problem.system.dimension,)
    assert MODELS[name].__doc__


@pytest.mark.parametrize("name", MODELS)
def test_every_parameter_matters_and_unknown_ones_are_refused(name):
    base = signature(MODELS[name]())
    for key, value in DEFAULTS[name].items():
        other = {"masses": 4.0, "dimension": 2.0, "reaction": 0.0, "th_goal": 0.3}.get(key, 1.5 * value + 0.01)
        if key == "th_goal":
            assert signature(MODELS[name](h=1.0, th_goal=other)) != signature(MODELS[name](h=1.0))
        else:
            assert signature(MODELS[name](**{key: other})) != base, key
    with pytest.raises(ValueError, match=f"`sigm` is no parameter of {name}; did you mean 'sigma'"):
        MODELS[name](sigm=1.0)
    with pytest.raises(ValueError, match="`sigma` must not contain nan"):
        MODELS[name](sigma=math.nan)


def signature(problem):
    """Everything of a problem that its parameters can reach."""
    system = problem.system
    noise = system.diffusion if system.time == "continuous" else system.noise.proxy
    boxes = [box.high.tolist() for box in (system.inputs, system.disturbance, problem.initial) if box is not None]
    radii = [getattr(constraint.region, "radius", None) for constraint in problem.safe]
    matrix = [] if system.time == "continuous" else system.noise_matrix.tolist()
    return repr(
        (system.dynamics.nodes, np.asarray(noise).tolist(), matrix, boxes, radii, np.asarray(problem.plan).tolist())
    )


def test_ou_is_the_papers():
    problem = load("ou")
    np.testing.assert_allclose(problem.system.diffusion, [[math.sqrt(0.1)]])
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(0.0, 2.0), [-1.0])
    assert (problem.horizon, problem.delta, problem.safe[0].region.radius) == (5.0, 1e-3, 1.5)
    assert load("ou", dimension=12).system.dimension == 12
    with pytest.raises(ValueError, match=r"`dimension` must be a whole number, at least 1, got 1.5"):
        load("ou", dimension=1.5)


def test_pendulum_is_the_documented_one():
    problem = load("pendulum", length=2)
    expected = [0.3, -9.81 / 2 * math.sin(0.7) - 0.5 * 0.3]
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(0.0, 0.7, 0.3), expected)
    np.testing.assert_array_equal(problem.system.diffusion, [[0.0], [0.05]])
    np.testing.assert_allclose(problem.initial.low, [0.45, -0.05])
    assert problem.safe[0].label == "-1.2 <= th <= 1.2"


def polar_controller(x, gamma=0.5, k=1.0, h=0.0, th_goal=0.0):
    """The controller as it is printed, with its angles."""
    to = np.array([0.5, 0.0]) - x[:2]
    bearing, e = math.atan2(to[1], to[0]), math.hypot(*to)
    alpha = math.remainder(bearing - x[2], math.tau)
    theta = math.remainder(bearing - th_goal, math.tau)
    v = gamma * e * math.cos(alpha)
    w = k * alpha + gamma * math.cos(alpha) * np.sinc(alpha / math.pi) * (alpha + h * theta)
    return np.array([v * math.cos(x[2]), v * math.sin(x[2]), w])


@pytest.mark.parametrize("gains", [{}, {"gamma": 1.0, "k": 2.0}, {"h": 1.0}, {"h": 0.5, "th_goal": 2.0}])
def test_unicycle_follows_the_polar_controller(gains):
    evaluate = compile_numpy(load("unicycle", **gains).closed_loop)
    rng = np.random.default_rng(0)
    for x in rng.uniform([-3, -3, -6], [7, 7, 6], (200, 3)):
        expected = polar_controller(x, **gains) + np.array([0, 0, 0.05])
        np.testing.assert_allclose(evaluate(0.0, *x, 0.05), expected, atol=2e-6)


def test_unicycle_scene_is_the_papers():
    problem = load("unicycle")
    np.testing.assert_allclose(problem.initial.low, [4.9, 4.9, -math.pi / 3 - 0.1])
    assert [(tuple(c.region.center), c.region.radius) for c in problem.safe] == [
        ((1.3, 3.5), 0.9),
        ((-1.0, 2.2), 0.72),
        ((6.2, 0.5), 0.75),
    ]
    assert problem.system.disturbance.high[0] == 0.1
    assert (problem.horizon, problem.delta) == (2.0, 1e-3)


def test_unicycle_keeps_its_nominal_clearance():
    """More than 1.6 from every obstacle along noise-free paths from the initial box."""
    problem = load("unicycle")
    evaluate = compile_numpy(problem.closed_loop)
    rng = np.random.default_rng(0)
    x = problem.initial.sample(rng, 200)
    d = rng.uniform(-0.1, 0.1, 200)
    nearest = np.inf
    for _ in range(500):
        x = x + 0.01 * evaluate(0.0, *x.T, d)
        for constraint in problem.safe:
            gap = np.linalg.norm(x[:, :2] - constraint.region.center, axis=1) - constraint.region.radius
            nearest = min(nearest, gap.min())
    assert 1.6 < nearest < 1.8
    distance = np.linalg.norm(x[:, :2] - [0.5, 0.0], axis=1)
    assert 0.68 < distance.min() < 0.75 < distance.max() < 0.85


@pytest.mark.parametrize("key", ["disturbance", "x0_halfwidth"])
def test_unicycle_sizes_are_not_negative(key):
    with pytest.raises(ValueError, match=f"`{key}` must not be negative"):
        load("unicycle", **{key: -1})


def printed_chain(x, u, reaction=True):
    """Eq. (52), with the reaction forces of the springs."""
    (p1, p2, p3), (v1, v2, v3) = x[:3], x[3:]
    f1, f2, f3 = 10 * (p2 - p1) + 2 * (v2 - v1), 10 * (p3 - p2) + 2 * (v3 - v2), -10 * p3 - 2 * v3
    back = (0, f1, f2) if reaction else (0, 0, 0)
    force = [f - b - math.tanh(v) for f, b, v in zip((f1, f2, f3), back, (v1, v2, v3))]
    return np.concatenate([x[:3] + 0.1 * x[3:], x[3:] + 0.1 * (np.array(force) + u)])


@pytest.mark.parametrize("reaction", [True, False])
def test_chain_is_the_printed_model(reaction):
    evaluate = compile_numpy(load("chain", reaction=float(reaction)).closed_loop)
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, u = rng.normal(size=6), rng.normal(size=3)
        np.testing.assert_allclose(evaluate(0, *x, *u), printed_chain(x, u, reaction), atol=1e-13)


def test_chain_plan_follows_the_trapezoid_to_the_origin():
    problem = load("chain")
    assert problem.plan.shape == (50, 3)
    assert np.abs(problem.plan).max() == pytest.approx(38.37, abs=0.01)
    evaluate = compile_numpy(problem.closed_loop)
    x, path = problem.initial.low, [problem.initial.low]
    for row in problem.plan:
        x = evaluate(0, *x, *row)
        path.append(x)
        assert all(constraint.satisfied(x) for constraint in problem.safe)
    path = np.array(path)
    np.testing.assert_allclose(path[0], [-1, -2, -3, 0, 0, 0])
    np.testing.assert_allclose(path[-1], 0, atol=1e-12)
    np.testing.assert_allclose(path[:, 1], 2 * path[:, 0], atol=1e-12)
    speed = np.diff(path[1:50, 0])
    np.testing.assert_allclose(speed[3:-2], speed[10], rtol=1e-9)
    np.testing.assert_allclose(speed[:3] / speed[10], [0.25, 0.5, 0.75], rtol=1e-9)


def test_chain_noise_enters_the_velocities_by_the_step():
    problem = load("chain")
    np.testing.assert_allclose(problem.system.noise.proxy, 0.43**2 * np.eye(3))
    np.testing.assert_array_equal(problem.system.noise_matrix, np.vstack([np.zeros((3, 3)), 0.1 * np.eye(3)]))
    assert (problem.horizon, problem.delta) == (50, 0.002)
    np.testing.assert_array_equal(problem.cost[1], 1e-4 * np.eye(3))
    np.testing.assert_array_equal(problem.system.inputs.high, [100.0] * 3)


def test_chain_rest_stays_at_the_origin():
    problem = load("chain_rest")
    assert problem.fixed_start
    assert not np.any(problem.plan)
    np.testing.assert_array_equal(compile_numpy(problem.closed_loop)(0, *[0.0] * 9), np.zeros(6))


@pytest.mark.parametrize("masses", [3, 6, 20])
def test_longer_chains_are_let_down_as_well(masses):
    problem = load("chain", masses=masses)
    assert problem.system.dimension == 2 * masses
    assert len(problem.safe) == masses + 1
    evaluate = compile_numpy(problem.closed_loop)
    x = problem.initial.low
    for row in problem.plan:
        x = evaluate(0, *x, *row)
    np.testing.assert_allclose(x, 0, atol=1e-11)


def test_chain_at_rest_may_be_short():
    assert load("chain_rest", masses=1).system.dimension == 2


def test_chain_labels_name_the_gaps():
    assert [c.label for c in load("chain").safe] == ["p1 >= -1.2", "p2 - p1 >= -1.2", "p3 - p2 >= -1.2", "v3 <= 2"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": 0}, "`mass` must be positive"),
        ({"eta": -1}, "`eta` must be positive"),
        ({"masses": 2}, "`masses` must be a whole number, at least 3, got 2"),
        ({"masses": 3.5}, "`masses` must be a whole number"),
        ({"reaction": 2}, "`reaction` must be 0 or 1"),
        ({"sigma": -1}, "`sigma` must not be negative"),
        ({"input_bound": 10}, "`plan` must stay in the input bounds"),
    ],
)
def test_chain_parameters_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        load("chain", **changes)
