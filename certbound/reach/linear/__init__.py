"""The linear-response engine (Thm K7): nominal, Gaussian response, proved remainder."""

from __future__ import annotations

from certbound.reach.linear.answer import linear_answer, linear_reach, refusal
from certbound.reach.linear.answer_tubes import DeviationTube
from certbound.reach.linear.diffusion import Accepted, DiffusionRun, Reference, depends_on_state
from certbound.reach.linear.fit import fitted
from certbound.reach.linear.held import HeldLinearisation
from certbound.reach.linear.linearisation import FEWEST_PIECES, Linearisation
from certbound.reach.linear.proved import LinearAnswer, Path, SplitAnswer
from certbound.reach.linear.run import Events, LinearRun, correlated
from certbound.reach.linear.shares import Share

__all__ = [
    "Accepted",
    "correlated",
    "depends_on_state",
    "DeviationTube",
    "DiffusionRun",
    "Events",
    "FEWEST_PIECES",
    "fitted",
    "HeldLinearisation",
    "linear_answer",
    "linear_reach",
    "LinearAnswer",
    "Linearisation",
    "LinearRun",
    "Path",
    "Reference",
    "refusal",
    "Share",
    "SplitAnswer",
]
