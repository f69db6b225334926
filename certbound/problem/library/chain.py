"""A chain of masses, springs and nonlinear dampers.

The model is eq. (52) of the paper, Sec. VIII-B. Its parameters are **reconstructed**: the paper takes them
from another work whose text was not available, and the noise level was calibrated so that the paper's Markov
baseline becomes feasible where the paper says so. They are parameters, so that the true values can be put in.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.library.parameters import merged, whole
from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, HalfSpace, Inside
from certbound.problem.systems import DiscreteSystem

DEFAULTS = {
    "masses": 3.0,
    "reaction": 1.0,
    "mass": 1.0,
    "stiffness": 10.0,
    "B1": 2.0,
    "B2": 1.0,
    "eta": 0.1,
    "sigma": 0.43,
    "input_bound": 100.0,
}
HORIZON = 50
RAMP = 3


def chain(**parameters: float) -> Problem:
    """A chain that is let down from a stretched start by a plan in closed form: does it stay safe?

    States p_1..p_m, v_1..v_m. With F_i = stiffness (p_{i+1} - p_i) + B1 (v_{i+1} - v_i), and F_m = -stiffness
    p_m - B1 v_m: p_i+ = p_i + eta v_i, v_i+ = v_i + eta ((F_i - F_{i-1} - tanh(B2 v_i))/mass + u_i + w_i),
    where the reaction F_{i-1} is dropped for ``reaction = 0`` (the cascade that the paper prints). Start p_i
    = -3 i/masses at rest; stay p_1 >= -1.2, p_{i+1} - p_i >= -1.2 and v_m <= 2 for 50 steps at delta = 0.002.
    The plan lets p_i = -(3 i/masses) s with s falling from 1 to 0 at a trapezoidal speed; u follows by
    inverting the model.

    Parameters
    ----------
    masses : int
        Number of masses m, at least 3 (fewer start beyond the constraints).
    reaction : 0 or 1
        Whether a spring also pulls at its other end.
    mass, stiffness, B1, B2, eta : float
        Mass, spring constant, linear and nonlinear damping, and step (all reconstructed).
    sigma : float
        Standard deviation of each w_i, **before** the factor eta (calibrated).
    input_bound : float
        Bound of |u_i|.

    Source: Sec. VIII-B of the paper, with ">= 1.2" read as ">= -1.2".
    """
    values = _checked("chain", parameters)
    positions, velocities = _descent(whole("masses", values["masses"], 3), values["eta"])
    plan = _inverse(positions, velocities, values)
    start = np.concatenate([positions[0], velocities[0]])
    return _problem("chain", values, start, plan)


def chain_rest(**parameters: float) -> Problem:
    """The same chain, left at the origin with zero inputs: does the noise alone drive it out?

    Parameters are those of ``chain``; any number of masses will do.
    """
    values = _checked("chain_rest", parameters)
    masses = whole("masses", values["masses"])
    return _problem("chain_rest", values, np.zeros(2 * masses), np.zeros((HORIZON, masses)))


def _checked(name: str, parameters: dict[str, float]) -> dict[str, float]:
    values = merged(name, DEFAULTS, parameters)
    for key in ("mass", "eta", "input_bound"):
        if values[key] <= 0:
            raise ValueError(f"`{key}` must be positive, got {values[key]:g}.")
    if values["reaction"] not in (0, 1):
        raise ValueError(f"`reaction` must be 0 or 1, got {values['reaction']:g}.")
    return values


def _problem(name: str, values: dict[str, float], start: Array, plan: Array) -> Problem:
    masses, eta = whole("masses", values["masses"]), values["eta"]

    def step(x: Any, u: Any) -> list[Any]:
        p, v = x[:masses], x[masses:]
        force = _acceleration(p, v, values)
        moved = [p[i] + eta * v[i] for i in range(masses)]
        return moved + [v[i] + eta * (force[i] + u[i]) for i in range(masses)]

    bound = np.full(masses, values["input_bound"])
    system = DiscreteSystem(
        step,
        states=[f"{letter}{i + 1}" for letter in "pv" for i in range(masses)],
        inputs=Box(-bound, bound),
        input_names=[f"u{i + 1}" for i in range(masses)],
        noise=Gaussian(std=values["sigma"]),
        noise_matrix=np.vstack([np.zeros((masses, masses)), eta * np.eye(masses)]),
    )
    return Problem(
        system,
        initial=start,
        safe=_constraints(masses),
        horizon=HORIZON,
        delta=0.002,
        plan=plan,
        cost=(np.ones(2 * masses), np.full(masses, 1e-4)),
        name=name,
        parameters=values,
    )


def _constraints(masses: int) -> list[Inside]:
    unit = np.eye(2 * masses)
    safe = [Inside(HalfSpace(-unit[0], 1.2), label="p1 >= -1.2")]
    for i in range(masses - 1):
        safe.append(Inside(HalfSpace(unit[i] - unit[i + 1], 1.2), label=f"p{i + 2} - p{i + 1} >= -1.2"))
    return [*safe, Inside(HalfSpace(unit[-1], 2.0), label=f"v{masses} <= 2")]


def _acceleration(p: Any, v: Any, values: dict[str, float]) -> list[Any]:
    """Force of springs and dampers on each mass, over the mass."""
    count, stiffness, linear = len(p), values["stiffness"], values["B1"]
    forces = [stiffness * (p[i + 1] - p[i]) + linear * (v[i + 1] - v[i]) for i in range(count - 1)]
    forces.append(-(stiffness * p[count - 1]) - linear * v[count - 1])
    total = [forces[i] - np.tanh(values["B2"] * v[i]) for i in range(count)]
    if values["reaction"]:
        total = [total[i] - forces[i - 1] if i else total[0] for i in range(count)]
    return [force / values["mass"] for force in total]


def _descent(masses: int, eta: float) -> tuple[Array, Array]:
    """Positions and velocities, shape (HORIZON + 1, masses), of the plan's nominal path."""
    speed = np.ones(HORIZON - 1)
    speed[:RAMP] = np.arange(1, RAMP + 1) / (RAMP + 1)
    speed[-RAMP:] = speed[:RAMP][::-1]
    share = np.concatenate([[1.0, 1.0], 1.0 - np.cumsum(speed / speed.sum()), [0.0]])
    positions = np.outer(share, -3.0 * np.arange(1, masses + 1) / masses)
    velocities = np.vstack([np.diff(positions, axis=0) / eta, np.zeros(masses)])
    return positions[: HORIZON + 1], velocities[: HORIZON + 1]


def _inverse(positions: Array, velocities: Array, values: dict[str, float]) -> Array:
    """Inputs, shape (HORIZON, masses), that drive the noise-free model along the path."""
    rows = []
    for now in range(HORIZON):
        drift = np.array(_acceleration(positions[now], velocities[now], values))
        rows.append((velocities[now + 1] - velocities[now]) / values["eta"] - drift)
    return np.array(rows)
