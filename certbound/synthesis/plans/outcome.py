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
    """A plan and what is known about it."""

    # A plan keeps the tightened constraints. Whether that means anything is for ``status`` to say: a one-time bound
    # such as Markov's may have a feasible plan, and its status is UNKNOWN.
    feasible: bool
    # what ``verify_safety`` proved about ``problem``; status UNKNOWN and 0 where nothing was
    status: str
    log10_delta: float
    reason: str  # the verdict's reason, or why there is no plan
    source: Problem  # what was asked
    problem: Problem  # what the verdict is about: the closed loop under the plan
    plan: Array  # (N, m): of that problem: inputs u, or w with u = w + K x where there is a feedback K
    inputs: Array  # (N, m): nominal inputs at the start of each piece
    # (points + 1, n), (points + 1,): noise-free path, and when
    states: Array
    times: Array
    erosion: Array  # (points, parts): what the tube takes from each face behind the start
    labels: tuple[str, ...]  # the faces
    method: str  # the tube
    constants: Constants | None
    feedback: Array | None  # K
    cost: float  # of the noise-free path
    max_input: float  # largest |u| of the noise-free path
    scale: float  # the largest s found such that s times the tube fits
    # by how much the plan misses the tightened constraints at most (soft fallback); 0 for a feasible one
    softened: float
    infeasibility: Infeasibility | None
    smallest_delta: float | None  # smallest delta for which a plan was found, where it was looked for
    verdict: Verdict | None  # all that was proved about ``problem``
    seconds: float
