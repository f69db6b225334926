"""The linear-response engine (Thm K7) as one of the engines of ``verify_safety``."""

from __future__ import annotations

import math

import numpy as np

from certbound.display import rounded
from certbound.problem.held import held_loop
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.problem import Problem
from certbound.reach.affine import AffineFailing, affine_failing
from certbound.reach.below import least_failing
from certbound.reach.linear import DeviationTube, LinearAnswer, depends_on_state, linear_answer
from certbound.reach.remainder import hidden_jump
from certbound.safety.answers import AS_IT_IS, SPARED, Deviation, EngineAnswer, Request

_SAYS = 1e-3  # of delta: a lower bound of less than that says nothing

_FIRST = "a first bound of the linear response; its largest parts were not made smaller after it"


def linear_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Smallest probability that Thm K7' proves for the problem, with one cell unless ``asked`` for more.

    With additive noise it covers every disturbance, even one that sees coming noise; with noise that depends on the
    state, those that do not.
    """
    if problem.hold is not None:
        return _held(problem, asked)
    problem = in_pieces(problem)
    hidden = hidden_jump(problem)
    if hidden is not None:
        return EngineAnswer(applicable=False, reason=hidden, method="linear")
    if asked.quick and depends_on_state(problem):
        return EngineAnswer(applicable=False, reason=SPARED, method="linear")
    foresight = not depends_on_state(problem)

    def found(answer: LinearAnswer) -> None:
        reason = _FIRST if answer.log10_delta < 0 and not answer.impossible else answer.reason
        asked.found(EngineAnswer(
            log10_delta=answer.log10_delta, method="linear", details=answer, foresight=foresight, reason=f"{reason}.",
        ))  # fmt: skip

    answer = linear_answer(
        problem, cells=asked.cells, thorough=asked.thorough, quick=asked.quick, before=asked.before, found=found
    )
    tube = answer.tube
    return EngineAnswer(
        log10_delta=answer.log10_delta,
        margin=answer.margin if np.isfinite(answer.margin) else None,
        time=answer.time,
        constraint=answer.constraint,
        reason=answer.reason,
        tube=tube,
        reach=answer.noise_free_reach,
        deviation=None if tube is None else _deviation(answer, tube),
        method="linear",
        details=answer,
        conclusive=answer.exact and answer.margin > -np.inf,
        foresight=foresight,
        by_limit=answer.by_limit,
    )


def _held(problem: Problem, asked: Request) -> EngineAnswer:
    """The same where inputs are held: the state that is bounded has them behind it."""
    loop = held_loop(problem)
    hidden = hidden_jump(loop.flow) or hidden_jump(loop.sample)
    if hidden is not None:
        return EngineAnswer(applicable=False, reason=hidden, method="linear")

    def found(answer: LinearAnswer) -> None:
        reason = answer.reason if answer.impossible else _FIRST
        asked.found(EngineAnswer(
            log10_delta=answer.log10_delta, method="linear", details=answer, foresight=True, reason=f"{reason}.",
        ))  # fmt: skip

    answer = linear_answer(loop, cells=asked.cells, thorough=asked.thorough, before=asked.before, found=found)
    tube = answer.tube
    return EngineAnswer(
        log10_delta=answer.log10_delta, margin=answer.margin if np.isfinite(answer.margin) else None,
        time=answer.time, constraint=answer.constraint, reason=answer.reason, tube=tube, reach=answer.noise_free_reach,
        deviation=None if tube is None else _deviation(answer, tube), method="linear", details=answer, foresight=True,
        by_limit=answer.by_limit,
    )


def linear_below(problem: Problem) -> EngineAnswer | None:
    """A lower bound of the probability of failing, by the linear response of paths that have not failed yet."""
    exact = affine_failing(problem)
    single = problem.fixed_start or problem.initial.random
    if exact is not None and (single or exact.probability > problem.delta):
        return None if exact.probability < _SAYS * problem.delta else _failing_exactly(problem, exact)
    found = least_failing(problem)
    if found is None or found.probability < _SAYS * problem.delta:
        return None
    start = ", ".join(rounded(value, up=False, digits=4) for value in found.start)
    when = f"t = {found.time:.4g}" if problem.system.time == "continuous" else f"step {found.time:g}"
    least = math.log10(found.probability)
    place = f"from what is drawn around ({start})" if problem.initial.random else f"from ({start})"
    words = (
        f"{place} the noise breaks '{found.label}' by about {when} with a probability of at least "
        f"{rounded(found.probability, up=False, digits=3)}"
    )
    return EngineAnswer(log10_lower=least - 1e-14 * (1 + abs(least)), method="linear", reason=f"{words}.")


def _failing_exactly(problem: Problem, found: AffineFailing) -> EngineAnswer:
    """The lower bound of a linear model's exact law."""
    start = ", ".join(rounded(value, up=False, digits=4) for value in found.start)
    place = f"from what is drawn around ({start})" if problem.initial.random else f"from ({start})"
    words = (
        f"{place} the noise breaks '{found.label}' or another limit with a probability of at least "
        f"{rounded(found.probability, up=False, digits=3)}"
    )
    least = math.log10(found.probability)
    return EngineAnswer(log10_lower=least - 1e-14 * (1 + abs(least)), method="linear", reason=f"{words}.")


def _deviation(answer: LinearAnswer, tube: DeviationTube) -> Deviation:
    """Bounds per piece; in discrete time a piece is a step and the next one."""
    half, times = tube.half_widths, tube.times
    if not answer.run.engine.continuous:
        half, times = np.maximum(half[:-1], half[1:]), times[:-1]
    return Deviation(times=times, radius=np.linalg.norm(half, axis=1) * (1 + 1e-14), extent=half)
