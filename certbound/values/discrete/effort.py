"""How fine the grids are, one after the other, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable

from certbound.values.grids import Grid

_SHARES = {
    1: (0.33, 0.15, 0.07, 0.035, 0.0175, 0.01),
    2: (0.5, 0.33, 0.22, 0.15, 0.1, 0.07, 0.05, 0.035),
    3: (0.4, 0.17, 0.14, 0.1, 0.07),
}
"""Sizes of the cells that are tried, relative to the lengths over which the solution changes."""
_UNIFORM_SHARES = {
    1: (0.2, 0.07, 0.025, 0.01, 0.005),
    2: (0.3, 0.15, 0.07, 0.035, 0.02, 0.012),
    3: (0.5, 0.3, 0.2, 0.12),
}
_CELL_SECONDS = 4e-6  # what a cell takes for one step, both bounds; measured once
_ORDER, _UNIFORM_ORDER = 2.5, 2.0
"""About the power of the cells' size with which the logarithm of upper over lower falls; measured."""
_COMMON_FACTOR = 20.0  # how much more that is with a common factor in the noise
_UNIFORM_FACTOR = 0.4
_OVERHEAD = 250  # cells that every step is worth in addition
_NEARLY = 1.15  # times the share that would do
_WIDEST = 10.0  # upper over lower beyond which nothing is known of how it will fall


def shares_of(states: int, *, uniform: bool) -> list[float]:
    """Sizes of the cells that are tried, relative to the lengths over which the solution changes."""
    return list((_UNIFORM_SHARES if uniform else _SHARES)[states])


def seconds_of(layout: list[Grid], *, common: bool, uniform: bool) -> float:
    """Seconds that the grids of all steps stand for, without disturbances."""
    rate = _CELL_SECONDS * (_COMMON_FACTOR if common else 1.0) * (_UNIFORM_FACTOR if uniform else 1.0)
    return rate * sum(_OVERHEAD + math.prod(grid.shape) for grid in layout)


def without_hopeless(
    shares: list[float], last: tuple[float, float, float], ratio: float, uniform: bool,
    affordable: Callable[[float], bool],
) -> list[float]:  # fmt: skip
    """The shares without those that would leave upper > ratio * lower, as long as the next one is affordable.

    Parameters
    ----------
    shares : list of float
        Falling; what is left to try.
    last : tuple of float
        The share of the last grid, upper and lower.
    ratio : float
        What is wanted.
    uniform : bool
        Whether the noise is.
    affordable : callable
        Whether a share may be tried.
    """
    share, upper, lower = last
    if not 0 < lower < upper < _WIDEST * lower:
        return shares
    wanted = share * (math.log(ratio) / math.log(upper / lower)) ** (1 / (_UNIFORM_ORDER if uniform else _ORDER))
    while len(shares) > 1 and shares[0] > _NEARLY * wanted and affordable(shares[1]):
        shares = shares[1:]
    return shares
