"""What the constants need of a system or a problem: a tape, where its inputs range, and the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Change, Tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, System, from_control
from certbound.rigor.intervals import Interval


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """Dynamics over boxes.

    ``dynamics`` is f, with the plan substituted where it is a feedback law; ``ranges``, shape (len(dynamics.inputs),),
    are those of time, states, inputs and disturbances, whose ends may be infinite; ``bounded_by_user`` says whether the
    states' were given; ``problem`` is where the model comes from.
    """

    system: ContinuousSystem | DiscreteSystem
    dynamics: Tape
    ranges: Interval
    bounded_by_user: bool
    problem: Problem | None = None

    @property
    def dimension(self) -> int:
        """State dimension n."""
        return self.system.dimension

    @property
    def continuous(self) -> bool:
        """True in continuous time."""
        return self.system.time == "continuous"

    @property
    def state_slots(self) -> tuple[int, ...]:
        """Input slots of the states: behind the time."""
        return tuple(range(1, self.dimension + 1))

    @property
    def domain_text(self) -> str:
        """The domain in words."""
        if not self.bounded_by_user:
            return "all of R^n"
        low, high = self.ranges.lo[1:], self.ranges.hi[1:]
        sides = [f"{name} in [{a:.6g}, {b:.6g}]" for name, a, b in zip(self.system.states, low, high)]
        return ", ".join(sides)

    def along(self, times: Array, boxes: Interval) -> Interval:
        """Ranges per time piece, shape (K, slots): the time, the given states, the inputs on that piece."""
        count = len(boxes)
        lo = np.array(np.broadcast_to(self.ranges.lo, (count, len(self.ranges))))
        hi = np.array(np.broadcast_to(self.ranges.hi, (count, len(self.ranges))))
        states = slice(1, self.dimension + 1)
        lo[:, 0], hi[:, 0] = times[:-1], times[1:] if self.continuous else times[:-1]
        if not self.continuous:
            hi[:, 0] = np.maximum(times[1:] - 1, times[:-1])
        lo[:, states], hi[:, states] = boxes.lo, boxes.hi
        plan = None if self.problem is None else self.problem.input_sequence
        if plan is not None:
            inputs = slice(self.dimension + 1, self.dimension + 1 + plan.shape[1])
            for piece in range(count):
                rows = self._rows(plan, lo[piece, 0], hi[piece, 0])
                lo[piece, inputs], hi[piece, inputs] = rows.min(axis=0), rows.max(axis=0)
        return Interval(lo, hi)

    def _rows(self, plan: Array, start: float, end: float) -> Array:
        """Rows of an array plan in force on [start, end]."""
        if not self.continuous:
            return plan[int(start) : int(end) + 1]
        assert self.problem is not None
        length = float(self.problem.horizon) / len(plan)
        first, last = int(np.floor(start / length - 1e-9)), int(np.ceil(end / length + 1e-9))
        rows = plan[max(first, 0) : max(last, 1)]
        changes = self.problem.changes
        if changes is None:
            return rows
        near = changes[max(first, 0) : max(last, 1) + 1]
        return _with_changes(rows, [one for one in near if one.first <= end and one.last >= start])


def _with_changes(rows: Array, changes: Sequence[Change]) -> Array:
    """The rows and what inputs may be where they change."""
    beside = [[*end, *rows[0, len(end) :]] for one in changes for end in (one.low, one.high)]
    return np.array([*rows, *beside])


def model_of(source: Any, domain: Any, horizon: float | None) -> Model:
    """The model of a system, a problem or a python-control system, over a domain.

    Another type of ``source`` or ``domain`` is a TypeError, a domain of the wrong dimension or a horizon that is not
    positive a ValueError.
    """
    problem = source if isinstance(source, Problem) else None
    system: Any = problem.system if problem is not None else source
    if not isinstance(system, System):
        system = from_control(system)
    if horizon is None and problem is not None:
        horizon = float(problem.horizon)
    if horizon is not None and not 0 < horizon < np.inf:
        raise ValueError(f"`horizon` must be positive and finite, got {horizon}.")
    if domain is None and problem is not None:
        domain = problem.domain
    low, high = _state_box(domain, system.dimension)
    dynamics, input_box = system.dynamics, system.inputs
    if problem is not None and (problem.plan is not None or system.inputs is None):
        dynamics = problem.closed_loop
        plan = problem.input_sequence
        rows = None if plan is None else _with_changes(plan, problem.changes or ())
        input_box = None if rows is None else Box(rows.min(axis=0), rows.max(axis=0))
    lows, highs = [np.zeros(1), low], [np.full(1, np.inf if horizon is None else horizon), high]
    for box in (input_box, system.disturbance):
        if box is not None:
            lows.append(box.low)
            highs.append(box.high)
    return Model(
        system=system,
        dynamics=dynamics,
        ranges=Interval(np.concatenate(lows), np.concatenate(highs)),
        bounded_by_user=domain is not None,
        problem=problem,
    )


def _state_box(domain: Any, dimension: int) -> tuple[Array, Array]:
    low, high = np.full(dimension, -np.inf), np.full(dimension, np.inf)
    if domain is None:
        return low, high
    if not isinstance(domain, Box) or domain.moving:
        raise TypeError(f"`domain` must be a fixed cb.Box, got {domain!r}.")
    if domain.coordinates is None and domain.dimension != dimension:
        raise ValueError(f"`domain` must have {dimension} sides, one per state, got {domain.dimension}.")
    places = np.arange(dimension) if domain.coordinates is None else np.asarray(domain.coordinates)
    low[places], high[places] = domain.low, domain.high
    return low, high
