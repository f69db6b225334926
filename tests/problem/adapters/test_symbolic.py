"""SymPy and CasADi expressions become the same models as Python functions do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.adapters.casadi import casadi_module
from certbound.problem.adapters.symbolic import is_symbolic, symbol_names
from certbound.problem.model.evaluation import compile_numpy

sympy = pytest.importorskip("sympy")
ANGLE, SPEED, PUSH, TIME = sympy.symbols("angle speed push t")


def values(system: Any, *inputs: float) -> np.ndarray:
    return compile_numpy(system.dynamics)(*inputs)


@pytest.mark.parametrize(
    "expression",
    [
        -sympy.Rational(981, 100) * sympy.sin(ANGLE) - SPEED / 2,
        sympy.exp(-TIME) * sympy.tanh(SPEED) + sympy.sqrt(ANGLE + 3) - sympy.log(SPEED + 4),
        sympy.Max(ANGLE, SPEED, 0) * sympy.Min(ANGLE, 1) + sympy.Abs(SPEED) ** sympy.Rational(1, 3),
        sympy.atan2(SPEED, ANGLE + 2) + sympy.cosh(ANGLE) ** 2 / sympy.pi + sympy.E,
        sympy.Piecewise((ANGLE, ANGLE > 1), (SPEED**3, sympy.Rational(1, 4) >= ANGLE), (2, True)),
        sympy.Piecewise((1, (ANGLE > 0) & (SPEED < 1)), (0, True)) + 2**ANGLE,
        sympy.acos(ANGLE / 9) * sympy.floor(SPEED * 5) + sympy.sign(SPEED),
        sympy.Piecewise((1, sympy.Or(sympy.Eq(ANGLE, 7), ~(SPEED > 2))), (0, True)),
    ],
)
def test_a_sympy_expression_has_its_values(expression: Any) -> None:
    system = cb.ContinuousSystem([SPEED, expression], states=[ANGLE, SPEED])
    rng = np.random.default_rng(1)
    for angle, speed, time in rng.uniform(-1, 2, (20, 3)):
        expected = float(expression.subs({ANGLE: angle, SPEED: speed, TIME: time}).evalf())
        assert values(system, time, angle, speed)[1] == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_a_rational_number_stays_a_quotient() -> None:
    system = cb.ContinuousSystem([ANGLE / 3], states=[ANGLE])
    assert "div" in {node.op for node in system.dynamics.nodes}


def test_functions_of_time_are_states_of_their_name() -> None:
    angle = sympy.Function("angle")(TIME)
    system = cb.ContinuousSystem([-sympy.sin(angle)], states=[angle], diffusion=0.1)
    assert system.states == ("angle",)
    assert values(system, 0.0, 0.5)[0] == -np.sin(0.5)


def test_the_diffusion_may_be_a_sympy_matrix() -> None:
    diffusion = sympy.Matrix([[0], [sympy.Rational(1, 10) * sympy.cos(ANGLE)]])
    system = cb.ContinuousSystem([SPEED, -ANGLE], states=[ANGLE, SPEED], diffusion=diffusion)
    assert compile_numpy(system.diffusion)(0.0, 0.5, 0.0).tolist() == [[0.0], [0.1 * np.cos(0.5)]]
    constant = cb.ContinuousSystem([SPEED, -ANGLE], states=[ANGLE, SPEED], diffusion=sympy.eye(2) / 4)
    assert constant.diffusion.tolist() == [[0.25, 0.0], [0.0, 0.25]]


@pytest.mark.parametrize("kind", ["SX", "MX"])
def test_a_casadi_expression_is_taken_as_it_is(kind: str) -> None:
    ca = casadi_module()
    symbol = getattr(ca, kind).sym
    x, u, d = symbol("x", 2), symbol("u"), symbol("d")
    expression = ca.vertcat(x[1], -9.81 * ca.sin(x[0]) + u * ca.tanh(x[1]) + d)
    system = cb.ContinuousSystem(
        expression, states=["angle", "speed"], inputs=cb.Box([-1], [1]), disturbance=cb.Box([-1], [1])
    )
    assert values(system, 0.0, 0.3, 0.4, 0.5, 0.6) == pytest.approx(
        [0.4, -9.81 * np.sin(0.3) + 0.5 * np.tanh(0.4) + 0.6]
    )


def test_casadi_symbols_name_the_states() -> None:
    ca = casadi_module()
    angle, speed, push = ca.SX.sym("angle"), ca.SX.sym("speed"), ca.SX.sym("push")
    system = cb.DiscreteSystem(
        [angle + 0.1 * speed, speed + 0.1 * push], states=[angle, speed], disturbance=cb.Box([-1], [1]),
        disturbance_names=[push], noise=cb.Gaussian(std=0.1),
    )  # fmt: skip
    assert system.states == ("angle", "speed")
    assert values(system, 0, 1.0, 2.0, 3.0) == pytest.approx([1.2, 2.3])
    vector = ca.SX.sym("z", 2)
    assert cb.ContinuousSystem(-vector, states=vector).states == ("z_0", "z_1")


def test_a_casadi_function_is_called_by_the_names_of_its_inputs() -> None:
    ca = casadi_module()
    x, u = ca.MX.sym("a", 2), ca.MX.sym("b")
    function = ca.Function("f", [u, x], [ca.vertcat(x[1], u)], ["u", "x"], ["xdot"])
    system = cb.ContinuousSystem(function, states=2, inputs=cb.Box([-1], [1]))
    assert values(system, 0.0, 1.0, 2.0, 3.0).tolist() == [2.0, 3.0]


@pytest.mark.parametrize("source", ["sympy", "casadi"])
def test_a_model_of_expressions_is_written_to_a_problem_file_and_read_back(source: str, tmp_path: Path) -> None:
    ca = casadi_module()
    names = ["angle", "speed"]
    if source == "sympy":
        f: Any = [SPEED, -sympy.Rational(981, 100) * sympy.sin(ANGLE) - SPEED / 2 + PUSH]
    else:
        x, d = ca.SX.sym("x", 2), ca.SX.sym("d")
        f = ca.vertcat(x[1], -9.81 * ca.sin(x[0]) - x[1] / 2 + d)
    system = cb.ContinuousSystem(
        f, states=names, disturbance=cb.Box([-0.1], [0.1]), disturbance_names=["push"], diffusion=[[0], [0.05]]
    )
    safe = [cb.Inside(cb.Box([-1, -np.inf], [1, 2])), cb.Outside(cb.Ball([0.5, 1], 0.2), during=(0, 1))]
    problem = cb.Problem(system, initial=cb.Ball([0, 0], 0.1), safe=safe, horizon=2, name="swing")
    cb.save(problem, tmp_path / "swing.toml")
    again = cb.load(tmp_path / "swing.toml")
    rng = np.random.default_rng(2)
    for point in rng.uniform(-1, 1, (10, 4)):
        assert values(again.system, *point) == pytest.approx(values(system, *point), rel=1e-14)
    assert [c.label for c in again.safe] == [c.label for c in problem.safe]
    assert again.initial.radius == 0.1


def test_numbers_and_names_are_not_symbolic() -> None:
    ca = casadi_module()
    for value in (1.0, [1.0, "x"], np.eye(2), ca.DM([1.0]), lambda x: x, None):
        assert not is_symbolic(value)
    assert symbol_names(("a", "b")) == ["a", "b"]
    assert symbol_names(3) == 3


def _casadi_unknown() -> Any:
    ca = casadi_module()
    return ca.vertcat(ca.SX.sym("x", 2)[0], ca.SX.sym("stiffness"))


def _casadi_unnamed() -> Any:
    ca = casadi_module()
    x = ca.SX.sym("x", 2)
    return ca.Function("f", [x], [-x])


def _casadi_short() -> Any:
    ca = casadi_module()
    x = ca.SX.sym("x", 3)
    return ca.Function("f", [x], [-x], ["x"], ["xdot"])


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda: [SPEED, sympy.Symbol("k") * ANGLE], "contains the symbol k, which is none of t, angle, speed"),
        (lambda: [SPEED, sympy.besselj(0, ANGLE)], "uses besselj"),
        (lambda: [SPEED, sympy.I * ANGLE], "must be real and finite"),
        (lambda: [SPEED, sympy.Piecewise((ANGLE, ANGLE > 0))], r"end it with \(value, True\)"),
        (lambda: [SPEED], "must return 2 values"),
        (_casadi_unknown, "contains the symbol stiffness"),
        (_casadi_unnamed, "inputs i0; name them"),
        (_casadi_short, "must take 2 entries as x, got 3"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_cure(f: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cb.ContinuousSystem(f(), states=["angle", "speed"])
