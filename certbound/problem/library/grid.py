"""Swing equations of the power grid of New England: 39 buses, 46 lines, 78 states."""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.problem.library.parameters import merged
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Inside
from certbound.problem.systems import ContinuousSystem

DEFAULTS = {"damping": 4.0, "load_damping": 20.0, "droop": 4.0, "load_inertia": 5.0, "side": 0.1, "sigma": 0.01}

BUSES = 39
# (bus, bus, reactance per unit)
LINES = (
    (1, 2, 0.0411), (1, 39, 0.025), (2, 3, 0.0151), (2, 25, 0.0086), (2, 30, 0.0181), (3, 4, 0.0213),
    (3, 18, 0.0133), (4, 5, 0.0128), (4, 14, 0.0129), (5, 6, 0.0026), (5, 8, 0.0112), (6, 7, 0.0092),
    (6, 11, 0.0082), (6, 31, 0.025), (7, 8, 0.0046), (8, 9, 0.0363), (9, 39, 0.025), (10, 11, 0.0043),
    (10, 13, 0.0043), (10, 32, 0.02), (11, 12, 0.0435), (12, 13, 0.0435), (13, 14, 0.0101), (14, 15, 0.0217),
    (15, 16, 0.0094), (16, 17, 0.0089), (16, 19, 0.0195), (16, 21, 0.0135), (16, 24, 0.0059), (17, 18, 0.0082),
    (17, 27, 0.0173), (19, 20, 0.0138), (19, 33, 0.0142), (20, 34, 0.018), (21, 22, 0.014), (22, 23, 0.0096),
    (22, 35, 0.0143), (23, 24, 0.035), (23, 36, 0.0272), (25, 26, 0.0323), (25, 37, 0.0232), (26, 27, 0.0147),
    (26, 28, 0.0474), (26, 29, 0.0625), (28, 29, 0.0151), (29, 38, 0.0156),
)  # fmt: skip
# inertia constants of the machines in seconds, at 100 MVA
INERTIA = {
    30: 42.0, 31: 30.3, 32: 35.8, 33: 28.6, 34: 26.0, 35: 34.8, 36: 26.4, 37: 24.3, 38: 34.5, 39: 500.0,
}  # fmt: skip
# angles of the solved power flow, in degrees
ANGLES = (
    -13.54, -9.79, -12.28, -12.63, -11.19, -10.41, -12.76, -13.34, -14.18, -8.17, -8.94, -9.00, -8.93, -10.72, -11.35,
    -10.03, -11.12, -11.99, -5.41, -6.82, -7.63, -3.18, -3.38, -9.91, -8.37, -9.44, -11.36, -5.93, -3.17, -7.37, 0.0,
    -0.19, -0.19, -1.63, 1.78, 4.47, -1.58, 3.89, -14.54,
)  # fmt: skip


def grid(**parameters: float) -> Problem:
    """Noise in the loads of a power grid: does every angle stay near the solved power flow?

    m_i d_i'' = -damping_i m_i d_i' - droop m_i d_i - sum_j b_ij (sin(a_i + d_i - a_j - d_j) - sin(a_i - a_j)) + noise,
    with d_i the deviation of bus i's angle from that of the power flow, a_i; b_ij = 1/x_ij at voltages of 1 (losses
    left out) and m_i = 2 H_i / (2 pi 60). On the domain |d_i| <= side. The angle droop stands for a wide-area control
    and makes the common angle restoring; ``damping``, ``load_damping`` and ``droop`` are no data.

    Parameters
    ----------
    damping, load_damping, droop : float
        In 1/s (of buses with a machine, and of the others) and 1/s^2.
    load_inertia : float
        H in seconds of the buses without a machine (motors).
    side : float
        In rad: the model's domain; angles are asked to stay within 0.8 of it.
    sigma : float
        Noise level of each angular acceleration.

    Source: Athay, Podmore, Virmani, IEEE Trans. Power Apparatus and Systems 98 (1979): lines and power flow, as
    MATPOWER's case39 has them; Pai, Energy Function Analysis for Power System Stability (1989): inertia.
    """
    values = merged("grid", DEFAULTS, parameters)
    angles = np.radians(ANGLES)
    mass = np.array([INERTIA.get(bus + 1, values["load_inertia"]) for bus in range(BUSES)]) / (60 * np.pi)

    drag = np.array([values["damping" if bus + 1 in INERTIA else "load_damping"] for bus in range(BUSES)])

    def rate(x: Any) -> list[Any]:
        d, w = x[:BUSES], x[BUSES:]
        force = [0.0 * d[0] for _ in range(BUSES)]
        for first, second, reactance in LINES:
            i, j = first - 1, second - 1
            steady = float(angles[i] - angles[j])
            flow = (np.sin(steady + d[i] - d[j]) - np.sin(steady)) / reactance
            force[i], force[j] = force[i] - flow, force[j] + flow
        pull = [force[i] / mass[i] - values["droop"] * d[i] - drag[i] * w[i] for i in range(BUSES)]
        return [*(w[i] for i in range(BUSES)), *pull]

    system = ContinuousSystem(
        rate,
        states=[f"{letter}{bus + 1}" for letter in "dw" for bus in range(BUSES)],
        diffusion=values["sigma"] * np.vstack([np.zeros((BUSES, BUSES)), np.eye(BUSES)]),
    )

    def box(side: float) -> Box:
        sides = np.concatenate([np.full(BUSES, side), np.full(BUSES, np.inf)])
        return Box(-sides, sides)

    return Problem(
        system,
        initial=np.zeros(2 * BUSES),
        safe=[Inside(box(0.8 * values["side"]))],
        horizon=1.0,
        delta=1e-3,
        domain=box(values["side"]),
        name="grid",
        parameters=values,
    )
