"""Value functions in continuous time: exit probabilities from both sides (Theorem K8-CT, docs/values.md).

``hypotheses`` says which function proves which hypothesis.
"""

from certbound.values.continuous.exits import ExitBounds, bound_exits, chart_exits

__all__ = ["ExitBounds", "bound_exits", "chart_exits"]
