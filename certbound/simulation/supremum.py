"""The largest value of a process between the steps of a simulated path, compiled into the kernels.

Between two steps of variance v the largest value of a Brownian bridge from a to b exceeds a record m with
probability exp(-2 (m - a) (m - b) / v). A kernel keeps the values at the steps of a stretch and its record at the
steps, and asks for the bridges when the stretch is over: by then the record is high, and whole blocks of steps lie
too far below it to matter.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

import math

from numba import njit

from certbound.simulation.streams import uniform

__all__ = ["STRETCH", "raise_top"]

STRETCH = 1024
"""Steps kept."""

_BLOCK = 8


def _raise_top(stream, track, count, top, spread, exponent_limit):  # type: ignore[no-untyped-def]
    """The record of ``track[: count + 1]`` with the bridges between its entries; ``top`` is that of the entries.

    Bridges that exceed the record with probability below exp(-exponent_limit) are left out. The last entry is moved
    to the front, where the next stretch begins.
    """
    near, scale = 0.5 * exponent_limit * spread, 2.0 / spread
    limit = top - math.sqrt(near)
    for first in range(0, count, _BLOCK):
        last = min(first + _BLOCK, count)
        largest = track[first]
        for k in range(first, last):
            largest = max(largest, track[k + 1])
        if largest <= limit:
            continue
        for k in range(first, last):
            before, after = track[k], track[k + 1]
            gap = (top - before) * (top - after)
            if gap < near:
                exponent = gap * scale
                chance = uniform(stream)
                if chance * (1.0 + exponent * (1.0 + 0.5 * exponent)) < 1.0:  # 1 + e + e^2/2 < exp(e) saves logarithms
                    rise = math.sqrt((after - before) ** 2 - 2.0 * spread * math.log(chance))
                    top = max(top, 0.5 * (before + after + rise))
    track[0] = track[count]
    return top


raise_top = njit(nogil=True, error_model="numpy", fastmath={"nnan", "nsz"})(_raise_top)
