"""Discrete time, one or two states, noise in pieces: bounds that are constant on the cells of a grid.

Coarser than ``discrete``, and for what that does not serve: noise that multiplies the state or leaves one without any,
laws given by tables, targets that are to be stayed in. From the bottom: ``pieces`` (the noise as boxes with
probabilities), ``extremes`` (the largest value over many boxes of cells), ``abstraction`` (the answer); by itself
``drifting`` (for ever, away from the only limit).
"""

from certbound.values.chains.abstraction import bound_chain, chain_grid
from certbound.values.chains.drifting import Drifting, bound_by_drift, bound_drifting

__all__ = ["Drifting", "bound_by_drift", "bound_chain", "bound_drifting", "chain_grid"]
