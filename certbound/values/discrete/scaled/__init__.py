"""Noise that the state multiplies: means of value functions where mean and variances move with the state.

``scaled_motion`` (mean and variances with their derivatives on a grid), ``scaled_means`` (integrals from every node,
and bounds of second derivatives over the cells).
"""

from certbound.values.discrete.scaled.scaled_means import ScaledTransition
from certbound.values.discrete.scaled.scaled_motion import ScaledDynamics, dynamics_of, noise_of

__all__ = ["ScaledDynamics", "ScaledTransition", "dynamics_of", "noise_of"]
