"""The remainder along the nominal curve itself, which the noise has no part in: beta at s = 0 over every piece.

beta(t, s) = delta(t) + gamma(t, s) with delta = f(p, d0) - p', the nominal's own defect, and gamma = f(p + s, d0) -
f(p, d0) - Jhat s. What a Taylor expansion in time leaves of delta is tiny, and the motion of gamma over a piece is of
first order in s: bounding it beside what holds at s = 0 keeps the two from being paid for as if they were unrelated.
"""

from __future__ import annotations

from math import comb

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.problem.model import Tape
from certbound.reach.nominal import Series, expand, polynomial_range, taylor_bounds
from certbound.reach.remainder.derivatives import Derivatives
from certbound.reach.remainder.frame import Frame
from certbound.rigor.intervals import Interval, stack

_ORDER = 4


class NominalDefect:
    """What `Expansion` subtracts at s = 0, piece by piece (axis 0), so that beta = defect + gamma.

    Where the dynamics or its derivatives are not enclosed along a whole piece, phi = p' takes the place of f(p): the
    defect is 0 there, and ``curve`` holds the second derivative that gamma is then left with.

    Attributes
    ----------
    value, rate : Interval, shape (M, n)
        phi at the middle of the piece, and its derivative by time but for what the constant entries of the Jacobian
        and explicit time contribute.
    first, first_over : Interval, shape (M, E)
        Varying entries of the Jacobian along the curve at the middle, and over the piece.
    second : Interval, shape (M, columns)
        Second derivatives over the piece.
    by_time, by_time_twice : Interval, shape (M, timed)
        First derivatives by explicit time at the middle, and second ones over the piece.
    defect : Interval, shape (M, n)
        delta over the piece.
    curve : ndarray, shape (M, n)
    """

    def __init__(self, model: Derivatives, frame: Frame) -> None:
        n, count = frame.spread.shape[1], len(frame)
        reach = frame.spread * (1 + 1e-14)
        thin = model.slots(frame.middle_time, frame.middle, frame.inputs, frame.disturbance_middle)
        wide = model.slots(frame.span, frame.middle + Interval(-reach, reach), frame.inputs, frame.disturbance_middle)

        def along(tape: Tape, slots: list[Interval]) -> Interval:
            return enclose(tape, slots, undefined="infinite").reshape((count, len(tape.outputs)))

        value = along(model.value, thin)
        first, first_over = along(model.varying, thin), along(model.varying, wide)
        second = along(model.second, wide)
        times = (along(model.time, thin), along(model.time2, wide)) if model.timed else (first[:, :0],) * 2
        parts = (first, first_over, second, *times, bound_defect_over_pieces(model, frame))
        known = np.all([np.isfinite(part.mag).all(axis=1) for part in (value, *parts)], axis=0)[:, None]
        velocity = frame.middle_velocity
        rates = [Interval.point(np.zeros(count))] * n
        for entry, (i, j) in enumerate(model.entries):
            rates[i] = rates[i] + first[:, entry] * velocity[:, j]
        constant = model.constant_slope
        other = frame.middle_acceleration - product(constant, velocity)
        self.value = _where(known, value, velocity)
        self.rate = _where(known, stack(rates, axis=-1), other)
        self.first, self.first_over, self.second, self.by_time, self.by_time_twice, self.defect = (
            _where(known, part, Interval.point(np.zeros(part.shape))) for part in parts
        )
        self.curve = np.where(known, 0.0, (product(constant, frame.acceleration) - frame.jerk).mag)


def bound_defect_over_pieces(model: Derivatives, frame: Frame) -> Interval:
    """Enclosure of f(p, d0) - p' over every piece, shape (M, n); infinite where it is not expanded.

    Proves: the difference lies in the box at every t of the piece, by Taylor expansion with Lagrange's remainder about
    its middle; the best order counts, coordinate by coordinate.
    """
    span = Interval(-frame.half, frame.half)
    powers = [frame.middle, frame.middle_velocity, frame.middle_acceleration / 2.0, frame.jerk / 6.0]
    one, n = Interval.point(1.0), frame.spread.shape[1]
    centre: list[Series] = [[power[:, i] for power in powers] for i in range(n)]
    piece: list[Series] = [
        [polynomial_range([c * float(comb(m, j)) for m, c in enumerate(series) if m >= j], span) for j in range(4)]
        for series in centre
    ]
    found = []
    for time, states in ((frame.middle_time, centre), (frame.span, piece)):
        slots: list[Series] = [[time, one], *states]
        slots += [[Interval.point(frame.inputs[:, i])] for i in range(frame.inputs.shape[1])]
        slots += [[Interval.point(value)] for value in frame.disturbance_middle]
        found.append(expand(model.value, slots, _ORDER))
    columns = []
    for i in range(n):
        series = []
        for field, states in zip(found, (centre, piece), strict=True):
            slope = [states[i][j] * float(j) for j in range(1, 4)] + [Interval.point(0.0)] * (_ORDER - 2)
            series.append([(a - b).broadcast_to((len(frame),)) for a, b in zip(field[i], slope, strict=True)])
        bounds = taylor_bounds(series[0], series[1], span)
        best = bounds[0]
        for bound in bounds[1:]:
            best = best.intersect(bound)
        columns.append(best)
    return stack(columns, axis=-1)


def _where(mask: Array, first: Interval, second: Interval) -> Interval:
    return Interval(np.where(mask, first.lo, second.lo), np.where(mask, first.hi, second.hi))


def product(matrix: Interval, vector: Interval) -> Interval:
    """``matrix`` (n, n) times a batch of interval vectors (M, n)."""
    return (matrix[None, :, :] * vector[:, None, :]).sum(axis=-1)
