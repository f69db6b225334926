"""The least value of a function of one number: a search that proposes, and proves nothing."""

from __future__ import annotations

import math
from collections.abc import Callable

from certbound.watch import poll


def golden(function: Callable[[float], float], low: float, high: float, width: float) -> float:
    """Place of the least value of a unimodal function on [low, high]."""
    ratio = (math.sqrt(5) - 1) / 2
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    fa, fb = function(a), function(b)
    while high - low > width:
        poll()
        if fa <= fb:
            high, b, fb = b, a, fa
            a = high - ratio * (high - low)
            fa = function(a)
        else:
            low, a, fa = a, b, fb
            b = low + ratio * (high - low)
            fb = function(b)
    return (low + high) / 2
