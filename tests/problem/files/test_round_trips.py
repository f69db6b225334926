"""What is saved is what was read: every law, start, constraint, plan and bundled problem."""

from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from certbound.problem.files.loading import load, loads, save
from certbound.problem.files.plans import write_plan
from certbound.problem.model import jacobian, trace
from tests.problem.toml_files import COURSE, STEPS, changed, same


@pytest.mark.parametrize(
    ("noise", "name", "proxy"),
    [
        ('law = "gaussian"\nvariance = [1, 4]', "gaussian", [1, 4]),
        ('law = "gaussian"\ncovariance = [[1, 0], [0, 4]]', "gaussian", [1, 4]),
        ('law = "uniform"\nhalfwidth = 3', "uniform", [3, 3]),
        ('law = "rademacher"\nscale = [1, 2]', "rademacher", [1, 4]),
        ('law = "bounded"\nhalfwidth = [3, 4]', "bounded", [9, 16]),
        ('law = "bounded"\nhalfwidth = [3, 4]\nindependent = false', "bounded", [25, 25]),
        ('law = "subgaussian"\nproxy_std = "1 + 1"', "subgaussian", [4, 4]),
        ('law = "subgaussian"\nproxy_variance = 2', "subgaussian", [2, 2]),
        ('law = "subgaussian"\nproxy_covariance = [[1, 0], [0, 2]]', "subgaussian", [1, 2]),
    ],
)
def test_every_law_is_read_and_written(noise, name, proxy, tmp_path):
    text = changed(STEPS, 'law = "gaussian"\nstd = 0.1\nmatrix = [[1], [0.5]]', noise)
    problem = loads(text)
    assert problem.system.noise.name == name
    np.testing.assert_allclose(np.diag(problem.system.noise.proxy), proxy, rtol=1e-15)
    save(problem.replace(name="again"), tmp_path / "law.toml")
    assert same(problem.replace(name="again"), load(tmp_path / "law.toml"))


START = "[initial]\npoint = [0, 0]"


@pytest.mark.parametrize(
    ("start", "kind", "low"),
    [
        ("[initial]\npoint = { y = 2, x = 1 }", cb.Box, [1, 2]),
        ("[initial]\nbox = { y = [2, 3], x = [1, 1] }", cb.Box, [1, 2]),
        ("[initial]\nball = { center = [1, 2], radius = 0.5 }", cb.Ball, [0.5, 1.5]),
        ("[initial]\nball = { center = { y = 2, x = 1 }, radius = 0.5 }", cb.Ball, [0.5, 1.5]),
        ("[initial]\nellipsoid = { center = { y = 2, x = 1 }, shape = [[4, 0], [0, 1]] }", cb.Ellipsoid, [0, 0]),
    ],
)
def test_every_start_is_read_and_written(start, kind, low, tmp_path):
    problem = loads(changed(STEPS, START, start))
    assert isinstance(problem.initial, kind)
    np.testing.assert_allclose(-problem.initial.support(-np.eye(2)), low)
    save(problem.replace(name="again"), tmp_path / "start.toml")
    assert same(problem.replace(name="again"), load(tmp_path / "start.toml"))


def test_a_random_start_is_read_and_written(tmp_path):
    problem = loads(changed(STEPS, "point = [0, 0]", "gaussian = { mean = [1, 2], covariance = [[1, 0], [0, 2]] }"))
    np.testing.assert_array_equal(problem.initial.mean, [1, 2])
    save(problem.replace(name="again"), tmp_path / "start.toml")
    assert same(problem.replace(name="again"), load(tmp_path / "start.toml"))


CONSTRAINTS = """
[[stay]]
box = [[-1, 1], [-inf, inf]]
label = "the corridor"
[[stay]]
box = { x = [-1, 1] }
center = { x = "0.1*t" }
[[stay]]
ball = { center = ["0.1*t", 0], radius = "2*1.5" }
[[stay]]
ellipsoid = { center = { y = 0, x = 0 }, shape = [[4, 0], [0, 1]] }
[[stay]]
halfspace = { normal = { y = 2 }, bound = 3 }
during = [3, 3]
[[avoid]]
box = { x = [5, 6], y = [5, 6] }
[[avoid]]
ellipsoid = { center = { y = "5 + t" }, shape = [[4]] }
[[avoid]]
halfspace = { normal = [-1, -1], bound = -9 }
[[avoid]]
polytope = { A = [[-1, 0], [0, -1], [1, 1]], b = [-5, -5, 20] }
"""


