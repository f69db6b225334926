"""A damped pendulum with torque noise."""

from __future__ import annotations

import numpy as np

from certbound.problem.library.parameters import merged
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Inside
from certbound.problem.systems import ContinuousSystem

DEFAULTS = {"gravity": 9.81, "length": 1.0, "damping": 0.5, "sigma": 0.05}


def pendulum(**parameters: float) -> Problem:
    """th' = w, w' = -(gravity/length) sin th - damping w + noise: does it stay within 1.2 rad of the bottom?

    Parameters
    ----------
    gravity, length, damping : float
        In m/s^2, m and 1/s.
    sigma : float
        Noise level of the angular acceleration.
    """
    values = merged("pendulum", DEFAULTS, parameters)
    stiffness, damping = values["gravity"] / values["length"], values["damping"]
    system = ContinuousSystem(
        lambda x: [x[1], -stiffness * np.sin(x[0]) - damping * x[1]],
        states=["th", "w"],
        diffusion=[[0.0], [values["sigma"]]],
    )
    return Problem(
        system,
        initial=Box([0.45, -0.05], [0.55, 0.05]),
        safe=[Inside(Box([-1.2, -np.inf], [1.2, np.inf]))],
        horizon=5.0,
        delta=1e-3,
        name="pendulum",
        parameters=values,
    )
