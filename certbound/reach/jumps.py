"""Jumps of the dynamics that a linearisation does not show."""

from __future__ import annotations

from certbound.problem.problem import Problem
from certbound.problem.tape import JUMPS, Tape
from certbound.problem.trace import jacobian

__all__ = ["hidden_jump"]


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
    if not any(node.op in JUMPS for node in tape.nodes):
        return None
    slopes = jacobian(tape, list(range(1, n + 1)))
    varying = _dependence(slopes)
    seen = {output % n for output, node in enumerate(slopes.outputs) if varying[node]}
    depends = _dependence(tape)
    for index, node in enumerate(tape.nodes):
        if node.op not in JUMPS:
            continue
        deciding = depends[node.args[0]] if node.op == "if_else_zero" else depends[index]
        for state in sorted(deciding):
            if 1 <= state <= n and state - 1 not in seen:
                return (
                    f"the dynamics may jump where `{tape.describe(index)}` does, with {tape.inputs[state]}, which "
                    "enters linearly otherwise: a linear response does not see that."
                )
    return None


def _dependence(tape: Tape) -> list[frozenset[int]]:
    """The inputs that every node depends on."""
    found: list[frozenset[int]] = []
    for node in tape.nodes:
        own = node.args if node.op == "input" else ()
        found.append(frozenset(own).union(*(found[arg] for arg in node.args if node.op != "input")))
    return found
