"""What the linear response proved: a probability, what stands in the way of a smaller one, and its tubes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.display import log10_text
from certbound.errors import EngineError
from certbound.gaussian.response import logsumexp
from certbound.problem.systems import ContinuousSystem
from certbound.reach.linear import answer_tubes
from certbound.reach.linear.answer_tubes import DeviationTube
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.nominal import Cells, Curve
from certbound.reach.sets import ReachTube, Requirement
from certbound.rigor.intervals import Interval

_LITTLE = 3.0  # natural logarithm, by which parts of a probability are less than what was set aside


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
    def impossible(self) -> bool:
        """Whether the probability is 0, or too small to be told from it."""
        return bool(self.outcome.log_probability / np.log(10.0) <= answer_tubes.LEAST)

    @property
    def engine(self) -> Linearisation:
        """The linearisation of all cells, which certificates start from."""
        return self.run.engine

    @property
    def exact(self) -> bool:
        """Whether the model is linear and its noise Gaussian: only the union over constraints and times is lost."""
        system = self.run.engine.system
        return not self.run.curved and (
            isinstance(system, ContinuousSystem) or bool(system.noise.gaussian)
        )

    @property
    def by_limit(self) -> dict[tuple[int, int], float] | None:
        """log10 of bounds of P(a path leaves first through a limit), by the numbers of constraint and limit.

        A path that leaves through a limit meets what the events share, or one of the limit's own: the sum of these.
        None where they are not known one by one: with several cells of the start, or where nothing was proved.
        """
        outcome, asked = self.outcome, self.run.requirements[self.outcome.cell]
        if self.run.engine.cells > 1 or outcome.bounds is None or len(outcome.logs) != len(asked):
            return None
        places: dict[tuple[int, int], list[int]] = {}
        for place, requirement in enumerate(asked):
            places.setdefault((requirement.constraint, requirement.limit), []).append(place)
        return {limit: self._cost_of(own) for limit, own in places.items()}

    def _cost_of(self, places: list[int]) -> float:
        """log10 of what some requirements cost together."""
        outcome = self.outcome
        log = logsumexp(np.array([outcome.shared, *(outcome.logs[place] for place in places)]))
        if outcome.unshared:
            log = min(log, logsumexp(np.array([outcome.unshared[place] for place in places])))
        value = max(float(log / np.log(10.0)), answer_tubes.LEAST)  # minus infinity where nothing can leave
        return max(value + 1e-14 * (1 + abs(value)), answer_tubes.LEAST)

    @cached_property
    def _tightest(self) -> tuple[Requirement | None, int, float]:
        return self.run.tightest(self.shown)

    @cached_property
    def rooms(self) -> list[tuple[Requirement, Array]]:
        """Every requirement with the room that the problem's delta leaves of it on each piece; ``margin`` is the least.

        Each is measured along its own direction; empty where nothing was bounded.
        """
        if self.shown.bounds is None:
            return []
        own, asked = self.engine.lasting, self.run.requirements[self.shown.cell]
        shown = [replace(one, rows=one.rows[own, : self.engine.states], room=one.room[own]) for one in asked]
        return list(zip(shown, self.run.left(self.shown)[own].T))

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
        return float(self.run.engine.times[self._tightest[1]])

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
            split = "split the initial set (cells), " if np.any(self.run.engine.radii[0]) else ""
            return f"{what} from t = {self.time:.4g} on; {split}shorten the horizon or lower the noise"
        if self.margin == -np.inf:
            return f"no bound of the deviation was found that the room of '{self.constraint}' could be compared with"
        asked, logs = self.run.requirements[self.outcome.cell], self.outcome.logs
        if not asked or len(logs) != len(asked) or self.log10_delta >= 0:
            return f"the noise takes more than the room of '{self.constraint}' at t = {self.time:.4g}"
        if self.impossible:
            return f"no noise that there can be takes all the room of '{self.constraint}', where it is least"
        worst = int(np.argmax(logs))
        part = f"{log10_text(min(logs[worst] / np.log(10.0), 0.0))} for '{asked[worst].label}'"
        left = log10_text(min(self.outcome.nonlinear.log / np.log(10.0), 0.0))
        if self.run.curved and logs[worst] < self.outcome.nonlinear.log - _LITTLE:
            return (
                "nearly all of that probability is the share of delta set aside for the remainder of the "
                f"linearisation, which holds; the largest part beside it is {part}. `smallest=True` goes on to less"
            )
        rest = f", and {left} is spent on bounding the remainder of the linearisation" if self.run.curved else ""
        return f"the largest part of that probability is {part}{rest}"

    @cached_property
    def tube(self) -> DeviationTube | None:
        """Deviation tube at the problem's delta (None when nothing was proved)."""
        bounds = self.shown.bounds
        return None if bounds is None else answer_tubes.deviation_tube(self.run, self.shown, bounds)

    def shown_values(self) -> dict[str, Any]:
        """What verdicts show of an answer, by name, for `knowing`."""
        return {name: getattr(self, name) for name in ("_tightest", "tube", "noise_free_reach")}

    def knowing(self, values: dict[str, Any]) -> LinearAnswer:
        """The same answer with values that were computed where it was proved."""
        vars(self).update(values)
        return self

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
        if self.shown.bounds is None:
            return None
        levels, log_probability = answer_tubes.levels_of_coordinates(self.run, self.shown)
        log10 = answer_tubes.log10_up(log_probability)
        return answer_tubes.reach_tube(self.run, self.shown.bounds, log10, levels)

    @cached_property
    def noise_free_reach(self) -> ReachTube | None:
        """Sets that contain every associated trajectory (its remainder lies in the noisy one's set)."""
        bounds = self.shown.bounds
        return None if bounds is None else answer_tubes.reach_tube(self.run, bounds, -np.inf, None)


