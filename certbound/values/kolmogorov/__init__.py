"""Values whose error the process carries: the backward equation solved in floats, and one inequality proved (Thm K10).

The parts, each above those that it uses: ``splines`` (axes and their lattices), ``cell_fields`` (drift and noise on
cells), ``products`` (time and disturbances apart from the states), ``factors`` (what they do within a slab),
``residual`` (the only trusted inequality), ``face_exits`` (what is asked of v at faces), ``box_setting`` (the
problem), ``axes`` (graded nodes), ``solve`` and ``changing`` (untrusted numerics), ``carry`` (u, and the error that is
carried), ``start_law`` (normal starts), ``door``.
"""

from certbound.values.kolmogorov.door import Bounds, bound_failing
from certbound.values.kolmogorov.witness import RoundedSide, RoundedStage, Witness

__all__ = ["bound_failing", "Bounds", "RoundedSide", "RoundedStage", "Witness"]
