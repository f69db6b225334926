"""Proofs by value functions as data.

Those of discrete time: ``step_values``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import packed
from certbound.safety.certificates.step_values import (
    INWARD,
    ROOMS,
    check_starts,
    claimed,
    claimed_below,
    induction_proof,
    some_starts,
    stretched,
)
from certbound.values.chains import Drifting
from certbound.values.continuous import ExitBounds, Lasting, Payment, Rate, SureExit, Surface, bound_lasting
from certbound.values.discrete import FailureBounds

Proposed = tuple[Surface | tuple[Surface, ...], Payment]

_COARSE = (0.04, 0.01, 0.0)  # of log P, for a smaller file
_MORE_ROOM = 3  # in continuous time and two states
_MORE = 1.02  # of lam, which the checker need not prove
_BITS = {"values": (42, 30, 22), "rates": (24, 18, 14)}  # of a value, a slope, a second derivative and beyond
_MOST_PATCHES = 400_000
_LONGEST = 15 * 2**20  # characters of the packed arrays
_LASTING = (2**9, 2**11, 2**13)  # cells of a function of the state alone
_OFF = 1e-4  # of an eigenfunction's rate and ends, which the checker encloses in its own way
_MEANS = 4000  # parts over which the mean over a random start is taken


def values_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the checker knows no proof of what was bounded.
    """
    if isinstance(answer.details, FailureBounds):
        return induction_proof(problem, answer, attempt)
    if problem.ending and not isinstance(answer.details, ExitBounds):  # that counts leaving the domain as failing
        raise CertificateError("the checker counts leaving the domain as failing, and this bound does not.")
    if isinstance(answer.details, Lasting):
        return _lasting(problem, attempt, above=True)
    if isinstance(answer.details, Rate):
        return _leaving(problem, answer.details, above=True)
    if isinstance(answer.details, Drifting):
        drift = answer.details
        data = {"engine": "drift", "mirrored": drift.mirrored, "limit": exact(drift.limit), "rate": exact(drift.rate)}
        return data, min(drift.log / math.log(10) * (1 - 1e-12), 0.0), []
    found, effort = _exits_of(problem, answer), min(attempt, len(_COARSE) - 1)
    claim = claimed(answer.log10_delta, problem.delta, _room(problem, effort))
    return _passage(problem, found, effort), claim, []