Path = tuple[tuple[int, bool], ...]
"""Halvings of the initial set: along which side, and whether the upper half is kept."""


def _cover(paths: list[Path]) -> bool:
    """Whether these are the leaves of one tree of halvings."""
    if () in paths:
        return len(paths) == 1
    halves = [[path[1:] for path in paths if path[0][1] == upper] for upper in (False, True)]
    return len({path[0][0] for path in paths}) == 1 and all(map(_cover, halves))


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitAnswer(LinearAnswer):
    """Answers for the cells of the initial set, each with a run of its own: the worst one is the answer.

    ``run``, ``outcome`` and ``shown`` are the worst cell's; ``paths`` the halvings that made the cells, in order, and
    ``low``, ``high`` (B, n) their boxes.
    """

    parts: tuple[LinearAnswer, ...]
    paths: tuple[Path, ...]
    low: Array
    high: Array

    @property
    def by_limit(self) -> None:
        """The worst cell for one limit need not be that for another."""
        return None

    @classmethod
    def of(cls, cells: list[tuple[Path, Array, Array, LinearAnswer]]) -> SplitAnswer:
        """Of the cells' paths, ends and answers, sorted by path.

        Raises
        ------
        EngineError
            A part of the initial set lies in no cell: whatever interrupted the search, nothing is proved of that.
        """
        if not _cover([path for path, _, _, _ in cells]):
            raise EngineError("the cells of the initial set do not cover it.")
        parts = tuple(part for _, _, _, part in cells)
        worst = max(parts, key=lambda part: part.outcome.log_probability)
        return cls(
            run=worst.run, outcome=worst.outcome, shown=worst.shown, parts=parts,
            paths=tuple(path for path, _, _, _ in cells), low=np.array([low for _, low, _, _ in cells]),
            high=np.array([high for _, _, high, _ in cells]),
        )

    @cached_property
    def engine(self) -> Linearisation:
        """All cells as one linearisation, with the slopes that were fitted to each."""
        own = [part.run.engine for part in self.parts]
        cells = Cells(centres=np.concatenate([e.centres for e in own]), boxes=Interval(self.low, self.high))
        whole = Linearisation(own[0].problem, cells=cells, pieces=own[0].pieces if own[0].continuous else None)
        shape = (1, own[0].pieces + 1, own[0].n, own[0].n)
        given = [np.zeros(shape) if e.correction is None else e.correction for e in own]
        return whole.corrected(np.concatenate(given))

    @cached_property
    def _tightest(self) -> tuple[Requirement | None, int, float]:
        return min((part._tightest for part in self.parts), key=lambda found: found[2])

    @cached_property
    def rooms(self) -> list[tuple[Requirement, Array]]:
        """The least over the cells; see `LinearAnswer.rooms`."""
        found = [part.rooms for part in self.parts]
        if not all(found):
            return []
        return [(same[0][0], np.min([room for _, room in same], axis=0)) for same in zip(*found)]

    @cached_property
    def tube(self) -> DeviationTube | None:
        """Deviation tube at the problem's delta, over all cells."""
        tubes = [part.tube for part in self.parts]
        found = [tube for tube in tubes if tube is not None]
        if len(found) < len(tubes):
            return None
        return DeviationTube(
            times=found[0].times, half_widths=np.max([tube.half_widths for tube in found], axis=0),
            log10_delta=max(tube.log10_delta for tube in found),
        )

    def extent_along(self, direction: ArrayLike) -> Array:
        """The largest one over the cells; see `LinearAnswer.extent_along`."""
        return np.asarray(np.max([part.extent_along(direction) for part in self.parts], axis=0))

    @cached_property
    def reach(self) -> ReachTube | None:
        """Sets that contain the state with probability at least 1 - delta, from every cell."""
        return _joined([part.reach for part in self.parts])

    @cached_property
    def noise_free_reach(self) -> ReachTube | None:
        """Sets that contain every associated trajectory, from every cell."""
        return _joined([part.noise_free_reach for part in self.parts])


def _joined(tubes: list[ReachTube | None]) -> ReachTube | None:
    """The union of tubes of single cells over the same pieces; None where one is missing."""
    found = [tube for tube in tubes if tube is not None]
    boxes = [tube.box for tube in found if tube.box is not None]
    if len(boxes) < len(tubes):
        return None
    first = found[0].curve
    curve = Curve(
        continuous=first.continuous, starts=first.starts, ends=first.ends,
        coefficients=np.concatenate([tube.curve.coefficients for tube in found]),
    )
    box = Interval(np.concatenate([box.lo for box in boxes]), np.concatenate([box.hi for box in boxes]))
    return ReachTube(
        curve=curve, box=box, noise=found[0].noise, log10_delta=max(tube.log10_delta for tube in found),
        method="linear",
    )
