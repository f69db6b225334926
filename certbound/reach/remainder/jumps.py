"""Jumps of the dynamics that a linearisation does not show."""

from __future__ import annotations

from certbound.problem.model import deciding, jacobian, varying_outputs
from certbound.problem.problem import Problem


def hidden_jump(problem: Problem) -> str | None:
    """Why the linear response would not see a jump of the dynamics; None where it sees all there are.

    Its remainder is bounded over the states in which the Jacobian varies. The derivative of a step is 0, so that a
    state may decide a jump and enter linearly otherwise: the remainder would be taken for constant along it.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> def jumping(x):
    ...     return [0.5 * x[0] + np.where(x[0] > 0.2, 0.8, 0.0)]
    >>> system = cb.DiscreteSystem(jumping, states=["x"], noise=cb.Gaussian(std=0.1))
    >>> problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=4)
    >>> str(hidden_jump(problem)).partition(", which")[0]
    'the dynamics may jump where `(0.2 < x)` does, with x'
    """
    tape, n = problem.closed_loop, problem.system.dimension
    jumps = deciding(tape)
    if not jumps:
        return None
    varying = varying_outputs(jacobian(tape, list(range(1, n + 1))))
    seen = {output % n for output, varies in enumerate(varying) if varies}
    for index, slots in jumps.items():
        for state in sorted(slots):
            if 1 <= state <= n and state - 1 not in seen:
                return (
                    f"the dynamics may jump where `{tape.describe(index)}` does, with {tape.inputs[state]}, which "
                    "enters linearly otherwise: a linear response does not see that."
                )
    return None