def test_every_constraint_is_read_and_written(tmp_path):
    problem = loads(STEPS + CONSTRAINTS)
    kinds = ["box", "box", "ball", "ellipsoid", "halfspace", "box", "ellipsoid", "halfspace", "polytope"]
    assert [constraint.region.kind for constraint in problem.safe] == kinds
    assert [constraint.region.moving for constraint in problem.safe] == [False, True, True] + [False] * 3 + [True] + [
        False
    ] * 2
    assert problem.safe[0].label == "the corridor"
    assert problem.safe[4].during == (3, 3)
    assert problem.safe[3].region.coordinates == (1, 0)
    save(problem.replace(name="again"), tmp_path / "sets.toml")
    assert same(problem.replace(name="again"), load(tmp_path / "sets.toml"))


def test_a_file_is_saved_as_it_was_written(tmp_path):
    problem = loads(COURSE, sigma=0.25)
    save(problem, tmp_path / "copy.toml")
    text = (tmp_path / "copy.toml").read_text()
    assert 'turn = "-0.5*th + d"' in text
    assert "sigma = 0.25" in text
    assert same(problem, load(tmp_path / "copy.toml"))
    assert load(tmp_path / "copy.toml", sigma=0.5).system.diffusion[0, 0] == 0.5


def test_a_changed_problem_is_saved_with_the_change(tmp_path):
    problem = loads(COURSE, v=2).replace(delta=0.25)
    save(problem, tmp_path / "copy.toml")
    assert same(problem, load(tmp_path / "copy.toml"))


@pytest.mark.parametrize("name", ["ou", "unicycle", "chain", "chain_rest", "pendulum"])
def test_bundled_problems_survive_the_round_trip(name, tmp_path):
    problem = load(name)
    save(problem, tmp_path / f"{name}.toml")
    assert same(problem, load(tmp_path / f"{name}.toml"))


def test_a_function_defined_problem_is_saved_as_expressions(tmp_path):
    system = cb.ContinuousSystem(
        lambda t, x, u: [np.maximum(x[0], 0.1) * x[1] ** 3 - t, np.arctan2(x[1], 2.0) * np.tanh(u[0]) + u[1] / 3],
        states=["s1", "s2"],
        inputs=cb.Box([-1, -np.inf], [1, np.inf]),
        diffusion=lambda t, x: [[0.1 * x[0] ** 2, 0], [0, np.exp(-t) * x[0] ** 2]],
    )
    plan = lambda t, x: [np.sin(t) * x[0], -x[1] * x[0] ** 2]  # noqa: E731
    problem = cb.Problem(system, initial=[0, 0], safe=[], horizon=1, plan=plan, cost=([1, 1], [1, 2]))
    save(problem, tmp_path / "model.toml")
    assert same(problem, load(tmp_path / "model.toml"))


def test_a_model_that_files_cannot_hold_is_refused(tmp_path):
    slope = jacobian(trace(lambda x: [np.abs(x[0])], {"t": ["t"], "x": ["x1"]}), [1])
    system = cb.ContinuousSystem(replace(slope, shape=(1,)), states=1)
    problem = cb.Problem(system, initial=[0], safe=[], horizon=1)
    with pytest.raises(ValueError, match="kink does not exist in problem files"):
        save(problem, tmp_path / "model.toml")
    assert not (tmp_path / "model.toml").exists()
    with pytest.raises(ValueError, match=r"`path` must end in \.toml"):
        save(problem, tmp_path / "model.txt")


def test_an_array_plan_is_kept_beside_the_file(tmp_path):
    write_plan(tmp_path / "plan.json", [[0.5, 1.5]] * 3, ("u", "w"))
    text = changed(STEPS, 'u = "-0.1*x"\nw = "sin(t)*y"', 'file = "plan.json"')
    problem = loads(text, folder=tmp_path)
    np.testing.assert_array_equal(problem.input_sequence, [[0.5, 1.5]] * 3)
    (tmp_path / "elsewhere").mkdir()
    save(problem, tmp_path / "elsewhere" / "copy.toml")
    assert (tmp_path / "elsewhere" / "copy.plan.json").exists()
    np.testing.assert_array_equal(load(tmp_path / "elsewhere" / "copy.toml").plan, problem.plan)
