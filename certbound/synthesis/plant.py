"""The noise-free system on a grid: what is rolled out, and what multiple shooting integrates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.adapters import to_casadi
from certbound.problem.export import runge_kutta
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.sets import Box


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """Pieces of the horizon: ``steps`` pieces of length ``step`` with ``substeps`` Runge-Kutta steps each.

    In discrete time ``step`` and ``substeps`` are 1.
    """

    steps: int
    step: float
    substeps: int
    continuous: bool

    @property
    def points(self) -> int:
        """Number of points at which constraints are imposed (the start is none)."""
        return self.steps * self.substeps

    def times(self, start: float = 0.0) -> Array:
        """Times of the start and of all points, shape (points + 1,)."""
        return np.asarray(start + np.arange(self.points + 1) * (self.step / self.substeps))


@dataclass(frozen=True, eq=False, kw_only=True)
class Plant:
    """Noise-free dynamics with a fixed disturbance and inputs in a box, and input rows that depend on the state."""

    dynamics: Tape  # over ("t", *states, *inputs, *disturbances)
    dimension: int
    disturbance: Array  # (q,): its middle
    # (m,): box of the decision u; infinite where there is none
    low: Array
    high: Array
    # (m, n): the plant's own input is u + feedback z; ``input_low`` and ``input_high`` bound it
    feedback: Array | None = None
    # (m,)
    input_low: Array | None = None
    input_high: Array | None = None

    @cached_property
    def evaluate(self) -> Callable[..., Array]:
        """f in floating point."""
        return compile_numpy(self.dynamics)

    def step(self, grid: Grid, time_: float, state: Array, inputs: Array) -> Array:
        """States (substeps, n) at the points of one piece, from one or many states (..., n)."""

        def f(t: float, x: Array) -> Array:
            return self.evaluate(t, *np.moveaxis(x, -1, 0), *inputs, *self.disturbance)

        return np.array(_piece(f, grid, time_, state))

    def rollout(self, grid: Grid, start: Array, inputs: Array) -> Array:
        """Noise-free states at all points, shape (points + 1, n)."""
        states = [np.asarray(start, dtype=float)]
        with np.errstate(all="ignore"):
            for k in range(len(inputs)):
                states += list(self.step(grid, k * grid.step, states[-1], inputs[k]))
        return np.array(states)

    def symbolic_step(self, ca: Any, grid: Grid, time_: Any, state: Any, inputs: Any) -> list[Any]:
        """CasADi expressions of the states at the points of one piece."""
        disturbance = [ca.SX(float(value)) for value in self.disturbance]

        def f(t: Any, x: Any) -> Any:
            return to_casadi(self.dynamics, [ca.SX(t), x, inputs, *disturbance])

        return _piece(f, grid, time_, state)


def _piece(f: Callable[[Any, Any], Any], grid: Grid, time_: Any, state: Any) -> list[Any]:
    """States at the points of one piece, for numbers and for CasADi's expressions."""
    if not grid.continuous:
        return [f(time_, state)]
    h = grid.step / grid.substeps
    found = []
    for i in range(grid.substeps):
        state = runge_kutta(f, time_ + i * h, state, h)
        found.append(state)
    return found


def middle_of(disturbance: Box | None) -> Array:
    """The middle of a disturbance's box, shape (q,)."""
    return np.zeros(0) if disturbance is None else np.asarray((disturbance.low + disturbance.high) / 2)
