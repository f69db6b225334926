"""``bound_reach``: the reach tube of a problem, by the engine that fits."""

from __future__ import annotations

from certbound.constants.bounds import bound_constants
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.reach.contraction import contraction_tube
from certbound.reach.flow import Flow
from certbound.reach.local import local_contraction_tube, local_tube, radius_over_pieces
from certbound.reach.tube import ReachTube
from certbound.tubes.tuning import tune_tube

__all__ = ["bound_reach"]

_ENGINES = ("linear", "contraction")
"""Names of the engines, in the order in which "auto" tries them."""


def bound_reach(problem: Problem, *, noise: bool = True, cells: int | None = None, method: str = "auto") -> ReachTube:
    """A tube that contains the state at every time up to its ``end``.

    Proves, for ``noise=False``: every noise-free trajectory from the initial set, under every disturbance, lies in
    the tube. For ``noise=True``: with probability at least 1 - delta (the problem's) the noisy one does, at all
    times at once.

    Parameters
    ----------
    problem : Problem
        With a plan if its system has inputs.
    noise : bool
        Whether the stochastic deviation is included.
    cells : int, optional
        Parts along each side of the initial set; the tube is the union over the cells.
    method : {"auto", "linear", "contraction"}
        Thm K7, or Thms K5 and K4; "auto" takes the first that reaches the horizon.

    Returns
    -------
    ReachTube
        ``end`` comes before the horizon where nothing was proved beyond it.

    Raises
    ------
    ValueError
        If the method is unknown, the system has inputs and no plan, or the nominal is lost before the horizon.
    ArithmeticError, InfeasibleError
        If no engine proved anything.

    Source: Thms K4, K5, K7 of theory.
    """
    if method not in ("auto", *_ENGINES):
        raise ValueError(f"`method` must be one of auto, {', '.join(_ENGINES)}, got {method!r}.")
    best: ReachTube | None = None
    failure: ArithmeticError | InfeasibleError | None = None
    for name in _ENGINES if method == "auto" else (method,):
        try:
            engine = response_reach if name == "linear" else contraction_reach
            tube = engine(problem, noise=noise, cells=cells)
        except (ArithmeticError, InfeasibleError) as error:
            failure = error
            continue
        if best is None or tube.end > best.end:
            best = tube
        if best.end >= float(problem.horizon):
            return best
    if best is None:
        raise failure if failure is not None else InfeasibleError("no engine fits the problem.")
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
        return reach
    tube = tune_tube(constants, horizon=float(problem.horizon), delta=problem.delta)
    radius = radius_over_pieces(tube, reach.curve)
    return reach.grown(radius, log10_delta=tube.log10_delta, method=f"{reach.method}, {tube.method}")


def response_reach(problem: Problem, *, noise: bool = True, cells: int | None = None) -> ReachTube:
    """Thm K7, loaded when it is first used."""
    from certbound.reach.response_tube import linear_reach

    return linear_reach(problem, noise=noise, cells=cells)
