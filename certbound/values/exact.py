"""Models of one state as polynomials, and sets as intervals, exactly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from flint import fmpq, fmpq_poly

from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import Tape
from certbound.problem.sets import Quadratic, Region


def polynomial_of(tape: Tape, sign: float) -> fmpq_poly | None:
    """A function of one state as a polynomial of y = sign * x, exactly, times the sign for a drift; None for others."""
    try:
        (found,) = tape.evaluate(_EXACT, [None, fmpq_poly([0, int(sign)])])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    value = fmpq_poly([found]) if isinstance(found, fmpq) else found
    return value * int(sign) if tape.shape == (1,) and isinstance(value, fmpq_poly) else value


def _power(base: Any, exponent: float) -> Any:
    if exponent < 0 or exponent != int(exponent):
        raise ValueError("no polynomial.")
    return base ** int(exponent)


def _over(x: Any, y: Any) -> Any:
    if isinstance(y, fmpq_poly):
        raise ValueError("no polynomial.")
    return x * (1 / y)


_EXACT: dict[str, Any] = {
    "const": lambda value: fmpq(*float(value).as_integer_ratio()), "add": lambda x, y: x + y, "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y, "neg": lambda x: -x, "sq": lambda x: x * x, "pow": _power, "div": _over,
}  # fmt: skip
"""The operations of polynomials; a function of time is none."""


def interval_of(region: Region) -> tuple[float, float]:
    """A set of one state as an interval that is exactly known; InfeasibleError of others."""
    refused = InfeasibleError("value functions of infinite horizons need boxes and half-spaces that stand still.")
    if region.moving:
        raise refused
    centre = float(np.ravel(region.center_at())[0]) if region.center is not None else 0.0
    match region.form:
        case Quadratic() as form if form.even and form.dimension == 1 and centre == 0.0:
            return -form.radius, form.radius
    try:
        normals, bounds = region.halfspaces()
    except (TypeError, ValueError, EnclosureError) as error:
        raise refused from error
    if centre != 0.0 or not np.all(np.abs(normals) == 1.0):
        raise refused
    low, high = -math.inf, math.inf
    for normal, bound in zip(np.ravel(normals).tolist(), np.ravel(bounds).tolist()):
        low, high = (low, min(high, bound)) if normal > 0 else (max(low, -bound), high)
    return low, high
