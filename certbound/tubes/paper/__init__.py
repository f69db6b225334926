"""The paper's formulas, as the baselines to compare with."""

from __future__ import annotations

from certbound.tubes.paper.baselines import BASELINES, baseline_tube, check_method

__all__ = ["baseline_tube", "BASELINES", "check_method"]
