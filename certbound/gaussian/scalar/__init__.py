"""Bounds of P(exists t: xi_t > z_t) for a centred scalar Gaussian process xi, from numbers alone.

The doors of this module take levels z_t (lower bounds) and second moments as ``(lo, hi)`` pairs, and
return upper bounds: functions named ``log_...`` natural logarithms entry by entry, the others log10 of the
probability of the whole event. Every event is one-sided; the two-sided one costs at most twice as much.
Leading axes are a batch (directions, trial scales).

Discrete time: `union`, `triple_below` (overlaps), `log_rectangle`. Continuous time: `crossing_rate` (smooth
directions), `node_clock` with `clock_crossing` (rough directions).
"""

from __future__ import annotations

from certbound.gaussian.scalar.normal import (
    EPS,
    LOG_ROOT_2PI,
    lift,
    log_below_above,
    log_between,
    log_tail,
    log_tail_below,
)
from certbound.gaussian.scalar.ornstein_uhlenbeck import log_line_crossing, log_polygon_crossing
from certbound.gaussian.scalar.pairs import Bounds, log_pair, total, union
from certbound.gaussian.scalar.rectangles import log_rectangle
from certbound.gaussian.scalar.rice import crossing_rate, log_crossings
from certbound.gaussian.scalar.slepian import Clock, clock_crossing, node_clock
from certbound.gaussian.scalar.triples import triple_below

__all__ = [
    "Bounds",
    "Clock",
    "clock_crossing",
    "crossing_rate",
    "EPS",
    "lift",
    "log_below_above",
    "log_between",
    "log_crossings",
    "log_line_crossing",
    "log_pair",
    "log_polygon_crossing",
    "log_rectangle",
    "LOG_ROOT_2PI",
    "log_tail",
    "log_tail_below",
    "node_clock",
    "total",
    "triple_below",
    "union",
]
