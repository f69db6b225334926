"""Values whose error the process carries: the backward equation solved in floats, and one inequality proved (Thm K10).

The parts, each above those that it uses: ``splines`` (axes and their lattices), ``coefficients`` (drift and noise on
cells), ``residual`` (the only trusted inequality), ``exits`` (what is asked of v at faces), ``setting`` (the problem),
``axes`` (graded nodes), ``solve`` (untrusted numerics), ``carry`` (u, and the error that is carried), ``door``.
"""

from certbound.lazy import lazily

_HOMES = {"door": "Bounds bound_failing"}
__all__ = ["Bounds", "bound_failing"]  # noqa: F822
__getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
