"""What would be certified besides what was asked; every value that is returned was itself verified SAFE.

For a problem that is UNKNOWN: the longest horizon, the strongest noise, the least widening of the safe set, by
bisection with the engine that came nearest. For one that is SAFE: the smallest probability.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.display import power_above, rounded
from certbound.errors import CertboundError
from certbound.problem.model import Tape, substitute, trace
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, System
from certbound.safety.portfolio import ENGINES
from certbound.safety.verification import Verdict, verify_safety

_HALVINGS = 5
_WIDENINGS = 4
_LEAST_EXPONENT = -300.0  # deltas are floats


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What would be SAFE, each with everything else as asked; None where nothing was found.

    ``delta`` is the probability that is certified as it stands, ``horizon`` one that is SAFE, ``noise`` a factor on the
    noise, ``widening`` a distance by which every constraint would have to give way (Euclidean, in the states' units).
    """

    delta: float | None
    horizon: float | None
    noise: float | None
    widening: float | None

    def summary(self) -> str:
        """One sentence; every number is rounded to the side on which SAFE was proved."""
        found = [
            (self.delta, True, 3, "delta = {}"),
            (self.horizon, False, 4, "a horizon of {}"),
            (self.noise, False, 3, "noise {} times as large"),
            (self.widening, True, 3, "constraints moved outward by {}"),
        ]
        words = [text.format(rounded(value, up=up, digits=n)) for value, up, n, text in found if value is not None]
        return f"SAFE would be: {', or '.join(words)}." if words else "Nothing near the problem was certified."


def find_limits(verdict: Verdict, *, cells: int | None = None) -> Limits:
    """Bisect for what would be SAFE, of a verdict that is not; ``cells`` are parts along each side of the initial set.

    A SAFE verdict, or one that knows no problem, is a ValueError.
    """
    problem = verdict.problem
    if problem is None or verdict.status == "SAFE":
        raise ValueError(f"`verdict` must be one that is not SAFE, of a problem; got {verdict.summary()}")
    asked = [name for name, row in ENGINES.items() if name in verdict.answers and not row.dear]
    useful = [name for name in asked if verdict.answers[name].applicable]
    engine = min(useful, key=lambda name: verdict.answers[name].log10_delta, default="auto")

    def safe(changed: Callable[[], Problem]) -> bool:
        try:
            return verify_safety(changed(), method=engine, cells=cells).status == "SAFE"
        except (CertboundError, ValueError, ArithmeticError):
            return False

    level = power_above(verdict.log10_delta)
    return Limits(
        delta=level if level < 1 else None,
        horizon=_horizon(problem, safe),
        noise=_largest(lambda factor: safe(lambda: _noisier(problem, factor)), 1e-3),
        widening=_widening(problem, verdict, safe),
    )


def smaller_verdicts(verdict: Verdict, *, method: str = "auto", cells: int | None = None) -> Iterator[Verdict]:
    """SAFE verdicts of the same problem at smaller and smaller delta, each as it is found.

    The engines share delta among the events that they count, so that a smaller one that is asked for often gives a
    smaller bound: the exponent is doubled while that succeeds, and then bisected. A verdict that is not SAFE, or knows
    no problem, is a ValueError.
    """
    problem = verdict.problem
    if problem is None or verdict.status != "SAFE":
        raise ValueError(f"`verdict` must be a SAFE one, of a problem; got {verdict.summary()}")
    level = min(verdict.log10_delta, math.log10(problem.delta))
    if method == "auto":
        method = min(verdict.answers, key=lambda name: verdict.answers[name].log10_delta)
        for name in (name for name, row in ENGINES.items() if row.reserve):
            asked = verdict.answers.get(name)
            if asked is None or not asked.applicable:  # left out so far, unless it refuses; its bound knows no delta
                found = verify_safety(problem, method=name)
                if found.log10_delta < level:
                    yield found
                    level = found.log10_delta
    step = max(-level, 1.0)
    while level > _LEAST_EXPONENT and step > 0.02 * -level:
        target = max(level - step, _LEAST_EXPONENT)
        try:
            found = verify_safety(problem.replace(delta=10.0**target), method=method, cells=cells)
        except (CertboundError, ArithmeticError):
            step /= 3
            continue
        if found.status == "SAFE":
            yield found
            level, step = found.log10_delta, 2 * step
        else:
            step = min(step / 3, max(0.99 * (level - found.log10_delta), step / 10))


def _horizon(problem: Problem, safe: Callable[[Callable[[], Problem]], bool]) -> float | None:
    if problem.system.time == "continuous":
        share = _largest(lambda factor: safe(lambda: problem.replace(horizon=factor * problem.horizon)), 1 / 64)
        return None if share is None else share * problem.horizon
    low, high = 0, int(problem.horizon)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if safe(lambda: problem.replace(horizon=middle)) else (low, middle)  # noqa: B023  (called at once)
    return float(low) if low else None


def _largest(holds: Callable[[float], bool], least: float) -> float | None:
    """Nearly the largest factor in (least, 1) that holds, by bisection of its logarithm."""
    low, high = math.log(least), 0.0
    found = None
    for _ in range(_HALVINGS + (low < -3)):
        middle = (low + high) / 2
        if holds(math.exp(middle)):
            found, low = math.exp(middle), middle
        else:
            high = middle
    return found


def _noisier(problem: Problem, factor: float) -> Problem:
    """The problem with its noise times ``factor``."""
    system: System = copy.copy(problem.system)
    if isinstance(system, ContinuousSystem):
        value: Any = system.diffusion
        if isinstance(value, Tape):
            rows, columns = value.shape
            names = [f"g {k}" for k in range(rows * columns)]
            scaled = trace(lambda g: [[factor * g[i * columns + j] for j in range(columns)] for i in range(rows)],
                           {"g": names})  # fmt: skip
            value = substitute(scaled, value.inputs, {name: (value, k) for k, name in enumerate(names)})
        else:
            value = factor * value
        object.__setattr__(system, "diffusion", value)
    else:
        object.__setattr__(system, "noise_matrix", factor * np.asarray(problem.system.noise_matrix))  # type: ignore[union-attr]
    return problem.replace(system=system)


def _widening(problem: Problem, verdict: Verdict, safe: Callable[[Callable[[], Problem]], bool]) -> float | None:
    """Nearly the least distance, from the verdict's own margin on."""
    if verdict.margin is None or not -math.inf < verdict.margin < 0:
        return None
    low, high = 0.0, -1.05 * verdict.margin
    for _ in range(_WIDENINGS):
        if safe(lambda: _wider(problem, high)):  # noqa: B023
            break
        low, high = high, 2 * high
    else:
        return None
    for _ in range(_HALVINGS - 2):
        middle = (low + high) / 2
        low, high = (low, middle) if safe(lambda: _wider(problem, middle)) else (middle, high)  # noqa: B023
    return high


def _wider(problem: Problem, distance: float) -> Problem:
    """Every constraint and the domain moved outward by ``distance``."""
    safe = [replace(c, region=c.region.grown(-distance if c.outside else distance)) for c in problem.safe]
    domain = None if problem.domain is None else problem.domain.grown(distance)
    return problem.replace(safe=safe, domain=domain)
