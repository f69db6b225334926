"""What is kept of a bound's proof: the function v of one side, and v with rounded coefficients, proved anew.

Quintic B-splines add up to 1, so that v at the starts moves by at most half a unit when every coefficient is rounded
to a multiple of it. The residual moves by |f| / h + a / h^2 times as much where a cell has the width h, and by three
half units over the length of the slab; a rounded rate moves it by two half units of its own.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.carry import Side
from certbound.watch import poll

_SOLVER = ("mesh", "carrier", "maps", "carried_maps", "sketch")
_FINER = 2  # bits more, where rounded coefficients raise the bound by more than there is room for
_MOST_BITS = 42  # of a whole number: five differences of such have 15 digits at most


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RoundedSide:
    """v with coefficients that are whole numbers times a unit, from the beginning on.

    Attributes
    ----------
    axes : tuple of ndarray, shapes (N_i + 1,)
    times : ndarray, shape (K + 1,)
        From 0 to the horizon.
    units : tuple of float
        Of the values and of the rates: powers of two.
    values, rates : ndarray of whole numbers, shape (K + 1, N_1 + 5, ...)
    eta : ndarray, shape (K,)
        What bounds v_t + L v on each slab.
    bound : float
        Of the side: P <= bound from above, P >= -bound from below.
    """

    axes: tuple[Array, ...]
    times: Array
    units: tuple[float, float]
    values: Array
    rates: Array
    eta: Array
    bound: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Witness:
    """One side's v at the pass that proved its best bound, without the numerics that found it.

    Attributes
    ----------
    side : Side
    value : float
        At least v at the start that counts.
    bound : float
        P <= bound from above, P >= -bound from below.
    horizon : float
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
        kept = copy.copy(side)
        kept.values, kept.rates = side.best.values, side.best.rates
        for name in _SOLVER:
            vars(kept).pop(name, None)
        return (cls(side=kept, value=side.best.value, bound=side.best.bound, horizon=float(side.setting.horizon)),)

    def rounded(self, room: float) -> RoundedSide:
        """v with as few digits as raise its bound by at most ``room``; proved by the engine's own inequality."""
        side, span = self.side, self.horizon
        slope = self._slope()
        exponents = [math.floor(math.log2(room / (2 * (span * slope + 3 * len(side.steps))))),
                     math.floor(math.log2(room / (4 * span)))]  # fmt: skip
        while True:
            poll("rounding a solution for the certificate")
            units = (2.0 ** exponents[0], 2.0 ** exponents[1])
            found = self._proved(units, room / span)
            if found.bound <= self.bound + room or np.abs(found.values).max() > 2.0**_MOST_BITS:
                return found
            exponents = [exponent - _FINER for exponent in exponents]

    def _slope(self) -> float:
        """By how much the residual may move for a unit of the coefficients, largest over the cells."""
        total = np.zeros(())
        for orders, field, weight, _ in self.side.generator.terms:
            size = weight * field.magnitude
            for axis, (one, order) in enumerate(zip(self.side.axes, orders)):
                size = size / one.widths.reshape([-1 if k == axis else 1 for k in range(len(orders))]) ** order
            total = total + size
        return float(total.max())

    def _proved(self, units: tuple[float, float], least: float) -> RoundedSide:
        side = copy.copy(self.side)
        whole = [np.rint(np.array(rows) / unit) for rows, unit in zip((side.values, side.rates), units)]
        side.values, side.rates = (list(rows * unit) for rows, unit in zip(whole, units))
        eta = np.array([float(rows.max()) for rows in side.residuals()])
        left = float(np.dot(side.steps, eta)) + side.lacking()
        times = self.horizon - np.concatenate([[0.0], np.cumsum(side.steps)])[::-1]
        times[0], times[-1] = 0.0, self.horizon
        return RoundedSide(
            axes=tuple(axis.nodes for axis in side.axes), times=times, units=units, values=whole[0][::-1],
            rates=whole[1][::-1], eta=np.maximum(eta[::-1], least),
            bound=(self.value + units[0] / 2 + left) * (1 + 1e-9) + 1e-15,
        )  # fmt: skip
