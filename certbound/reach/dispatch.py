"""``bound_reach``: the reach tube of a problem, by the engine that fits."""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.checks import instance
from certbound.constants.bounds import bound_constants
from certbound.errors import EnclosureError, EngineError, InfeasibleError, contained
from certbound.parallel import alone
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.problem import Problem
from certbound.reach.contraction import (
    contraction_tube,
    local_contraction_tube,
    local_tube,
    needed_radius,
    random_start,
)
from certbound.reach.nominal import Flow, initial_cells
from certbound.reach.sets import ReachTube
from certbound.tubes.question import Start
from certbound.tubes.tuning import tune_tube

_ENGINES = ("linear", "contraction")
"""Names of the engines, in the order in which "auto" tries them."""

_STATISTICAL = ("sampled", "learned")
"""Names of the methods that rest on samples; "auto" never takes them."""


@alone()
def bound_reach(
    problem: Problem, *, noise: bool = True, cells: int | None = None, method: str = "auto", **sampling: Any
) -> ReachTube:
    """A tube that contains the state at every time up to its ``end``.

    Proves, for ``noise=False``: every noise-free trajectory from the initial set (from the mean of a random start),
    under every disturbance, lies in the tube. For ``noise=True``: with probability at least 1 - delta (the problem's)
    the noisy one does, at all times at once.

    Parameters
    ----------
    problem : Problem
        With a plan if its system has inputs.
    noise : bool
        Whether the stochastic deviation is included.
    cells : int, optional
        Parts along each side of the initial set; the tube is the union over the cells.
    method : {"auto", "linear", "contraction", "sampled", "learned"}
        Thm K7, or Thms K5 and K4; "auto" takes the first that reaches the horizon. "sampled" and "learned" prove
        nothing: they give a statistical statement about sampled trajectories (`certbound.reach.sampled.boxes`,
        `certbound.reach.sampled.classifier`), marked as such, with ``certified`` False.
    **sampling
        Only for the statistical methods: ``epsilon``, ``confidence``, ``pieces``, ``rng`` (and ``points``).

    Returns
    -------
    ReachTube
        ``end`` comes before the horizon where nothing was proved beyond it.

    Raises
    ------
    ValueError
        If the method is unknown or does not take an argument, ``cells`` cannot be, or a plan is missing.
    EngineError, InfeasibleError
        If no engine proved anything; it says what stood in the way of the last.

    Source: Thms K4, K5, K7 of theory.
    """
    instance("problem", problem, Problem)
    if method in _STATISTICAL:
        return statistical_reach(problem, method, noise=noise, cells=cells, **sampling)
    if method not in ("auto", *_ENGINES):
        raise ValueError(f"`method` must be one of auto, {', '.join((*_ENGINES, *_STATISTICAL))}, got {method!r}.")
    if sampling:
        name = next(iter(sampling))
        raise ValueError(f"`{name}` must be left out for the method {method!r}; it belongs to 'sampled' and 'learned'.")
    initial_cells(problem, cells)  # with the plan, what can be wrong with the input
    _ = problem.closed_loop
    problem = in_pieces(problem)
    best: ReachTube | None = None
    failure = EngineError("no engine fits the problem.")
    for name in _ENGINES if method == "auto" else (method,):
        try:
            with contained(name):
                engine = response_reach if name == "linear" else contraction_reach
                tube = engine(problem, noise=noise, cells=cells)
        except EngineError as error:
            failure = error
            continue
        if best is None or tube.end > best.end:
            best = tube
        if best.end >= float(problem.horizon):
            return best
    if best is None:
        cause = failure.__cause__
        raise cause if isinstance(cause, InfeasibleError) else failure
    return best


def contraction_reach(problem: Problem, *, noise: bool = True, cells: int | None = None) -> ReachTube:
    """Thm K5 with global constants where they are finite, with local ones otherwise; Thm K1 (K4) for the noise."""
    try:
        constants = bound_constants(problem)
    except (InfeasibleError, EnclosureError):
        reach = local_contraction_tube(Flow(problem), cells=cells)
        if not noise:
            return reach
        tube, radius = local_tube(problem, reach, delta=problem.delta)
        return reach.grown(radius, log10_delta=tube.log10_delta, method=f"{reach.method}, {tube.method}")
    reach = contraction_tube(problem, constants, cells=cells)
    if not noise:
        return _while_in_domain(problem, reach)
    start = random_start(problem, constants)
    if start != Start():  # its spread belongs to the deviation, whose tube then needs nu = n
        constants = constants.with_full_dimension()
    tube = tune_tube(constants, horizon=float(problem.horizon), delta=problem.delta, start=start)
    radius = needed_radius(tube, reach.curve, start)
    grown = reach.grown(radius, log10_delta=tube.log10_delta, method=f"{reach.method}, {tube.method}")
    return _while_in_domain(problem, grown)


def _while_in_domain(problem: Problem, reach: ReachTube) -> ReachTube:
    """The pieces that constants of the domain prove: up to the first that leaves it.

    That one itself is proved in discrete time only, where its constants are those of the step before.
    """
    if problem.domain is None:
        return reach
    low, high, hull = problem.domain.low, problem.domain.high, reach.hull
    left = np.any((hull.lo < low) | (hull.hi > high), axis=1)
    if not left.any():
        return reach
    proved = int(np.argmax(left)) + (0 if reach.curve.continuous else 1)
    if proved == 0:
        raise EnclosureError(
            "the tube leaves the model's domain on its first piece, and the constants hold in the domain only; give a "
            "larger `domain`, or use more cells or less noise."
        )
    return reach.until(proved)


def response_reach(problem: Problem, *, noise: bool = True, cells: int | None = None) -> ReachTube:
    """Thm K7, loaded when it is first used."""
    from certbound.reach.linear import linear_reach
    from certbound.reach.remainder import hidden_jump

    hidden = hidden_jump(problem)
    if hidden is not None:
        raise ArithmeticError(hidden)
    return linear_reach(problem, noise=noise, cells=cells)


def statistical_reach(
    problem: Problem, method: str, *, noise: bool, cells: int | None = None, **sampling: Any
) -> ReachTube:
    """A tube around samples, not certified; loaded when it is first used."""
    from certbound.reach.sampled import estimate_reach, estimate_reach_by_classifier

    if cells is not None:
        raise ValueError(f"`cells` must be left out for the method {method!r}, which does not split, got {cells!r}.")
    known = ("epsilon", "confidence", "pieces", "rng", *(("points",) if method == "learned" else ()))
    for name in sampling:
        if name not in known:
            raise ValueError(f"`{name}` must be one of {', '.join(known)} for the method {method!r}.")
    if method == "sampled":
        return estimate_reach(problem, noise=noise, **sampling)
    if noise:
        raise ValueError("`noise` must be False for the method 'learned', which runs the model backwards, got True.")
    return estimate_reach_by_classifier(problem, **sampling)
