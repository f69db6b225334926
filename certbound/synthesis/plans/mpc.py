"""Predictive control over the whole horizon: a plan, the verdict on it, and the reason where there is none.

Receding-horizon control with the noise-free state as its state (`certbound.synthesis.controllers.receding`) leads to a
plan as well, since nothing random enters it; both are judged by ``verify_safety``.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from numpy.typing import ArrayLike

from certbound.checks import instance
from certbound.constants.matching import check_constants
from certbound.constants.stated import refuse_contradiction
from certbound.errors import EnclosureError, InfeasibleError
from certbound.parallel import alone
from certbound.problem.problem import Problem
from certbound.problem.sets import Region
from certbound.reach.linear import refusal
from certbound.synthesis.planning import Planner, check_tube
from certbound.synthesis.plans.attempts import Attempts
from certbound.synthesis.plans.outcome import Synthesis
from certbound.synthesis.terminal import TerminalSet
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import METHODS

_LOG = logging.getLogger(__name__)


@alone()
def synthesize_plan(
    problem: Problem,
    *,
    method: str = "auto",
    tube: Tube | None = None,
    epsilon: float | None = None,
    step: float | None = None,
    constants: Constants | None = None,
    stage_cost: Callable[..., Any] | None = None,
    terminal: str | TerminalSet | Region | None = None,
    feedback: str | ArrayLike | None = None,
    steps: int | None = None,
    find_delta: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Synthesis:
    """A plan of inputs of least cost under which the noisy system stays safe but for a probability of delta.

    Proves, where ``status`` is SAFE: under the inputs ``plan`` (with u = plan + K x where there is a feedback),
    P(some constraint of the problem, input bounds included, is broken within the horizon) <= 10**log10_delta <= delta.
    The inputs must not be planned anew from measured states: the noise-free path that they belong to would change.

    Parameters
    ----------
    problem : Problem
        With inputs; an array plan serves as the first guess.
    method : str
        "auto" (the linear response, then the Kummer tube), "linear", or a tube method: "kummer", "thm5", "markov".
    tube : Tube, optional
        A tube for this problem, in place of a method.
    epsilon, step : float, optional
        The paper's free parameters, for its methods.
    constants : Constants, optional
        Stated constants; certified ones in one common metric when omitted.
    stage_cost : callable, optional
        ``stage(t, x, u)``, one number; the problem's cost when omitted (the inputs' energy if it has none).
    terminal : "contraction", "riccati", TerminalSet, set, or None
        Where the noise-free path must end, inside the tightened constraints.
    feedback : "riccati", "lmi", array_like of shape (m, n), or None
        K of u = w + K x.
    steps : int, optional
        Pieces of the horizon in continuous time (40).
    find_delta : bool
        Look for the smallest feasible delta also where there is a plan.
    progress : callable, optional
        Told in words what is being done.

    Returns
    -------
    Synthesis

    Raises
    ------
    ValueError
        If the system has no inputs, K does not stabilise, the inputs have no bounds where the tube needs them, the
        terminal set leaves the tightened constraints, the method is unknown, the tube or the constants are of another
        problem, or stated constants contradict the problem's own noise.
    InfeasibleError
        If no noise-free trajectory exists to begin with.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.linear_system(
    ...     [[1, 0.1], [0, 1]], [[0], [0.1]], inputs=cb.Box([-2], [2]), noise=cb.Gaussian(std=0.01))
    >>> problem = cb.Problem(
    ...     system, initial=[1, 0], safe=[cb.Inside(cb.Box([-0.5, -1], [1.5, 1]))], horizon=20, delta=1e-3,
    ...     cost=([1, 1], [0.01]))
    >>> result = synthesize_plan(problem)
    >>> result.feasible, result.status
    (True, 'SAFE')
    """
    instance("problem", problem, Problem)
    began = time.perf_counter()
    if tube is not None:
        check_tube(problem, tube)
    names = _chosen(method, problem) if tube is None else (tube.method,)
    if constants is not None and not constants.certified:
        refuse_contradiction(problem, constants)
    work = Attempts(
        Planner(problem, stage_cost=stage_cost, terminal=terminal, feedback=feedback, steps=steps),
        given=tube,
        parameters={name: value for name, value in (("epsilon", epsilon), ("step", step)) if value is not None},
        constants=constants, find_delta=find_delta, tell=progress or (lambda text: _LOG.info("%s", text)),
    )  # fmt: skip
    for name, given in (("tube", tube.constants if tube is not None else None), ("constants", constants)):
        if given is not None:
            check_constants(work.planner.nominal, given, name)
    work.tell("looking for the plan with the most room")
    first = work.planner.first_plan()
    best: Synthesis | None = None
    for index, name in enumerate(names):
        try:
            found = work.attempt(name, first)
        except (InfeasibleError, EnclosureError) as error:
            if best is None and index == len(names) - 1:
                raise
            _LOG.info("tube %s: %s", name, error)
            continue
        if found is not None and (best is None or _rank(found) < _rank(best)):
            best = found
        if best is not None and best.status == "SAFE":
            break
    if best is None:
        raise InfeasibleError("no tube could be computed along any plan; lower the noise, or name a `method`.")
    if best.infeasibility is not None:
        best = work.explained(best)
    return replace(best, seconds=time.perf_counter() - began)


def _rank(found: Synthesis) -> tuple[bool, bool, float, float]:
    return found.status != "SAFE", not found.feasible, found.log10_delta, -found.scale


def _chosen(method: str, problem: Problem) -> tuple[str, ...]:
    if method == "auto":
        return ("kummer",) if refusal(problem) else ("linear", "kummer")
    if method == "linear":
        refused = refusal(problem)
        if refused:
            raise ValueError(f"`method` 'linear' does not fit: {refused}; use 'kummer'.")
    elif method not in METHODS:
        known = ", ".join(["auto", "linear", *(name for name in METHODS if name != "auto")])
        raise ValueError(f"`method` must be one of {known}, got {method!r}.")
    return (method,)
