"""Two states among curved limits and obstacles: both bounds (docs/values.md, "Curved limits and obstacles").

From the bottom: ``boundaries`` (what is safe, in outward-rounded arithmetic), ``region`` (a box around it), ``cuts``
(the cells and parts of cells that it meets), ``proof``, ``continuation`` (proposals of log U), ``walled_ramps`` and
``near_walls`` (of U), ``bounding``; ``proof_below``, ``near_walls_below`` from below; ``target_ramps`` for targets.
"""

from certbound.values.continuous.curved.bounding import bound_region, ramps_for
from certbound.values.continuous.curved.region import boxed, walled

__all__ = ["bound_region", "boxed", "ramps_for", "walled"]
