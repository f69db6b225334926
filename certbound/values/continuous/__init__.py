"""Value functions in continuous time: exit probabilities from both sides (Theorem K8-CT, docs/values.md).

``hypotheses`` says which function proves which hypothesis.
"""

from certbound.values.continuous.exits import ExitBounds, bound_exits, chart_exits, chart_slabs_of, is_confined
from certbound.values.continuous.line import (
    Lasting,
    Rate,
    SureExit,
    bound_lasting,
    bound_mean_time,
    bound_rate,
    leaves_surely,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.surface import Surface
from certbound.values.room import faces_of, starts_of

__all__ = [
    "ExitBounds", "Lasting", "Payment", "Rate", "SureExit", "Surface", "bound_exits", "bound_lasting",
    "bound_mean_time", "bound_rate", "chart_exits", "chart_slabs_of", "faces_of", "is_confined", "leaves_surely",
    "starts_of",
]
