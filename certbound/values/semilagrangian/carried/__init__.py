"""Noise in one of three coordinates: the other two are carried along by it (K8-SL, docs/values.md).

From the bottom: ``carried_problem`` (what is read of a problem), ``carried_motion`` (one step without noise, and what
splitting the noise off leaves out), ``carried_cells`` (interpolation along the flow, compiled), ``carried_step`` (one
step back), ``carried_grid``, ``carried_exits``.
"""

from certbound.values.semilagrangian.carried.carried_exits import bound_carried_exits
from certbound.values.semilagrangian.carried.carried_problem import carries

__all__ = ["bound_carried_exits", "carries"]
