"""How probable it is at least that a path meets an obstacle within a step and ends beside it (lower bounds).

As in ``passings``, Z is the distance of q from an end of the obstacle [p0, p1] x [q0, q1], and p stays in [p0, p1] once
it is there. For a time t in the step and a height z > 0

    P(meets it, ends with Z_h > z and p in [p0, p1]) >= P(-depth <= Z_t <= 0, Z_h > z) - P(p_t outside of [p0, p1]).

On the tube Z lies between Y <= Z <= Y', the solutions of linear equations with the least and the largest drift
(`least_mean`), and with N the noise of both, -depth - E Y_t <= N_t <= -E Y'_t and N_h > z - E Y_h will do. N_h is
e^{-pull (h - t)} N_t + N', N' and N_t independent: given N_t the second is the more probable the larger N_t is, and
the integral over N_t is at least its sum over pieces with the lower end of each. Where p falls and dF <= c dt + a s dW
the distance of p from p1 is at most away + F_0 t + c t^2/2 + a s int W, whose last part has variance (a s)^2 t^3/3;
without c, speeds bound it. Probabilities of leaving the tube are taken off. All t are valid, and the largest bound is
taken.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval
from certbound.values.semilagrangian.obstacles.passings import Passing, at_most, least_mean, whole

_LESS = 1 - 1e-8
_TIMES = np.arange(1, 24) / 24
_PIECES = 20


def caught(
    found: Passing, k: int, heights: Interval, drift: Interval, far: tuple[Array, Array], rates: Interval,
    above: Array, s: float, step: float, omega: float,
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
    s, step, omega : float
        sup |W| <= omega sqrt(step) on the tube.

    Returns
    -------
    ndarray, shape (K, N)
    """
    pull = float(found.pull[k])
    best = np.zeros((len(above), len(rates)))
    if not found.stays[k]:
        return best
    lost = 4 * float(at_most(np.array(-omega)))
    mirrored = replace(found, turn=-found.turn)
    last = above[:, None] - least_mean(found, k, heights.lo, drift.lo, np.array(step))
    for share in _TIMES:
        t = share * step
        one = s * math.sqrt(float(whole(2 * pull, np.array(t))))
        two = s * math.sqrt(float(whole(2 * pull, np.array(step - t))))
        high = np.minimum(least_mean(mirrored, k, -heights.hi, -drift.hi, np.array(t)), 4 * one)
        low = np.maximum(-found.depth - least_mean(found, k, heights.lo, drift.lo, np.array(t)), -4 * one)
        away = _absent(found, k, far, rates, s, t)
        due = (away < 0.5) & (low < high)
        low, high = low[due], high[due]
        n = low + (high - low) * np.linspace(0, 1, _PIECES + 1)[:, None]  # shape (pieces + 1, N)
        n[-1] = np.minimum(n[-1], high)
        mass = at_most(n / one)
        mass = np.maximum(mass[1:] * _LESS - mass[:-1], 0.0)
        ends = at_most((math.exp(-pull * (step - t)) * n[:-1] - last[:, None, due]) / two) * _LESS - 1e-12
        here = (np.maximum(ends, 0.0) * mass).sum(axis=1) * _LESS - away[due] - lost
        best[:, due] = np.maximum(best[:, due], here)
    return best


def _absent(found: Passing, k: int, far: tuple[Array, Array], rates: Interval, s: float, t: float) -> Array:
    """Upper bounds of the probability that p is not between the obstacle's ends at the time t."""
    total = np.zeros(len(rates))
    noise = float(found.slope[k]) * s * math.sqrt(t**3 / 3)
    for part, slow, turn, start in zip(far, found.slow, found.slowed, (rates.hi, -rates.lo)):
        left = part - float(slow[k]) * t * _LESS
        chance = np.where((part <= 0) | (left <= 0), 0.0, 1.0)
        if math.isfinite(turn[k]) and noise > 0:
            left = part + start * t + float(turn[k]) * t**2 / 2
            left += 1e-12 * (np.abs(part) + np.abs(start) * t + abs(float(turn[k])) * t**2)
            chance = np.minimum(chance, at_most(left / noise))
        total += chance
    return total
