"""A problem whose model jumps at known times as one with an input that is constant on pieces of time."""

from __future__ import annotations

import numpy as np

from certbound.problem.model import Tape, cut_at_jumps
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import ContinuousSystem


def in_pieces(problem: Problem) -> Problem:
    """The same problem with the jumps that t alone decides as a plan of equal pieces; itself where there are none.

    Where a jump misses the end of its piece by rounding, the problem's ``changes`` say so.

    Jumps in continuous time only: in discrete time t is a whole number, and everything is decided. A problem with a
    plan that is an array already has pieces of its own, and is left as it is.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> def pushed(t, x):
    ...     return -x + np.where(t < 5, 0.2, -0.2)
    >>> system = cb.ContinuousSystem(pushed, states=["x"], diffusion=0.1)
    >>> problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=10)
    >>> in_pieces(problem).plan.tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    system = problem.system
    if not isinstance(system, ContinuousSystem) or problem.endless or isinstance(problem.plan, np.ndarray):
        return problem
    if problem.hold is not None or (problem.plan is None and system.inputs is not None):
        return problem
    tape: Tape = problem.closed_loop
    found = cut_at_jumps(tape, system.dimension, float(problem.horizon))
    if found is None:
        return problem
    rows = np.array(found.rows)
    low, high = (np.array([getattr(change, end) for change in found.changes]) for end in ("low", "high"))
    cut = ContinuousSystem(
        found.tape, states=system.states, inputs=Box(low.min(axis=0), high.max(axis=0)), input_names=found.names,
        disturbance=system.disturbance, disturbance_names=system.disturbance_names or None, diffusion=system.diffusion,
    )
    return problem.replace(system=cut, plan=rows, cost=None, changes=found.changes)
