"""Attempts of the linear response at a target: which shares of it have a chance, and what they prove."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import numpy as np

from certbound.problem.held import HeldLoop
from certbound.problem.problem import Problem
from certbound.reach.linear import shares
from certbound.reach.linear.diffusion import DiffusionRun, depends_on_state
from certbound.reach.linear.fit import fitted
from certbound.reach.linear.held import HeldLinearisation
from certbound.reach.linear.linearisation import FEWEST_PIECES, Linearisation
from certbound.reach.linear.proved import LinearAnswer
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.nominal import Cells
from certbound.watch import in_proportion

_SEVERAL, _FINE = 4, 300  # states, and pieces of time
_COARSER = (16.0, 6.0, 2.4)  # times fewer pieces
_REFINEMENTS = 3
_SURELY = 0.9  # of what a guess says, in its worst case
_MOST = 100.0  # of logarithms
_FURTHER, _BRIEFLY = 0.3, 1.0  # of the time until the target was met, and seconds, for a smaller probability
_MANY = 20  # nonlinear coordinates beyond which a probability below the target is not refined


def coarser(problem: Problem | HeldLoop, cells: int | None) -> list[int]:
    """Pieces of grids that are tried before a fine one in four states or more: it is dear, and seldom needed."""
    if isinstance(problem, HeldLoop) or problem.system.time == "discrete" or problem.system.dimension < _SEVERAL:
        return []
    plain = Linearisation.of(problem, cells=cells)
    if plain.pieces < _FINE or not len(plain.model.active) or depends_on_state(problem):
        return []
    found = (int(np.ceil(plain.pieces / factor)) for factor in _COARSER)
    return [pieces for pieces in found if pieces >= FEWEST_PIECES]


def nobody(answer: LinearAnswer) -> None:
    """Takes answers that nobody waits for."""


def nobody_waits() -> None:
    """Is called where nobody has anything to begin with."""


def run_of(
    problem: Problem | HeldLoop, *, cells: int | Cells | None, noise: bool = True, pieces: int | None = None
) -> LinearRun:
    """The engine for the problem's noise, on a grid that resolves it or on so many pieces."""
    if isinstance(problem, HeldLoop):
        assert not isinstance(cells, Cells)
        held = HeldLinearisation.of_loop(problem, cells=cells, noise=noise)
        return LinearRun(fitted(held, Share.of(problem.delta * shares.FITTED)))
    if pieces is None:
        plain = Linearisation.of(problem, cells=cells, noise=noise)
    else:
        plain = Linearisation(problem, cells=cells, pieces=pieces, noise=noise)
    engine = fitted(plain, Share.of(problem.delta * shares.FITTED))
    return DiffusionRun(engine) if noise and depends_on_state(problem) else LinearRun(engine)


def best_of(
    run: LinearRun, target: Share, found: Callable[[LinearAnswer], object] = nobody,
    begin: Callable[[], object] = nobody_waits,
) -> tuple[Outcome, int]:
    """The least probability over a few shares of the target for delta_N, and the last effort.

    Where a guess of the remainder tells which of them has a chance, only those are proved, and the last one if none.
    ``begin`` is called before each proof.
    """
    guessed = run.curved and not isinstance(run, DiffusionRun)
    parts = shares.GUESSED if guessed else shares.HOPED if run.curved else shares.HOPED_LINEAR
    best: Outcome | None = None
    for hope in hopes_of(run, target) if guessed else parts:
        begin()
        outcome = tried(run, target, hope)
        best = outcome if best is None else least(best, outcome)
        found(LinearAnswer(run=run, outcome=best, shown=best))
        if best.log_probability <= target.log or not (run.curved or run.engine.continuous):
            return best, hope[1]
    if best is None:
        begin()
        best = tried(run, target, parts[-1])
    return best, parts[-1][1]


def meeting(run: LinearRun, target: Share) -> tuple[Outcome, int] | None:
    """The first outcome that meets the target, with its effort, among those that a guess promises; None without."""
    for hope in hopes_of(run, target):
        outcome = tried(run, target, hope)
        if outcome.log_probability <= target.log:
            return outcome, hope[1]
    return None


