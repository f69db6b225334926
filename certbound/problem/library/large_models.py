"""Models with many states: a power grid, a formation, a heat equation, forced oscillators.

All of them have additive noise on every state that is pushed, start at rest and ask that no state goes far: problems of
the size that networks and discretised equations have.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.problem.library.parameters import merged, whole
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Inside
from certbound.problem.systems import ContinuousSystem

FORMATION = {"agents": 50.0, "stiffness": 1.0, "anchor": 0.5, "damping": 2.0, "sigma": 0.005}
HEAT = {"nodes": 200.0, "conductivity": 1.0, "reaction": 2.0, "sigma": 0.01}
KURAMOTO = {"oscillators": 60.0, "coupling": 1.0, "forcing": 1.0, "spread": 0.1, "sigma": 0.02}


def formation(**parameters: float) -> Problem:
    """A line of vehicles that saturate: does each stay within 0.5 of its place?

    x_i'' = -damping x_i' - anchor x_i - stiffness (tanh(x_i - x_{i-1}) + tanh(x_i - x_{i+1})) + noise, in deviations
    from the places, for double integrators with a saturated coupling to their neighbours and a weak one to the ground.

    Parameters
    ----------
    agents : int
    stiffness, anchor, damping : float
        Coupling and feedback per unit mass.
    sigma : float
        Noise level of each acceleration.

    Source: consensus of double integrators with bounded coupling, Ren, IEEE Trans. Autom. Control 53 (2008).
    """
    values = merged("formation", FORMATION, parameters)
    n = whole("agents", values["agents"], 2)

    def rate(x: Any) -> list[Any]:
        p, v = x[:n], x[n:]
        pulls = [values["stiffness"] * np.tanh(p[i + 1] - p[i]) for i in range(n - 1)]
        total = [-values["damping"] * v[i] - values["anchor"] * p[i] for i in range(n)]
        for i, pull in enumerate(pulls):
            total[i], total[i + 1] = total[i] + pull, total[i + 1] - pull
        return [*(v[i] for i in range(n)), *total]

    system = ContinuousSystem(
        rate,
        states=[f"{letter}{i + 1}" for letter in "pv" for i in range(n)],
        diffusion=values["sigma"] * np.vstack([np.zeros((n, n)), np.eye(n)]),
    )
    sides = np.concatenate([np.full(n, 0.5), np.full(n, np.inf)])
    return _problem("formation", system, [Inside(Box(-sides, sides))], values, horizon=2.0)


def heat(**parameters: float) -> Problem:
    """The heat equation with a bistable source on a rod: does it stay below 1?

    u_t = conductivity u_xx + reaction (u - u^3) + noise on (0, 1), u = 0 at both ends, by central differences on
    ``nodes`` inner nodes; on the domain |u| <= 1.2.

    Parameters
    ----------
    nodes : int
    conductivity, reaction : float
        In 1/s, lengths in rods.
    sigma : float
        Noise level of each node.

    Source: Chafee and Infante, Applicable Analysis 4 (1974).
    """
    values = merged("heat", HEAT, parameters)
    n = whole("nodes", values["nodes"], 2)
    push, pull = values["reaction"], values["conductivity"] * (n + 1) ** 2

    def rate(x: Any) -> list[Any]:
        padded = [0.0, *(x[i] for i in range(n)), 0.0]
        flow = [pull * (padded[i] - 2 * padded[i + 1] + padded[i + 2]) for i in range(n)]
        return [flow[i] + push * (x[i] - x[i] ** 3) for i in range(n)]

    system = ContinuousSystem(
        rate, states=[f"u{i + 1}" for i in range(n)], diffusion=values["sigma"] * np.eye(n)
    )
    one = np.ones(n)
    return _problem("heat", system, [Inside(Box(-one, one))], values, horizon=0.2, domain=Box(-1.2 * one, 1.2 * one))


def kuramoto(**parameters: float) -> Problem:
    """Oscillators on a ring that follow a pacemaker: does each stay within 0.6 of its phase?

    th_i' = omega_i - forcing sin(th_i) + coupling sum_j sin(th_j - th_i) + noise, over the two neighbours at each side,
    in the frame of the pacemaker; omega_i lies evenly in [-spread, spread]; on the domain |th_i| <= 0.7.

    Parameters
    ----------
    oscillators : int
        At least 5.
    coupling, forcing, spread : float
        In 1/s.
    sigma : float
        Noise level of each phase.

    Source: Childs and Strogatz, Stability diagram for the forced Kuramoto model, Chaos 18 (2008).
    """
    values = merged("kuramoto", KURAMOTO, parameters)
    n = whole("oscillators", values["oscillators"], 5)
    own = values["spread"] * np.linspace(-1.0, 1.0, n)

    def rate(x: Any) -> list[Any]:
        total = [own[i] - values["forcing"] * np.sin(x[i]) for i in range(n)]
        for i in range(n):
            for step in (1, 2):
                j = (i + step) % n
                pull = values["coupling"] * np.sin(x[j] - x[i])
                total[i], total[j] = total[i] + pull, total[j] - pull
        return total

    system = ContinuousSystem(
        rate, states=[f"th{i + 1}" for i in range(n)], diffusion=values["sigma"] * np.eye(n)
    )
    one = np.ones(n)
    return _problem(
        "kuramoto", system, [Inside(Box(-0.6 * one, 0.6 * one))], values, horizon=10.0,
        domain=Box(-0.7 * one, 0.7 * one),
    )  # fmt: skip


def _problem(
    name: str, system: ContinuousSystem, safe: list[Inside], values: dict[str, float], *, horizon: float,
    domain: Box | None = None,
) -> Problem:  # fmt: skip
    return Problem(
        system,
        initial=np.zeros(system.dimension),
        safe=safe,
        horizon=horizon,
        delta=1e-3,
        domain=domain,
        name=name,
        parameters=values,
    )
