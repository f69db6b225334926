"""Stage costs, quadratic or the user's own, and the cost of the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.adapters import to_casadi
from certbound.problem.model import Tape, compile_numpy, trace
from certbound.problem.problem import Problem
from certbound.synthesis.plant import Grid


@dataclass(frozen=True, eq=False, kw_only=True)
class Cost:
    """Sum over the pieces of step * stage(t, z, u), and an end cost (z - c)' end (z - c)."""

    stage: tuple[Array, Array] | Tape  # quadratic weights, or a function over ("t", *states, *inputs) of shape (1,)
    end: Array  # (n, n)
    center: Array  # (n,): c

    def symbolic(self, ca: Any, time: Any, state: Any, inputs: Any) -> Any:
        """Stage cost as a CasADi expression."""
        if isinstance(self.stage, Tape):
            return to_casadi(self.stage, [ca.SX(time), state, inputs])
        weight, effort = self.stage
        return ca.bilin(ca.DM(weight), state, state) + ca.bilin(ca.DM(effort), inputs, inputs)

    def symbolic_end(self, ca: Any, state: Any) -> Any:
        """End cost as a CasADi expression."""
        offset = state - ca.DM(self.center)
        return ca.bilin(ca.DM(self.end), offset, offset)

    def values(self, times: Array, states: Array, inputs: Array) -> Array:
        """Stage costs for batches (..., n) and (..., m), with times broadcast against them."""
        if isinstance(self.stage, Tape):
            found = compile_numpy(self.stage)(times, *np.moveaxis(states, -1, 0), *np.moveaxis(inputs, -1, 0))
            return np.asarray(found[..., 0])
        weight, effort = self.stage
        quadratic = np.einsum("...i,ij,...j->...", states, weight, states)
        return np.asarray(quadratic + np.einsum("...i,ij,...j->...", inputs, effort, inputs))

    def end_value(self, states: Array) -> Array:
        """End cost of states (..., n)."""
        offset = states - self.center
        return np.asarray(np.einsum("...i,ij,...j->...", offset, self.end, offset))

    def total(self, grid: Grid, feedback: Array | None, states: Array, inputs: Array, time: float = 0.0) -> float:
        """Cost of a plan with its rolled-out states (points + 1, n)."""
        nodes = states[:: grid.substeps]
        own = inputs if feedback is None else inputs + nodes[:-1] @ feedback.T
        times = np.asarray(time + np.arange(grid.steps) * grid.step, dtype=float)
        with np.errstate(all="ignore"):
            return float(grid.step * np.sum(self.values(times, nodes[:-1], own)) + self.end_value(nodes[-1]))


def cost_of(
    problem: Problem,
    stage: Callable[..., Any] | Tape | None = None,
    end: Array | None = None,
    center: Array | None = None,
) -> Cost:
    """The cost that a problem or a user states.

    Without any, the inputs' energy is counted. Without an end cost a quadratic stage cost counts the last state too.

    Raises
    ------
    ValueError
        If the stage cost is no scalar.
    """
    system = problem.system
    n, m = system.dimension, len(system.input_names)
    middle = np.zeros(n) if center is None else center
    if stage is not None:
        arguments = {"t": ["t"], "x": system.states, "u": system.input_names}
        tape = stage if isinstance(stage, Tape) else trace(stage, arguments)
        if tape.shape not in ((1,), (1, 1)):
            raise ValueError(f"`stage_cost` must return one number from t, x and u, got shape {tape.shape}.")
        return Cost(stage=tape, end=np.zeros((n, n)) if end is None else end, center=middle)
    weight, effort = problem.cost if problem.cost is not None else (np.zeros((n, n)), np.eye(m))
    last = np.asarray(weight) if end is None else end
    return Cost(stage=(np.asarray(weight), np.asarray(effort)), end=last, center=middle)
