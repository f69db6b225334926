"""The closed loop of a problem as the reach engines read it: values, enclosures, series and Jacobians.

The tape's slots are t, the states, the inputs of an array plan (if any) and the disturbances. ``Flow``
fills them: the caller gives times, states and disturbances, the rows of an array plan are looked up by
piece.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.problem.goals import check_end
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.model import Tape, compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.reach.nominal.series import expand
from certbound.rigor.intervals import Interval, stack
from certbound.rigor.series import Series


@dataclass(frozen=True, eq=False)
class Flow:
    """The map f(t, x, d) of a problem's closed loop.

    Raises
    ------
    ValueError
        If the system has inputs and the problem has no plan.
    """

    problem: Problem  # with a plan if its system has inputs
    only: ArrayLike | None = None  # (q,): study this one constant disturbance instead of the whole set D
    tape: Tape = field(init=False)
    dimension: int = field(init=False)

    def __post_init__(self) -> None:
        check_end(self.problem, "a noise-free trajectory")
        if self.problem.random:
            _ = self.problem.constraints  # which refuses them
        object.__setattr__(self, "problem", in_pieces(self.problem))
        object.__setattr__(self, "tape", self.problem.closed_loop)
        object.__setattr__(self, "dimension", self.problem.system.dimension)

    @property
    def continuous(self) -> bool:
        """True in continuous time."""
        return bool(self.problem.system.time == "continuous")

    @property
    def horizon(self) -> float:
        """Horizon T in seconds or steps."""
        return float(self.problem.horizon)

    @cached_property
    def breaks(self) -> Array:
        """Times where the plan jumps, 0 and the horizon included (continuous time).

        Where it is not said to jump at a float, it does between two neighbouring ones, and both are among them.
        """
        sequence, changes = self.problem.input_sequence, self.problem.changes
        if changes is None:
            count = 1 if sequence is None else len(sequence)
            return np.linspace(0.0, self.horizon, count + 1)
        ends = [end for change in changes for end in _around(change.first, change.last)]
        return np.unique(np.clip([0.0, *ends, self.horizon], 0.0, self.horizon))

    @cached_property
    def _pieces(self) -> tuple[Array, Array, Array]:
        """Rows between `breaks`, one of those that hold there, and the least and largest of them."""
        sequence, changes = self.problem.input_sequence, self.problem.changes
        assert sequence is not None
        rows = np.asarray(sequence, dtype=float)
        if changes is None:
            return rows, rows, rows
        around = [_around(change.first, change.last) for change in changes]
        own = rows[np.searchsorted([last for _, last in around[1:-1]], self.breaks[:-1], side="right")]
        low, high = own.copy(), own.copy()
        for change, (first, last) in zip(changes, around):
            inside = (self.breaks[:-1] >= first) & (self.breaks[1:] <= last)
            low[inside] = np.minimum(low[inside], change.low)
            high[inside] = np.maximum(high[inside], change.high)
        return own, low, high

    def _index(self, starts: ArrayLike) -> Array:
        times = np.asarray(starts, dtype=float)
        index = np.searchsorted(self.breaks, times, side="right") - 1 if self.continuous else times.astype(int)
        return np.clip(index, 0, len(self._pieces[0]) - 1)

    def plan_rows(self, starts: ArrayLike) -> Array:
        """Inputs of the array plan on the pieces (or steps) that begin at ``starts``, shape (K, m)."""
        if self.problem.input_sequence is None:
            return np.zeros((len(np.asarray(starts)), 0))
        rows: Array = self._pieces[0][self._index(starts)]
        return rows

    def plan_ranges(self, starts: ArrayLike) -> Interval:
        """Enclosure of them: of more than one row only where the plan jumps between two neighbouring floats."""
        if self.problem.input_sequence is None:
            return Interval.point(self.plan_rows(starts))
        _, low, high = self._pieces
        index = self._index(starts)
        return Interval(low[index], high[index])

    @cached_property
    def disturbance(self) -> Interval:
        """The box D, shape (number of disturbances,)."""
        if self.only is not None:
            return Interval.point(self.only)
        box = self.problem.system.disturbance
        return Interval.point(np.zeros(0)) if box is None else Interval(box.low, box.high)

    @cached_property
    def centre_disturbance(self) -> Array:
        """The value d0 that the nominal curve uses, a float inside D."""
        return np.asarray(self.disturbance.mid)

    @cached_property
    def state_jacobian(self) -> Tape:
        """Tape of D_x f, shape (n, n)."""
        return jacobian(self.tape, columns=tuple(range(1, self.dimension + 1)))

    @cached_property
    def disturbance_jacobian(self) -> Tape:
        """Tape of D_d f, shape (n, number of disturbances)."""
        last = len(self.tape.inputs)
        return jacobian(self.tape, columns=tuple(range(last - self.disturbance.shape[0], last)))

    def value(self, times: ArrayLike, states: Array, rows: Array, disturbance: Array | None = None) -> Array:
        """Floating-point f at states (..., n), plan rows (..., m), disturbance (..., q) (d0 when omitted)."""
        d = self.centre_disturbance if disturbance is None else disturbance
        slots = [np.asarray(times, dtype=float), *_columns(states), *_columns(rows), *_columns(d)]
        return compile_numpy(self.tape)(*slots)

    def bounds(
        self, tape: Tape, times: Interval, states: Interval, rows: Interval, disturbance: Interval | None = None
    ) -> Interval:
        """Enclosure of ``tape`` (f or one of its Jacobians) over boxes; [-inf, inf] where undefined.

        Parameters
        ----------
        times : Interval, shape (K,)
        states : Interval, shape (..., K, n)
        rows : Interval, shape (K, m)
        disturbance : Interval, shape (..., q), optional
            The whole set D when omitted.
        """
        slots = self.slots(times, states, rows, disturbance)
        return enclose(tape, [slots[..., i] for i in range(slots.shape[-1])], undefined="infinite")

    def slots(
        self, times: Interval, states: Interval, rows: Interval, disturbance: Interval | None = None
    ) -> Interval:
        """Boxes of all input slots, shape (..., K, slots), from the parts that `bounds` takes."""
        d = self.disturbance if disturbance is None else disturbance
        parts = [times, *(states[..., i] for i in range(self.dimension))]
        parts += [rows[..., i] for i in range(rows.shape[-1])]
        parts += [d[..., i] for i in range(d.shape[-1])]
        batch = np.broadcast_shapes(*(part.shape for part in parts))
        return stack([part.broadcast_to(batch) for part in parts], axis=-1)

    def expand(self, times: Series, states: Sequence[Series], rows: Interval, order: int) -> list[Series]:
        """Series of f at d0 along series of time and states."""
        slots = [times, *states]
        slots += [[rows[..., i]] for i in range(rows.shape[-1])]
        slots += [[Interval.point(value)] for value in self.centre_disturbance]
        return expand(self.tape, slots, order)


def _around(first: Fraction, last: Fraction) -> tuple[float, float]:
    """The floats next to the two, outwards."""
    low, high = float(first), float(last)
    low = low if Fraction(low) <= first else math.nextafter(low, -math.inf)
    return low, high if Fraction(high) >= last else math.nextafter(high, math.inf)


def _columns(values: Array) -> list[Array]:
    return [values[..., i] for i in range(values.shape[-1])]
