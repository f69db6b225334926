"""The door: an upper bound of the probability that a continuous-time problem with several states fails."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.display import log10_text
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.quadratic.corners import Cells, Dynamics, curved_axes, grid
from certbound.quadratic.inequality import corner_levels, prove
from certbound.quadratic.mirror_images import Mirror, mirrors
from certbound.quadratic.setting import Setting, make_setting, refuse
from certbound.quadratic.wall_attempts import (
    APART,
    NOTHING,
    PAIRS,
    PIECES,
    SPLIT,
    Attempt,
    Option,
    groups,
    log10_up,
    log_sum,
    refuse_large,
    total,
)  # fmt: skip
from certbound.quadratic.wall_program import Proposal, StatedCells, propose
from certbound.quadratic.working_boxes import moved_sides, working_boxes
from certbound.watch import poll

_MOST_STATES = 12
_LOOSE, _LARGE = 0.1, 0.5  # remainders, in working boxes within the horizon: small; large enough to be made small
_SINGLE = 0.6  # of the time of a group's program that one wall's takes
_FIRST_SLABS, _FEWER_SLABS, _SMALL_DIMENSION = 8, 4, 4  # at first, up to so many states and beyond
_MOST_ENTRIES = 1.1e6  # of the matrix inequalities of a program
_GAIN = 0.03  # of a wall's logarithm: a refinement that gains less is not repeated
_DONE = 1e-3  # share of the bound that a wall may have without being looked at again
_LEAST = 1e-300
_MOVES, _WORTH = 2, 0.1  # how often the box's sides are moved, and what log10 must gain by it to go on
_SAME = 0.02  # of the logarithm: what a mirrored bound may lose
_HOPE, _SLABS = 0.3, 0.7  # of the logarithm: what pieces and windows, or slabs, gain where nothing is known
_AGAIN = 0.6  # of what a refinement gained: what it gains once more
_RESCUES = 2  # refinements of a wall that proves nothing, before the working box is given up
_HOPELESS = 8.0  # the logarithm of such a wall's bound beyond which they are not tried


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class QuadraticBound:
    """A certified upper bound of the probability of failing.

    Attributes
    ----------
    upper : float
        Its log10, for every start and every disturbance that does not see coming noise; 0 says nothing.
    words : str
        What was done.
    seconds : float
    setting : Setting or None
        Working box and walls.
    walls : tuple of Attempt
        What is proved at each wall, in one window of time or several that cover the horizon.
    search : Search or None
        What a later search of the same problem goes on from.
    """

    upper: float
    words: str
    seconds: float
    setting: Setting | None = None
    walls: tuple[Attempt, ...] = ()
    search: Search | None = None


def bound_quadratic(
    problem: Problem, *, target: float = 0.0, seconds: float = 20.0, before: QuadraticBound | None = None,
    found: Callable[[QuadraticBound], object] = lambda bound: None,
) -> QuadraticBound:
    """Bound P(failing within T) by Theorem K9: one time-varying quadratic value bound a wall of the safe set.

    Parameters
    ----------
    problem : Problem
        Continuous time; a smooth model; boxes, half-spaces, balls and obstacles for the whole horizon.
    target : float
        The refinement ends at a bound below this.
    seconds : float
        About what may be spent.
    before : QuadraticBound, optional
        Of the same problem: the search goes on from there.
    found : callable
        Takes each better bound while the search goes on (it stands where a watch ends the search).

    Returns
    -------
    QuadraticBound

    Raises
    ------
    InfeasibleError
        The theorem, or this implementation of it, does not apply; the message says why.
    EnclosureError
        The model is undefined somewhere in the working box.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1]], states=2, diffusion=[[0.1], [0.2]])
    >>> problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    >>> bound_quadratic(problem, target=1e-3, seconds=5).upper < -3
    True
    """
    n = problem.system.dimension
    if n > _MOST_STATES:
        raise InfeasibleError(f"quadratic value bounds serve at most {_MOST_STATES} states, the problem has {n}.")
    refuse(problem)
    quest = _Quest(problem, target, seconds, found)
    if before is not None and before.search is not None and before.search.worst < math.inf:  # else it had no time
        quest.best, quest.chosen = before, before.search
    return quest.run()


class _Quest:
    """Working boxes one after the other: sides by the spread of paths, then moved to where they cost little."""

    def __init__(
        self, problem: Problem, target: float, seconds: float, found: Callable[[QuadraticBound], object]
    ) -> None:
        self.problem, self.target, self.found = problem, target, found
        self.begin = time.perf_counter()
        self.until = self.begin + seconds
        self.best: QuadraticBound | None = None
        self.chosen: Search | None = None
        self.failure: InfeasibleError | None = None

    def run(self) -> QuadraticBound:
        seconds = self.until - self.begin
        for low, high in working_boxes(self.problem) if self.best is None else ():
            left = self.until - time.perf_counter()
            if self.best is not None and (left <= seconds / 2 or self.best.upper < 0):
                break
            self._try(low, high, left)
        if self.best is None or self.chosen is None:
            raise self.failure or InfeasibleError("no working box was found.")
        self._move()
        if self.best.upper > _log10(self.target) and self.chosen.worst <= _HOPELESS:
            self.chosen.run(self.target, self.until - time.perf_counter(), self._note)
        spent = time.perf_counter() - self.begin
        return replace(self.best, seconds=spent, search=self.chosen)

    def _try(self, low: Array, high: Array, share: float, *, together: bool = True) -> Search | None:
        """One pass over the walls of a working box; None where there can be none."""
        try:
            search = make_search(self.problem, low, high, together=together)
            refuse_large(search.attempts[:1], search.setting.dimension)
        except InfeasibleError as error:
            self.failure = error
            return None
        for bound in search.first(self.target, share):
            if self.best is None or bound.upper < self.best.upper:
                self.chosen = search
                self._note(bound)
        return search

    def _move(self) -> None:
        """Move the sides of the working box to where leaving there costs a part of the whole."""
        for _ in range(_MOVES):
            if self.best is None or self.chosen is None or not _log10(self.target) < self.best.upper < 0:
                return
            search, before, left = self.chosen, self.best.upper, self.until - time.perf_counter()
            box = moved_sides(self.problem, search.setting, *search.by_wall())
            if box is None or left < 1.1 * sum(attempt.seconds for attempt in search.attempts):
                return
            self._try(*box, left, together=False)
            if self.best.upper > before - _WORTH:
                return

    def _note(self, bound: QuadraticBound) -> None:
        if self.best is None or bound.upper < self.best.upper:
            self.best = bound
            if bound.upper < 0:
                self.found(bound)


def make_search(problem: Problem, low: Array, high: Array, *, together: bool = False) -> Search:
    """The search on the working box [low, high], its sides ``together`` at first; for errors see `bound_quadratic`."""
    setting, curved = make_setting(problem, low, high), curved_axes(problem)
    walls = tuple(replace(w, far=w.side is not None and w.side[0] not in curved) for w in setting.walls)
    return Search(problem, replace(setting, walls=walls), together=together)


class Search:
    """One working box: its walls, refined where the bound is made of."""

    def __init__(self, problem: Problem, setting: Setting, *, together: bool) -> None:
        self.setting, self.horizon = setting, float(problem.horizon)
        self.dynamics = Dynamics(problem, setting)
        self.kept: dict[tuple[object, ...], list[StatedCells]] = {}
        self.mirrors: dict[tuple[int, ...], list[Mirror]] = {}
        self.solved: dict[tuple[object, ...], Attempt] = {}
        self.gains: dict[int, float] = {}  # of pieces and windows, at the wall that was refined last
        slabs = self._first_slabs()
        whole = (0.0, self.horizon)
        self.attempts = [Attempt(wall=one[0], others=one[1:], slabs=slabs, during=whole)
                         for one in groups(setting.walls, together=together)]  # fmt: skip

    def _first_slabs(self) -> tuple[int, ...]:
        """Slabs that make a large remainder small, as far as a few do: without them many a bound is 1."""
        held, n = self.dynamics.held, self.setting.dimension
        slabs = [1] * len(held)
        least = self.dynamics.remainder(*grid(n, held, slabs))
        most = _FEWER_SLABS if n > _SMALL_DIMENSION else _FIRST_SLABS
        if least <= _LARGE:  # the walls by themselves gain more
            return tuple(slabs)
        while least > _LOOSE and math.prod(slabs) < most:
            trials = [[2 * count if k == axis else count for k, count in enumerate(slabs)] for axis in range(len(held))]
            values = [self.dynamics.remainder(*grid(n, held, trial)) for trial in trials]
            if not values or min(values) > 0.95 * least:
                break
            slabs, least = trials[int(np.argmin(values))], min(values)
        return tuple(slabs)

    def first(self, target: float, share: float) -> Iterator[QuadraticBound]:
        """Bound every wall once, then the sides by themselves; a wall that proves nothing, even refined, ends it."""
        until = time.perf_counter() + share
        for place, attempt in enumerate(self.attempts):
            poll(f"walls {place + 1} of {len(self.attempts)}")
            if time.perf_counter() > until:
                break
            self._solve(attempt, until)
            for _ in range(_RESCUES):
                hope = 0.0 <= self.attempts[place].found <= _HOPELESS
                if not (hope and self._refined(self._option(place, until), until)):
                    break
            if not self.attempts[place].level < 0:
                break
        level, parts = total(self.attempts)
        yield self._answer(level)
        place = len(self.attempts) - 1
        near = level < 0 or all(one.level < 0 for one in self.attempts)  # with the sides apart the sum may be below 1
        unsettled = near and level / math.log(10) > _log10(target) and self.attempts[place].others
        large = parts[place] >= level + math.log(_DONE)
        if unsettled and large and self._refined(self._option(place, until), until):
            yield self._answer(total(self.attempts)[0])

    @property
    def worst(self) -> float:
        """The largest logarithm at a wall, above 0 too; infinite where one has none."""
        return max((attempt.found for attempt in self.attempts), default=0.0)

    def run(self, target: float, share: float, found: Callable[[QuadraticBound], object]) -> None:
        """Refine the wall that counts most until the target or the time is reached; each better bound is told."""
        until = time.perf_counter() + share
        while True:
            level, parts = total(self.attempts)
            found(self._answer(level))
            if level / math.log(10) <= _log10(target) or time.perf_counter() > until:
                return
            places = np.flatnonzero(parts >= level + math.log(_DONE)).tolist()
            options = (self._option(place, until) for place in places)
            if not self._refined(max(options, key=lambda one: one.worth(parts), default=NOTHING), until):
                return

    def by_wall(self) -> tuple[Array, float]:
        """The logarithm of every wall's bound, and of their sum."""
        levels = [[one.level for one in self.attempts if w in (one.wall, *one.others)] for w in self.setting.walls]
        return np.array([log_sum(one) for one in levels]), log_sum([one.level for one in self.attempts])

    def _answer(self, level: float) -> QuadraticBound:
        finest = max(self.attempts, key=lambda attempt: attempt.blocks, default=None)
        where = "" if finest is None else f", up to {len(finest.times[0]) - 1} pieces of time"
        slabs = "" if finest is None or math.prod(finest.slabs) == 1 else f" and {math.prod(finest.slabs)} slabs"
        words = f"quadratic value bounds of {len(self.setting.walls)} walls{where}{slabs}"
        if self.attempts:
            levels, _ = self.by_wall()
            worst = int(np.argmax(levels))
            part = log10_text(min(log10_up(float(levels[worst])), 0.0))
            words += f"; the largest part is {part} for '{self.setting.name_of(self.setting.walls[worst])}'"
        return QuadraticBound(upper=log10_up(level), words=words, seconds=0.0, setting=self.setting,
                              walls=tuple(self.attempts))  # fmt: skip

    def _option(self, place: int, until: float) -> Option:
        """The refinement of an attempt that promises most for its time."""
        attempt = self.attempts[place]
        hopes = {PIECES: _HOPE, SPLIT: _HOPE} | self._slabs(attempt)
        if not attempt.level < 0:  # windows are no cure, and pieces seldom
            hopes = {PIECES: _HOPE / 3} | self._slabs(attempt)
        left, found, entries = until - time.perf_counter(), [], math.comb(self.setting.dimension + 2, 2)
        if attempt.others and attempt.gains.get(APART, math.inf) > 0:
            many = _SINGLE * len(attempt.finer(APART)) * attempt.seconds
            hopes = {APART if many < left or not attempt.paired else PAIRS: 1.0}
        for kind, hope in hopes.items():
            blocks = sum(child.blocks for child in attempt.finer(kind))
            seconds = (_SINGLE if kind in (APART, PAIRS) else 1.3) * blocks / attempt.blocks * attempt.seconds
            gain = _AGAIN * attempt.gains[kind] if kind in attempt.gains else self.gains.get(kind, hope)
            if gain > _GAIN and blocks * entries <= _MOST_ENTRIES and seconds < left:
                found.append(Option(int(place), kind, gain, max(seconds, 1e-3)))
        return max(found, key=lambda option: option.gain / option.seconds, default=NOTHING)

    def _refined(self, option: Option, until: float) -> bool:
        """Refine an attempt and its mirror images; False where there is no option."""
        if option.place < 0:
            return False
        attempt = self.attempts[option.place]
        poll(f"refining {attempt.wall.label}")
        self._adopt(attempt, option.kind, until)
        for image in [one for one in self.attempts if any(twin is attempt for _, twin in self._twins(one))]:
            self._adopt(image, option.kind, until)
        return True

    def _slabs(self, attempt: Attempt) -> dict[int, float]:
        """What slabs of each held coordinate may gain: those of the wall's own, and that bend its drift, most."""
        side, held = attempt.wall.side, self.dynamics.held
        near = set() if side is None or attempt.others else {side[0], *self.dynamics.bending(side[0])}
        known = near & set(held)
        return {k: _SLABS if axis in near or not known else _SLABS / 8 for k, axis in enumerate(held)}

    def _adopt(self, attempt: Attempt, option: int, until: float) -> None:
        """Refine an attempt; it stays if that gains nothing."""
        children = attempt.finer(option)
        for child in children:
            self._solve(child, until)
        gain = max(attempt.level - log_sum([child.level for child in children]), 0.0)
        if gain == attempt.level == 0 and len(children) == 1 and children[0].found < math.inf:
            gain = max(attempt.found - children[0].found, 0.0)
        if option < 0 and option not in attempt.gains:  # which coordinate's slabs help differs from wall to wall
            self.gains[option] = gain
        attempt.gains[option] = gain
        if gain > 0:
            for child in children:
                child.gains = dict(attempt.gains)
            place = next(k for k, one in enumerate(self.attempts) if one is attempt)
            self.attempts[place : place + 1] = children

    def cells(self, times: Array, slabs: tuple[int, ...]) -> list[StatedCells]:
        """The cells of every piece of time."""
        pieces = len(times) - 1
        key = slabs if self.dynamics.autonomous else (*slabs, times.tobytes())
        if key not in self.kept:
            low, high = grid(self.setting.dimension, self.dynamics.held, slabs)
            spans = [(0.0, self.horizon)] if self.dynamics.autonomous else list(itertools.pairwise(times))
            cells = [self.dynamics.over(low, high, *span) for span in spans]
            self.kept[key] = [StatedCells(self.setting, one) for one in cells]
        found = self.kept[key]
        return found * pieces if self.dynamics.autonomous else found

    def _solve(self, attempt: Attempt, until: float) -> None:
        """Solve and prove what is to be tried."""
        begin = time.perf_counter()
        times, first = attempt.times
        cells = self.cells(times, attempt.slabs)
        if not self._mirrored(attempt, cells):
            left = max(until - begin, 1.0)
            others = attempt.others
            proposal = propose(self.setting, attempt.wall, times, cells, seconds=left, first=first, others=others)
            if proposal is not None:
                self._prove(attempt, proposal, cells)
            attempt.seconds = time.perf_counter() - begin
        self.solved[attempt.key] = attempt

    def _prove(self, attempt: Attempt, proposal: Proposal, cells: Sequence[StatedCells]) -> None:
        attempt.proved = prove(self.setting, attempt.wall, proposal, [c.cells for c in cells], others=attempt.others)
        attempt.corners = corner_levels(self.setting, attempt.proved)

    def _mirrored(self, attempt: Attempt, cells: Sequence[StatedCells]) -> bool:
        """Whether the mirror image of what was found for other walls proves about the same here."""
        self._mirrors(attempt.slabs, cells[0].cells)
        for mirror, twin in self._twins(attempt):
            if twin.proved is not None:
                self._prove(attempt, mirror.of(twin.proved.proposal), cells)
                if attempt.level <= twin.level + _SAME:
                    attempt.seconds = twin.seconds
                    return True
        return False

    def _twins(self, attempt: Attempt) -> list[tuple[Mirror, Attempt]]:
        """The first of the same attempts at walls that are mapped to these, with the mirror."""
        walls, (_, *rest) = (attempt.wall, *attempt.others), attempt.key
        for mirror in self.mirrors.get(attempt.slabs, ()):
            images = tuple(id(mirror.wall(wall, self.setting.walls)) for wall in walls)
            if (images, *rest) in self.solved:
                return [(mirror, self.solved[(images, *rest)])]
        return []

    def _mirrors(self, slabs: tuple[int, ...], cells: Cells) -> None:
        if slabs not in self.mirrors:
            self.mirrors[slabs] = mirrors(self.setting, cells)


def _log10(target: float) -> float:
    return math.log10(max(target, _LEAST))
