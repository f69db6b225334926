"""Functions whose second derivatives vary linearly over cells: fewer cells where everything is smooth.

``majorants`` (how large derivatives of phi = h(f) are, from those of f), ``cell_scans`` (loops over cells, compiled),
``cubic_step`` (one step back).
"""

from certbound.values.discrete.cubic.cubic_step import CubicTransition, all_alike, cubic_transition

__all__ = ["CubicTransition", "all_alike", "cubic_transition"]
