"""Problems with a target as plain problems: up to a time, and with the target to be met at that very time.

A path fails unless it enters the target within its window, having kept every constraint until then. To meet the target
at one time t of the window is one way of not failing, so that P(failing) <= P(some constraint is broken up to t, or the
state is outside the target at t): any bound of a plain problem serves. Where the window is that one time the two are
equal.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside


def until(problem: Problem, t: float) -> Problem:
    """The problem without its target, up to a time: what is asked later does not count.

    InfeasibleError where the plan is an array over a longer horizon in continuous time.
    """
    safe = []
    for constraint in problem.safe:
        first, last = constraint.during or (0.0, float(problem.horizon))
        if first <= t:
            whole = constraint.during is None or (first, last) == (0.0, float(problem.horizon))
            safe.append(replace(constraint, during=None if whole else (first, min(last, t))))
    changes = {"horizon": t, "safe": safe, "reach": None}
    if isinstance(problem.plan, np.ndarray) and problem.system.time == "continuous" and t != problem.horizon:
        raise InfeasibleError("a plan that is an array over the horizon cannot be cut off before it; give a law.")
    return problem.replace(**changes)


def check_end(problem: Problem, what: str) -> None:
    """Refuse an infinite horizon, with an InfeasibleError, where ``what`` needs an end."""
    if problem.endless:
        raise InfeasibleError(f"{what} needs an end, and the horizon is infinite; give a finite `horizon`.")


def met_at(problem: Problem, t: float) -> Problem:
    """The plain problem of keeping the constraints up to a time, and of being in the target then."""
    plain, target = until(problem, t), problem.reach
    due = Inside(target.region, during=(t, t), label=f"{target.label} at {t:g}")
    return plain.replace(safe=[*plain.safe, due])
