"""Vectorised, outward-rounded interval arithmetic on NumPy arrays.

>>> import numpy as np
>>> from certbound.rigor import intervals as iv
>>> x = iv.Interval(np.array([0.0, -np.inf]), np.array([2.0, np.inf]))
>>> iv.tanh(x).hi.tolist()[1], iv.cos(x).lo.tolist()[1]
(1.0, -1.0)

The parts: ``arithmetic`` (the type, + - * / @), ``elementary`` (functions),
``rounding`` (the error model).
"""

from certbound.rigor.arithmetic import Interval, IntervalLike, concatenate, matmul, stack
from certbound.rigor.elementary import (
    abs_,
    acos,
    asin,
    atan,
    atan2,
    cos,
    cosh,
    exp,
    hypot,
    log,
    maximum,
    minimum,
    pow_,
    sin,
    sinh,
    sq,
    sqrt,
    tan,
    tanh,
)
from certbound.rigor.rounding import down, matmul_error, up

__all__ = [
    "Interval", "IntervalLike", "abs_", "acos", "asin", "atan", "atan2", "concatenate", "cos", "cosh", "down", "exp",
    "hypot", "log", "matmul", "matmul_error", "maximum", "minimum", "pow_", "sin", "sinh", "sq", "sqrt", "stack", "tan",
    "tanh", "up",
]  # fmt: skip
