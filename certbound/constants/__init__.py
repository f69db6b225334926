"""The constants room: certified c, L, sigma, nu and the metrics they hold in, from any model.

What a user may want of it, each name loaded when it is first used:

- ``bound_constants``, ``bound_metrics``, ``propose_metrics``, ``split_delta``: certified constants, metrics to try,
  shares of delta.
- ``constants_along``, ``fitted_constants_along``: constants per time piece over given boxes (Thm K4).
- ``moving_constants_along``: the same in coordinates that move along a trajectory.
- ``matrix_measure``, ``induced_norm``, ``diagonal_weights``: the norms 1, 2 and infinity, weighted or not.
- ``jacobian_set`` and the sets ``AffineSet``, ``SectorSet``, ``VertexPolytope``, ``IntervalMatrixSet``, ``UnionSet``.
- ``certify_rate``, ``certify_gain``: c or L of a set of Jacobians in a given metric, proved.
- ``bound_network_gain``: a Lipschitz constant of a network.
- ``design_feedback``: a feedback gain and its metric together.
"""

from __future__ import annotations

from certbound.lazy import lazily, names_in

_HOME = {
    "bounds": "bound_constants constants_along",
    "metrics": "bound_metrics propose_metrics split_delta jacobian_set",
    "fitted": "fitted_constants_along moving_constants_along",
    "jacobians": "matrix_measure induced_norm diagonal_weights "
    "AffineSet SectorSet VertexPolytope IntervalMatrixSet UnionSet",
    "recheck": "certify_rate certify_gain",
    "network_gains": "bound_network_gain",
    "programs": "design_feedback",
}

__all__ = names_in(_HOME)

__getattr__, __dir__ = lazily(__name__, _HOME, __all__)
