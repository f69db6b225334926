"""What an engine answers, before a verdict is made of it, and the shape of the proof that a certificate states."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.display import Shown, rounded
from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.reach.sets import ReachTube, limit_names
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.norms import Norm
from certbound.tubes.constants import Constants

_NEAR = math.log10(4)  # of two bounds, that an engine which knows both may decide between with more time

Proof = tuple[dict[str, Any], float, list[str]]
"""The proof's data, the claimed log10 of the probability, and what is assumed."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Deviation(Shown):
    """Upper bounds on the stochastic deviation S = X - x at the target probability, piece by piece.

    Parameters
    ----------
    times : ndarray, shape (K + 1,)
        Piece k is [times[k], times[k + 1]] with both ends; in discrete time the steps k and k + 1.
    radius : ndarray, shape (K,)
        Of the Euclidean size of S.
    extent : ndarray, shape (K, n)
        Of |S_i| for every state.
    """

    times: Array
    radius: Array
    extent: Array

    def summary(self) -> str:
        """The largest radius, in one line."""
        largest = rounded(float(np.max(self.radius)), up=True)
        return f"stochastic deviation of at most {largest} in {len(self.radius)} pieces of time"

    def to_dict(self) -> dict[str, Any]:
        """``times``, ``radius`` and ``extent`` as lists."""
        return {name: getattr(self, name).tolist() for name in ("times", "radius", "extent")}

    def to_columns(self, states: Sequence[str] | None = None) -> dict[str, Array]:
        """Columns start, end, radius and one per state, as ``pandas.DataFrame`` takes them."""
        names = [f"x{k + 1}" for k in range(self.extent.shape[1])] if states is None else states
        columns = {"start": self.times[:-1], "end": self.times[1:], "radius": self.radius}
        return columns | {f"extent_{name}": self.extent[:, k] for k, name in enumerate(names)}

    @classmethod
    def of_ball(cls, times: Array, radius: Array, norm: Norm) -> Deviation:
        """From radii in the norm of a metric."""
        eye = np.eye(norm.dimension)
        size = np.nextafter(radius * norm.section(eye), np.inf)
        extent = np.nextafter(radius[:, None] * norm.dual(eye), np.inf)
        return cls(times=times, radius=size, extent=extent)


Limit = tuple[int, int]
"""A limit: the number of its constraint (-1: the model's domain), and its own among those of that (`limit_names`)."""


@dataclass(frozen=True, kw_only=True)
class LimitBounds:
    """Bounds of the probability that a path fails by one limit: that it is broken where the first constraint is.

    Parameters
    ----------
    constraint : str
        The limit: a face of a set to stay in, or a constraint as a whole.
    log10_upper : float or None
        log10 of a bound from above, for every start; None where nothing is proved.
    log10_lower : float or None
        The same from below, for some start; None where nothing is proved.
    """

    constraint: str
    log10_upper: float | None
    log10_lower: float | None


def limits_of(problem: Problem) -> dict[Limit, str]:
    """The limits by which a path can fail, each with its name; the domain is none where paths end at it."""
    kept = problem.safe if problem.ending else problem.kept
    return {
        (number if number < len(problem.safe) else -1, place): name
        for number, constraint in enumerate(kept) for place, name in enumerate(limit_names(constraint, problem.system))
    }  # fmt: skip


def bound_limits(
    names: Mapping[Limit, str], upper: float, lower: float | None, *, uppers: Sequence[Mapping[Limit, float]] = (),
    lowers: Mapping[Limit, float] | None = None,
) -> tuple[LimitBounds, ...]:
    """What is proved of every limit; all in log10.

    ``upper`` and ``lower`` bound the probability of failing at all, and nothing but these limits fails; ``uppers`` and
    ``lowers`` are what is proved of single limits. A path that fails meets one of the limits, so that P(this one) >=
    P(failing) - sum of P(another one).
    """
    most = {limit: min([upper, 0.0, *(one[limit] for one in uppers if limit in one)]) for limit in names}
    found = []
    for limit, name in names.items():
        least = -math.inf if lowers is None else lowers.get(limit, -math.inf)
        if lower is not None:
            others = sum(10.0**value for other, value in most.items() if other != limit)
            rest = 10.0**lower * (1 - 1e-12) - others * (1 + 1e-12)
            least = max(least, math.log10(rest) * (1 + 1e-14) if rest > 0 else -math.inf)
        found.append(LimitBounds(
            constraint=name, log10_upper=most[limit] if most[limit] < 0 else None,
            log10_lower=least if least > -math.inf else None,
        ))  # fmt: skip
    return tuple(found)


