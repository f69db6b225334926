"""What is kept of a bound's proof: the function v of one side, and v with rounded coefficients, proved anew.

Quintic B-splines add up to 1, so that v at the starts moves by at most half a unit when every coefficient is rounded
to a multiple of it. The residual moves by |f| / h + a / h^2 times as much where a cell has the width h, and by three
half units over the length of the slab; a rounded rate moves it by two half units of its own.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from certbound.arrays import Array
from certbound.problem.sets import GaussianStart
from certbound.values.kolmogorov.box_setting import Setting
from certbound.values.kolmogorov.carry import Side
from certbound.values.kolmogorov.start_law import CELLS, Directions, directions_of
from certbound.watch import poll

_SOLVER = ("mesh", "carrier", "maps", "carried_maps", "policy")
_FINER = 2  # bits more, where rounded coefficients raise the bound by more than there is room for
_BRIEF = 0.1  # of the room, over all slabs, that these may cost without a closer look
_MOST_BITS = 42  # of a whole number: five differences of such have 15 digits at most


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RoundedStage:
    """v of one stage with coefficients that are whole numbers times a unit, from the beginning on.

    Attributes
    ----------
    axes : tuple of ndarray, shapes (N_i + 1,)
    times : ndarray, shape (K + 1,)
        From the stage's first to its last.
    units : tuple of float
        Of the values and of the rates: powers of two.
    values, rates : ndarray of whole numbers, shape (K + 1, N_1 + 5, ...)
    eta : ndarray, shape (K,)
        What bounds v_t + L v on each slab.
    """

    axes: tuple[Array, ...]
    times: Array
    units: tuple[float, float]
    values: Array
    rates: Array
    eta: Array


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RoundedSide:
    """The stages of a side in their order, and its bound: P <= bound from above, P >= -bound from below.

    ``outward`` holds, for each axis, the places of limits and of faces of the target, and the sign of the way out;
    ``disturbances``, shape (V, m), those of which from below one serves each cell and slab.
    """

    stages: tuple[RoundedStage, ...]
    bound: float
    outward: tuple[tuple[tuple[float, int], ...], ...]
    disturbances: Array


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Witness:
    """One side's v at the pass that proved its best bound, without the numerics that found it.

    Attributes
    ----------
    side : Side
        The first of its stages.
    value : float
        At least v at the start that counts.
    bound : float
        P <= bound from above, P >= -bound from below.
    horizon : float
        The end of the last stage.
    """

    side: Side
    value: float
    bound: float
    horizon: float

    @classmethod
    def of(cls, side: Side) -> tuple[Witness, ...]:
        """What is kept of a side: nothing where it has proved no bound."""
        if side.best is None:
            return ()
        kept = _without_solver(side)
        kept.values, kept.rates = side.best.values, side.best.rates
        horizon = float(side.stages[-1].setting.horizon)
        return (cls(side=kept, value=side.best.value, bound=side.best.bound, horizon=horizon),)

    @staticmethod
    def directions(start: GaussianStart) -> tuple[Directions, int]:
        """Those of a normal start in which the mean of v is bounded, and into how many parts each is cut."""
        found = directions_of(start)
        return found, CELLS.get(len(found.rows), 1)

    def rounded(self, room: float) -> RoundedSide:
        """v with as few digits as raise its bound by at most ``room``; proved by the engine's own inequality."""
        stages, span = self.side.stages, self.horizon
        moved = sum(_span(one) * _slope(one) + 3 * len(one.steps) for one in stages)
        exponents = [math.floor(math.log2(room / (2 * moved))), math.floor(math.log2(room / (4 * span)))]
        while True:
            poll("rounding a solution for the certificate")
            units = (2.0 ** exponents[0], 2.0 ** exponents[1])
            found = self._proved(units, room)
            largest = max(float(np.abs(one.values).max()) for one in found.stages)
            if found.bound <= self.bound + room or largest > 2.0**_MOST_BITS:
                return found
            exponents = [exponent - _FINER for exponent in exponents]

    def _proved(self, units: tuple[float, float], room: float) -> RoundedSide:
        stages, left, later = list[RoundedStage](), 0.0, None
        slabs = sum(len(one.steps) for one in self.side.stages)
        for one in reversed(self.side.stages):
            later, rounded = _rounded(one, units, later)
            eta = np.array([float(rows.max()) for rows in later.residuals()])
            lengths = one.steps if one.clock is None else one.steps * (1 + one.clock)
            left += float(np.dot(lengths, eta)) + later.lacking()
            least = room * np.maximum(1 / self.horizon, _BRIEF / (slabs * lengths))  # a closer look is not worth it
            stages.insert(0, replace(rounded, eta=np.maximum(eta, least)[::-1]))
        return RoundedSide(
            stages=tuple(stages), bound=(self.value + units[0] / 2 + left) * (1 + 1e-9) + 1e-15,
            outward=_outward([one.setting for one in self.side.stages], self.side.row),
            disturbances=self.side.setting.nodes,
        )  # fmt: skip


def _without_solver(side: Side) -> Side:
    """A side and its later stages without what found v, so that neither later passes nor copies of it matter."""
    kept = copy.copy(side)
    kept.values, kept.rates = list(side.values), list(side.rates)
    kept.later = None if side.later is None else _without_solver(side.later)
    for name in _SOLVER:
        vars(kept).pop(name, None)
    return kept


def _outward(stages: Sequence[Setting], row: int) -> tuple[tuple[tuple[float, int], ...], ...]:
    marks: list[set[tuple[float, int]]] = [set() for _ in stages[0].noisy]
    for one in stages:
        pairs = [np.where(one.limited, np.array([one.low[row], one.high[row]]), np.inf)]
        pairs += [np.array([one.due_low[row], one.due_high[row]])]
        pairs += [] if one.target is None else [one.target[:, row]]
        for pair, (side, sign) in product(pairs, enumerate((-1, 1))):
            for own, place in zip(marks, pair[side]):
                own |= {(float(place), sign)} if np.isfinite(place) else set()
    return tuple(tuple(sorted(own)) for own in marks)


def _span(side: Side) -> float:
    return float(side.setting.horizon - side.setting.begin)


def _slope(side: Side) -> float:
    """By how much the residual may move for a unit of the coefficients, largest over the cells."""
    total = np.zeros(())
    large = [1.0 if one is None else float(one.size.max()) for one in side.factors]
    for orders, field, weight, number in side.generator.terms:
        size = weight * large[number] * field.magnitude
        for axis, (one, order) in enumerate(zip(side.axes, orders)):
            size = size / one.widths.reshape([-1 if k == axis else 1 for k in range(len(orders))]) ** order
        total = total + size
    return float(total.max())


def _rounded(side: Side, units: tuple[float, float], later: Side | None) -> tuple[Side, RoundedStage]:
    """A side with rounded coefficients, and these from the beginning on."""
    one, setting = copy.copy(side), side.setting
    whole = [np.rint(np.array(rows) / unit) for rows, unit in zip((side.values, side.rates), units)]
    one.values, one.rates = (list(rows * unit) for rows, unit in zip(whole, units))
    one.later = later
    times = side.times[::-1].copy()
    times[0], times[-1] = setting.begin, setting.horizon
    return one, RoundedStage(
        axes=tuple(axis.nodes for axis in side.axes), times=times, units=units, values=whole[0][::-1],
        rates=whole[1][::-1], eta=np.zeros(len(side.steps)),
    )  # fmt: skip
