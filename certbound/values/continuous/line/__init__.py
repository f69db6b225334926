"""One state in continuous time: pieces of time with their own safe interval, and the chain of surfaces over them.

From the bottom: ``phases`` (what the constraints leave, piece by piece), ``charts`` (coordinates in which moving limits
stand still), ``profiles`` (what the proposal of a phase starts from), ``joins`` (one surface against the next),
``linked`` (the proof over all of them), ``ladder`` (finer and finer, until the work is spent).
"""

from certbound.values.continuous.line.ladder import bound_line

__all__ = ["bound_line"]
