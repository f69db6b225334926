"""The exported nominal problem agrees with the model that certificates speak of."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.problem.export import export_casadi, export_control
from certbound.problem.model.evaluation import compile_numpy


def arms() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda t, x, u, d: np.array([x[1], -np.sin(x[0]) + u[0] * np.cos(t) + d[0]]),
        states=["angle", "speed"], inputs=cb.Box([-1], [1]), disturbance=cb.Box([-0.1], [0.1]),
    )  # fmt: skip
    safe = [
        cb.Inside(cb.Box([-1.0, -np.inf], [1.0, 2.0])),
        cb.Outside(cb.Box([0.5, 0.5], [0.7, 0.9])),
        cb.Outside(cb.Ball(lambda t: np.array([0.1 * t]), 0.2, coordinates=(1,))),
        cb.Inside(cb.Ellipsoid([0.0, 0.0], [[4.0, 0.5], [0.5, 3.0]])),
        cb.Inside(cb.HalfSpace([1.0, 1.0], 2.5)),
    ]
    return cb.Problem(system, initial=[0.0, 1.0], safe=safe, horizon=3, cost=([1.0, 2.0], [0.5]))


def test_the_dynamics_and_the_cost_agree() -> None:
    problem = arms()
    nominal = export_casadi(problem)
    evaluate = compile_numpy(problem.system.dynamics)
    rng = np.random.default_rng(0)
    for t, x1, x2, u, d in rng.uniform(-1, 1, (10, 5)):
        assert np.ravel(nominal.dynamics(t, [x1, x2], u, d)) == pytest.approx(evaluate(t, x1, x2, u, d))
        assert float(nominal.cost([x1, x2], u)) == pytest.approx(x1**2 + 2 * x2**2 + 0.5 * u**2)


def test_the_constraints_are_positive_exactly_where_one_is_broken() -> None:
    problem = arms()
    nominal = export_casadi(problem)
    assert nominal.constraints.numel_out(0) == len(nominal.labels) == 7
    points = np.random.default_rng(1).uniform(-2.5, 2.5, (300, 2))
    seen = set()
    for point in points:
        values = np.ravel(nominal.constraints(2.0, point))
        for constraint in problem.constraints:
            own = [value for value, label in zip(values, nominal.labels) if label == constraint.label]
            assert (max(own) <= 0) == bool(constraint.satisfied(point, 2.0))
            seen.add((constraint.label, max(own) <= 0))
    assert len(seen) == 2 * len(problem.constraints)


def test_a_step_is_of_fourth_order_and_the_dynamics_themselves_in_discrete_time() -> None:
    step = export_casadi(cb.load("ou")).step
    errors = [abs(float(step(0, 1.0, [], [], h)) - np.exp(-0.5 * h)) for h in (0.4, 0.2)]
    assert 25 < errors[0] / errors[1] < 40
    chain = cb.load("chain")
    nominal = export_casadi(chain)
    x, u = np.arange(6.0), np.ones(3)
    assert np.ravel(nominal.step(0, x, u, [], 7.0)) == pytest.approx(np.ravel(nominal.dynamics(0, x, u, [])))


def test_a_control_system_moves_as_the_model_does() -> None:
    control = pytest.importorskip("control")
    problem = arms()
    exported = export_control(problem)
    assert exported.input_labels == ["u", "d"]
    linear = control.linearize(exported, [0, 0], [0, 0])
    assert pytest.approx(np.array([[0, 1], [-1, 0]]), abs=1e-6) == linear.A
    response = control.input_output_response(export_control(cb.load("ou").system), np.linspace(0, 2, 5), 0, [1.0])
    assert response.states[0] == pytest.approx(np.exp(-0.5 * response.time), rel=1e-3)
    assert export_control(cb.load("chain")).dt == 1


def test_a_discretised_control_model_goes_round(tmp_path: object) -> None:
    control = pytest.importorskip("control")
    plant = control.c2d(control.ss([[0.0, 1.0], [-2.0, -1.0]], np.zeros((2, 1)), np.eye(2), np.zeros((2, 1))), 0.1)
    system = cb.from_control(plant, noise=cb.Gaussian(std=0.01))
    assert isinstance(system, cb.DiscreteSystem)
    back = export_control(system)
    following = back.dynamics(0, np.array([1.0, -1.0]), np.zeros(0))
    assert following == pytest.approx(np.asarray(plant.A) @ [1.0, -1.0])
