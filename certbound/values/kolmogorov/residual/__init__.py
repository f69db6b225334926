"""The inequality that is proved: bounds of v_t + L v on cells and slabs, and the compiled loops beneath them."""

from __future__ import annotations

from certbound.values.kolmogorov.residual.images import Images
from certbound.values.kolmogorov.residual.slab_residual import (
    Generator,
    most_at_knots,
    residual_bound,
    rough_residual,
)

__all__ = ["Generator", "Images", "most_at_knots", "residual_bound", "rough_residual"]
