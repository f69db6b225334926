"""Obstacles along the coordinates: who meets one within a step and ends beside it is paid (K8-SL, docs/values.md).

From the bottom: ``passings`` (how probable that is from a box of starts), ``tolls`` (what the grid's cells pay).
"""

from certbound.values.semilagrangian.obstacles.tolls import Way, tolls_of, ways_past

__all__ = ["Way", "tolls_of", "ways_past"]
