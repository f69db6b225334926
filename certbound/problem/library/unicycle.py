"""A unicycle that is steered to a point, past three obstacles.

The scene (obstacles, start, goal, horizon, disturbance channel) is the paper's, Sec. VIII-A. The controller's
gains, the size of the disturbance and the noise level are **reconstructed**: the paper takes them from
another work whose text was not available. They are parameters, so that the true values can be put in.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from certbound.problem.library.parameters import merged
from certbound.problem.problem import Problem
from certbound.problem.sets import Ball, Box, Outside
from certbound.problem.systems import ContinuousSystem

DEFAULTS = {
    "gamma": 0.5,
    "k": 1.0,
    "h": 0.0,
    "th_goal": 0.0,
    "disturbance": 0.1,
    "sigma": 0.01,
    "x0_halfwidth": 0.1,
}
GOAL = (0.5, 0.0)
OBSTACLES = (((1.3, 3.5), 0.9), ((-1.0, 2.2), 0.72), ((6.2, 0.5), 0.75))


def unicycle(**parameters: float) -> Problem:
    """dX = (v cos th, v sin th, w + d) dt + sigma dW under a polar feedback: does it miss every obstacle?

    With e the distance to the goal, alpha the angle from the heading to the goal and theta_p the goal's
    bearing less ``th_goal``: v = gamma e cos(alpha), w = k alpha + gamma cos(alpha) sinc(alpha) (alpha + h
    theta_p). The only singularity is at the goal.

    Parameters
    ----------
    gamma, k, h : float
        Controller gains in 1/s, 1/s and 1 (reconstructed); h = 0 asks for the position only.
    th_goal : float
        Heading wanted at the goal; matters for h != 0 only.
    disturbance : float
        Bound of the unknown turn rate d, in rad/s (reconstructed).
    sigma : float
        Noise level of each state (reconstructed).
    x0_halfwidth : float
        Half-width of the initial box around (5, 5, -pi/3).

    Source: Sec. VIII-A of the paper; controller of Aicardi et al. (1995).
    """
    values = merged("unicycle", DEFAULTS, parameters)
    bound, half = values["disturbance"], values["x0_halfwidth"]
    for name in ("disturbance", "x0_halfwidth"):
        if values[name] < 0:
            raise ValueError(f"`{name}` must not be negative, got {values[name]:g}.")
    system = ContinuousSystem(
        _closed_loop(values),
        states=["px", "py", "th"],
        disturbance=Box([-bound], [bound]),
        diffusion=values["sigma"] * np.eye(3),
    )
    start = np.array([5.0, 5.0, -math.pi / 3])
    return Problem(
        system,
        initial=Box(start - half, start + half),
        safe=[Outside(Ball(center, radius, coordinates=(0, 1))) for center, radius in OBSTACLES],
        horizon=2.0,
        delta=1e-3,
        name="unicycle",
        parameters=values,
    )


def _closed_loop(values: dict[str, float]) -> Any:
    gamma, k, h, th_goal = (values[name] for name in ("gamma", "k", "h", "th_goal"))

    def dynamics(x: Any, d: Any) -> list[Any]:
        to_x, to_y = GOAL[0] - x[0], GOAL[1] - x[1]
        c, s = np.cos(x[2]), np.sin(x[2])
        dot, cross = to_x * c + to_y * s, c * to_y - s * to_x
        v = gamma * dot
        alpha = np.arctan2(cross, dot)
        turn = k * alpha + gamma * cross * dot / (to_x**2 + to_y**2)
        if h != 0:
            turn = turn + gamma * h * np.cos(alpha) * _sinc(alpha) * _bearing(to_x, to_y, th_goal)
        return [v * c, v * s, turn + d[0]]

    return dynamics


def _bearing(to_x: Any, to_y: Any, th_goal: float) -> Any:
    c, s = math.cos(th_goal), math.sin(th_goal)
    return np.arctan2(to_y * c - to_x * s, to_x * c + to_y * s)


def _sinc(angle: Any) -> Any:
    """sin(angle)/angle as a product of cosines (Viete), which has no singularity; to 1e-7 on [-pi, pi]."""
    result = 1.0
    for halving in range(1, 13):
        result = result * np.cos(angle * 0.5**halving)
    return result
