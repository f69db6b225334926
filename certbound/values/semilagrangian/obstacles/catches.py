"""How probable it is at least that a path meets an obstacle within a step and ends beside it (lower bounds).

As in ``passings``, Z is the distance of q from an end of the obstacle [p0, p1] x [q0, q1], and p stays in [p0, p1] once
it is there. If p is there at the time t, Z <= 0 somewhere in [t, h] and Z_h > z >= 0, the path goes through Z = 0 in
[t, h] and meets the obstacle. So for every t

    P(meets it, ends with Z_h > z) >= P(Z <= 0 somewhere in [t, h], Z_h > z, p_t in [p0, p1]),

which ``reflections`` bounds from below, less the probability of leaving the tube. Where p falls and dF <= c dt + a s dW
the distance of p from p1 is at most away + F_0 t + c t^2/2 + a s int W (`arrival_of`); without c, speeds bound it. The
largest bound of a few t is taken.
"""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval
from certbound.values.semilagrangian.obstacles.passings import Passing, arrival_of, at_most, motion_of
from certbound.values.semilagrangian.obstacles.reflections import dipped

_WIDE = (0.5, 1.2, 2.0, math.inf)


def caught(
    found: Passing, k: int, heights: Interval, drift: Interval, far: tuple[Array, Array], rates: Interval,
    above: Array, s: float, step: float,
) -> Array:  # fmt: skip
    """Lower bounds of the probability that a path meets the obstacle within the step and ends more than ``above`` it.

    Parameters
    ----------
    found : Passing
    k : int
        The box of starts.
    heights : Interval, shape (N,)
        Z of the starts.
    drift : Interval, shape (N,)
        Of Z at the end of the obstacle, for p of the starts.
    far : two ndarrays, shape (N,)
        Largest distances of p above the obstacle's upper (below its lower) end; at most 0 where it is within.
    rates : Interval, shape (N,)
        Of F at the starts.
    above : ndarray, shape (K,)
        Heights Z at the end.
    s, step : float

    Returns
    -------
    ndarray, shape (K, N)
    """
    best = np.zeros((len(above), len(rates)))
    if not found.stays[k]:
        return best
    lost = 4 * float(at_most(np.array(-found.omega)))
    motion = motion_of(found, k, heights, drift, rates, s, step)
    for wide in _WIDE:
        arrival = arrival_of(found, k, far, rates, s, step, wide, upper=False)
        best = np.maximum(best, np.nan_to_num(dipped(motion, arrival, above, upper=False) - lost))
    return best