def tried(run: LinearRun, target: Share, hope: tuple[float, int]) -> Outcome:
    """What a part of the target proves, with its effort."""
    return run.probability(target.part(hope[0]), hope[1])


def hopes_of(run: LinearRun, target: Share) -> Iterator[tuple[float, int]]:
    """The shares of the target with which a guess of the remainder says that it is within reach.

    Of all of them the last one has the least levels, and so the least remainder. Where the first has no chance, it is
    looked at next: what the noise takes with it, it takes with the others as well, and those that leave less than that
    need no look. ``run.hoped`` is the first; then it is the one that promises most. Where a remainder could not be
    enclosed, only the last share is tried after it.
    """
    taken, found = 0.0, np.inf  # of the target: by the noise next to the least remainder, and in all
    first, last = run.hoped, shares.GUESSED[-1]
    looked: dict[tuple[float, int], float] = {}

    def promise(hope: tuple[float, int], spare: float = 0.0) -> float:
        """Of the target; beyond ``spare`` more than it, no more than that is said."""
        nonlocal found
        if hope not in looked:
            share, limit = target.part(hope[0]), target.log + float(np.log1p(spare))
            looked[hope] = value = float(np.exp(min(run.promise(share, hope[1], limit=limit) - target.log, _MOST)))
            if value < found:
                found, run.hoped = value, share
        return looked[hope]

    in_order = sorted(shares.GUESSED, key=lambda hope: first is None or target.part(hope[0]) != first)
    for index, hope in enumerate(in_order):
        if hope[0] + _SURELY * taken > 1:
            continue
        if promise(hope, hope[0] if hope == last else 0.0) <= 1:
            yield hope
            if run.lost >= target.part(hope[0]).log:  # the last one has the best chance then, and is the end of it
                if hope[0] < last[0] and promise(last) <= 1:
                    yield last
                return
        elif index == 0:
            taken = promise(last, last[0]) - last[0]


def promising(run: LinearRun, target: Share) -> bool:
    """Whether a guess of the remainder says that the target is within reach."""
    return any(True for _ in hopes_of(run, target))


def least(first: Outcome, second: Outcome) -> Outcome:
    return second if second.log_probability < first.log_probability else first


def afterwards() -> AbstractContextManager[None]:
    """What goes on once the target is met: a limit of time leaves it a part of what that took."""
    return in_proportion(_FURTHER, _BRIEFLY)


def gains_by_halves(run: LinearRun, best: Outcome, gain: float) -> bool:
    """Whether the share that gave less than ``best``, as the remainder grew, is likely to do on halves of the starts.

    What the starts take of the room is halved then; the remainder's part, which falls as well, is left as it is.
    """
    beyond = run.beyond
    if beyond is None or beyond.bounds is None or beyond.nonlinear.log > gain * best.log_probability:
        return False
    rooms, support = run.rooms(beyond.cell, beyond.bounds), run.supports[beyond.cell]
    rooms = rooms + 0.5 * support.y[:, run.inner :]
    events = run.kept[beyond.nonlinear][1][beyond.cell]
    asked = run.requirements[beyond.cell]
    return all(
        events.along(one.rows).log_exceedance(rooms[:, i]) <= gain * best.log_probability for i, one in enumerate(asked)
    )


def refined(
    run: LinearRun, best: Outcome, effort: int, target: Share, found: Callable[[Outcome], object] = lambda outcome: None
) -> Outcome:
    """A smaller probability, where the levels cost most of what was proved: with smaller and smaller shares."""
    above = best.log_probability - best.nonlinear.log
    if best.log_probability > target.log or above <= -3.0 or (above >= 2.0 and not run.curved):
        return best
    coupled = max((len(group[0]) for group in run.engine.model.blocks), default=1) > 1
    with afterwards():
        for _ in range(0 if coupled or len(run.engine.model.active) > _MANY else _REFINEMENTS):
            outcome = run.probability(Share(2 * best.nonlinear.log), effort)
            if outcome.log_probability >= best.log_probability:
                run.beyond = outcome
                break
            best = outcome
            found(best)
    return best
