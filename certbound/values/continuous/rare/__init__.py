"""Two states, failing rarer than about e^-20: logarithms, corrected by what their proofs pay."""

from certbound.values.continuous.rare.rare_above import RAREST, bound_rare

__all__ = ["RAREST", "bound_rare"]
