"""Answers of the linear-response engine: the least probability found, its reach tube and its deviation tube."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.reach.linear import answer_tubes, shares
from certbound.reach.linear.deviation_tube import DeviationTube
from certbound.reach.linear.diffusion import DiffusionRun, depends_on_state
from certbound.reach.linear.fit import fitted
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.sets import ReachTube, Requirement

_REFINEMENTS = 3
_MANY = 20  # nonlinear coordinates beyond which a probability below the target is not refined
_NOTHING = -0.1  # log of a probability that says nothing
_PARTS = (2, 4, 8)  # cells along each side, tried one after the other
_NEAR = 3.5  # log of how many times the target one cell may prove for more cells to be tried
_MOST_PIECES = 4000  # pieces of time times cells


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearAnswer:
    """Best certified probability of the engine, and what stands in the way of a smaller one.

    ``outcome`` holds the least probability found; ``shown`` the run whose tube fits the problem's own delta.
    """

    run: LinearRun
    outcome: Outcome
    shown: Outcome

    @property
    def log10_delta(self) -> float:
        """log10 of a bound on the probability of leaving the safe set: finite, at most 0."""
        value = max(self.outcome.log_probability / np.log(10.0), answer_tubes.LEAST)
        return float(min(value + 1e-15 * abs(value), 0.0))

    @property
    def exact(self) -> bool:
        """Whether the model is linear and its noise Gaussian: only the union over constraints and times is lost."""
        system = self.run.engine.system
        return not self.run.curved and (
            isinstance(system, ContinuousSystem) or bool(system.noise.gaussian)
        )

    @cached_property
    def _tightest(self) -> tuple[Requirement | None, int, float]:
        return self.run.tightest(self.shown)

    @property
    def margin(self) -> float:
        """Room left at the problem's delta, in the units of the tightest constraint.

        It is not negative where that delta is proved: the tube shares delta evenly between the constraints, the
        probability does not need to.
        """
        left = self._tightest[2]
        return max(left, 0.0) if self.log10_delta <= np.log10(self.run.engine.problem.delta) else left

    @property
    def time(self) -> float:
        """Where the room is least, or where the remainder begins to feed itself."""
        return float(self._tightest[1] * self.run.engine.step)

    @property
    def constraint(self) -> str | None:
        """The tightest requirement."""
        return None if self._tightest[0] is None else self._tightest[0].label

    @property
    def reason(self) -> str:
        """Why nothing smaller was proved, in words."""
        if self.outcome.bounds is None:
            what = "the remainder of the linearisation feeds itself"
            if self.run.engine.model.jumping:
                what = f"the dynamics may jump inside the tube, or {what},"
            return (
                f"{what} from t = {self.time:.4g} on; split the initial set (cells), shorten the horizon or lower "
                "the noise"
            )
        if self.margin == -np.inf:
            return f"no bound of the deviation was found that the room of '{self.constraint}' could be compared with"
        return f"the room of '{self.constraint}' at t = {self.time:.4g} is {self.margin:.4g}"

    @cached_property
    def tube(self) -> DeviationTube | None:
        """Deviation tube at the problem's delta (None when nothing was proved)."""
        bounds = self.shown.bounds
        return None if bounds is None else answer_tubes.deviation_tube(self.run, self.shown, bounds)

    def extent_along(self, direction: ArrayLike) -> Array:
        """Bounds of |a . (X_t - x_t)| over every piece for one direction a alone: shape (K,).

        They hold for all pieces at once with probability at least 1 - delta, the whole of delta spent on this direction
        and on the remainder; `tube` holds for all states at once.

        Raises
        ------
        ArithmeticError
            If the remainder feeds itself, or was bounded at the whole of delta or more only.
        """
        run, outcome, bounds = self.run, self.shown, self.shown.bounds
        left = run.engine.problem.delta - np.exp(outcome.nonlinear.log) * (1 + 1e-12)
        if bounds is None or left <= 0:
            raise ArithmeticError(self.reason)
        own = np.asarray(direction, dtype=float)
        return answer_tubes.deviation_along(run, outcome, bounds, own, Share.of(0.49 * left))

    @cached_property
    def reach(self) -> ReachTube | None:
        """Sets that contain the state with probability at least 1 - delta (None when nothing was proved)."""
        bounds, tube = self.shown.bounds, self.tube
        if bounds is None or tube is None:
            return None
        levels, _ = answer_tubes.levels_of_coordinates(self.run, self.shown)
        return answer_tubes.reach_tube(self.run, bounds, tube.log10_delta, levels)

    @cached_property
    def noise_free_reach(self) -> ReachTube | None:
        """Sets that contain every associated trajectory (its remainder lies in the noisy one's set)."""
        bounds = self.shown.bounds
        return None if bounds is None else answer_tubes.reach_tube(self.run, bounds, -np.inf, None)


def refusal(problem: Problem) -> str | None:
    """Why the deviation's law does not follow from the plan alone, as synthesis needs it; None where it does."""
    if depends_on_state(problem):
        return "the noise depends on the state, and the linear response to it on the plan's own tube"
    return None


