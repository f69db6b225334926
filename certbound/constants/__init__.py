"""The constants room: certified c, L, sigma, nu and the metrics they hold in, from any model.

What a user may want of it, each name loaded when it is first used:

- ``bound_constants``, ``bound_metrics``, ``propose_metrics``, ``split_delta``: certified constants, metrics to try,
  shares of delta.
- ``constants_along``, ``fitted_constants_along``: constants per time piece over given boxes (Thm K4).
- ``matrix_measure``, ``induced_norm``, ``diagonal_weights``: the norms 1, 2 and infinity, weighted or not.
- ``jacobian_set`` and the sets ``AffineSet``, ``SectorSet``, ``VertexPolytope``, ``IntervalMatrixSet``, ``UnionSet``.
- ``certify_rate``, ``certify_gain``: c or L of a set of Jacobians in a given metric, proved.
- ``design_feedback``: a feedback gain and its metric together.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "bound_constants": "bounds",
    "bound_metrics": "metrics",
    "propose_metrics": "metrics",
    "split_delta": "metrics",
    "constants_along": "bounds",
    "fitted_constants_along": "fitted",
    "matrix_measure": "jacobians",
    "induced_norm": "jacobians",
    "diagonal_weights": "jacobians",
    "jacobian_set": "jacobians",
    "AffineSet": "jacobians",
    "SectorSet": "jacobians",
    "VertexPolytope": "jacobians",
    "IntervalMatrixSet": "jacobians",
    "UnionSet": "jacobians",
    "certify_rate": "recheck",
    "certify_gain": "recheck",
    "design_feedback": "programs",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
