"""Two states in discrete time, normal noise along one direction only (docs/values.md).

From the bottom: ``noise_directions`` (the problem in coordinates of which noise moves one), ``hats`` (means of hat
functions), ``cell_landings`` (where cells come to), ``overshoots`` (what means exceed their interpolation by),
``means`` (one step back), ``directed_grids``, ``directed_failures`` (the door).
"""

from certbound.values.directed.directed_failures import bound_directed_failure

__all__ = ["bound_directed_failure"]
