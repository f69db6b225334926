"""A problem's noise-free part for other tools: CasADi functions, and python-control systems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.checks import instance
from certbound.problem.adapters import casadi_module, to_casadi
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside, Quadratic
from certbound.problem.systems import System


@dataclass(frozen=True, eq=False, kw_only=True)
class CasadiProblem:
    """The nominal problem as CasADi functions of columns; t is a scalar.

    Parameters
    ----------
    dynamics : casadi.Function
        (t, x, u, d) to dx/dt, or to the next state in discrete time.
    step : casadi.Function
        (t, x, u, d, h) to the state one step later: the dynamics themselves in discrete time (h is ignored), one
        step of the classical Runge-Kutta method of length h in continuous time.
    constraints : casadi.Function
        (t, x) to a column that is nowhere positive where every constraint holds (its window is not looked at).
    labels : tuple of str
        Which constraint each entry of that column belongs to.
    cost : casadi.Function or None
        (x, u) to x' Q x + u' R u, where the problem has weights.
    """

    dynamics: Any
    step: Any
    constraints: Any
    labels: tuple[str, ...]
    cost: Any = None


def export_casadi(problem: Problem) -> CasadiProblem:
    """The noise-free problem as CasADi functions, for an optimal-control tool of your own.

    The functions are those that the certificates speak of: both are made from the same traced model. A plan is not
    substituted: u stays free.

    Parameters
    ----------
    problem : Problem
        Any problem; empty columns stand for missing inputs and disturbances.

    Returns
    -------
    CasadiProblem

    Examples
    --------
    >>> from certbound.problem.files import load
    >>> nominal = export_casadi(load("ou"))
    >>> float(nominal.dynamics(0, [2.0], [], [])), nominal.labels
    (-1.0, ('inside the ball of radius 1.5 around (0)',))
    """
    instance("problem", problem, Problem)
    ca = casadi_module()
    system = problem.system
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    x = ca.SX.sym("x", system.dimension)
    u, d = ca.SX.sym("u", len(system.input_names)), ca.SX.sym("d", len(system.disturbance_names))
    value = to_casadi(system.dynamics, [part for part in (t, x, u, d) if part.numel()])
    dynamics = ca.Function("dynamics", [t, x, u, d], [value], ["t", "x", "u", "d"], ["f"])
    following = value if system.time == "discrete" else runge_kutta(lambda s, y: dynamics(s, y, u, d), t, x, h)
    step = ca.Function("step", [t, x, u, d, h], [following], ["t", "x", "u", "d", "h"], ["next"])
    rows, labels = _constraint_rows(ca, problem, t, x)
    constraints = ca.Function("constraints", [t, x], [rows], ["t", "x"], ["g"])
    cost = None
    if problem.cost is not None:
        state, control = problem.cost
        stage = ca.bilin(ca.DM(state), x, x) + ca.bilin(ca.DM(control), u, u)
        cost = ca.Function("cost", [x, u], [stage], ["x", "u"], ["l"])
    return CasadiProblem(dynamics=dynamics, step=step, constraints=constraints, labels=labels, cost=cost)


def runge_kutta(f: Callable[[Any, Any], Any], t: Any, x: Any, h: Any) -> Any:
    """One step of length h of the classical method for x' = f(t, x), of numbers or CasADi's expressions."""
    first = f(t, x)
    second = f(t + h / 2, x + h / 2 * first)
    third = f(t + h / 2, x + h / 2 * second)
    fourth = f(t + h, x + h * third)
    return x + h / 6 * (first + 2 * second + 2 * third + fourth)


def _constraint_rows(ca: Any, problem: Problem, t: Any, x: Any) -> tuple[Any, tuple[str, ...]]:
    rows: list[Any] = []
    labels: list[str] = []
    for constraint in problem.constraints:
        found = _values(ca, constraint, t, x)
        rows += found
        labels += [constraint.label] * len(found)
    return ca.vertcat(*rows) if rows else ca.SX(0, 1), tuple(labels)


def _values(ca: Any, constraint: Inside, t: Any, x: Any) -> list[Any]:
    """Expressions that are at most 0 exactly where a constraint holds."""
    region = constraint.region
    own = ca.vertcat(*(x[k] for k in region.places(x.numel())))
    center = region.center
    if center is not None:
        own = own - (to_casadi(center, [t]) if isinstance(center, Tape) else ca.DM(center))
    match region.form:
        case Quadratic() as form:
            square = ca.sumsqr(own) if form.even else ca.bilin(ca.DM(np.linalg.inv(form.shape)), own, own)
            value = square - form.radius**2
            return [-value if constraint.outside else value]
        case Faces() as form:
            faces = ca.DM(form.normals) @ own - ca.DM(form.bounds)
            entries = [faces[k] for k in range(len(form.bounds))]
    if not constraint.outside:
        return entries
    largest = entries[0]
    for entry in entries[1:]:
        largest = ca.fmax(largest, entry)
    return [-largest]


def export_control(source: Problem | System) -> Any:
    """The noise-free model as a python-control ``NonlinearIOSystem``, for its simulation and design functions.

    Parameters
    ----------
    source : Problem or system
        A problem's plan is not substituted. Inputs come first and disturbances after them in the model's input; the
        output is the state. In discrete time the sampling time is 1, and the model's time counts steps.

    Returns
    -------
    control.NonlinearIOSystem

    Examples
    --------
    >>> from certbound.problem.files import load
    >>> export_control(load("ou")).state_labels
    ['x1']
    """
    import control

    system = source.system if isinstance(source, Problem) else source
    evaluate: Callable[..., Any] = compile_numpy(system.dynamics)
    count = len(system.input_names) + len(system.disturbance_names)

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        return evaluate(t, *x, *np.atleast_1d(u)[:count])

    return control.nlsys(
        update,
        None,
        states=list(system.states),
        inputs=[*system.input_names, *system.disturbance_names],
        outputs=list(system.states),
        dt=1 if system.time == "discrete" else 0,
        name="certbound",
    )
