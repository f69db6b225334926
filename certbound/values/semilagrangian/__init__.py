"""Continuous time with noise in one coordinate of two or three: steps along the flow (K8-SL, docs/values.md).

From the bottom: ``confines`` (what bounds the states), ``noisy_axis`` (the problem), ``flows`` (the flow and its
covariance, enclosed), ``remainders`` (what the linearisation leaves out; how a path strays in a step), ``local_steps``
(both, box by box), ``smoothers``, ``smoothing`` (the noise of one step), ``landings`` (of the flow), ``bands``,
``mirrors`` (what is beyond a noisy face), ``obstacles`` (passed within a step), ``backward`` (one step),
``groundwork``, ``carried`` (three coordinates), ``leaving``.
"""

from certbound.values.semilagrangian.leaving import bound_exits_by_steps
from certbound.values.semilagrangian.noisy_axis import serves

__all__ = ["bound_exits_by_steps", "serves"]
