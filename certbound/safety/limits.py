"""What would be certified besides what was asked; every value that is returned was itself verified SAFE.

For a problem that is UNKNOWN or UNSAFE: the longest horizon, the strongest noise, the least widening of the safe set,
by bisection with the engine that came nearest. For one that is SAFE: the smallest probability.
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
from certbound.safety.decision import decide
from certbound.safety.portfolio import ENGINES
from certbound.safety.verdict import Verdict
from certbound.watch import poll, share_of_time

_HALVINGS = 5
_WIDENINGS = 4
_LONGEST = 5000  # times or steps, where the horizon is infinite
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
    *_, found = limits_so_far(verdict, cells=cells)
    return found


def limits_so_far(verdict: Verdict, *, cells: int | None = None) -> Iterator[Limits]:
    """What `find_limits` finds, each as it is found: delta first, which costs nothing.

    Under a limit of time (`certbound.watch`) noise, horizon and widening have a share of it each.
    """
    problem = verdict.problem
    if problem is None or verdict.status == "SAFE":
        raise ValueError(f"`verdict` must be one that is not SAFE, of a problem; got {verdict.summary()}")
    asked = [name for name, row in ENGINES.items() if name in verdict.answers and not row.dear]
    useful = [name for name in asked if verdict.answers[name].applicable]
    engine = min(useful, key=lambda name: verdict.answers[name].log10_delta, default="auto")

    def safe(changed: Callable[[], Problem]) -> bool:
        try:
            found = decide(changed(), method=engine, cells=cells)
        except (CertboundError, ValueError, ArithmeticError):
            return False
        poll("what would be SAFE")
        return found.status == "SAFE"

    level = power_above(verdict.log10_delta)
    found = Limits(delta=level if level < 1 else None, horizon=None, noise=None, widening=None)
    yield found
    searches = {
        "noise": _largest(lambda factor: safe(lambda: _noisier(problem, factor)), 1e-3),
        "horizon": _horizon(problem, safe),
        "widening": _widening(problem, verdict, safe),
    }
    for index, (name, values) in enumerate(searches.items()):
        with share_of_time(1 / (len(searches) - index)):
            for value in values:
                found = replace(found, **{name: value})
                yield found


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
                found = decide(problem, method=name)
                if found.log10_delta < level:
                    yield found
                    level = found.log10_delta
    step = max(-level, 1.0)
    while level > _LEAST_EXPONENT and step > 0.02 * -level:
        target = max(level - step, _LEAST_EXPONENT)
        try:
            found = decide(problem.replace(delta=10.0**target), method=method, cells=cells)
        except (CertboundError, ArithmeticError):
            step /= 3
            continue
        if found.status == "SAFE":
            yield found
            level, step = found.log10_delta, 2 * step
        else:
            step = min(step / 3, max(0.99 * (level - found.log10_delta), step / 10))


def _horizon(problem: Problem, safe: Callable[[Callable[[], Problem]], bool]) -> Iterator[float]:
    """Longer and longer horizons; of an infinite one, each four times the one before."""
    if problem.endless:
        length = 1
        while length < _LONGEST and safe(lambda: problem.replace(horizon=length)):  # noqa: B023  (called at once)
            yield float(length)
            length *= 4
        return
    if problem.system.time == "continuous":
        shares = _largest(lambda factor: safe(lambda: problem.replace(horizon=factor * problem.horizon)), 1 / 64)
        yield from (share * problem.horizon for share in shares)
        return
    low, high = 0, int(problem.horizon)
    while high - low > 1:
        middle = (low + high) // 2
        if safe(lambda: problem.replace(horizon=middle)):  # noqa: B023
            low = middle
            yield float(low)
        else:
            high = middle


def _largest(holds: Callable[[float], bool], least: float) -> Iterator[float]:
    """Factors in (least, 1) that hold, the last one nearly the largest, by bisection of the logarithm."""
    low, high = math.log(least), 0.0
    for _ in range(_HALVINGS + (low < -3)):
        middle = (low + high) / 2
        if holds(math.exp(middle)):
            low = middle
            yield math.exp(middle)
        else:
            high = middle


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
        object.__setattr__(system, "fixed_gain", factor * np.asarray(problem.system.noise_matrix))  # type: ignore[union-attr]
    return problem.replace(system=system)


def _widening(problem: Problem, verdict: Verdict, safe: Callable[[Callable[[], Problem]], bool]) -> Iterator[float]:
    """Smaller and smaller distances, from the verdict's own margin on."""
    if verdict.margin is None or not -math.inf < verdict.margin < 0:
        return
    low, high = 0.0, -1.05 * verdict.margin
    for _ in range(_WIDENINGS):
        if safe(lambda: _wider(problem, high)):  # noqa: B023
            break
        low, high = high, 2 * high
    else:
        return
    yield high
    for _ in range(_HALVINGS - 2):
        middle = (low + high) / 2
        if safe(lambda: _wider(problem, middle)):  # noqa: B023
            high = middle
            yield high
        else:
            low = middle


def _wider(problem: Problem, distance: float) -> Problem:
    """Every constraint, the domain and the target moved outward by ``distance``."""
    safe = [replace(c, region=c.region.grown(-distance if c.outside else distance)) for c in problem.safe]
    domain = None if problem.domain is None else problem.domain.grown(distance)
    target = problem.reach and replace(problem.reach, region=problem.reach.region.grown(distance))
    return problem.replace(safe=safe, domain=domain, reach=target)
