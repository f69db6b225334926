"""Two problem files and what it means that problems agree, for the tests of files."""

import numpy as np

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tape import Tape

__all__ = ["COURSE", "STEPS", "changed", "course_in_python", "same"]

COURSE = """
name = "obstacle course"
time = "continuous"
horizon = 5.0
delta = 1e-3
states = ["px", "py", "th"]
[parameters]
sigma = 0.01
v = 1.0
[disturbances]
d = [-0.1, 0.1]
[definitions]
turn = "-0.5*th + d"
[dynamics]
px = "v*cos(th)"
py = "v*sin(th)"
th = "turn"
[noise]
diffusion = [["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]
[initial]
box = [[-0.1, 0.1], [-0.1, 0.1], [-0.1, 0.1]]
[[stay]]
box = { px = [-1, 10], py = [-2, 2] }
[[avoid]]
ball = { center = { px = "5 + 0.1*t", py = 0 }, radius = 0.9 }
during = [0, 2]
[domain]
box = { px = [-5, 20] }
"""

STEPS = """
time = "discrete"
horizon = 3
states = ["x", "y"]
[inputs]
u = [-1, 1]
w = [-2, 2]
[dynamics]
A = [[0.9, 0.1], [0, 0.8]]
B = [[1, 0], [0, 1]]
b = [0.5, 0]
[plan]
u = "-0.1*x"
w = "sin(t)*y"
[cost]
Q = [1, 2]
R = [[1, 0], [0, 1]]
[noise]
law = "gaussian"
std = 0.1
matrix = [[1], [0.5]]
[initial]
point = [0, 0]
"""


def changed(text, old, new):
    assert old in text
    return text.replace(old, new)


def same(first, second):
    """Whether two problems agree in everything that an engine reads."""
    points = np.random.default_rng(0).uniform(-1, 1, (len(first.closed_loop.inputs), 50))
    assert first.closed_loop.inputs == second.closed_loop.inputs
    closed = (compile_numpy(first.closed_loop)(*points), compile_numpy(second.closed_loop)(*points))
    np.testing.assert_array_equal(*closed)
    for name in ("horizon", "delta", "name"):
        assert getattr(first, name) == getattr(second, name)
    assert [c.label for c in first.constraints] == [c.label for c in second.constraints]
    assert [c.during for c in first.constraints] == [c.during for c in second.constraints]
    states = np.random.default_rng(1).uniform(-2, 2, (200, first.system.dimension))
    for one, other in zip(first.constraints, second.constraints):
        for t in (0.0, 0.7):
            np.testing.assert_array_equal(one.satisfied(states, t), other.satisfied(states, t))
    assert type(first.initial) is type(second.initial)
    rng = [np.random.default_rng(3), np.random.default_rng(3)]
    np.testing.assert_array_equal(first.initial.sample(rng[0], 5), second.initial.sample(rng[1], 5))
    if first.system.time == "discrete":
        np.testing.assert_array_equal(first.system.noise.proxy, second.system.noise.proxy)
        np.testing.assert_array_equal(first.system.noise_matrix, second.system.noise_matrix)
        assert first.system.noise.name == second.system.noise.name
    elif isinstance(first.system.diffusion, Tape):
        at = np.random.default_rng(0).uniform(-1, 1, (len(first.system.diffusion.inputs), 20))
        both = (compile_numpy(first.system.diffusion)(*at), compile_numpy(second.system.diffusion)(*at))
        np.testing.assert_array_equal(*both)
    else:
        np.testing.assert_array_equal(first.system.diffusion, second.system.diffusion)
    assert (first.cost is None) == (second.cost is None)
    if first.cost is not None:
        np.testing.assert_array_equal(first.cost[0], second.cost[0])
        np.testing.assert_array_equal(first.cost[1], second.cost[1])
    return True


def course_in_python(sigma=0.01):
    system = cb.ContinuousSystem(
        lambda x, d: [1.0 * np.cos(x[2]), 1.0 * np.sin(x[2]), -0.5 * x[2] + d[0]],
        states=["px", "py", "th"],
        disturbance=cb.Box([-0.1], [0.1]),
        diffusion=sigma * np.eye(3),
    )
    rock = cb.Ball(lambda t: [5 + 0.1 * t, 0.0], 0.9, coordinates=(0, 1))
    return cb.Problem(
        system,
        initial=cb.Box([-0.1] * 3, [0.1] * 3),
        safe=[cb.Inside(cb.Box([-1, -2, -np.inf], [10, 2, np.inf])), cb.Outside(rock, during=(0, 2))],
        horizon=5,
        domain=cb.Box([-5, -np.inf, -np.inf], [20, np.inf, np.inf]),
        name="obstacle course",
    )
