"""Engines asked in logarithms first, where the noise of a state is in proportion to it and limits keep it positive.

Until a limit is broken Y_i = log X_i solves the equation that Ito's formula gives, and Y breaks a limit x_i <= b where
y_i > log b: the same paths fail. Noise that is in proportion is constant there, and what falls off as a power of x_i
does so exponentially. Limits are rounded inward and starts outward, so that only upper bounds are kept. The disturbance
must not see coming noise, as Ito's formula asks for.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import Tape, in_logarithms, proportional
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Faces, HalfSpace, Inside, Polytope
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.balls import lower, precision, upper
from certbound.safety.answers import AS_IT_IS, EngineAnswer, Request, is_at_most
from certbound.safety.engines.turning import is_plain

Prove = Callable[[Problem, Request], EngineAnswer]

_LONGEST = 300  # operations, which recursion goes through
_UNASKED = EngineAnswer(applicable=False, reason="not asked in the states, as their logarithms did.")


@dataclass(frozen=True, eq=False, kw_only=True)
class Logarithmic:
    """What was proved in logarithms of the states ``places``: the answer to the problem stated so, and the plain one."""

    places: tuple[int, ...]
    problem: Problem
    answer: EngineAnswer
    plain: EngineAnswer


def by_logarithms(prove: Prove, *, again: bool = False) -> Prove:
    """The engine, asked in logarithms first where there are states of that kind, and as it is where that is too weak.

    ``again``: that comes only once it is asked thoroughly.
    """

    def proved(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
        before = asked.before if isinstance(asked.before, Logarithmic) else None
        other = None
        if not asked.quick and problem.system.dimension > 1:
            with contextlib.suppress(InfeasibleError):
                other = logarithmic(problem)
        if other is None:
            return prove(problem, asked)
        places, turned = other
        names = ", ".join(f"log {problem.system.states[i]}" for i in places)

        def stated(answer: EngineAnswer, plain: EngineAnswer = _UNASKED) -> EngineAnswer:
            details = Logarithmic(places=places, problem=turned, answer=answer, plain=plain)
            return replace(
                plain, applicable=answer.applicable and answer.certified, log10_delta=answer.log10_delta, margin=None,
                time=None, constraint=None, method=answer.method, foresight=False, conclusive=plain.conclusive,
                reason=f"{answer.reason.rstrip('.')}; in the coordinates {names}.", details=details,
            )  # fmt: skip

        inner = replace(asked, before=before and before.answer.details, found=lambda answer: asked.found(stated(answer)))
        found: EngineAnswer | None = None
        with contextlib.suppress(InfeasibleError, EnclosureError):
            found = prove(turned, inner)
        useful = found is not None and found.applicable and found.certified and found.log10_delta < 0
        if found is not None and useful:
            if is_at_most(found.log10_delta, problem.delta):
                return stated(found)
            asked.found(stated(found))
        if found is not None and again and not asked.thorough:
            return stated(found)
        plain = prove(problem, replace(asked, before=before.plain.details if before else asked.before))
        if found is not None and useful and not (plain.applicable and plain.log10_delta <= found.log10_delta):
            return stated(found, plain)
        return plain

    return proved


def logarithmic(problem: Problem) -> tuple[tuple[int, ...], Problem] | None:
    """The states that are stated by their logarithms, and the problem stated so; None where there are none.

    Proves: P(failing) is at most the largest probability of failing in the problem that is returned.

    Raises
    ------
    InfeasibleError
        If the problem cannot be stated so: a start has no room once it is rounded, say.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: 0.1 * x, states=["price"], diffusion=lambda x: [[0.2 * x[0]]])
    >>> problem = cb.Problem(system, initial=[1.0], safe=[cb.Inside(cb.Box([0.5], [2.0]))], horizon=1.0)
    >>> places, stated = logarithmic(problem)
    >>> places, stated.system.diffusion.tolist(), round(float(stated.safe[0].region.high[0]), 3)
    ((0,), [[0.2]], 0.693)
    """
    system, n = problem.system, problem.system.dimension
    if not isinstance(system, ContinuousSystem) or not isinstance(system.diffusion, Tape) or not is_plain(problem):
        return None
    if problem.domain is not None or not np.isfinite(problem.horizon):
        return None
    if max(len(system.diffusion.nodes), len(problem.closed_loop.nodes)) > _LONGEST:
        return None
    positive, barred = _limited(problem)
    places = tuple(i for i in proportional(system.diffusion) if i in positive and i not in barred)
    if not places:
        return None
    law = isinstance(problem.plan, Tape)
    signals: dict[str, Any] = {}
    if system.inputs is not None and not law:
        signals |= {"inputs": system.inputs, "input_names": system.input_names}
    if system.disturbance is not None:
        signals |= {"disturbance": system.disturbance, "disturbance_names": system.disturbance_names}
    dynamics, diffusion = in_logarithms(problem.closed_loop, system.diffusion, places)
    given: Array | Tape = diffusion
    constants = [diffusion.nodes[output] for output in diffusion.outputs]
    if all(node.op == "const" for node in constants):
        given = np.array([node.value for node in constants]).reshape(diffusion.shape)
    elif all(node.op != "input" for node in diffusion.nodes):
        raise InfeasibleError("the noise is constant in logarithms, which is not stated so.")
    try:
        turned = ContinuousSystem(dynamics, states=system.states, diffusion=given, **signals)
        return places, problem.replace(
            system=turned, initial=_start(problem, places), safe=[_constraint(one, places, n) for one in problem.safe],
            plan=None if law else problem.plan, cost=None, units=None,
        )  # fmt: skip
    except ValueError as error:
        raise InfeasibleError(f"the problem is not stated in logarithms: {error}") from error


def _limited(problem: Problem) -> tuple[set[int], set[int]]:
    """States that a limit for all time keeps positive, and states that some limit binds to others, or in its own way."""
    n = problem.system.dimension
    positive, barred = set[int](), set[int]()
    for constraint in problem.safe:
        region = constraint.region
        flat = isinstance(region.form, Faces) and region.kind in ("box", "halfspace", "polytope")
        if not flat or region.moving or np.any(region.center_at()):
            barred |= set(region.places(n))
            continue
        for row, bound in zip(region.lifted(region.form.normals, n), region.form.bounds):
            own = np.flatnonzero(row).tolist()
            if len(own) > 1:
                barred |= set(own)
            elif row[own[0]] < 0 and bound < 0 and not constraint.outside and constraint.during is None:
                positive.add(own[0])
            elif bound * row[own[0]] <= 0:
                barred.add(own[0])
    return positive, barred


def _log(value: arb, *, up: bool) -> float:
    with precision():
        return upper(value.log()) if up else lower(value.log())


def _start(problem: Problem, places: tuple[int, ...]) -> Box:
    """A box around the starts, rounded outward."""
    hull = problem.initial.hull()
    low, high = hull.lo.copy(), hull.hi.copy()
    for i in places:
        if not low[i] > 0:
            raise InfeasibleError("a start is not positive.")
        low[i], high[i] = _log(arb(low[i]), up=False), _log(arb(high[i]), up=True)
    return Box(low, high)


def _constraint(constraint: Inside, places: tuple[int, ...], n: int) -> Inside:
    region, out = constraint.region, constraint.outside
    if not set(places) & set(region.places(n)):
        return constraint
    rows, bounds = np.array(region.lifted(region.form.normals, n), dtype=float), np.array(region.form.bounds)
    for number, row in enumerate(rows):
        i = int(np.flatnonzero(row)[0])
        if i in places:
            with precision():
                end = arb(float(bounds[number])) / arb(float(row[i]))
            positive = row[i] > 0
            side = _log(end, up=bool(out) == bool(positive))
            rows[number], bounds[number] = 0.0, side if positive else -side
            rows[number, i] = 1.0 if positive else -1.0
    if region.kind == "box":
        low, high = np.full(n, -math.inf), np.full(n, math.inf)
        for row, bound in zip(rows, bounds):
            i = int(np.flatnonzero(row)[0])
            low[i], high[i] = (low[i], bound) if row[i] > 0 else (-bound, high[i])
        kept = list(region.places(n))
        stated: Any = Box(low[kept], high[kept], coordinates=region.coordinates)
    else:
        stated = HalfSpace(rows[0], bounds[0]) if region.kind == "halfspace" else Polytope(rows, bounds)
    return type(constraint)(stated, during=constraint.during, label=constraint.label)
