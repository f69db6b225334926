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

from certbound.simulation.compiled.streams import inner, uniform

STRETCH = 1024
"""Steps kept."""

_BLOCK = 8


def _raise_top(stream, track, count, top, spread, exponent_limit):  # type: ignore[no-untyped-def]
    """The record of ``track[: count + 1]`` with the bridges between its entries; ``top`` is that of the entries.

    Bridges that exceed the record with probability below exp(-exponent_limit) are left out. The bridges of a block
    take one variate for the least of their variates, and draw these only if the likeliest would notice the least. The
    last entry is moved to the front, where the next stretch begins.
    """
    near, scale = 0.5 * exponent_limit * spread, 2.0 / spread
    limit = top - math.sqrt(near)
    whole = count - count % _BLOCK
    for first in range(0, whole, _BLOCK):
        largest = track[first]
        for k in range(_BLOCK):
            largest = max(largest, track[first + k + 1])
        if largest <= limit:
            continue
        gap = math.inf
        for k in range(_BLOCK):
            gap = min(gap, (top - track[first + k]) * (top - track[first + k + 1]))
        if gap < near:
            top = _raise_over(stream, track, first, _BLOCK, gap * scale, top, spread)
    for k in range(whole, count):
        gap = (top - track[k]) * (top - track[k + 1])
        if gap < near:
            top = _raise_over(stream, track, k, 1, gap * scale, top, spread)
    track[0] = track[count]
    return top


def _raise_block(stream, track, first, size, exponent, top, spread):  # type: ignore[no-untyped-def]
    """The record with ``size`` bridges, of which the likeliest exceeds it with probability exp(-exponent)."""
    chance = uniform(stream)
    growth = 1.0 + 0.0625 * exponent
    growth *= growth
    growth *= growth
    growth *= growth
    growth *= growth
    if chance * growth >= size:  # 1 - (1 - q)^size <= size q, and q = exp(-e) <= (1 + e/16)^-16
        return top
    least = -math.expm1(math.log1p(-chance) / size)
    place = first + int(size * uniform(stream))
    for k in range(first, first + size):
        variate = least if k == place else least + (1.0 - least) * uniform(stream)
        before, after = track[k], track[k + 1]
        exponent = 2.0 * (top - before) * (top - after) / spread
        if variate * (1.0 + exponent * (1.0 + 0.5 * exponent)) < 1.0:  # 1 + e + e^2/2 < exp(e) saves logarithms
            rise = math.sqrt((after - before) ** 2 - 2.0 * spread * math.log(variate))
            top = max(top, 0.5 * (before + after + rise))
    return top


def _touches(stream, exponent):  # type: ignore[no-untyped-def]
    """True with probability exp(-e), which is below 1/(1 + e + e^2/2): that saves most exponentials."""
    chance = uniform(stream)
    return chance * (1.0 + exponent * (1.0 + 0.5 * exponent)) < 1.0 and chance < math.exp(-exponent)


def _crossed(stream, before, after, spread, exponent_limit):  # type: ignore[no-untyped-def]
    """Whether a bridge between two gaps that are not negative touches 0; one that hardly can draws no variate."""
    if before >= 0.0 and before * after < 0.5 * exponent_limit * spread:
        return touches(stream, 2.0 * before * after / spread)
    return False


def _rise_between(stream, before, after, exponent, spread, top):  # type: ignore[no-untyped-def]
    """The record ``top`` with a bridge that exceeds it with probability exp(-e); few need the logarithm."""
    chance = uniform(stream)
    if chance * (1.0 + exponent * (1.0 + 0.5 * exponent)) < 1.0:
        rise = math.sqrt((after - before) ** 2 - 2.0 * spread * math.log(chance))
        return max(top, 0.5 * (before + after + rise))
    return top


def _fall_between(stream, before, after, floor, spread, low):  # type: ignore[no-untyped-def]
    """The least value of a bridge where it may lie below ``floor``, else ``low``."""
    exponent = 2.0 * (before - floor) * (after - floor) / spread
    chance = uniform(stream)
    if chance * (1.0 + exponent * (1.0 + 0.5 * exponent)) < 1.0:
        fall = math.sqrt((before - after) ** 2 - 2.0 * spread * math.log(chance))
        return 0.5 * (before + after - fall)
    return low


def _bin_of(value, lowest, density, bins):  # type: ignore[no-untyped-def]
    """The bin of a value in a histogram of ``density`` bins per factor of two above 2**lowest."""
    if not value > 2.0**lowest:
        return 0
    return min(1 + int((math.log2(value) - lowest) * density), bins - 1)


_raise_over = njit(inline="always", error_model="numpy", fastmath={"nnan", "nsz"})(_raise_block)
raise_top = njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan", "nsz"})(_raise_top)
bin_of = inner(_bin_of)
touches = inner(_touches)
crossed = inner(_crossed)
rise_between = inner(_rise_between)
fall_between = inner(_fall_between)
