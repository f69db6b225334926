"""Exit probabilities, deviations and paths from simulation, with confidence limits."""

from __future__ import annotations

from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.paths import sample_paths
from certbound.simulation.estimates.splitting import simulate_rare_exits
from certbound.simulation.estimates.statistics import bound_binomial

__all__ = ["bound_binomial", "sample_paths", "simulate_exits", "simulate_rare_exits"]
