"""Three states: V on a tensor grid of cubic cells, proposed for the upper bound and proved by `hypotheses`.

From the bottom: ``space_box``, ``space_grids``, ``space_solver``, ``space_bounds``.
"""

from certbound.values.continuous.space.space_bounds import three_states

__all__ = ["three_states"]