def linear_answer(
    problem: Problem, *, cells: int | None = None, thorough: bool = True, before: LinearAnswer | None = None
) -> LinearAnswer:
    """Bound the probability of leaving the safe set by the linear response (Thm K7').

    Parameters
    ----------
    cells : int, optional
        Cells along each side of the initial set; as few as serve when omitted.
    thorough : bool
        False: one cell when omitted, and no larger shares where nothing was proved.
    before : LinearAnswer, optional
        What was found for the same problem without ``thorough`` and ``cells``; it is not looked for again.
    """
    target = Share.of(problem.delta)
    run = _run(problem, cells=1 if cells is None else cells) if before is None else before.run
    best, effort = _best(run, target) if before is None else (before.outcome, shares.HOPED[-1][1])
    closes = best.bounds is not None
    near = best.log_probability < target.log + _NEAR and run.curved and not isinstance(run, DiffusionRun)
    if thorough and cells is None and best.log_probability > target.log and (near or not closes):
        for finer in _splits(problem, run):
            if _promising(finer, target) if closes else _tried(finer, target, shares.HOPED[0]).bounds is not None:
                other = _best(finer, target)
                if not closes or other[0].log_probability < best.log_probability:
                    run, (best, effort) = finer, other
                break
    if thorough and best.log_probability > _NOTHING and run.curved:
        for likelier in (share for share in map(Share.of, shares.LIKELIER) if target.log < share.log):
            best = _least(best, run.probability(likelier, 2))
            if best.bounds is not None:
                break
    shown = best
    above = best.log_probability - best.nonlinear.log
    if best.log_probability <= target.log and above > -3.0 and (above < 2.0 or run.curved):
        coupled = max((len(group[0]) for group in run.engine.model.blocks), default=1) > 1
        for _ in range(0 if coupled or len(run.engine.model.active) > _MANY else _REFINEMENTS):
            outcome = run.probability(Share(2 * best.nonlinear.log), effort)
            if outcome.log_probability >= best.log_probability:
                break
            best = outcome
    return LinearAnswer(run=run, outcome=best, shown=shown)


def _run(problem: Problem, *, cells: int | None, noise: bool = True) -> LinearRun:
    """The engine for the problem's noise."""
    engine = fitted(Linearisation.of(problem, cells=cells, noise=noise), Share.of(problem.delta * shares.FITTED))
    return DiffusionRun(engine) if noise and depends_on_state(problem) else LinearRun(engine)


def _best(run: LinearRun, target: Share) -> tuple[Outcome, int]:
    """The least probability over a few shares of the target for delta_N, and the last effort.

    Where a guess of the remainder tells which of them has a chance, only those are proved, and the last one if none.
    """
    guessed = run.curved and not isinstance(run, DiffusionRun)
    parts = shares.GUESSED if guessed else shares.HOPED if run.curved else shares.HOPED_LINEAR
    best: Outcome | None = None
    for hope in _hopes(run, target) if guessed else parts:
        found = _tried(run, target, hope)
        best = found if best is None else _least(best, found)
        if best.log_probability <= target.log or not (run.curved or run.engine.continuous):
            return best, hope[1]
    return best or _tried(run, target, parts[-1]), parts[-1][1]


def _tried(run: LinearRun, target: Share, hope: tuple[float, int]) -> Outcome:
    """What a part of the target proves, with its effort."""
    return run.probability(target.part(hope[0]), hope[1])


def _hopes(run: LinearRun, target: Share) -> Iterator[tuple[float, int]]:
    """The shares of the target with which a guess of the remainder says that it is within reach.

    Of all of them the last one has the least levels, and so the least remainder. Where the first has no chance, it is
    looked at next: if the noise takes more than the target with it as well, the others need no look.
    """
    for index, (share, effort) in enumerate(shares.GUESSED):
        if run.promise(target.part(share), effort, limit=target.log) <= target.log:
            yield share, effort
        elif index == 0 and not _within_reach(run, target):
            return


def _within_reach(run: LinearRun, target: Share) -> bool:
    """Whether the noise alone, next to the least remainder that is tried, may cost no more than the target."""
    share, effort = shares.GUESSED[-1]
    limit = target.log + float(np.log1p(share))
    return run.promise(target.part(share), effort, limit=limit) <= limit


def _splits(problem: Problem, run: LinearRun) -> Iterator[LinearRun]:
    """Engines on more and more cells of the initial set, as long as they are not too many."""
    wide = int(np.count_nonzero(run.engine.radii[0]))
    for parts in _PARTS if wide else ():
        if parts**wide * run.engine.pieces > _MOST_PIECES:
            return
        yield _run(problem, cells=parts)


def _promising(run: LinearRun, target: Share) -> bool:
    """Whether a guess of the remainder says that the target is within reach."""
    return _within_reach(run, target) and any(True for _ in _hopes(run, target))


def _least(first: Outcome, second: Outcome) -> Outcome:
    return second if second.log_probability < first.log_probability else first


def linear_reach(problem: Problem, *, noise: bool = True, cells: int | None = None) -> ReachTube:
    """Reach tube of the linear-response engine; with ``noise=False`` of the associated trajectories.

    Raises
    ------
    ArithmeticError
        If the remainder feeds itself before the horizon ends, or no bound of the noise along some state was found.
    """
    run = _run(problem, cells=cells, noise=noise)
    outcome = run.probability(Share.of(problem.delta / 2), 2 if noise else 1)
    answer = LinearAnswer(run=run, outcome=outcome, shown=outcome)
    if outcome.bounds is None:
        raise ArithmeticError(answer.reason)
    tube = answer.tube if noise else None
    for name, half in zip(problem.system.states, () if tube is None else tube.half_widths.T):
        if not np.all(np.isfinite(half)):
            raise ArithmeticError(
                f"no bound of the deviation of {name} was found at delta = {problem.delta:.3g}; "
                "shorten the horizon, or use method='contraction'."
            )
    reach = answer.reach if noise else answer.noise_free_reach
    assert reach is not None
    return reach
