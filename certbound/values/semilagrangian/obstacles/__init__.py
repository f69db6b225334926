"""Obstacles along the coordinates: who meets one within a step and ends beside it is paid (K8-SL, docs/values.md).

From the bottom: ``passings`` (how probable that is from a box of starts), ``catches`` (how probable at
least), ``tolls`` (what the grid's cells pay, and are paid from below).
"""

from certbound.values.semilagrangian.obstacles.tolls import Catch, Toll, Way, catches_of, tolls_of, ways_past

__all__ = ["Catch", "Toll", "Way", "catches_of", "tolls_of", "ways_past"]