def values_proof_below(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The same for the lower bound."""
    if answer.log10_lower is None:
        raise CertificateError("no lower bound was found.")
    if isinstance(answer.details, FailureBounds):
        return induction_proof(problem, answer, attempt, lower=True)
    if isinstance(answer.details, Lasting):
        return _lasting(problem, attempt, above=False)
    if isinstance(answer.details, Rate) and answer.details.fast is not None:
        return _leaving(problem, answer.details, above=False)
    if isinstance(answer.details, SureExit):
        sure = answer.details
        data = {
            "engine": "surely", "state": sure.state, "mirrored": sure.mirrored, "noise": exact(sure.noise * (1 - _OFF)),
            "drift": exact(sure.drift + _OFF * (1 + abs(sure.drift))), "side": "lower",
        }
        return data, 0.0, []
    check_starts(problem)
    found, effort = _exits_of(problem, answer), min(attempt, len(_COARSE) - 1)
    least = claimed_below(answer.log10_lower, problem.delta, _room(problem, effort))
    return _crossing(problem, found, effort), least, []


def _room(problem: Problem, effort: int) -> float:
    return ROOMS[effort] * (_MORE_ROOM if problem.system.dimension > 1 else 1)


def _exits_of(problem: Problem, answer: EngineAnswer) -> ExitBounds:
    """What was found in continuous time."""
    if not isinstance(answer.details, ExitBounds):
        raise CertificateError("certificates do not state rates of leaving.")
    if problem.endless:
        raise CertificateError("certificates state no bounds of infinite horizons that rest on grids.")
    return answer.details


def _lasting(problem: Problem, attempt: int, *, above: bool) -> Proof:
    """A function of the state alone: its slopes from one side."""
    found = bound_lasting(problem, cells=_LASTING[min(attempt, len(_LASTING) - 1)])
    low, high = found.slopes
    tail = found.tail if above else None
    data = {
        "engine": "lasting", "mirrored": bool(found.side), "edges": exact(found.edges),
        "slopes": exact(low if above else high),
        "tail": None if tail is None else {"kind": tail[0], "rate": exact(tail[1])},
    } | ({} if above else {"side": "lower"})
    level, room = (found.upper if above else found.lower) / math.log(10), 1e-9 * (1 + abs(found.upper))
    return data, (min(level + room, 0.0) if above else level - room), []


def _leaving(problem: Problem, known: Rate, *, above: bool) -> Proof:
    """How fast paths leave: an eigenfunction, a little less or more of it being claimed than what was proved."""
    found = known.slow if above else known.fast
    assert found is not None
    sign, horizon = -1.0 if above else 1.0, float(problem.horizon)
    start, extreme = (value * (1 + s * _OFF) for value, s in ((found.start, sign), (found.extreme, -sign)))
    rate = found.rate * (1 - sign * _OFF)
    data = {
        "engine": "rate", "low": exact(found.ends[0]), "high": exact(found.ends[1]), "rate": exact(rate),
        "coefficients": exact(found.coefficients), "start": exact(start), "extreme": exact(extreme),
    } | ({} if above else {"side": "lower"})
    still = math.log(start / extreme) - rate * horizon
    level = math.log10(max(-math.expm1(still), 1e-300))
    return data, min(level + 1e-9 if above else level - 1e-9, 0.0), []


def _passage(problem: Problem, found: ExitBounds, effort: int) -> dict[str, Any]:
    """Continuous time: V and what it is paid with; the coarsest one that costs little."""
    if problem.system.dimension == 3:
        raise CertificateError(
            "no certificate states a value function in continuous time and three states yet; `quadratic` and `barrier` "
            "write certificates of such problems."
        )
    if not found.proposed:
        raise CertificateError(
            "no value function was found that a certificate can state: in one state it states limits that do not move "
            "and noise that does not jump, in two states bounded boxes that do not move and whose faces paths cross, "
            "no obstacles and no oblique or curved limits."
        )
    if problem.reach is not None:
        return _entered(problem, *_enough(problem, found.proposed, effort), lower=False)
    best = min(payment.log for _, payment in found.proposed)
    share = _COARSE[effort] * max(1.0, -0.1 * best)
    stages, payment = next(pair for pair in found.proposed if pair[1].log <= best + share)
    raised = [surface.raised(payment.lift) for surface in _listed(stages)]
    return _staged(problem, [_past_domain(problem, surface) for surface in raised], payment)


def _crossing(problem: Problem, found: ExitBounds, effort: int) -> dict[str, Any]:
    """The same for the lower bound: the sides of the grid must lie beyond those of the safe set."""
    if not found.proposed_below:
        raise CertificateError("no value function was found that the checker knows, from below.")
    if problem.reach is not None:
        return _entered(problem, *_enough(problem, found.proposed_below, effort), lower=True)
    best = max(payment.log for _, payment in found.proposed_below)
    share = _COARSE[effort] * max(1.0, -0.1 * best)
    stages, payment = next(pair for pair in found.proposed_below if pair[1].log >= best - share)
    moved = _beyond(problem, _listed(stages))
    data = _staged(problem, moved, payment)
    data["side"] = "lower"
    if not problem.initial.random:
        data["starts"] = exact(some_starts(problem))
    return data


def _enough(problem: Problem, pairs: Sequence[Proposed], effort: int) -> Proposed:
    """The coarsest value function of a target whose bound is about that of the last one, the best."""
    arriving = problem.system.dimension == 1
    levels = [math.log(-math.expm1(one.log)) if arriving else one.log for _, one in pairs]
    share = _COARSE[effort] * max(1.0, -0.1 * levels[-1])
    return next(pair for pair, level in zip(pairs, levels) if abs(level - levels[-1]) <= share)


def _listed(stages: Surface | tuple[Surface, ...]) -> tuple[Surface, ...]:
    return (stages,) if isinstance(stages, Surface) else stages


def _past_domain(problem: Problem, surface: Surface) -> Surface:
    """With sides at which paths end, as they leave the domain, a little beyond it."""
    if not problem.ending or problem.domain is None:
        return surface
    axes = [axis.copy() for axis in surface.axes]
    for axis, low, high in zip(axes, problem.domain.low, problem.domain.high):
        step = INWARD * (axis[-1] - axis[0])
        axis[[0, -1]] += np.array([-step, step]) * (axis[[0, -1]] == np.array([low, high]))
    return replace(surface, axes=tuple(axes))


def _beyond(problem: Problem, stages: Sequence[Surface]) -> list[Surface]:
    """Surfaces of a lower bound whose sides, and the nodes on faces of constraints, lie a little farther out."""
    n, marks = problem.system.dimension, list[tuple[int, float, int]]()
    steps = [INWARD * max(float(np.ptp(surface.axes[axis])) for surface in stages) for axis in range(n)]
    for constraint in problem.constraints if _windowed(problem) else ():
        around = constraint.region.hull()
        for place, *ends in zip(constraint.region.places(n), around.lo.tolist(), around.hi.tolist()):
            marks += [(place, end, sign) for end, sign in zip(ends, (-1, 1))]
    found = []
    for surface in stages:
        axes = []
        for place, (axis, step) in enumerate(zip(surface.axes, steps)):
            moved = axis.copy()
            ends = [problem.domain.low[place], problem.domain.high[place]] if problem.ending and problem.domain else []
            moved[[0, -1]] += np.array([-step, step]) * ([end not in ends for end in axis[[0, -1]]])
            for _, end, sign in (mark for mark in marks if mark[0] == place):
                moved[1:-1] += sign * step * (np.abs(axis[1:-1] - end) <= 1e-14 * (1 + abs(end)))
            axes.append(moved)
        found.append(replace(surface, axes=tuple(axes)))
    return found


def _windowed(problem: Problem) -> bool:
    return any(constraint.during is not None for constraint in problem.constraints)


def _staged(problem: Problem, stages: Sequence[Surface], payment: Payment) -> dict[str, Any]:
    """Value functions of stages that follow each other; of one, where no constraint has a window."""
    if not _windowed(problem):
        return _stated(problem, stages[0], payment)
    shared, own, first = dict[str, Any](), list[dict[str, Any]](), 0
    for surface in stages:
        data, last = _stated(problem, surface, payment), first + surface.slabs
        own.append({name: data.pop(name) for name in ("axes", "times", "values", "rates")})
        own[-1] |= {name: data.pop(name)[first:last] for name in ("lam", "eps")}
        shared, first = data, last
    return shared | {"stages": own}


def _entered(
    problem: Problem, stages: Surface | tuple[Surface, ...], payment: Payment, *, lower: bool
) -> dict[str, Any]:
    """A value function of a target. From below the grid keeps off the target, or has small cells around it."""
    assert problem.reach is not None
    (surface,) = (one.raised(payment.lift) for one in _listed(stages))
    if lower:
        around, axes = problem.reach.region.hull(), [_spread(axis) for axis in surface.axes]
        places = problem.reach.region.places(problem.system.dimension)
        for place, *ends in zip(places, around.lo.tolist(), around.hi.tolist()):
            step = INWARD * (axes[place][-1] - axes[place][0])
            for end, sign in zip(ends, (-1, 1)):
                if problem.system.dimension == 1 and np.min(np.abs(axes[0][[0, -1]] - end)) <= 3 * step:
                    axes[0] = np.where(np.abs(axes[0] - end) <= 3 * step, end + sign * step, axes[0])
                else:
                    axes[place] = axes[place] + sign * step * (surface.axes[place] == end)
        surface = replace(surface, axes=tuple(axes))
    data = _stated(problem, surface, payment)
    return data | ({"side": "lower", "starts": exact(some_starts(problem))} if lower else {})


def _stated(problem: Problem, surface: Surface, payment: Payment) -> dict[str, Any]:
    """A value function in continuous time."""
    terms = payment.terms
    if terms is None:
        raise CertificateError("the value function bounds nothing.")
    rates = np.concatenate([surface.start_rates, surface.end_rates[-1:]])
    if surface.slabs * math.prod(surface.cells) > _MOST_PATCHES:
        raise CertificateError(f"the value function has more than {_MOST_PATCHES} patches: too many for a certificate.")
    values, slopes = _packed(surface.values, _BITS["values"]), _packed(rates, _BITS["rates"])
    if len(values) + len(slopes) > _LONGEST:
        raise CertificateError(f"the value function takes over {_LONGEST // 2**20} MiB: too much for a certificate.")
    data = {
        "engine": "values",
        "axes": [exact(axis) for axis in surface.axes],
        "times": exact(surface.times),
        "values": values,
        "rates": slopes,
        "edges": exact(terms.levels.edges),
        "m": exact(terms.levels.m),
        "q": exact(terms.levels.q),
        "lam": exact(terms.lam * _MORE),
        "eps": exact(terms.eps),
    }
    return data | ({"pieces": max(1, min(16, _MEANS // surface.cells[0]))} if problem.initial.random else {})


def _packed(numbers: Array, bits: tuple[int, ...]) -> str:
    """Numbers as one compressed text.

    By the order of the derivative they keep so many bits: V is as smooth with any, and nearly as good with these.
    """
    order = np.zeros(numbers.shape, dtype=int)
    for axis in range(2, numbers.ndim, 2):
        order += np.arange(3).reshape([3 if k == axis else 1 for k in range(numbers.ndim)])
    step = np.frexp(numbers)[1] - np.asarray(bits)[np.minimum(order, len(bits) - 1)]
    rounded = np.ldexp(np.rint(np.ldexp(numbers, -step)), step)
    return packed(rounded)


def _spread(edges: Array) -> Array:
    return stretched(edges, INWARD)


