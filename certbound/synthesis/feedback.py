"""Ancillary feedback u = v + K (x - z): the closed loop as a system of its own, and where K comes from.

With w = v - K z the loop is x+ = f(x, w + K x, d): an ordinary system whose input is w, so that constants, tubes and
the linear response are those of the closed loop. The bounds of u become constraints on the state, K x + w_k within the
bounds during piece k, which the verdict proves like every other constraint.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import matrix
from certbound.constants.metrics import jacobian_set
from certbound.constants.programs import design_feedback
from certbound.errors import EnclosureError, InfeasibleError, SolverError
from certbound.problem.model import Tape, jacobian, needed, substitute, trace
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Inside, Polytope
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, System
from certbound.synthesis.terminal import linearise, riccati

_MOST_VERTICES = 64
LARGER = 2.0


def resolve_feedback(problem: Problem, feedback: str | ArrayLike, start: Array) -> Array:
    """The gain K (m, n) that ``feedback`` names or is.

    Parameters
    ----------
    feedback : {"riccati", "lmi"} or array_like of shape (m, n)
        "riccati": the linear-quadratic regulator of the linearisation at ``start``; "lmi": K and a metric together,
        with the smallest c or L over all Jacobians.
    start : ndarray, shape (n,)

    Raises
    ------
    ValueError
        If K does not stabilise the linearisation, the name is unknown, or the co-design has no answer.
    """
    n, m = problem.system.dimension, len(problem.system.input_names)
    if isinstance(feedback, str):
        if feedback == "riccati":
            gain = riccati(problem, start)[1]
        elif feedback == "lmi":
            gain = _designed(problem, start)
        else:
            raise ValueError(f"`feedback` must be 'riccati', 'lmi' or a ({m}, {n}) matrix, got {feedback!r}.")
    else:
        gain = matrix("feedback", feedback, m, n)
    _check_stable(problem, gain, start)
    return np.asarray(gain, dtype=float)


def _check_stable(problem: Problem, gain: Array, start: Array) -> None:
    a, b = linearise(problem, start, np.zeros(len(gain)))
    values = np.linalg.eigvals(a + b @ gain)
    if problem.system.time == "continuous":
        worst, limit, name = float(values.real.max()), 0.0, "largest real part"
    else:
        worst, limit, name = float(np.abs(values).max()), 1.0, "spectral radius"
    if worst >= limit:
        raise ValueError(
            f"`feedback` must stabilise the system linearised at the start, but the {name} of A + B K is {worst:.4g} "
            f"(needed: below {limit:g}); try feedback='riccati'."
        )


def _designed(problem: Problem, start: Array) -> Array:
    """K from the co-design LMI over all Jacobians."""
    system = problem.system
    slots = range(1 + system.dimension, 1 + system.dimension + len(system.input_names))
    if depends_on(jacobian(system.dynamics, slots), range(len(system.dynamics.inputs))):
        raise ValueError("`feedback` 'lmi' needs inputs that enter as a constant matrix times u; try 'riccati'.")
    _, b = linearise(problem, start, np.zeros(len(system.input_names)))
    try:
        members = jacobian_set(system, problem.domain)
        if members.vertex_count > _MOST_VERTICES:
            raise ValueError(
                f"`feedback` 'lmi' needs at most {_MOST_VERTICES} vertices of the Jacobian, got "
                f"{members.vertex_count}; try 'riccati'."
            )
        # without a bound there is no smallest c or L: allow a few times what the regulator takes
        most = LARGER * float(np.linalg.norm(riccati(problem, start)[1], 2))
        continuous = system.time == "continuous"
        return np.asarray(design_feedback(members, b, continuous=continuous, max_gain=most, tolerance=1e-3).feedback)
    except (EnclosureError, InfeasibleError, SolverError) as error:
        raise ValueError(f"`feedback` 'lmi' found no gain: {error}") from error


def depends_on(tape: Tape, slots: Container[int]) -> bool:
    """Whether the outputs of a tape depend on any of the input slots."""
    live = needed(tape.nodes, tape.outputs)
    return any(use and node.op == "input" and node.args[0] in slots for use, node in zip(live, tape.nodes, strict=True))


def close_loop(system: System, gain: Array) -> System:
    """The system x+ = f(t, x, w + K x, d) (or dx = ...), K = ``gain`` (m, n), with inputs w without bounds."""
    names = system.input_names

    def law(x: Any, u: Any) -> Any:
        return [u[i] + sum(gain[i, j] * x[j] for j in range(len(system.states))) for i in range(len(names))]

    tape = trace(law, {"t": ["t"], "x": system.states, "u": names})
    dynamics = substitute(system.dynamics, system.dynamics.inputs, {name: (tape, i) for i, name in enumerate(names)})
    count = len(names)
    options: dict[str, Any] = {
        "states": system.states, "inputs": Box(np.full(count, -np.inf), np.full(count, np.inf)), "input_names": names,
        "disturbance": system.disturbance, "disturbance_names": system.disturbance_names or None,
    }  # fmt: skip
    if isinstance(system, ContinuousSystem):
        return ContinuousSystem(dynamics, diffusion=system.diffusion, **options)
    assert isinstance(system, DiscreteSystem)
    matrix = system.fixed_gain if system.gain is None else system.gain
    return DiscreteSystem(dynamics, noise=system.noise, noise_matrix=matrix, **options)


def constrain_inputs(problem: Problem, gain: Array, plan: Array, used: Array) -> list[Inside]:
    """The bounds of u = w + K x as constraints on the state, for the plan w of shape (N, m).

    Neighbouring pieces share one constraint, with the tightest of their bounds, where that leaves each of them at least
    half of its own room: fewer constraints are verified sooner.

    K = ``gain`` (m, n); ``used`` (N, 2 m) are the largest K z + e and -K z + e on each piece, e what the tube takes:
    bounds less this is the room of a piece.
    """
    box = problem.system.inputs
    assert box is not None
    normals = np.concatenate([gain, -gain])
    bounds = np.concatenate([box.high - plan, plan - box.low], axis=1)
    kept = np.any(normals != 0, axis=1) & np.isfinite(bounds[0])
    if not np.any(kept):
        return []
    room = np.maximum(bounds - used, 0.0)
    discrete = problem.system.time == "discrete"
    length = 1.0 if discrete else float(problem.horizon) / len(plan)
    found, first = [], 0
    for k in range(1, len(plan) + 1):
        if k < len(plan):
            group = slice(first, k + 1)
            shared = bounds[group].min(axis=0)
            if np.all((shared - used[group] >= 0.5 * room[group])[:, kept]):
                continue
        last = k - 1 if discrete else k
        during = (first * length, min(last * length, float(problem.horizon)))
        label = f"inputs within their bounds, {'step' if discrete else 't ='} {during[0]:g}"
        label += "" if during[0] == during[1] else f" to {during[1]:g}"
        region = Polytope(normals[kept], bounds[first:k, kept].min(axis=0))
        found.append(Inside(region, during=during, label=label))
        first = k
    return found
