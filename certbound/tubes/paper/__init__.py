"""The paper's formulas, as the baselines to compare with, and its martingales, for processes of the user's own."""

from __future__ import annotations

from certbound.tubes.paper.affine_martingale import AffineMartingale, estimate_affine_excess
from certbound.tubes.paper.baselines import BASELINES, baseline_tube, check_method
from certbound.tubes.paper.energy import log_energy

__all__ = ["AffineMartingale", "baseline_tube", "BASELINES", "check_method", "estimate_affine_excess", "log_energy"]
