"""Continuous time with noise in one of two coordinates: steps along the flow (K8-SL, docs/values.md).

From the bottom: ``setting`` (the problem), ``flows`` (the flow and its covariance, enclosed), ``remainders`` (what the
linearisation leaves out; how a path strays in a step), ``local_steps`` (both, box by box), ``smoothers``, ``smoothing``
(the noise of one step), ``images`` (of the flow), ``bands``, ``backward`` (one step), ``groundwork``, ``leaving``.

What is shown, step by step: u_t(x), the probability of leaving in the remaining steps, is at most U_t(x) + (number of
those steps) 16 spare. Here U_t is at least 1 where p has left its faces, moved inward by the largest distance of a path
from its chord, and at least 2 where q has crossed a noisy face and the noise has since done its share: a path that
crosses the face ends there with probability at least one half, whatever came before.
"""

from certbound.values.semilagrangian.leaving import bound_exits_by_steps
from certbound.values.semilagrangian.setting import serves

__all__ = ["bound_exits_by_steps", "serves"]
