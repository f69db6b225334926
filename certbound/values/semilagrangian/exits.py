"""The door: an upper bound of the probability of leaving a box, for noise in one of two coordinates."""

from __future__ import annotations

import math
import time

import numpy as np

from certbound.problem.problem import Problem
from certbound.values.continuous import ExitBounds
from certbound.values.semilagrangian.induction import back, highest, limited
from certbound.values.semilagrangian.layout import Layout, Plan, layout_of
from certbound.values.semilagrangian.setting import Setting, setting_of
from certbound.values.semilagrangian.smoothing import Lines


def bound_by_steps(setting: Setting, plan: Plan) -> float:
    """Upper bound of the probability of leaving by the horizon, from one plan."""
    layout = layout_of(setting, plan)
    value = terminal(layout)
    for _ in range(plan.count):
        value = back(layout.frame, layout.bands, layout.bounds, value)
    best = highest(layout.frame, value, setting.starts, layout.clock.shear)
    return best + 16 * plan.count * plan.spare


def terminal(layout: Layout) -> Lines:
    shape = layout.bounds.level.shape
    return limited(layout.frame, layout.bounds, np.zeros(shape), np.zeros((shape[0], shape[1] - 1)))
