"""The engines that bound a probability, a module each, and what their certificates restate of them."""

from __future__ import annotations

from certbound.safety.engines.barrier import Barrier, barrier_engine
from certbound.safety.engines.constants import constants_engine
from certbound.safety.engines.erosion import Erosion, erode
from certbound.safety.engines.linear import linear_below, linear_engine
from certbound.safety.engines.linear_sketch import linear_chance
from certbound.safety.engines.oblique_limits import Apart, Logarithmic, Turned, by_logarithms, in_coordinates
from certbound.safety.engines.quadratic import quadratic_engine
from certbound.safety.engines.random_starts import prove_truncated, starts_engine
from certbound.safety.engines.rooms import joined, log10_sum
from certbound.safety.engines.values import backward_engine, values_engine

__all__ = [
    "Apart",
    "backward_engine",
    "Barrier",
    "barrier_engine",
    "by_logarithms",
    "constants_engine",
    "erode",
    "Erosion",
    "in_coordinates",
    "joined",
    "linear_below",
    "linear_chance",
    "linear_engine",
    "log10_sum",
    "Logarithmic",
    "prove_truncated",
    "quadratic_engine",
    "starts_engine",
    "Turned",
    "values_engine",
]
