"""Answers of the linear-response engine: the least probability found, its reach tube and its deviation tube."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np

from certbound.problem.held import HeldLoop
from certbound.problem.problem import Problem
from certbound.reach.linear import shares
from certbound.reach.linear.bisection import CLEARLY, Bisection
from certbound.reach.linear.diffusion import DiffusionRun, depends_on_state
from certbound.reach.linear.hopes import (
    afterwards,
    best_of,
    coarser,
    gains_by_halves,
    hopes_of,
    least,
    nobody,
    nobody_waits,
    refined,
    run_of,
    tried,
)
from certbound.reach.linear.proved import LinearAnswer
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.nominal import Cells
from certbound.reach.sets import ReachTube
from certbound.watch import share_of_time

_NOTHING = -0.1  # log of a probability that says nothing
_PARTS = (2, 4, 8)  # cells along each side, tried one after the other
_MOST_PIECES = 4000  # pieces of time times cells
_FEW = 3  # states up to which cells of the start are looked at without being asked thoroughly
_AT_ONCE = 3  # states from which on that is at once: with fewer, polynomials and metrics are quick, and may say more
_EARLY = 0.35  # of the time that is left, for them


def refusal(problem: Problem) -> str | None:
    """Why the deviation's law does not follow from the plan alone, as synthesis needs it; None where it does."""
    if depends_on_state(problem):
        return "the noise depends on the state, and the linear response to it on the plan's own tube"
    return None


def linear_answer(
    problem: Problem | HeldLoop, *, cells: int | Cells | None = None, thorough: bool = True, quick: bool = False,
    before: LinearAnswer | None = None, found: Callable[[LinearAnswer], object] = nobody,
) -> LinearAnswer:
    """Bound the probability of leaving the safe set by the linear response (Thm K7').

    Parameters
    ----------
    cells : int or Cells, optional
        Cells along each side of the initial set, as few as serve when omitted; or the cells themselves.
    thorough : bool
        False: one cell when omitted, but for a while in three states, or in fewer with ``before``; and no larger shares
        where nothing was proved.
    quick : bool
        One cell whatever the states.
    before : LinearAnswer, optional
        What was found for the same problem without ``thorough`` and ``cells``; it is not looked for again.
    found : callable
        Takes each better answer on the way to the best one.
    """
    target = Share.of(problem.delta)
    first = None if before is not None or isinstance(cells, Cells) else _on_coarse_grids(problem, cells, target, found)
    if first is not None and first.outcome.log_probability <= target.log:
        return first
    run = run_of(problem, cells=1 if cells is None else cells) if before is None else before.run
    plain = isinstance(problem, Problem) and not isinstance(run, DiffusionRun)
    early = not quick and run.engine.n <= _FEW and (before is not None or run.engine.n >= _AT_ONCE)
    halved = cells is None and run.curved and plain and not run.parted and (thorough or early)
    with Bisection.of(run, target) if halved else nullcontext() as parts:
        begin = nobody_waits if parts is None else parts.begin
        best, effort = best_of(run, target, found, begin) if before is None else (before.outcome, shares.HOPED[-1][1])
        alone = cells is None and best.log_probability > target.log
        if parts is not None and alone:
            with nullcontext() if thorough else share_of_time(_EARLY):
                split = parts.proved()
                if split is not None:
                    return split
                run.parted = True
    if thorough and alone and best.bounds is None and not (run.curved and plain):
        run, (best, effort) = _on_grids(problem, run, target, found) or (run, (best, effort))
    if thorough and best.log_probability > _NOTHING and run.curved:
        for likelier in (share for share in map(Share.of, shares.LIKELIER) if target.log < share.log):
            best = least(best, run.probability(likelier, 2))
            found(LinearAnswer(run=run, outcome=best, shown=best))
            if best.bounds is not None:
                break
    shown = best
    best = refined(run, best, effort, target, lambda o: found(LinearAnswer(run=run, outcome=o, shown=shown)))
    if first is not None and first.outcome.log_probability < best.log_probability:
        return first
    answer = LinearAnswer(run=run, outcome=best, shown=shown)
    if cells is None and plain and not (quick or run.engine.continuous) and gains_by_halves(run, best, CLEARLY):
        with afterwards(), Bisection.of(run, target, met=True) as parts:
            return parts.finer(answer) or answer
    return answer


def _on_coarse_grids(
    problem: Problem | HeldLoop, cells: int | None, target: Share, found: Callable[[LinearAnswer], object]
) -> LinearAnswer | None:
    """The best of grids with fewer and fewer too few pieces, up to one that meets the target; each is a proof."""
    best: LinearAnswer | None = None
    for pieces in coarser(problem, 1 if cells is None else cells):
        run = run_of(problem, cells=1 if cells is None else cells, pieces=pieces)
        tries = ((target.part(part), effort) for part, effort in hopes_of(run, target))
        rough = (share for share in map(Share.of, shares.LIKELIER) if target.log < share.log)
        for share, effort in itertools.chain(tries, ((share, 2) for share in rough)):
            if best is not None and share.log > target.log:
                break
            if share.log > target.log and run.promise(share, effort, limit=_NOTHING) > _NOTHING:
                continue
            outcome = run.probability(share, effort)
            if outcome.bounds is None or (best and outcome.log_probability >= best.outcome.log_probability):
                continue
            best = LinearAnswer(run=run, outcome=refined(run, outcome, effort, target), shown=outcome)
            found(best)
            if outcome.log_probability <= target.log:
                return best
    return best


def _on_grids(
    problem: Problem | HeldLoop, run: LinearRun, target: Share, found: Callable[[LinearAnswer], object]
) -> tuple[LinearRun, tuple[Outcome, int]] | None:
    """On the first grid of cells on which the remainder does not feed itself, as long as they are not too many."""
    wide = int(np.count_nonzero(run.engine.radii[0]))
    for parts in _PARTS if wide else ():
        if parts**wide * run.engine.pieces > _MOST_PIECES:
            return None
        finer = run_of(problem, cells=parts)
        if tried(finer, target, shares.HOPED[0]).bounds is not None:
            return finer, best_of(finer, target, found)
    return None


def linear_reach(problem: Problem, *, noise: bool = True, cells: int | None = None) -> ReachTube:
    """Reach tube of the linear-response engine; with ``noise=False`` of the associated trajectories.

    Raises
    ------
    ArithmeticError
        If the remainder feeds itself before the horizon ends, or no bound of the noise along some state was found.
    """
    run = run_of(problem, cells=cells, noise=noise)
    outcome = run.bounded(Share.of(problem.delta / 2), 2 if noise else 1)
    answer = LinearAnswer(run=run, outcome=outcome, shown=outcome)
    if outcome.bounds is None:
        raise ArithmeticError(answer.reason)
    reach = answer.reach if noise else answer.noise_free_reach
    assert reach is not None
    assert reach.box is not None
    wide = np.maximum(np.abs(reach.box.lo), np.abs(reach.box.hi))
    for i, name in enumerate(problem.system.states if noise else ()):
        if not np.all(np.isfinite(wide[..., i])):
            raise ArithmeticError(
                f"no bound of the deviation of {name} was found at delta = {problem.delta:.3g}; "
                "shorten the horizon, or use method='contraction'."
            )
    return reach
