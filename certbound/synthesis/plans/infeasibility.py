"""Why no plan was found: the record, and the smallest delta that would do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

_LOG_TOLERANCE = 1e-3
_LARGEST = math.log10(0.999)


@dataclass(frozen=True, eq=False, kw_only=True)
class Infeasibility:
    """What stands between a problem and a plan."""

    proved: bool  # whether it is proved that no inputs keep the noise-free state in the eroded set
    kind: str  # "eroded set empty" (proved), "no noise-free trajectory" (proved) or "solver found no point"
    constraint: str  # where the plan with the most room is held back most
    time: float
    scale: float  # how much of the tube fits: the largest s found such that s times the erosion does
    scale_bound: float  # proved upper bound of s; inf where nothing was proved
    # smallest delta for which a plan was found (bisection); None where there is none below 1
    smallest_delta: float | None

    def describe(self, unit: str) -> str:
        """One or two sentences for humans."""
        where = f"'{self.constraint}' at {unit} {self.time:g}"
        if self.kind == "eroded set empty":
            text = f"the eroded set is empty (proved): the tube takes more than there is, first of all from {where}"
        elif self.proved:
            text = (
                f"no inputs within their bounds keep the noise-free state in the eroded set (proved: at most "
                f"{self.scale_bound:.4g} of the tube fits); it is held back most by {where}"
            )
        else:
            text = (
                f"the solver found no point in the eroded set (not a proof): at most {self.scale:.4g} of the tube "
                f"fits; it is held back most by {where}"
            )
        if self.smallest_delta is None:
            return f"{text}. No delta below 1 was feasible."
        return f"{text}. The smallest feasible delta found is {self.smallest_delta:.4g}."


def smallest_delta(feasible: Callable[[float], bool], delta: float) -> float | None:
    """The smallest delta that ``feasible`` accepts, within 0.25 %, from the side where it does; None if none does.

    ``feasible`` is monotone in delta; the search begins at ``delta``.
    """
    start = math.log10(delta)
    if feasible(delta):
        high, step = start, 0.5
        while step < 400 and feasible(10.0 ** max(high - step, -300.0)):
            high, step = max(high - step, -300.0), 2 * step
        if high <= -300.0:
            return 1e-300
        low = max(high - step, -300.0)
    else:
        low, high = start, _LARGEST
        if not feasible(10.0**high):
            return None
    while high - low > _LOG_TOLERANCE:
        middle = (low + high) / 2
        low, high = (low, middle) if feasible(10.0**middle) else (middle, high)
    return float(10.0**high)