@dataclass(frozen=True, eq=False, kw_only=True)
class EngineAnswer:
    """The best that one engine could prove.

    Parameters
    ----------
    log10_delta : float
        log10 of an upper bound of the probability that a constraint is broken: finite, at most 0 (0: nothing).
    log10_lower : float or None
        log10 of a lower bound of that probability from some start, None where the engine has none.
    margin : float or None
        Least Euclidean room left at the target probability, negative when it does not fit; None if unknown.
    time, constraint
        Where that is, and for which constraint (None if nothing could be evaluated).
    reason : str
        One or two sentences for humans: what was proved, or what stood in the way and what would work.
    below : str
        Of ``reason`` what shows the lower bound, where that was found before the rest.
    tube : Any
        The stochastic tube at the target probability, if the engine has one.
    reach : ReachTube or None
        Noise-free reach tube.
    constants : Constants or None
        What the tube rests on.
    deviation : Deviation or None
        The stochastic deviation as plain bounds.
    applicable : bool
        False: the engine does not fit the problem, ``reason`` says why.
    method : str
        Name for the verdict.
    certified : bool
        False where the probability is not of trajectory level (one-time bounds): such an answer is never SAFE.
    assumption : str
        What the answer rests on besides the problem (stated constants); empty when nothing.
    foresight : bool
        Whether the probability covers even disturbances that see coming noise; the others are always covered.
    hit : float or None
        Where the problem has a target: the one time at which the answer has it met; None where it counts all of them.
    details : Any
        Whatever a certificate needs of the engine.
    conclusive : bool
        Whether no other engine can do much better: slow refinements of others may be left out.
    truncated : bool
        Whether an ellipsoid of starts stands for a random start, whose other values count as failing.
    effort : float or None
        The effort that was spent (`Request`), where the engine plans its work; None: what was asked for.
    hoped : float or None
        About log10 of the lower bound that a request from ``below`` would lead to; none was looked for.
    by_limit : mapping of Limit to float, or None
        log10 of bounds of the probability that a path leaves first through a limit, where the engine knows them.
    """

    log10_delta: float = 0.0
    log10_lower: float | None = None
    margin: float | None = None
    time: float | None = None
    constraint: str | None = None
    reason: str = ""
    below: str = ""
    tube: Any = None
    reach: ReachTube | None = None
    constants: Constants | None = None
    deviation: Deviation | None = None
    applicable: bool = True
    method: str = ""
    certified: bool = True
    assumption: str = ""
    foresight: bool = False
    hit: float | None = None
    details: Any = None
    conclusive: bool = False
    truncated: bool = False
    effort: float | None = None
    hoped: float | None = None
    by_limit: Mapping[Limit, float] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """What an engine is asked besides the problem: made once, and each engine reads what it knows.

    ``method`` is "auto", or a tube method by name; ``cells`` are parts along each side of the initial set;
    ``constants`` are used instead of certified ones. ``quick``: another engine has proved SAFE or been conclusive, and
    what is slow and then seldom decides may be left out. Not ``thorough``: an engine may spare itself, as it is asked
    again where that matters, with the ``details`` of its first answer as ``before``. ``first``: it may end with the
    first bound that it finds, and goes on from there when it is asked again. ``effort``: the work that it is asked for,
    as a multiple of what it does where it is asked alone; its pace is known then, so that it plans for just that. None:
    as much of 1 as the engine itself takes to fit into the time.
    ``below``: a lower bound is all that is wanted, where that is less work; ``above``: an upper one.
    ``found`` takes an answer that holds already while the engine looks for a better one: it stands where time ends the
    search (`certbound.watch`).
    """

    method: str = "auto"
    cells: int | None = None
    constants: Constants | None = None
    quick: bool = False
    thorough: bool = True
    first: bool = False
    effort: float | None = None
    below: bool = False
    above: bool = False
    before: Any = None
    found: Callable[[EngineAnswer], object] = lambda answer: None

    @property
    def at_length(self) -> bool:
        """Whether more is asked for than an engine does by itself."""
        return self.effort is not None and self.effort > 1


SPARED = "not asked, since another engine had answered."
"""The reason of an engine that was left out."""

AS_IT_IS = Request()
"""Nothing but the problem."""


def exact(value: Any) -> Any:
    """Floats as hexadecimal strings, arrays as nested lists of them."""
    if isinstance(value, (float, np.floating)):
        if not np.isfinite(value):
            raise CertificateError(f"the proof holds the number {value}, which no certificate can state.")
        return float(value).hex()
    if isinstance(value, np.ndarray):
        return exact(value.tolist())
    if isinstance(value, (list, tuple)):
        return [exact(item) for item in value]
    return value


class Answered(Protocol):
    """What a certificate needs of a verdict."""

    @property
    def status(self) -> str:
        """SAFE, UNKNOWN or UNSAFE."""

    @property
    def reason(self) -> str:
        """In one sentence."""

    @property
    def answers(self) -> Mapping[str, EngineAnswer]:
        """What each engine answered, by its name."""


def is_at_most(log10_delta: float, target: float) -> bool:
    """Whether 10**log10_delta <= target is proved, in ball arithmetic."""
    with precision():
        return log10_delta <= lower(arb(target).log() / arb(10).log())


def is_more_than(log10_lower: float, target: float) -> bool:
    """Whether 10**log10_lower > target is proved, in ball arithmetic."""
    with precision():
        return log10_lower > upper(arb(target).log() / arb(10).log())


def may_decide(answer: EngineAnswer, target: float) -> bool:
    """Whether an engine's bounds are near each other with the target in between, so that more time may decide."""
    if not answer.applicable or answer.log10_lower is None:
        return False
    return answer.log10_lower <= math.log10(target) < answer.log10_delta <= answer.log10_lower + _NEAR


def with_lower(answer: EngineAnswer, before: EngineAnswer | None) -> EngineAnswer:
    """The answer with the lower bound of an earlier one of the same engine, where that is more."""
    if before is None or before.log10_lower is None:
        return answer
    if not answer.applicable:
        return before
    if answer.log10_lower is not None and answer.log10_lower >= before.log10_lower:
        return answer
    below = before.below or before.reason
    words = f"{answer.reason.rstrip('.')}; {below}" if answer.reason else below
    return replace(answer, log10_lower=before.log10_lower, reason=words, below=below)


def settled(log10_delta: float, target: float) -> float:
    """``log10_delta`` such that comparing floats, ``<= math.log10(target)``, says what `is_at_most` says."""
    value = min(max(log10_delta, -1e12), 0.0) + 0.0
    if is_at_most(value, target):
        return min(value, math.log10(target))
    return max(value, math.nextafter(math.log10(target), math.inf))
