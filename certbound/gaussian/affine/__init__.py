"""Exit probabilities of affine models with additive Gaussian noise, at any stiffness and horizon."""

from __future__ import annotations

from certbound.gaussian.affine.below import bound_exits_below
from certbound.gaussian.affine.law import AffineLaw
from certbound.gaussian.affine.stated_pieces import Stated, stated_exits
from certbound.gaussian.affine.trace import Inaccurate
from certbound.gaussian.affine.upper import Limit, bound_exits

__all__ = ["AffineLaw", "bound_exits", "bound_exits_below", "Inaccurate", "Limit", "Stated", "stated_exits"]
