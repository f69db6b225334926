"""The Ornstein-Uhlenbeck process."""

from __future__ import annotations

import numpy as np

from certbound.problem.library.parameters import merged, whole
from certbound.problem.problem import Problem
from certbound.problem.sets import Ball, Inside
from certbound.problem.systems import ContinuousSystem

DEFAULTS = {"rate": -0.5, "sigma": 0.1**0.5, "radius": 1.5, "dimension": 1.0}


def ou(**parameters: float) -> Problem:
    """dX = rate X dt + sigma dW from 0: does it stay in a ball?

    Parameters
    ----------
    rate : float
        Contraction rate c, in 1/s.
    sigma : float
        Noise level of each entry.
    radius : float
        Radius of the safe ball.
    dimension : int
        Number of states.

    Source: Sec. VII-A and Fig. 4 of the paper (c = -0.5, sigma^2 = 0.1, T = 5, delta = 1e-3).
    """
    values = merged("ou", DEFAULTS, parameters)
    n, rate = whole("dimension", values["dimension"]), values["rate"]
    system = ContinuousSystem(lambda x: rate * x, states=n, diffusion=values["sigma"] * np.eye(n))
    return Problem(
        system,
        initial=np.zeros(n),
        safe=[Inside(Ball(np.zeros(n), values["radius"]))],
        horizon=5.0,
        delta=1e-3,
        name="ou",
        parameters=values,
    )
