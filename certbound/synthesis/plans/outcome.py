"""What ``synthesize_plan`` returns."""

from __future__ import annotations

from dataclasses import dataclass

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.safety.verification import Verdict
from certbound.synthesis.plans.infeasibility import Infeasibility
from certbound.tubes.constants import Constants


@dataclass(frozen=True, eq=False, kw_only=True)
class Synthesis:
    """A plan and what is known about it.

    Parameters
    ----------
    feasible : bool
        A plan keeps the tightened constraints. Whether that means anything is for ``status`` to say: a one-time bound
        such as Markov's may have a feasible plan, and its status is UNKNOWN.
    status, log10_delta
        What ``verify_safety`` proved about ``problem``; status UNKNOWN and 0 where nothing was.
    reason : str
        The verdict's reason, or why there is no plan.
    source : Problem
        What was asked.
    problem : Problem
        What the verdict is about: the closed loop under the plan.
    plan : ndarray, shape (N, m)
        Of that problem: inputs u, or w with u = w + K x where there is a feedback K.
    inputs : ndarray, shape (N, m)
        Nominal inputs at the start of each piece.
    states, times : ndarray, shape (points + 1, n), (points + 1,)
        Noise-free path, and when.
    erosion : ndarray, shape (points, parts)
        What the tube takes from each face behind the start.
    labels : tuple of str
        The faces.
    method : str
        The tube.
    constants : Constants or None
    feedback : ndarray or None
        K.
    cost : float
        Of the noise-free path.
    max_input : float
        Largest |u| of the noise-free path.
    scale : float
        The largest s found such that s times the tube fits.
    softened : float
        By how much the plan misses the tightened constraints at most (soft fallback); 0 for a feasible one.
    infeasibility : Infeasibility or None
    smallest_delta : float or None
        Smallest delta for which a plan was found, where it was looked for.
    verdict : Verdict or None
        All that was proved about ``problem``.
    seconds : float
    """

    feasible: bool
    status: str
    log10_delta: float
    reason: str
    source: Problem
    problem: Problem
    plan: Array
    inputs: Array
    states: Array
    times: Array
    erosion: Array
    labels: tuple[str, ...]
    method: str
    constants: Constants | None
    feedback: Array | None
    cost: float
    max_input: float
    scale: float
    softened: float
    infeasibility: Infeasibility | None
    smallest_delta: float | None
    verdict: Verdict | None
    seconds: float
